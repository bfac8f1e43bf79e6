"""Tests of jobs/evaluate_scenes.py --protocol on small data; the protocols' numbers are reduced."""

import json
from dataclasses import replace

import numpy as np
import pytest
import safetensors.numpy
from golden.golden_recipe import random_state_dict

from jobs.evaluate_scenes import Config
from jobs.implementation.evaluate_scenes import evaluate
from jobs.implementation.protocols import PROTOCOLS
from pipelines.evaluation.features import load_scenes
from pipelines.metrics.adm_npz import write_npz
from pipelines.metrics.vgg16 import VGG16
from pipelines.rendering.render import render_bev
from pipelines.reporting.evaluation_report import list_headlines
from pipelines.schema.dataset import Dataset
from pipelines.schema.scene_subset import SceneSubset

SMALL = 8


@pytest.fixture
def data(smoke, monkeypatch) -> str:
    values = dict(PROTOCOLS["paper-pr"].values) | {"max_scenes": SMALL}
    small = replace(PROTOCOLS["paper-pr"], values=values, num_generated=SMALL)
    monkeypatch.setitem(PROTOCOLS, "paper-pr", small)
    return str(smoke / "datasets/smoke")


def render_scenes(data: str, count: int) -> np.ndarray:
    """Pictures of training scenes, the same again if there are too few."""
    chosen = SceneSubset(data, "town", "train")
    total = sum(len(rows) for _, rows in chosen.shards())
    return np.stack([render_bev(scene) for scene in load_scenes(chosen.shards(), np.arange(count) % total)])


def count_training_scenes(data: str) -> int:
    return sum(len(rows) for _, rows in SceneSubset(data, "town", "train").shards())


def test_paper_pr_compares_exact_numbers_with_a_ceiling(data, tmp_path):
    base = Config(real=data, generated=data, protocol="paper-pr", lite0=False, num_actors=1)
    found = evaluate(replace(base, generated_split="test", output=str(tmp_path / "a")))["generation"]
    assert found["scenes"] == {"real": SMALL, "generated": SMALL} and found["protocol"] == "paper-pr"
    assert {"random_precision_k3", "random_recall_k3"} <= found.keys()
    assert "ceiling" in found["sets"] and "nearest_distance_random" in found and "memorisation" not in found
    assert any(name.startswith("nearest_distance_random.") for name, _ in list_headlines(found))
    page = (tmp_path / "a/evaluation.html").read_text()
    assert "Protocol: paper-pr" in page and "farthest point sampling" in page and "nearest_distance_random" in page
    write_npz(str(tmp_path / "few.npz"), [render_scenes(data, 3)], 3)
    with pytest.raises(ValueError, match=rf"paper-pr needs {SMALL} generated scenes, but .*few\.npz has 3"):
        evaluate(replace(base, generated=str(tmp_path / "few.npz"), output=str(tmp_path / "b")))


@pytest.mark.slow
def test_paper_fid_streams_all_training_scenes(data, tmp_path):
    total = count_training_scenes(data)
    write_npz(str(tmp_path / "few.npz"), [render_scenes(data, total - 1)], total - 1)
    write_npz(str(tmp_path / "many.npz"), [render_scenes(data, total + 2)], total + 2)
    base = Config(real=data, generated=str(tmp_path / "many.npz"), protocol="paper-fid", lite0=False, num_actors=1)
    with pytest.raises(ValueError, match=rf"needs {total} generated scenes, but .*few\.npz has {total - 1}"):
        evaluate(replace(base, generated=str(tmp_path / "few.npz"), output=str(tmp_path / "a")))
    evaluate(replace(base, output=str(tmp_path / "b")))
    written = json.loads((tmp_path / "b/metrics.json").read_text())["generation"]
    assert written["scenes"] == {"real": total, "generated": total} and written["protocol"] == "paper-fid"
    assert written["random_frechet"]["value"] == pytest.approx(0, abs=1e-3)  # the same scenes
    assert not {"layout_frechet", "random_precision_k3", "validity", "nearest_distance_random", "sets"} & set(written)
    assert "There is no ceiling" in (tmp_path / "b/evaluation.html").read_text()
    with pytest.raises(ValueError, match=rf"--controls with --protocol paper-fid needs {total} other real scenes"):
        evaluate(replace(base, controls=True, output=str(tmp_path / "c")))


@pytest.mark.slow  # Describes all scenes with VGG16.
def test_paper_nearest_computes_only_distances_of_vgg16(data, tmp_path, monkeypatch):
    """All generated pictures are copies of training scenes; the test split is not used."""
    weights = str(tmp_path / "vgg16.safetensors")
    shapes = {name: value.shape for name, value in VGG16().state_dict().items()}
    safetensors.numpy.save_file(random_state_dict(shapes), weights)
    values = dict(PROTOCOLS["paper-nearest"].values) | {"max_scenes": 32}
    small = replace(PROTOCOLS["paper-nearest"], values=values, num_generated=4)
    monkeypatch.setitem(PROTOCOLS, "paper-nearest", small)
    write_npz(str(tmp_path / "same.npz"), [render_scenes(data, 32)[[0, 1, 2, 3]]], 4)
    base = Config(real=data, generated=str(tmp_path / "same.npz"), protocol="paper-nearest", num_actors=1)
    with pytest.raises(ValueError, match="--protocol paper-nearest needs VGG16 weights; add --vgg16 FILE"):
        evaluate(replace(base, output=str(tmp_path / "a")))
    with pytest.raises(ValueError, match="--controls True conflicts with --protocol paper-nearest"):
        evaluate(replace(base, vgg16=weights, controls=True, output=str(tmp_path / "a")))
    found = evaluate(replace(base, vgg16=weights, output=str(tmp_path / "a")))["generation"]
    assert set(found) == {"scenes", "memorisation", "protocol"} and found["scenes"] == {"real": 32, "generated": 4}
    assert found["memorisation"]["real"]["mean"]["value"] > 0 and found["memorisation"]["copies"]["value"] == 1
    assert "supplement G" in (tmp_path / "a/evaluation.html").read_text()


@pytest.mark.slow
def test_pdd_drops_and_counts_blank_pictures(data, tmp_path):
    pictures = render_scenes(data, 9)
    pictures[2] = 255
    pictures[4, 10, 10] = 0
    pictures[7, 0, 0] = 0
    write_npz(str(tmp_path / "samples.npz"), [pictures], 9)
    base = Config(real=data, generated=str(tmp_path / "samples.npz"), protocol="pdd", lite0=False, num_actors=1)
    found = evaluate(replace(base, reference="min-distance", output=str(tmp_path / "a")))["generation"]
    assert found["dropped"]["generated"] == 3 and found["dropped"]["real"] == 0
    apart = SceneSubset(data, Dataset.open(data).source, "train", None, "apart", 10.0)
    assert found["scenes"] == {"real": sum(len(rows) for _, rows in apart.shards()), "generated": 6}
    page = (tmp_path / "a/evaluation.html").read_text()
    assert "Protocol: pdd" in page and "3 of 9 (generated)" in page
    white = np.full((4, 256, 256, 3), 255, np.uint8)
    write_npz(str(tmp_path / "white.npz"), [white], 4)
    with pytest.raises(ValueError, match=r"drops 4 of 4 pictures of .*white\.npz \(generated\)"):
        evaluate(replace(base, generated=str(tmp_path / "white.npz"), output=str(tmp_path / "b")))
