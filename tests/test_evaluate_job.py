"""jobs/evaluate_scenes.py with Inception weights (random ones) and with pictures instead of tables."""

import json

import numpy as np
import pytest
import safetensors.numpy
from golden_recipe import random_state_dict

from jobs.evaluate_scenes import Config, evaluate
from pipelines.metrics.adm_npz import write_npz
from pipelines.metrics.inception import Inception
from pipelines.scenes.render import bev_picture
from pipelines.scenes.tables import read_scenes


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("weights") / "random.safetensors"
    shapes = {name: value.shape for name, value in Inception().state_dict().items()}
    safetensors.numpy.save_file(random_state_dict(shapes), path)
    return str(path)


def test_tables_and_their_pictures_score_the_same(home, weights, tmp_path):
    """Real training scenes against real test scenes: once as tables, once as ADM's .npz of their pictures."""
    data = str(home / "datasets/smoke")
    test = list(read_scenes(data, "town", "test"))
    batches = (np.stack([bev_picture(scene)]) for scene in test)
    write_npz(str(tmp_path / "test.npz"), batches, len(test))
    as_tables = evaluate(
        Config(real=data, generated=data, generated_split="test", balance=False, inception=weights, k=(1, 3),
               output=str(tmp_path / "tables"))
    )["generation"]  # fmt: skip
    as_pictures = evaluate(
        Config(
            real=data, generated=str(tmp_path / "test.npz"), inception=weights, k=(1, 3), output=str(tmp_path / "npz")
        )
    )["generation"]
    assert as_tables["scenes"] == as_pictures["scenes"] == {"real": len(test), "generated": len(test)}
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


def test_pictures_of_another_size_are_refused(home, tmp_path):
    write_npz(str(tmp_path / "small.npz"), [np.zeros((4, 64, 64, 3), np.uint8)], 4)
    with pytest.raises(ValueError, match=r"real pictures are \[256, 256\] pixels, generated ones \[64, 64\]"):
        evaluate(Config(real=str(home / "datasets/smoke"), generated=str(tmp_path / "small.npz"), output=str(tmp_path)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"samples": 1}, "--samples is 1, expected 2 or more"),
        ({"supersample": 0}, "--supersample is 0"),
        ({"reference": "apart", "apart_m": 0.0}, "apart_m is 0"),
        ({"inception": "nowhere.pth"}, "nowhere.pth: no such file"),
        ({"generated": "nowhere.npz"}, "nowhere.npz: no such file"),
    ],
)
def test_wrong_options_are_named(home, tmp_path, options, message):
    data = str(home / "datasets/smoke")
    with pytest.raises(ValueError, match=message):
        evaluate(Config(**({"real": data, "generated": data, "output": str(tmp_path)} | options)))
