"""jobs/evaluate_scenes.py with Inception weights (random ones) and with pictures instead of tables."""

import json
from contextlib import suppress

import numpy as np
import pytest
import safetensors.numpy
from golden_recipe import random_state_dict

from jobs.evaluate_scenes import Config
from jobs.implementation.evaluate_scenes import evaluate
from pipelines.evaluation.evaluate import compare, memorisation
from pipelines.evaluation.features import Looks, chosen_scenes, describe
from pipelines.metrics.adm_npz import write_npz
from pipelines.metrics.inception import Inception
from pipelines.metrics.intervals import Estimate
from pipelines.rendering.render import bev_picture
from pipelines.schema.dataset import Dataset
from pipelines.schema.scene_subset import Selection

SAMPLES = 5  # of a network that takes a second per picture


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("weights") / "random.safetensors"
    shapes = {name: value.shape for name, value in Inception().state_dict().items()}
    safetensors.numpy.save_file(random_state_dict(shapes), path)
    return str(path)


def test_tables_and_their_pictures_score_the_same(smoke, weights, tmp_path):
    """Real training scenes against real test scenes: once as tables, once as ADM's .npz of their pictures."""
    data = str(smoke / "datasets/smoke")
    test = chosen_scenes(Selection(data, "town", "test", SAMPLES).shards(), np.arange(SAMPLES))
    write_npz(str(tmp_path / "test.npz"), (np.stack([bev_picture(scene)]) for scene in test), SAMPLES)
    options = {"real": data, "max_scenes": SAMPLES, "inception": weights, "k": (1, 3), "num_actors": 1}
    as_tables = evaluate(
        Config(generated=data, generated_split="test", balance_labels=False, output=str(tmp_path / "tables"), **options)
    )["generation"]
    as_pictures = evaluate(Config(generated=str(tmp_path / "test.npz"), output=str(tmp_path / "npz"), **options))[
        "generation"
    ]
    assert as_tables["scenes"] == as_pictures["scenes"] == {"real": SAMPLES, "generated": SAMPLES}
    for name in ("fid", "sfid", "kid", "inception_score", "precision_k1", "recall_k3", "density_k3", "coverage_k1"):
        assert as_pictures[name]["value"] == pytest.approx(as_tables[name]["value"], rel=1e-5), name  # batches round
        assert as_tables[name]["low"] <= as_tables[name]["high"]
    assert as_tables["fid"]["value"] > 0 and as_tables["inception_score"]["value"] >= 1
    assert "validity" in as_tables and "validity" not in as_pictures
    for directory in ("tables", "npz"):
        written = json.loads((tmp_path / directory / "metrics.json").read_text())["generation"]
        page = (tmp_path / directory / "evaluation.html").read_text()
        assert written["memorisation"]["generated"]["mean"]["value"] > 0
        assert "no score of theirs compares with published ones" in page and page.count("<img") > 10


def test_pictures_of_another_size_are_refused(smoke, tmp_path):
    write_npz(str(tmp_path / "small.npz"), [np.zeros((4, 64, 64, 3), np.uint8)], 4)
    with pytest.raises(ValueError, match=r"real pictures are \[256, 256\] pixels, generated ones \[64, 64\]"):
        evaluate(
            Config(real=str(smoke / "datasets/smoke"), generated=str(tmp_path / "small.npz"), output=str(tmp_path))
        )


def test_a_killed_worker_changes_nothing(smoke, tmp_path):
    """Its process is killed as soon as the first part is written."""
    from test_faults import psutil

    dataset = Dataset.open(str(smoke / "datasets/smoke"))
    chosen = Selection(dataset.root, "town", "train")
    whole = describe(chosen, dataset, Looks(), str(tmp_path / "whole"))
    killed = []

    def kill(scenes: int) -> None:
        for process in psutil.Process().children(recursive=True) if scenes and not killed else ():
            with suppress(psutil.Error, IndexError):
                if "describe_scenes" in process.cmdline()[0]:
                    process.kill()
                    killed.append(process.pid)

    again = describe(chosen, dataset, Looks(), str(tmp_path / "killed"), on_scenes=kill)
    assert len(killed) == 1 and whole.keys() == again.keys()
    assert all(np.array_equal(whole[name], again[name], equal_nan=name == "statistics") for name in whole)


def scores_of(real: np.ndarray, generated: np.ndarray) -> dict:
    sides = [{"scene_id": np.arange(len(side)), "random": side} for side in (real, generated)]
    return compare(*sides)


def test_degenerate_features_get_the_right_number_or_a_clear_error(cluster):
    rng = np.random.default_rng(0)
    some, constant = rng.normal(size=(20, 6)), np.ones((20, 6))
    same = scores_of(constant, constant)
    assert same["random_frechet"].value == 0 and same["random_precision_k3"].value == 1
    apart = scores_of(constant, constant + 1)
    assert apart["random_frechet"].value == pytest.approx(6) and apart["random_recall_k3"].value == 0
    twice = scores_of(some, np.concatenate([some, some]))  # unequal numbers, each scene twice
    assert twice["random_precision_k3"].value == 1 and twice["random_recall_k3"].value == 1
    assert twice["random_frechet"].value < 0.2
    for values in (same, apart, twice):
        assert all(np.isfinite(score).all() for score in values.values() if isinstance(score, Estimate))
    with pytest.raises(ValueError, match=r"generated features hold NaN .* first 4"):
        scores_of(some, np.where(np.arange(20)[:, None] == 4, np.nan, some))
    with pytest.raises(ValueError, match="--k 3 needs more than 3 scenes on each side, got 20 and 3"):
        scores_of(some, some[:3])
    found = memorisation(some, np.concatenate([some[:5], some[5:] + 9]))
    assert found["copies"].value == 0.25 and found["memorised"].value == 0.25 and found["nearest"][3, 0] == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_scenes": 1}, "--max-scenes is 1, expected 2 or more"),
        ({"supersample": 0}, "--supersample is 0"),
        ({"reference": "min-distance", "min_distance_m": 0.0}, "apart_m is 0"),
        ({"inception": "nowhere.pth"}, "nowhere.pth: no such file"),
        ({"generated": "nowhere.npz"}, "nowhere.npz: no such file"),
    ],
)
def test_wrong_options_are_named(smoke, tmp_path, options, message):
    data = str(smoke / "datasets/smoke")
    with pytest.raises(ValueError, match=message):
        evaluate(Config(**({"real": data, "generated": data, "output": str(tmp_path)} | options)))
