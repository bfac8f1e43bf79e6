"""Turn street views into photographs. Stable Diffusion and a ControlNet for semantic images run with local weights."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from PIL import Image

from models.local_copy import make_local_copy
from models.uris import split_name
from pipelines.rendering.render import arrange_contact_sheet, encode_png
from pipelines.rendering.street_views import ON_SHEET, encode_animation
from pipelines.runtime import storage
from pipelines.runtime.ray_tasks import map_actors
from pipelines.runtime.resources import find_device
from pipelines.schema.palette import CLASS_COLORS, EMPTY
from pipelines.schema.run_guard import find_changed_option

# Sky colour of the KITTI-360 and Cityscapes palette. Empty pixels of a street view get this colour.
SKY = (70, 130, 180)
SUMMARIES = ("photos.png", "photos.webp")  # Contact sheet and animation of a drive.
MULTIPLE_PX = 8  # The width and height of the network's images are multiples of this value.


@dataclass(frozen=True)
class PhotoRequest:
    """Options for photographs from street views.

    Attributes:
        diffusion: Local directory of a Stable Diffusion model in diffusers format (safetensors).
        controlnet: Local directory of a ControlNet in diffusers format (safetensors).
        prompt: Text prompt.
        negative_prompt: Text prompt that describes unwanted content; empty: no negative prompt.
        steps: Number of denoising steps.
        guidance_scale: Weight of classifier-free guidance.
        control_scale: Weight of the ControlNet.
        seed: Random seed of the noise. All frames use the same seed.
    """

    diffusion: str
    controlnet: str
    prompt: str
    negative_prompt: str
    steps: int
    guidance_scale: float
    control_scale: float
    seed: int


def make_control_image(class_id: np.ndarray) -> np.ndarray:
    """Draw class ids in the KITTI-360 palette.

    Args:
        class_id: (H, W) class ids.

    Returns:
        (H, W, 3) uint8 sRGB. Pixels with class id EMPTY have the colour SKY.
    """
    return np.where((class_id == EMPTY)[..., None], np.array(SKY, np.uint8), CLASS_COLORS[class_id])


class Painter:
    """Stable Diffusion with a ControlNet."""

    def __init__(self, request: PhotoRequest) -> None:
        """Load the models.

        Raises:
            ValueError: A directory does not hold the expected model.
        """
        from diffusers import (
            ControlNetModel,  # pyright: ignore[reportPrivateImportUsage]
            StableDiffusionControlNetPipeline,  # pyright: ignore[reportPrivateImportUsage]
        )
        from diffusers.utils.logging import disable_progress_bar

        disable_progress_bar()
        # Weights in other formats are pickles, and code in a model directory must not run.
        local = {"local_files_only": True, "use_safetensors": True, "trust_remote_code": False}
        try:
            controlnet = ControlNetModel.from_pretrained(make_local_copy(request.controlnet), **local)
            self.pipeline = StableDiffusionControlNetPipeline.from_pretrained(
                make_local_copy(request.diffusion),
                controlnet=controlnet,
                safety_checker=None,
                requires_safety_checker=False,
                **local,
            )
        except Exception as error:  # Damaged files make diffusers and transformers raise errors of many types.
            raise ValueError(
                f"{request.diffusion} must hold Stable Diffusion weights and {request.controlnet} ControlNet "
                f"weights, both in diffusers format with safetensors ({error})"
            ) from error
        self.pipeline.set_progress_bar_config(disable=True)
        self.pipeline.to(find_device())
        self.request = request

    def paint(self, class_id: np.ndarray) -> np.ndarray:
        """Generate a photograph for an image of class ids.

        The same request and image give the same photograph.

        Args:
            class_id: (H, W) class ids.

        Returns:
            (H, W, 3) uint8 sRGB.
        """
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
    """Ray actor that generates the missing photographs of a drive.

    The input row holds the index of the drive. The output row holds the number of frames in this drive.
    """

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
        contents = (encode_png(arrange_contact_sheet(every, 3)), encode_animation(frames))
        for name, content in zip(SUMMARIES, contents, strict=True):
            storage.write_whole(
                storage.join_uri(directory, name), lambda stream, content=content: stream.write(content)
            )
        return {"frames": len(frames)}


def list_frame_names(directory: str) -> list[str]:
    """Return the file names of the frames of a drive.

    Args:
        directory: Directory of the drive.

    Returns:
        Names such as 000000.png, in order.
    """
    return storage.list_names(storage.join_uri(directory, "class_id"), suffix=".png")


def list_drives(streets: str) -> list[str]:
    """Return the directories of all drives that have frames.

    Args:
        streets: Directory streets/<run>.

    Returns:
        Directories in alphabetical order.

    Raises:
        ValueError: The directory holds no frame.
    """
    folders = {split_name(path)[0] for path in storage.list_files(streets, ".png")}
    found = sorted(drive for drive, name in map(split_name, folders) if name == "class_id")
    if not found:
        raise ValueError(f"{streets} holds no street views; run jobs/render_streets.py first")
    return found


def paint_streets(
    request: PhotoRequest, directories: Sequence[str], actors: int = 1, on_drive: Callable[[], None] | None = None
) -> int:
    """Generate a photograph for every frame of several drives.

    A second call resumes an interrupted run.

    Args:
        request: Options of the photographs.
        directories: Directories of the drives.
        actors: Maximum number of actors.
        on_drive: Function that is called after each drive.

    Returns:
        Number of frames.

    Raises:
        ValueError: A drive has photographs with other options, or a photograph is missing at the end.
    """
    for directory in directories:
        record = storage.join_uri(directory, "photos.json")
        if said := find_changed_option(record, asdict(request)):
            raise ValueError(
                f"{directory} holds photographs with {said}; delete its photo/ and photos.json to generate them again"
            )
        storage.write_json(asdict(request), record)
    total = 0
    for row in map_actors(range(len(directories)), StreetPainter, (request, directories), actors):
        total += row["frames"]
        if on_drive:
            on_drive()
    for directory in directories:
        photos = [storage.join_uri(directory, "photo", name) for name in list_frame_names(directory)]
        photos += [storage.join_uri(directory, name) for name in SUMMARIES]
        storage.require_files(photos, directory)
    return total
