"""Tests that compare the split of the paper (supplement A) with a literal implementation and with all distances."""

import logging

import numpy as np
import pytest

from pipelines.schema.splits import count_segments, make_no_split, split_poses


def draw_drive(rng: np.random.Generator, length_m: float, start_m: np.ndarray) -> np.ndarray:
    """Return positions (p, 3) every 0.3 to 1.1 m along a smooth random path."""
    step_m = rng.uniform(0.3, 1.1, int(length_m / 0.7))
    yaw = np.cumsum(rng.normal(0, 0.03, len(step_m)))
    steps = np.stack([np.cos(yaw), np.sin(yaw), 0.01 * np.sin(yaw)], axis=1) * step_m[:, None]
    return start_m + np.cumsum(steps, axis=0)


def split_literally(positions_by_sequence: dict[str, np.ndarray]) -> dict[str, list[str]]:
    """Compute the split as in the supplement, pose by pose."""
    driven, label = 0.0, {}
    for sequence, positions in positions_by_sequence.items():
        for k in range(len(positions)):
            driven += np.linalg.norm(positions[k] - positions[k - 1]) if k else 0.0
            label[sequence, k] = driven
    length = driven / max(1, min(100, int(driven / 50)))
    for key, at in label.items():
        left = length - at % length if at < driven else 0.0
        label[key] = "train" if left > 25 else "unused" if left > 20 else "test" if left > 5 else "unused"
    where = {key: positions_by_sequence[key[0]][key[1]][:2] for key in label}
    sides = {s: np.array([where[k] for k in label if label[k] == s]).reshape(-1, 2) for s in ("train", "test")}
    other = {"train": "test", "test": "train"}
    close = [
        key
        for key in label
        if label[key] != "unused" and np.linalg.norm(sides[other[label[key]]] - where[key], axis=1).min() <= 5
    ]
    for key in close:
        label[key] = "unused"
    return {s: [label[s, k] for k in range(len(p))] for s, p in positions_by_sequence.items()}


def test_split_equals_literal_supplement():
    rng = np.random.default_rng(0)
    drives = {
        "0000": draw_drive(rng, 900, np.array([0.0, 0, 100])),
        "0002": draw_drive(rng, 400, np.array([50.0, 20, 100])),  # this drive crosses drive 0000
        "0003": draw_drive(rng, 700, np.array([3000.0, 0, 90])),
    }
    split = split_poses(drives)
    assert {s: label.tolist() for s, label in split.items()} == split_literally(drives)


def test_split_keeps_train_poses_5_m_from_test_poses():
    there = np.column_stack([np.arange(0, 3000, 0.8), np.zeros(3750), np.zeros(3750)])
    back = there[:1500:-1] + np.array([0.3, 3.5, 0.0])
    split = split_poses({"0000": np.concatenate([there, back])})["0000"]
    positions = np.concatenate([there, back])[:, :2]
    train, test = positions[split == "train"], positions[split == "test"]
    assert len(train) and len(test)
    assert np.linalg.norm(train[:, None] - test[None], axis=2).min() > 5


def test_split_of_straight_drive_has_100_test_regions_of_15_m():
    positions = np.column_stack([np.arange(0, 20_000.0), np.zeros(20_000), np.zeros(20_000)])
    split = split_poses({"0000": positions})["0000"]
    starts = np.flatnonzero((split[1:] == "test") & (split[:-1] != "test"))
    assert len(starts) == 100
    assert abs((split == "test").sum() - 1500) <= 100
    # Each segment of 200 m has 10 m without a split: the last 5 m, and 5 m before the test region.
    # A few more poses have no split because they are less than 5 m from the other split.
    assert abs((split == "unused").sum() - 1000) <= 200


def test_split_ignores_jump_between_sequences():
    drive = np.column_stack([np.arange(0, 1000.0), np.zeros(1000), np.zeros(1000)])
    near = split_poses({"a": drive, "b": drive + np.array([1010, 0, 0])})
    far = split_poses({"a": drive, "b": drive + np.array([90_000, 0, 0])})
    assert all((near[s] == far[s]).all() for s in "ab")


def test_split_keeps_waiting_car_in_its_segment():
    drive = np.repeat(np.column_stack([np.arange(0, 100.0), np.zeros(100), np.zeros(100)]), 3, axis=0)
    split = split_poses({"0000": drive})["0000"].reshape(100, 3)
    assert (split == split[:, :1]).all()


@pytest.mark.parametrize(("total_m", "count"), [(10, 1), (99, 1), (100, 2), (320, 6), (5000, 100), (73_700, 100)])
def test_split_of_short_drive_has_fewer_segments_and_warns(total_m, count, caplog):
    with caplog.at_level(logging.WARNING):
        assert count_segments(total_m) == count
    assert ("instead of the paper's 100" in caplog.text) == (count < 100)
    assert ("no training pose remains" in caplog.text) == (total_m < 25)


def test_no_split_uses_all_poses_for_training():
    split = make_no_split({"a": np.zeros((3, 3)), "b": np.zeros((0, 3))})
    assert split["a"].tolist() == ["train"] * 3
    assert split["b"].tolist() == []


@pytest.mark.parametrize(
    "positions", [np.zeros((0, 3)), np.zeros((1, 3)), np.zeros((5, 3)), np.array([[0, 0, 0], [1e4, 0, 0.0]])]
)
def test_split_labels_degenerate_drives(positions):
    split = split_poses({"a": positions, "b": np.zeros((0, 3))})
    assert len(split["a"]) == len(positions) and len(split["b"]) == 0


@pytest.mark.parametrize("positions", [np.zeros((4, 2)), np.zeros(3), np.full((2, 3), np.nan)])
def test_split_rejects_invalid_positions(positions):
    with pytest.raises(ValueError, match="sequence 0007"):
        split_poses({"0007": positions})
