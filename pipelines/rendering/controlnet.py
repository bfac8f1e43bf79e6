"""Paint street views as photographs with a ControlNet on semantic images, from local weights (diffusers)."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from PIL import Image

from pipelines.rendering.render import arrange_contact_sheet, encode_png
from pipelines.rendering.street_views import ON_SHEET, encode_animation
from pipelines.runtime import storage
from pipelines.runtime.ray_tasks import map_actors
from pipelines.schema.palette import CLASS_COLORS, EMPTY
from pipelines.schema.run_guard import find_changed_option

SKY = (70, 130, 180)  # of the KITTI-360 and Cityscapes palette, where a street view is empty
MULTIPLE_PX = 8  # the sides of the network's pictures are multiples of this


@dataclass(frozen=True)
class PhotoRequest:
    """Options of painting. `diffusion` and `controlnet` are local directories of diffusers models, as safetensors."""

    diffusion: str
    controlnet: str
    prompt: str
    negative_prompt: str
    steps: int
    guidance_scale: float
    control_scale: float
    seed: int  # the same noise for every frame


def make_control_image(class_id: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 in the KITTI-360 palette, SKY where class_id (H, W) is EMPTY."""
    return np.where((class_id == EMPTY)[..., None], np.array(SKY, np.uint8), CLASS_COLORS[class_id])


class Painter:
    """Stable Diffusion under a ControlNet."""

    def __init__(self, request: PhotoRequest) -> None:
        """Load the models. Raises ValueError if a directory does not hold one."""
        from diffusers import (
            ControlNetModel,  # pyright: ignore[reportPrivateImportUsage]
            StableDiffusionControlNetPipeline,  # pyright: ignore[reportPrivateImportUsage]
        )
        from diffusers.utils.logging import disable_progress_bar

        disable_progress_bar()
        local = {"local_files_only": True, "use_safetensors": True}
        try:
            controlnet = ControlNetModel.from_pretrained(request.controlnet, **local)
            self.pipeline = StableDiffusionControlNetPipeline.from_pretrained(
                request.diffusion, controlnet=controlnet, safety_checker=None, requires_safety_checker=False, **local
            )
        except (OSError, ValueError, ImportError) as error:
            raise ValueError(
                f"{request.diffusion} and {request.controlnet}: no Stable Diffusion and ControlNet weights in"
                f" diffusers' layout, as safetensors ({error})"
            ) from error
        self.pipeline.set_progress_bar_config(disable=True)
        self.pipeline.to("cuda" if torch.cuda.is_available() else "cpu")
        self.request = request

    def paint(self, class_id: np.ndarray) -> np.ndarray:
        """Paint class ids (H, W): (H, W, 3) uint8, the same for the same request and image."""
        rows, cols = class_id.shape
        size = [-(-n // MULTIPLE_PX) * MULTIPLE_PX for n in (rows, cols)]
        control = Image.fromarray(make_control_image(class_id)).resize(size[::-1], Image.Resampling.NEAREST)
        request = self.request
        output: Any = self.pipeline(
            request.prompt,
            image=control,
            height=size[0],
            width=size[1],
            num_inference_steps=request.steps,
            guidance_scale=request.guidance_scale,
            controlnet_conditioning_scale=request.control_scale,
            negative_prompt=request.negative_prompt or None,
            generator=torch.Generator().manual_seed(request.seed),
        )
        painted = output.images[0]
        return np.asarray(painted.resize((cols, rows), Image.Resampling.LANCZOS))


class StreetPainter:
    """Actor. Row in: number of a drive. Row out: its number of frames. Paints the frames that are not painted yet."""

    def __init__(self, request: PhotoRequest, directories: Sequence[str]) -> None:
        self.painter, self.directories = Painter(request), directories

    def __call__(self, row: dict) -> dict:
        directory, frames = self.directories[int(row["id"])], []
        for name in list_frame_names(directory):
            path = storage.join_uri(directory, "photo", name)
            if not storage.exists(path):
                class_id = np.asarray(
                    Image.open(io.BytesIO(storage.read_bytes(storage.join_uri(directory, "class_id", name))))
                )
                content = encode_png(self.painter.paint(class_id))
                storage.write_whole(path, lambda stream, content=content: stream.write(content))
            frames.append(np.asarray(Image.open(io.BytesIO(storage.read_bytes(path)))))
        every = frames[:: -(-len(frames) // ON_SHEET)]
        for name, content in {
            "photos.png": encode_png(arrange_contact_sheet(every, 3)),
            "photos.webp": encode_animation(frames),
        }.items():
            storage.write_whole(
                storage.join_uri(directory, name), lambda stream, content=content: stream.write(content)
            )
        return {"frames": len(frames)}


def list_frame_names(directory: str) -> list[str]:
    return [path.rsplit("/", 1)[1] for path in storage.list_files(storage.join_uri(directory, "class_id"), ".png")]


def list_drives(streets: str) -> list[str]:
    """Return the directories of all drives with frames under streets/<run>. Raises ValueError if there is none."""
    found = sorted({path.rsplit("/", 2)[0] for path in storage.list_files(streets, ".png") if "/class_id/" in path})
    if not found:
        raise ValueError(f"{streets}: no street views here; run jobs/render_streets.py first")
    return found


def paint_streets(
    request: PhotoRequest, directories: Sequence[str], actors: int = 1, on_drive: Callable[[], None] | None = None
) -> int:
    """Paint every frame of some drives, and return the number of frames. Another call resumes an interrupted one.

    Args:
        request: Options of painting.
        directories: Directories of the drives.
        actors: Maximum number of actors.
        on_drive: Called after each drive.

    Raises:
        ValueError: A drive was painted with other options.
    """
    for directory in directories:
        record = storage.join_uri(directory, "photos.json")
        if said := find_changed_option(record, asdict(request)):
            raise ValueError(
                f"{directory} was painted with {said}; delete its photo/ and photos.json to paint it again"
            )
        storage.write_json(asdict(request), record)
    total = 0
    for row in map_actors(range(len(directories)), StreetPainter, (request, directories), actors):
        total += row["frames"]
        if on_drive:
            on_drive()
    return total
