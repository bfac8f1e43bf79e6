"""The ControlNet step with tiny random weights: real diffusers pipelines, saved and loaded as a user's would be."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pipelines.rendering.controlnet import SKY, Painter, PhotoRequest, control_image
from pipelines.schema.palette import CLASS_COLORS, CLASS_ID, EMPTY


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> tuple[str, str]:
    """Directories of a Stable Diffusion pipeline and its ControlNet: 32 channels, nobody's pictures."""
    from diffusers import (
        AutoencoderKL,
        ControlNetModel,
        DDIMScheduler,
        StableDiffusionPipeline,
        UNet2DConditionModel,
    )
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer

    torch.manual_seed(0)
    root = tmp_path_factory.mktemp("weights")
    words = [
        "<|startoftext|>",
        "<|endoftext|>",
        *"abcdefghijklmnopqrstuvwxyz",
        *(f"{c}</w>" for c in "abcdefghijklmnopqrstuvwxyz"),
    ]
    (root / "vocab.json").write_text(json.dumps({word: k for k, word in enumerate(words)}))
    (root / "merges.txt").write_text("#version: 0.2\n")
    tokenizer = CLIPTokenizer(str(root / "vocab.json"), str(root / "merges.txt"), model_max_length=77)
    text = CLIPTextModel(
        CLIPTextConfig(
            vocab_size=len(words),
            hidden_size=32,
            intermediate_size=37,
            num_hidden_layers=2,
            num_attention_heads=4,
            bos_token_id=0,
            eos_token_id=1,
        )
    )
    common = {
        "block_out_channels": (32, 64),
        "layers_per_block": 1,
        "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D"),
        "cross_attention_dim": 32,
        "norm_num_groups": 8,
        "attention_head_dim": 8,
    }
    unet = UNet2DConditionModel(
        sample_size=32, in_channels=4, out_channels=4, up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"), **common
    )
    controlnet = ControlNetModel(in_channels=4, conditioning_embedding_out_channels=(16, 32), **common)
    embedding = controlnet.controlnet_cond_embedding.conv_out
    for block in (*controlnet.controlnet_down_blocks, controlnet.controlnet_mid_block, embedding):
        torch.nn.init.normal_(block.weight, std=0.5)  # zeros at first: the picture would not matter
    vae = AutoencoderKL(
        block_out_channels=(32, 64),
        down_block_types=("DownEncoderBlock2D",) * 2,
        up_block_types=("UpDecoderBlock2D",) * 2,
        latent_channels=4,
        norm_num_groups=8,
    )
    pipeline = StableDiffusionPipeline(
        vae,
        text,
        tokenizer,
        unet,
        DDIMScheduler(),
        safety_checker=None,
        feature_extractor=None,
        requires_safety_checker=False,
    )
    pipeline.save_pretrained(root / "diffusion", safe_serialization=True)
    controlnet.save_pretrained(root / "controlnet", safe_serialization=True)
    return str(root / "diffusion"), str(root / "controlnet")


def request(weights: tuple[str, str], **changes) -> PhotoRequest:
    return PhotoRequest(
        *weights,
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


def class_ids(rows: int = 44, cols: int = 60) -> np.ndarray:
    """Sky above a road with a car."""
    ids = np.full((rows, cols), EMPTY, np.uint8)
    ids[rows // 2 :], ids[rows // 2 : rows // 2 + 8, 20:40] = CLASS_ID["road"], CLASS_ID["vehicle_small"]
    return ids


def test_control_images_are_in_the_palette_with_a_sky():
    image = control_image(class_ids())
    assert image.dtype == np.uint8 and image[0, 0].tolist() == list(SKY)
    assert image[-1, 0].tolist() == CLASS_COLORS[CLASS_ID["road"]].tolist()


def test_a_painting_depends_on_picture_prompt_and_seed(weights):
    painter = Painter(request(weights))
    first = painter.paint(class_ids())
    assert first.shape == (44, 60, 3) and first.dtype == np.uint8 and first.std() > 1  # 44 is no multiple of 8
    assert np.array_equal(first, painter.paint(class_ids()))
    assert not np.array_equal(first, painter.paint(class_ids()[::-1].copy()))
    for other in ({"seed": 1}, {"prompt": "xyz"}, {"control_scale": 0.0}):
        assert not np.array_equal(first, Painter(request(weights, **other)).paint(class_ids())), other


def test_a_drive_is_painted_and_goes_on(weights, tmp_path, cluster):
    from jobs.implementation.paint_streets import paint
    from jobs.paint_streets import Config

    drive = tmp_path / "streets" / "drive" / "scene-1"
    (drive / "class_id").mkdir(parents=True)
    for k in range(2):
        Image.fromarray(class_ids(24, 32)).save(drive / "class_id" / f"{k:06d}.png")
    options = {
        "streets": str(tmp_path / "streets" / "drive"),
        "diffusion": weights[0],
        "controlnet": weights[1],
        "num_inference_steps": 1,
    }
    assert paint(Config(**options)) == (options["streets"], 2)
    files = {path.name: path.stat().st_mtime_ns for path in (drive / "photo").iterdir()}
    assert set(files) == {"000000.png", "000001.png"} and (drive / "photos.webp").stat().st_size > 0
    (drive / "photo" / "000001.png").unlink()
    assert paint(Config(**options))[1] == 2
    again = {path.name: path.stat().st_mtime_ns for path in (drive / "photo").iterdir()}
    assert again["000000.png"] == files["000000.png"] and again["000001.png"] != files["000001.png"]
    with pytest.raises(
        ValueError, match=r'was painted with prompt="a photograph.*asked for "night"; delete its photo/'
    ):
        paint(Config(**options, prompt="night"))


def test_missing_weights_are_said_clearly(weights, tmp_path):
    from jobs.implementation.paint_streets import paint
    from jobs.paint_streets import Config

    with pytest.raises(ValueError, match="--diffusion is missing"):
        paint(Config(controlnet=weights[1]))
    with pytest.raises(ValueError, match=r"--controlnet .*nowhere: no model here"):
        paint(Config(diffusion=weights[0], controlnet=str(tmp_path / "nowhere")))
    for path in Path(weights[1]).glob("*.json"):
        (tmp_path / path.name).write_text(path.read_text())
    with pytest.raises(ValueError, match="no Stable Diffusion and ControlNet weights"):
        Painter(request((weights[0], str(tmp_path))))
    with pytest.raises(ValueError, match="no street views here; run jobs/render_streets"):
        paint(Config(streets=str(tmp_path), diffusion=weights[0], controlnet=weights[1]))
