"""Tests of the ControlNet step with a small diffusers pipeline that has random weights."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import street_class_ids
from safetensors.torch import load_file

from pipelines.rendering.controlnet import SKY, Painter, PhotoRequest, make_control_image
from pipelines.schema.palette import CLASS_COLORS, CLASS_ID


def make_request(controlnet_weights: tuple[str, str], **changes) -> PhotoRequest:
    return PhotoRequest(
        *controlnet_weights,
        **(
            {
                "prompt": "a street",
                "negative_prompt": "",
                "steps": 2,
                "guidance_scale": 3.0,
                "control_scale": 1.0,
                "seed": 0,
            }
            | changes
        ),
    )


def test_control_image_uses_palette_and_sky():
    image = make_control_image(street_class_ids())
    assert image.dtype == np.uint8 and image[0, 0].tolist() == list(SKY)
    assert image[-1, 0].tolist() == CLASS_COLORS[CLASS_ID["road"]].tolist()


def test_painter_depends_on_image_prompt_and_seed(controlnet_weights):
    painter = Painter(make_request(controlnet_weights))
    first = painter.paint(street_class_ids())
    assert first.shape == (44, 60, 3) and first.dtype == np.uint8 and first.std() > 1  # 44 is not a multiple of 8
    assert np.array_equal(first, painter.paint(street_class_ids()))
    assert not np.array_equal(first, painter.paint(street_class_ids()[::-1].copy()))
    for other in ({"seed": 1}, {"prompt": "xyz"}, {"control_scale": 0.0}):
        assert not np.array_equal(
            first, Painter(make_request(controlnet_weights, **other)).paint(street_class_ids())
        ), other


def test_painter_names_missing_weights(controlnet_weights, tmp_path):
    from jobs.implementation.paint_streets import paint
    from jobs.paint_streets import Config

    with pytest.raises(ValueError, match="--diffusion is missing"):
        paint(Config(controlnet=controlnet_weights[1]))
    with pytest.raises(ValueError, match=r"--controlnet .*nowhere: no model here"):
        paint(Config(diffusion=controlnet_weights[0], controlnet=str(tmp_path / "nowhere")))
    for path in Path(controlnet_weights[1]).glob("*.json"):
        (tmp_path / path.name).write_text(path.read_text())
    with pytest.raises(ValueError, match="must hold Stable Diffusion weights"):
        Painter(make_request((controlnet_weights[0], str(tmp_path))))
    with pytest.raises(ValueError, match="holds no street views; run jobs/render_streets"):
        paint(Config(streets=str(tmp_path), diffusion=controlnet_weights[0], controlnet=controlnet_weights[1]))


def test_painter_loads_neither_pickles_nor_code(controlnet_weights, tmp_path):
    ran = tmp_path / "ran"
    for number in range(2):
        copies = [Path(shutil.copytree(path, tmp_path / f"{number}-{k}")) for k, path in enumerate(controlnet_weights)]
        changed = copies[number]
        for path in list(changed.rglob("*.safetensors")):
            torch.save(load_file(path), path.with_suffix(".bin"))
            path.unlink()
        with pytest.raises(ValueError, match="must hold Stable Diffusion weights"):
            Painter(make_request((str(copies[0]), str(copies[1]))))
    copy = Path(shutil.copytree(controlnet_weights[0], tmp_path / "code"))
    (copy / "unet" / "evil.py").write_text(f"open({str(ran)!r}, 'w')\nclass Evil: pass\n")
    for component in (["evil", "Evil"], ["diffusers", []], 3):
        index = copy / "model_index.json"
        index.write_text(json.dumps(json.loads(index.read_text()) | {"unet": component}))
        with pytest.raises(ValueError, match="must hold Stable Diffusion weights"):
            Painter(make_request((str(copy), controlnet_weights[1])))
    assert not ran.exists()
