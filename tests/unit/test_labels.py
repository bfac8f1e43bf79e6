"""Tests of labels: names, indices, parts and their dropout in training."""

import pyarrow as pa
import pytest
import torch

from models.dit import DiT
from models.labels import (
    LABELS,
    PART_DROPOUT,
    compose_label,
    find_label_index,
    list_dropped_labels,
    list_usual_labels,
    split_label,
)
from models.training import make_diffusion_loss
from pipelines.training.data_loader import label_indices


@pytest.mark.parametrize("kind", LABELS)
def test_labels_are_composed_from_their_parts(kind):
    for index, name in enumerate(LABELS[kind]):
        free = name.endswith("-free")
        assert find_label_index(kind, name) == index
        assert compose_label(kind, *split_label(kind, name), free) == name
    assert set(list_usual_labels(kind)) <= set(LABELS[kind])


def test_partial_labels_cover_all_combinations():
    names = LABELS["partial"]
    assert len(names) == len(set(names)) == 2 * 4 * 4
    assert compose_label("partial", None, "low") == "any-low"
    assert compose_label("partial", "high", None, free_pose=True) == "high-any-free"
    assert split_label("partial", "any-any-free") == (None, None)
    assert list_usual_labels("partial") == LABELS["joint"]


def test_half_a_label_is_an_error():
    expected = r"label 'high' is unknown to a partial model.*such as 'low-high'.*'any' if it is left open"
    with pytest.raises(ValueError, match=expected):
        find_label_index("partial", "high")
    with pytest.raises(ValueError, match="such as 'medium-medium-free'"):
        find_label_index("partial", "medium-medium-fre")


def test_dropped_labels_keep_the_pose():
    names, rows = LABELS["partial"], list_dropped_labels("partial")
    assert rows is not None and list_dropped_labels("joint") is None
    found = [names[k] for k in rows[names.index("low-high-free")]]
    assert found == ["low-high-free", "any-high-free", "low-any-free", "any-any-free"]
    assert all(names[rows[k][3]].startswith("any-any") for k in range(len(names)))


def test_training_drops_each_part_at_its_rate():
    dit = DiT(channels=2, size=4, width=16, depth=1, heads=2, label="partial", num_labels=32)
    loss = make_diffusion_loss(dit, label_dropout=0.1)
    seen = []

    def model(latent, timestep, label):
        seen.append(label)
        return torch.zeros_like(latent)

    count, start = 4000, LABELS["partial"].index("medium-high-free")
    latents = torch.zeros(count, 2, 4, 4)
    arrays = {"mean": latents, "logvar": latents, "label": torch.full((count,), start)}
    loss(model, arrays, [torch.Generator().manual_seed(k) for k in range(count)])
    share = torch.bincount(seen[0], minlength=33) / count
    assert share[dit.null_label] == pytest.approx(0.1, abs=0.02)
    kept, both = 0.9 * (1 - PART_DROPOUT) ** 2, 0.9 * PART_DROPOUT**2
    names = ("medium-high-free", "any-any-free", "any-high-free", "medium-any-free")
    for name, expected in zip(names, (kept, both, *[(0.9 - kept - both) / 2] * 2), strict=True):
        assert share[LABELS["partial"].index(name)] == pytest.approx(expected, abs=0.025)


def test_labels_are_read_from_scenes_table():
    columns = {
        "vegetation_density": ["low", None, "high"],
        "vehicle_density": ["high", "medium", None],
        "free_pose": [False, True, True],
    }
    found = label_indices(pa.table(columns), "partial")
    assert [LABELS["partial"][k] for k in found] == ["low-high", "any-medium-free", "high-any-free"]
    with pytest.raises(ValueError, match="label 'None' is unknown to a vegetation model"):
        label_indices(pa.table(columns), "vegetation")
