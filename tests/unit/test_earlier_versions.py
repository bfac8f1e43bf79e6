"""Tests that read pipelines and tables written by version 0.1 (tests/golden/version_0_1)."""

import json

import numpy as np
import pytest
from diffusers import DDPMScheduler
from helpers import ROOT

from models.dit import DiT
from models.lvae import LayoutVAE
from models.pipeline import PrITTIPipeline
from models.vae.config import GroundConfig, ObjectConfig
from pipelines.schema.tables import read_scenes

GOLDEN = ROOT / "tests" / "golden" / "version_0_1"
EXPECTED = json.loads((GOLDEN / "expected.json").read_text())


def test_pipeline_of_version_0_1_samples_same_latents():
    pipeline = PrITTIPipeline.from_pretrained(GOLDEN / "pipeline")
    pipeline.set_progress_bar_config(disable=True)
    stored = {"noise_scaling": 1.01, "existence_threshold": 0.4}
    assert pipeline.config == stored | {
        "neighbour_latents": "reencode",
        "constraints": False,
        "attach": True,
        "pag_scale": 0.0,
        "pag_drops_label": False,
        "street_pag_factor": 1.0,
        "num_inference_steps": 250,
    }  # Current defaults.
    latents = pipeline.sample_latents(["low", "high"], seed=5, indices=[0, 1], num_inference_steps=5)
    assert np.allclose(latents.numpy(), EXPECTED["latents"], atol=1e-4)


def test_diffusers_loads_saved_scheduler(tmp_path):
    PrITTIPipeline.from_pretrained(GOLDEN / "pipeline").save_pretrained(tmp_path)
    for path in (GOLDEN / "pipeline", tmp_path):
        scheduler = DDPMScheduler.from_pretrained(path, subfolder="scheduler")
        pipeline = PrITTIPipeline.from_pretrained(path)
        assert scheduler.config.beta_end == 0.015 and scheduler.config.prediction_type == "epsilon"
        assert np.allclose(scheduler.alphas_cumprod, pipeline.scheduler.alphas_cumprod)


def test_flat_options_of_version_0_1_become_nested(tmp_path):
    pipeline = PrITTIPipeline.from_pretrained(GOLDEN / "pipeline")
    ground, objects = pipeline.lvae.config.ground, pipeline.lvae.config.objects
    assert GroundConfig(**ground) == GroundConfig((4, 8), 2, 4, attention=False)
    assert ObjectConfig(**objects) == ObjectConfig(8, 1, 2, 8, 8, "cells", 1, "cells")
    assert pipeline.dit.config.prediction == "v_prediction"
    pipeline.save_pretrained(tmp_path)
    again = PrITTIPipeline.from_pretrained(tmp_path)
    assert again.lvae.spec == pipeline.lvae.spec and again.dit.config.prediction == "v_prediction"
    for old, new in ((pipeline.lvae, again.lvae), (pipeline.dit, again.dit)):
        assert all((value == new.state_dict()[name]).all() for name, value in old.state_dict().items())


def test_tables_of_version_0_1_hold_same_scenes():
    scenes = list(read_scenes(str(GOLDEN / "tables")))
    assert [len(scene) for scene in scenes] == EXPECTED["primitives"]
    assert [scene.occupied.sum((1, 2)).tolist() for scene in scenes] == EXPECTED["occupied"]
    assert not any(scene.free_pose for scene in scenes)  # The tables lack the column.
    sums = [scene.center_m.sum(axis=0) for scene in scenes]
    assert np.allclose(sums, EXPECTED["center_sum_m"], atol=1e-3)


@pytest.mark.parametrize("kind", [LayoutVAE, DiT])
def test_unknown_option_in_config_is_named(kind):
    with pytest.raises(ValueError, match=f"{kind.__name__} has no option colour; expected some of"):
        kind.from_config({"colour": "red"})


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: (path / "dit/config.json").unlink(), "dit/config.json: No such file"),
        (lambda path: (path / "dit/config.json").write_text("{"), "dit/config.json: not JSON"),
        (lambda path: (path / "dit/diffusion_pytorch_model.safetensors").unlink(), "safetensors: no such file"),
        (lambda path: (path / "dit/diffusion_pytorch_model.safetensors").write_bytes(b"12"), "the file is damaged"),
        (
            lambda path: (path / "lvae/diffusion_pytorch_model.safetensors").write_bytes(
                (path / "dit/diffusion_pytorch_model.safetensors").read_bytes()
            ),
            "the weights do not fit the config.json",
        ),
        (lambda path: (path / "model_index.json").write_text('{"lvae": ["os", "system"]}'), "lvae is .'os', 'system'"),
    ],
    ids=["no config", "broken config", "no weights", "broken weights", "other weights", "foreign class"],
)
def test_pipeline_names_damaged_file(damage, message, tmp_path):
    PrITTIPipeline.from_pretrained(GOLDEN / "pipeline").save_pretrained(tmp_path)
    damage(tmp_path)
    with pytest.raises(ValueError, match=message):
        PrITTIPipeline.from_pretrained(tmp_path)
