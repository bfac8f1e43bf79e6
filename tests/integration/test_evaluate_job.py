"""Tests of jobs/evaluate_scenes.py with random Inception weights, on tables and on images."""

import json

import numpy as np
import pytest
import safetensors.numpy
from golden.golden_recipe import random_state_dict
from helpers import kill_ray_workers

from jobs.evaluate_scenes import Config
from jobs.implementation.evaluate_scenes import evaluate
from models.layout import SLAB_OFFSET_M
from models.scene import Scene
from pipelines.evaluation.evaluate import (
    compare_datasets,
    compute_nearest_distances,
    compute_set_scores,
    find_sensitive_scores,
    is_sensitive,
)
from pipelines.evaluation.features import FeatureConfig, compute_scene_features, load_scenes
from pipelines.metrics.adm_npz import write_npz
from pipelines.metrics.controls import CONTROLS, damage_scene
from pipelines.metrics.inception import Inception
from pipelines.metrics.intervals import Estimate
from pipelines.metrics.relations import compute_scene_relations
from pipelines.metrics.statistics import compute_layout_statistics
from pipelines.preprocess.sources.town.generator import generate_town
from pipelines.rendering.render import render_bev
from pipelines.schema.dataset import Dataset
from pipelines.schema.scene_subset import SceneSubset

SAMPLES = 5  # the network needs one second per image


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("weights") / "random.safetensors"
    shapes = {name: value.shape for name, value in Inception().state_dict().items()}
    safetensors.numpy.save_file(random_state_dict(shapes), path)
    return str(path)


@pytest.mark.slow  # test_protocol_job.py scores images, and the test of the controls scores tables.
def test_evaluate_scores_tables_and_their_images_equally(smoke, weights, tmp_path):
    """The test compares training scenes with test scenes twice: first from tables, then from ADM's .npz files of
    images."""
    data = str(smoke / "datasets/smoke")
    test = load_scenes(SceneSubset(data, "town", "test", SAMPLES).shards(), np.arange(SAMPLES))
    write_npz(str(tmp_path / "test.npz"), (np.stack([render_bev(scene)]) for scene in test), SAMPLES)
    options = {"real": data, "max_scenes": SAMPLES, "inception": weights, "k": (1, 3), "num_actors": 1}
    as_tables = evaluate(
        Config(generated=data, generated_split="test", balance_labels=False, output=str(tmp_path / "tables"), **options)
    )["generation"]
    as_pictures = evaluate(Config(generated=str(tmp_path / "test.npz"), output=str(tmp_path / "npz"), **options))[
        "generation"
    ]
    assert as_tables["scenes"] == as_pictures["scenes"] == {"real": SAMPLES, "generated": SAMPLES}
    for name in ("fid", "sfid", "kid", "inception_score", "precision_k1", "recall_k3", "density_k3", "coverage_k1"):
        assert as_pictures[name]["value"] == pytest.approx(as_tables[name]["value"], rel=1e-5), (
            name
        )  # rounding errors depend on the composition of the batch
        assert as_tables[name]["low"] <= as_tables[name]["high"]
    assert as_tables["fid"]["value"] > 0 and as_tables["inception_score"]["value"] >= 1
    assert "validity" in as_tables and "validity" not in as_pictures
    for directory in ("tables", "npz"):
        written = json.loads((tmp_path / directory / "metrics.json").read_text())["generation"]
        page = (tmp_path / directory / "evaluation.html").read_text()
        assert written["nearest_distance_pool3"]["generated"]["mean"]["value"] > 0
        assert "memorisation" not in written
        assert "scores are not comparable with published scores" in page and page.count("<img") > 10


def test_evaluate_rejects_images_of_another_size(smoke, tmp_path):
    write_npz(str(tmp_path / "small.npz"), [np.zeros((4, 64, 64, 3), np.uint8)], 4)
    with pytest.raises(ValueError, match=r"real pictures have \[256, 256\] pixels, generated pictures have \[64, 64\]"):
        evaluate(
            Config(real=str(smoke / "datasets/smoke"), generated=str(tmp_path / "small.npz"), output=str(tmp_path))
        )


@pytest.mark.slow
def test_scene_features_are_unchanged_by_worker_kill(smoke, tmp_path):
    """The test kills the worker as soon as the job has written the first part."""
    dataset = Dataset.open(str(smoke / "datasets/smoke"))
    chosen = SceneSubset(dataset.root, "town", "train")
    whole = compute_scene_features(chosen, dataset, FeatureConfig(), str(tmp_path / "whole")).read()
    killed = []

    def kill(scenes: int) -> None:
        if scenes and not killed:
            killed.extend(kill_ray_workers("describe_scenes"))

    again = compute_scene_features(chosen, dataset, FeatureConfig(), str(tmp_path / "killed"), on_scenes=kill).read()
    assert len(killed) == 1 and whole.keys() == again.keys()
    assert all(
        np.array_equal(whole[name], again[name], equal_nan=name in ("statistics", "relations")) for name in whole
    )


def test_evaluate_scores_ceiling_and_controls(smoke, tmp_path):
    data = str(smoke / "datasets/smoke")
    options = {"real": data, "generated": data, "generated_split": "test", "balance_labels": False, "num_actors": 1}
    config = Config(controls=True, peers=(data,), output=str(tmp_path / "out"), **options)
    scores = evaluate(config)["generation"]
    assert list(scores["sets"]) == ["ceiling", *CONTROLS]
    names = set(scores["sets"]["ceiling"])
    assert {"relation_frechet", "layout_frechet", "random_coverage_k3", "validity.overlapping"} <= names
    assert all(set(values) <= names for values in scores["sets"].values())
    assert set(scores["sensitive"]) == names and {c for found in scores["sensitive"].values() for c in found} <= set(
        CONTROLS
    )
    assert scores["sets"]["dropped"]["layout_frechet"] != scores["sets"]["ceiling"]["layout_frechet"]
    assert scores["sets"]["moved"]["layout_frechet"] == scores["sets"]["ceiling"]["layout_frechet"]
    assert scores["peers"]["smoke"]["road_connectivity"]["value"] > 0
    page = (tmp_path / "out/evaluation.html").read_text()
    for words in (
        "Scores of damaged scenes",
        "other real scenes (ceiling)",
        "Validity by category",
        "deviation",
        "smoke",
    ):
        assert words in page
    halves = evaluate(Config(ceiling_split="halves", output=str(tmp_path / "halves"), **options))["generation"]
    assert list(halves["sets"]) == ["ceiling"] and 2 <= halves["scenes"]["real"] < scores["scenes"]["real"] * 2
    with pytest.raises(ValueError, match="no real scenes for the ceiling \\(--ceiling-split nowhere\\)"):
        evaluate(Config(ceiling_split="nowhere", output=str(tmp_path / "x"), **options))


def test_headline_scores_notice_every_control():
    """Of the headline scores without pictures, at least one notices each control; layout statistics do not."""

    def sample_scenes(seed: int) -> list[list[Scene]]:
        drives = [generate_town(100 * seed + k) for k in range(8)]
        return [[drive.scene(int(n), "test") for n in np.linspace(0, len(drive) - 1, 10)] for drive in drives]

    def describe(drives: list[list[Scene]], control: str = "") -> dict[str, np.ndarray]:
        rows, places = [], []
        for k, scenes in enumerate(drives):
            if control:
                scenes = [damage_scene(control, s, scenes[i - 5], (k, i)) for i, s in enumerate(scenes)]
            rows += [(compute_layout_statistics(s), compute_scene_relations(s, SLAB_OFFSET_M).vector) for s in scenes]
            places += [f"town/{id(drives)}-{k}/0/0"] * len(scenes)
        statistics, relations = map(np.stack, zip(*rows, strict=True))
        return {"scene_id": np.arange(80), "place": np.array(places), "statistics": statistics, "relations": relations}

    real, other = describe(sample_scenes(1)), sample_scenes(2)
    classes = [str(k) for k in range(real["statistics"].shape[1] - 44)]
    sets = {
        name: compute_set_scores(real, describe(other, name.replace("ceiling", "")), classes)
        for name in ("ceiling", *CONTROLS)
    }
    names = ("two_sample_auc", "relation_frechet", "layout_frechet")
    found = find_sensitive_scores({name: {n: scores[n] for n in names} for name, scores in sets.items()})
    assert set(found["two_sample_auc"]) >= set(CONTROLS) - {"dropped"}
    assert set(found["relation_frechet"]) | set(found["two_sample_auc"]) == set(CONTROLS)
    assert not {"moved", "turned", "permuted", "ground_roughened"} & set(found["layout_frechet"])
    auc = sets["ceiling"]["two_sample_auc"]
    assert auc.low < 0.5


def test_sensitivity_needs_worse_value_and_disjoint_intervals():
    ceiling = Estimate(0.5, 0.45, 0.55)
    assert is_sensitive("two_sample_auc", Estimate(0.7, 0.6, 0.8), ceiling)
    assert not is_sensitive("two_sample_auc", Estimate(0.3, 0.2, 0.4), ceiling)
    assert not is_sensitive("two_sample_auc", Estimate(0.6, 0.54, 0.66), ceiling)
    assert is_sensitive("random_frechet", Estimate(0.7, 0.6, 0.8), ceiling)
    assert not is_sensitive("random_frechet", Estimate(0.3, 0.2, 0.4), ceiling)  # better, not worse
    assert is_sensitive("lite0_coverage_k3", Estimate(0.3, 0.2, 0.4), ceiling)
    assert not is_sensitive("precision_k3", Estimate(0.7, 0.6, 0.8), ceiling)


def compare_features(real: np.ndarray, generated: np.ndarray) -> dict:
    sides = [{"scene_id": np.arange(len(side)), "random": side} for side in (real, generated)]
    return compare_datasets(*sides)


def test_compare_handles_degenerate_features(cluster):
    rng = np.random.default_rng(0)
    some, constant = rng.normal(size=(20, 6)), np.ones((20, 6))
    same = compare_features(constant, constant)
    assert same["random_frechet"].value == 0 and same["random_precision_k3"].value == 1
    apart = compare_features(constant, constant + 1)
    assert apart["random_frechet"].value == pytest.approx(6) and apart["random_recall_k3"].value == 0
    twice = compare_features(some, np.concatenate([some, some]))  # the second side contains each scene twice
    assert twice["random_precision_k3"].value == 1 and twice["random_recall_k3"].value == 1
    assert twice["random_frechet"].value < 0.2
    for values in (same, apart, twice):
        assert all(np.isfinite(score).all() for score in values.values() if isinstance(score, Estimate))
    with pytest.raises(ValueError, match=r"generated features hold NaN .* first 4"):
        compare_features(some, np.where(np.arange(20)[:, None] == 4, np.nan, some))
    with pytest.raises(ValueError, match="--k 3 needs more than 3 scenes on each side, got 20 and 3"):
        compare_features(some, some[:3])
    found = compute_nearest_distances(some, np.concatenate([some[:5], some[5:] + 9]))
    assert found["copies"].value == 0.25 and found["below_limit"].value == 0.25 and found["nearest"][3, 0] == 3


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
def test_evaluate_rejects_wrong_options(smoke, tmp_path, options, message):
    data = str(smoke / "datasets/smoke")
    with pytest.raises(ValueError, match=message):
        evaluate(Config(**({"real": data, "generated": data, "output": str(tmp_path)} | options)))
