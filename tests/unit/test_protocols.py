"""Tests of evaluation protocols: fixed options, dropped pictures, and scores from features in parts."""

import numpy as np
import pytest

from jobs.evaluate_scenes import Config
from jobs.implementation.checks import check_evaluate_scenes
from jobs.implementation.protocols import PROTOCOLS, apply_protocol
from pipelines.evaluation.evaluate import estimate_frechet, score_nearest_distances
from pipelines.evaluation.features import (
    FeatureConfig,
    FeatureParts,
    drop_blank,
    find_blank_pictures,
    make_options_record,
    write_part,
)
from pipelines.evaluation.streamed import compare_streamed, compute_streamed_moments
from pipelines.metrics import inception_score
from pipelines.metrics.frechet import compute_moments
from pipelines.metrics.inception_score import compute_inception_score, compute_streamed_inception_score


def test_protocol_sets_its_options():
    plain = apply_protocol(Config())
    assert (plain.max_scenes, plain.reference, plain.k) == (1000, "farthest-point", (3,))
    assert apply_protocol(Config(max_scenes=5, k=(1, 5))).k == (1, 5)
    paper = apply_protocol(Config(protocol="paper-pr", max_scenes=1000))  # the protocol's own value is no conflict
    assert (paper.max_scenes, paper.reference, paper.k) == (1000, "farthest-point", (3,))
    everything = apply_protocol(Config(protocol="paper-fid"))
    assert (everything.max_scenes, everything.reference) == (None, "uniform")
    assert apply_protocol(Config(protocol="pdd", max_scenes=5000)).max_scenes == 5000
    assert apply_protocol(Config(protocol="pdd", reference="min-distance")).max_scenes is None
    assert PROTOCOLS["pdd"].num_generated == 50_000 and PROTOCOLS["paper-pr"].num_generated == 1000


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"protocol": "paper-pr", "max_scenes": 500}, r"--max-scenes 500 conflicts with --protocol paper-pr, .* 1000"),
        ({"protocol": "paper-pr", "k": (3, 5)}, "--k 3 5 conflicts with --protocol paper-pr, which fixes --k 3"),
        ({"protocol": "paper-pr", "reference": "uniform"}, "--reference uniform conflicts with --protocol paper-pr"),
        ({"protocol": "paper-pr", "real_split": "test"}, "--real-split test conflicts with --protocol paper-pr"),
        ({"protocol": "paper-pr", "ceiling_split": "halves"}, "--ceiling-split halves conflicts with --protocol"),
        ({"protocol": "paper-fid", "max_scenes": 1000}, "--max-scenes 1000 conflicts with .* all scenes"),
        ({"protocol": "paper-fid", "k": (3,)}, "--k 3 conflicts with --protocol paper-fid, which computes only"),
        ({"protocol": "paper-fid", "vgg16": "file.pth"}, "--vgg16 file.pth conflicts with --protocol paper-fid"),
        ({"protocol": "pdd", "reference": "uniform"}, "which allows farthest-point and min-distance"),
        ({"protocol": "pdd", "reference": "min-distance", "max_scenes": 9}, "--max-scenes 9 conflicts with --protocol"),
        ({"protocol": "pdd", "real": "real.npz"}, r"--real real\.npz conflicts with --protocol pdd"),
        ({"protocol": "pdd", "lvae": "model"}, "--protocol pdd needs generated scenes"),
    ],
)
def test_conflicting_option_is_an_error_that_names_both(options, message):
    with pytest.raises(ValueError, match=message):
        apply_protocol(Config(**options))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"generated": "samples.npz"}, "--guess-scenes draws scenes, but samples.npz contains pictures"),
        ({"protocol": "paper-fid"}, "--guess-scenes is not available with --protocol paper-fid"),
        ({"lvae": "town"}, "--guess-scenes needs generated scenes; add --generated"),
        ({"guess_scenes": -1}, "--guess-scenes is -1, expected 0 or more"),
    ],
)
def test_guess_page_needs_scenes_of_both_sides(options, message):
    with pytest.raises(ValueError, match=message):
        check_evaluate_scenes(Config(**{"guess_scenes": 4} | options))


def test_blank_pictures_are_found_and_dropped(tmp_path):
    pictures = np.full((5, 4, 4, 3), 255, np.uint8)
    pictures[1, 0, 0] = 254  # nearly white
    pictures[2, 3, 3] = 0  # one black pixel
    pictures[3, 1, 1] = (0, 0, 1)  # nearly black
    pictures[4] = 90
    found = find_blank_pictures(pictures)
    assert found.tolist() == [True, False, True, False, False]
    columns = {"blank": found[:, None].astype(np.uint8), "random": np.arange(5.0)[:, None]}
    for number, rows in enumerate((slice(0, 2), slice(2, 5))):
        names = [f"scene-{k}" for k in range(5)[rows]]
        write_part(str(tmp_path), number, names, names, {name: values[rows] for name, values in columns.items()})
    whole = FeatureParts(str(tmp_path), 2).open()
    assert set(whole) == {"scene_id", "place", "blank", "random"} and "row" not in whole
    kept, dropped = drop_blank(whole)
    assert dropped == 2 and kept["row"].tolist() == [1, 3, 4] and kept["random"].ravel().tolist() == [1, 3, 4]
    assert kept["scene_id"].tolist() == ["scene-1", "scene-3", "scene-4"]


def write_parts(directory: str, features: np.ndarray, sizes: tuple[int, ...], column: str = "random") -> FeatureParts:
    ends = np.cumsum(sizes)
    assert ends[-1] == len(features)
    for number, (end, size) in enumerate(zip(ends, sizes, strict=True)):
        names = [str(k) for k in range(size)]
        write_part(directory, number, names, names, {column: features[end - size : end]})
    return FeatureParts(directory, len(sizes))


def test_streamed_frechet_distance_equals_whole_distance(tmp_path):
    rng = np.random.default_rng(0)
    real, other = (rng.normal(shift, 1 + shift, (90, 7)).astype(np.float32) for shift in (5, 7))
    parts = write_parts(str(tmp_path / "real"), real, (1, 50, 39)), write_parts(str(tmp_path / "b"), other, (40, 50))
    moments, whole = compute_streamed_moments(parts[0], "random"), compute_moments(real)
    assert moments.count == 90
    assert np.allclose(moments.mean, whole.mean, rtol=1e-9) and np.allclose(moments.scatter, whole.scatter, rtol=1e-9)
    found = compare_streamed(parts[0], {"generated": parts[1]})["generated"]
    assert found.keys() == {"random_frechet"}
    assert found["random_frechet"] == pytest.approx(estimate_frechet(real, other), rel=1e-9)
    assert np.array_equal(parts[0].read()["random"], real)


def test_streamed_scores_hold_one_part_in_memory(tmp_path, monkeypatch):
    """No array that reaches the moments is larger than a part."""
    rng, seen = np.random.default_rng(0), []
    parts = write_parts(str(tmp_path), rng.normal(size=(60, 4)), (20, 25, 15))

    def record(features: np.ndarray):
        seen.append(len(features))
        return compute_moments(features)

    monkeypatch.setattr("pipelines.evaluation.streamed.compute_moments", record)
    compute_streamed_moments(parts, "random")
    assert seen == [20, 25, 15]


def test_streamed_moments_name_wrong_features(tmp_path):
    features = np.zeros((6, 2))
    features[4, 1] = np.nan
    parts = write_parts(str(tmp_path), features, (3, 3))
    with pytest.raises(ValueError, match=f"{tmp_path}, column random: .* NaN"):
        compute_streamed_moments(parts, "random")


def test_inception_score_is_the_mean_over_adm_chunks(monkeypatch):
    """The expected value is the formula of ADM's evaluator, with chunks of 40 instead of 5,000."""
    logits = np.random.default_rng(0).normal(0, 2, (100, 12))
    assert inception_score.SPLIT_SAMPLES == 5000
    whole = compute_inception_score(logits)
    monkeypatch.setattr(inception_score, "SPLIT_SAMPLES", 40)
    p = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    scores = []
    for start in range(0, 100, 40):
        part = p[start : start + 40]
        kl = part * (np.log(part) - np.log(np.expand_dims(np.mean(part, 0), 0)))
        scores.append(np.exp(np.mean(np.sum(kl, 1))))
    found = compute_inception_score(logits)
    assert found.value == pytest.approx(np.mean(scores), rel=1e-12) and found.value != pytest.approx(whole.value)
    streamed = compute_streamed_inception_score(np.split(logits, [7, 7, 93]))
    assert streamed == pytest.approx(found, rel=1e-12)
    with pytest.raises(ValueError, match="0 samples"):
        compute_streamed_inception_score([])


def test_only_vgg16_distances_are_called_memorisation():
    rng = np.random.default_rng(0)
    side = {name: rng.normal(size=(6, 3)) for name in ("random", "lite0", "pool3", "vgg16")}
    for best, name in (("vgg16", "memorisation"), ("pool3", "nearest_distance_pool3")):
        found, score = score_nearest_distances(side, side)
        assert found == name and score["copies"].value == 1
        del side[best]
    assert score_nearest_distances(side, side)[0] == "nearest_distance_lite0"


def test_features_of_earlier_runs_are_kept():
    """The record of the default options lacks the options that protocols added."""
    assert set(make_options_record(FeatureConfig())) == {"supersample", "inception", "lite0", "control", "version"}
    assert (
        make_options_record(FeatureConfig(blank=True, random=False)).items() >= {"blank": True, "random": False}.items()
    )
