"""Measure the seams in the scenes of a source with Ray, and render the page."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import chain

import numpy as np
import pyarrow as pa

from models.scene import Grid, Scene
from pipelines.evaluation.features import READER_CPUS, load_scenes
from pipelines.metrics.seams import (
    FAR_M,
    MEASURES,
    NEAR_M,
    estimate_seam_ratios,
    join_unrelated_scenes,
    measure_scene_seams,
)
from pipelines.rendering.render import MARK_COLOR, render_bev
from pipelines.reporting.evaluation_report import format_value
from pipelines.reporting.report import Picture, Pictures, Table, Text, render_report_html
from pipelines.runtime.ray_tasks import map_tasks
from pipelines.schema.scene_subset import SceneSubset, select_evenly
from pipelines.schema.tables import Shard

BLOCK_M = 64.0  # Side length of the middle block of an outpainted scene.
COLUMNS = {"generated": "generated", "real": "real scenes (ceiling)", "joined": "unrelated real scenes (control)"}
MEANINGS = {
    "class_changes": "share of pixel pairs across the line with different ground classes",
    "height_step": "mean height difference of the ground at the line",
    "cut_objects": "share of objects near the line that end at the line",
    "doubled_objects": "share of objects at the line that overlap an object of the same category on the other side",
}


@dataclass(frozen=True)
class SeamLines:
    """Positions of seams. By default, the seams are the edges of the middle block of a scene.

    Attributes:
        rows_m: Distances of seams from the front edge of the scene (m).
        cols_m: Distances of seams from the left edge of the scene (m).
    """

    rows_m: tuple[float, ...] = ()
    cols_m: tuple[float, ...] = ()

    def pixels(self, grid: Grid) -> tuple[list[int], list[int]]:
        """Return the indices of the pixel rows and columns that follow the seams. Raises ValueError if the scene is too
        small for seams."""
        sides = [(self.rows_m, grid.rows), (self.cols_m, grid.cols)]
        if not (self.rows_m or self.cols_m):
            sides = [(find_middle_m(count * grid.resolution_m), count) for _, count in sides]
        found = [[round(line / grid.resolution_m) for line in lines] for lines, _ in sides]
        if not any(found):
            raise ValueError(
                f"scenes of {grid.rows} x {grid.cols} pixels have no seams by default; pass their positions with"
                " --rows-m or --cols-m"
            )
        return found[0], found[1]


def find_middle_m(extent_m: float) -> tuple[float, ...]:
    """Return the two edges (m) of the middle block along an extent, or () if the extent is a single block."""
    margin_m = (extent_m - BLOCK_M) / 2
    return (margin_m, extent_m - margin_m) if margin_m > 0 else ()


@dataclass(frozen=True, eq=False)
class SeamMeasurement:
    """Records of the seams in scenes.

    Attributes:
        scene_ids: Scene ids.
        records: (n, 4, 2, 2) records of `measure_scene_seams`.
        seams: (n,) number of seams of each scene.
    """

    scene_ids: list[str]
    records: np.ndarray
    seams: np.ndarray


def measure_shard(
    parts: list[tuple[Shard, list[int]]], number: int, lines: SeamLines, is_joined: bool
) -> list[tuple[str, int, np.ndarray]]:
    """Measure the seams in the selected scenes of one shard; return scene id, number of seams and record per scene."""
    shard, rows = parts[number]
    total, first = sum(len(r) for _, r in parts), sum(len(r) for _, r in parts[:number])
    before = load_scenes(parts, np.arange(first - 1, first - 1 + len(rows)) % total) if is_joined else ()
    out = []
    for place, scene in enumerate(shard.scenes(rows)):
        if is_joined:
            across, along = [scene.grid.rows // 2], []
            scene = join_unrelated_scenes(scene, before[place], across[0])
        else:
            across, along = lines.pixels(scene.grid)
        out.append((scene.scene_id, len(across) + len(along), measure_scene_seams(scene, across, along)))
    return out


def measure_seams(
    selection: SceneSubset,
    lines: SeamLines,
    num_tasks: int,
    on_scene: Callable[[], None] = lambda: None,
    is_joined: bool = False,
) -> SeamMeasurement:
    """Measure the seams in a selection of scenes, with one task per shard.

    Args:
        selection: Scenes.
        lines: Positions of the seams.
        num_tasks: Maximum number of concurrent tasks.
        on_scene: Called after each scene.
        is_joined: Whether to measure the control instead of the scenes: the far half of each scene, joined in the
            middle with the near half of the scene before it. `lines` is then ignored.

    Returns:
        Records of all scenes.

    Raises:
        ValueError: The control needs two scenes, but only one is selected.
    """
    parts = selection.shards()
    if is_joined and sum(len(rows) for _, rows in parts) < 2:
        raise ValueError(f"{selection.root}: one scene is selected; joined scenes need at least two")

    def measure_part(number: int) -> list[tuple[str, int, np.ndarray]]:
        return measure_shard(parts, number, lines, is_joined)

    found = []
    for row in chain.from_iterable(map_tasks(measure_part, range(len(parts)), READER_CPUS, num_tasks)):
        found.append(row)
        on_scene()
    names, seams, records = zip(*sorted(found, key=lambda row: row[0]), strict=True)
    return SeamMeasurement(list(names), np.stack(records), np.array(seams))


# ------------------------------------------------------------------------------------------------------ writing


def join_scene_sets(measured: Mapping[str, SeamMeasurement]) -> dict:
    """Return the ratio per measure, the number of scenes and the number of seams, each for all sides."""
    ratios = {side: estimate_seam_ratios(found.records, key) for key, (side, found) in enumerate(measured.items())}
    return {
        "scenes": {side: len(found.scene_ids) for side, found in measured.items()},
        "seams": {side: int(found.seams.sum()) for side, found in measured.items()},
        "ratios": {name: {side: ratios[side][name] for side in ratios} for name in MEASURES},
    }


def build_seams_table(measured: Mapping[str, SeamMeasurement]) -> pa.Table:
    """Return one row per scene: side, scene_id, seams, and the numerator and denominator of each measure."""
    rows = []
    for side, found in measured.items():
        for scene_id, seams, record in zip(found.scene_ids, found.seams.tolist(), found.records.tolist(), strict=True):
            row = {"side": side, "scene_id": scene_id, "seams": seams}
            for name, (across, nearby) in zip(MEASURES, record, strict=True):
                row |= {f"{name}_across": across[0], f"{name}_of": across[1]}
                row |= {f"{name}_nearby": nearby[0], f"{name}_nearby_of": nearby[1]}
            rows.append(row)
    return pa.Table.from_pylist(rows)


def select_shown_rows(scores: Mapping) -> list[tuple[str, ...]]:
    """Return, for each measure, its name and the formatted ratios of each side."""
    return [
        (name.replace("_", " "), *(format_value(ratio) or "–" for ratio in sides.values()))
        for name, sides in scores["ratios"].items()
    ]


def draw_lines(scene: Scene, lines: SeamLines, size_px: int = 512) -> np.ndarray:
    """Render the scene from above, with marks at the ends of the seams; return (H, W, 3) uint8."""
    picture = render_bev(scene, size_px, supersample=2).copy()
    scale = picture.shape[0] / scene.grid.rows
    tick = size_px // 24
    for axis, seams in enumerate(lines.pixels(scene.grid)):
        turned = picture.swapaxes(0, axis)
        for seam in seams:
            at = round(seam * scale)
            turned[at - 1 : at + 1, :tick] = turned[at - 1 : at + 1, -tick:] = MARK_COLOR
    return picture


def render_seams_html(scores: Mapping, selection: SceneSubset, lines: SeamLines, count: int) -> str:
    """Render the page: ratios and their meaning, and example scenes with marks at the ends of the seams."""
    parts = selection.shards()
    total = sum(len(rows) for _, rows in parts)
    scenes = load_scenes(parts, select_evenly(total, min(count, total)))
    pictures = [Picture(scene.scene_id, draw_lines(scene, lines), "generated") for scene in scenes]
    table = Table(
        "Seam ratios",
        ("measure", *(COLUMNS[side] for side in scores["scenes"])),
        select_shown_rows(scores),
        meanings=list(MEANINGS.values()),
        note="Each ratio is the rate across seams divided by the rate across nearby lines. A ratio of 1 means that "
        "seams are invisible. Brackets contain 95 % bootstrap intervals over scenes.",
    )
    how = (
        f"The generated side has {scores['seams']['generated']} seams in {scores['scenes']['generated']} scenes. "
        f"The real side has {scores['seams']['real']} lines across the driving direction in "
        f"{scores['scenes']['real']} scenes. The control joins halves of different real scenes. "
        f"Nearby lines are parallel to a seam, {NEAR_M:g} to {FAR_M:g} m away from "
        f"it, and at least {NEAR_M:g} m away from all other seams."
    )
    pages = [table, Pictures("Generated scenes", pictures, columns=3), Text("Method", [how])]
    return render_report_html("Seams", pages)
