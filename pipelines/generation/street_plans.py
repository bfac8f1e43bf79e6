"""Sections of street plans as tasks and files, for outpainting with Ray (models/composition/street_plan.py)."""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image
from safetensors import SafetensorError
from safetensors.torch import load, save

from models.composition.block_grid import BlockIndex, rank_outward
from models.composition.street_plan import StreetPlan
from models.scene import Grid
from pipelines.runtime import storage

PLAN_PIXEL_M = 1.0  # Side of a pixel of the picture of a street plan.


@dataclass(frozen=True, order=True)
class Section:
    """A section of the street plan of a scene.

    Attributes:
        ahead: Number of steps ahead of the first section.
        left: Number of steps to its left.
    """

    ahead: int
    left: int


Part = BlockIndex | Section  # What a task of a scene makes or needs.


@dataclass(frozen=True)
class SectionTask:
    """A section of a street plan to generate.

    Attributes:
        number: Number of the scene in the run.
        section: The section.
        needs: Sections that this section continues.
    """

    number: int
    section: Section
    needs: frozenset[Part]


def list_sections(plan: StreetPlan, wanted: Iterable[Section], number: int) -> list[SectionTask]:
    """List sections of a street plan and their predecessors, in an order that respects dependencies.

    Args:
        plan: Street plan.
        wanted: Sections that are needed.
        number: Number of the scene in the run.

    Returns:
        Sections.
    """
    needs: dict[BlockIndex, list[BlockIndex]] = {}
    waiting = [(section.ahead, section.left) for section in wanted]
    while waiting:
        if (index := waiting.pop()) not in needs:
            needs[index] = plan.list_predecessors(index)
            waiting += needs[index]
    ordered = sorted(needs, key=lambda index: (rank_outward(index), index))
    return [SectionTask(number, Section(*index), frozenset(Section(*one) for one in needs[index])) for index in ordered]


def make_section_path(directory: str, section: Section) -> str:
    """Return the path of the file of a section of a street plan.

    Args:
        directory: Directory of the blocks of the scene.
        section: The section.

    Returns:
        Path of a .safetensors file.
    """
    return storage.join_uri(directory, f"streets{section.ahead:+05d}{section.left:+05d}.safetensors")


def write_section(distance_m: np.ndarray, path: str) -> None:
    """Write a section.

    Args:
        distance_m: (2, size, size) distances (m).
        path: Path of the .safetensors file.
    """
    data = save({"distance_m": torch.from_numpy(distance_m.copy())})
    storage.write_whole(path, lambda stream: stream.write(data))


def read_section(path: str) -> np.ndarray:
    """Read the distances of a section of a street plan.

    Args:
        path: Path of the .safetensors file.

    Returns:
        (2, size, size) distances (m).

    Raises:
        ValueError: The file is damaged. The message names the file.
    """
    try:
        return load(storage.read_bytes(path))["distance_m"].numpy()
    except (SafetensorError, KeyError) as error:
        raise ValueError(f"{path}: no complete street plan ({error}); delete the file and run the job again") from error


def draw_plan(plan: StreetPlan, whole: Grid, first: Grid) -> bytes:
    """Draw a street plan as a map that `--road-sketch` accepts: white roads, grey sidewalks, black elsewhere.

    Args:
        plan: Street plan.
        whole: Grid of the city.
        first: Grid of the given scene, whose middle is the middle of the picture.

    Returns:
        PNG file with pixels of PLAN_PIXEL_M. It covers the city and is black outside.
    """
    ahead_m, left_m = (first.front_m + first.back_m) / 2, (first.left_m + first.right_m) / 2
    reach = max(whole.front_m - ahead_m, ahead_m - whole.back_m), max(whole.left_m - left_m, left_m - whole.right_m)
    rows, cols = (2 * round(one / PLAN_PIXEL_M) for one in reach)
    grid = Grid(ahead_m + rows / 2 * PLAN_PIXEL_M, left_m + cols / 2 * PLAN_PIXEL_M, PLAN_PIXEL_M, rows, cols)
    inside = whole.contains(grid.x_m()[:, None], grid.y_m()[None, :])
    road, paved = (mask & inside for mask in plan.collect(whole).draw(grid))
    stream = io.BytesIO()
    Image.fromarray(np.where(road, 255, np.where(paved, 128, 0)).astype(np.uint8)).save(stream, "png")
    return stream.getvalue()
