"""Convert the scenes of a dataset to voxels with Ray, and write the table voxels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import NamedTuple

from models.voxel_grids import COARSE_FACTORS, Factor
from pipelines.geometry.voxels import VoxelGrid, voxelize
from pipelines.io.voxel_table import make_voxel_row, make_voxel_table
from pipelines.runtime import storage
from pipelines.runtime.ray_tasks import map_tasks
from pipelines.schema.run_guard import guard_tables
from pipelines.schema.scene_subset import SceneSubset
from pipelines.schema.tables import Shard

PART_SCENES = 16  # Number of scenes per task.


@dataclass(frozen=True)
class VoxelRequest:
    """Options of the conversion.

    Attributes:
        output: Dataset directory to write.
        bottom_m: Lower end of the voxels in the scene frame (m).
        top_m: Upper end of the voxels in the scene frame (m).
        levels: Number of levels.
        factors: Sizes of coarse voxels to store, too.
    """

    output: str
    bottom_m: float = VoxelGrid.bottom_m
    top_m: float = VoxelGrid.top_m
    levels: int = VoxelGrid.levels
    factors: tuple[Factor, ...] = COARSE_FACTORS


class Part(NamedTuple):
    """Scenes of a shard that one task converts."""

    request: VoxelRequest
    shard: Shard
    rows: list[int]


class PartResult(NamedTuple):
    """Rows of the table voxels of a part, by row number of the scene."""

    shard: Shard
    rows: dict[int, dict]


def voxelize_part(part: Part) -> PartResult:
    """Convert the scenes of a part.

    Args:
        part: Scenes.

    Returns:
        Rows.

    Raises:
        ValueError: A scene has another size than whole blocks of coarse voxels.
    """
    request, shard, rows = part
    found = {}
    for number, scene in zip(rows, shard.scenes(rows), strict=True):
        grid = VoxelGrid(scene.grid, request.bottom_m, request.top_m, request.levels)
        found[number] = make_voxel_row(scene.scene_id, voxelize(scene, grid), grid, request.factors)
    return PartResult(shard, found)


def voxelize_dataset(
    request: VoxelRequest, selection: SceneSubset, on_scenes: Callable[[int], None] | None = None
) -> list[Shard]:
    """Convert the selected scenes; resume an interrupted run.

    Each shard of the table scenes gets a file of the same number in the table voxels.

    Args:
        request: Options.
        selection: Scenes.
        on_scenes: Called with the number of scenes that were finished since the previous call.

    Returns:
        Shards of the table voxels.

    Raises:
        ValueError: The output contains voxels with other options, or a scene cannot be converted.
    """
    options = {key: value for key, value in asdict(request).items() if key != "output"}
    guard_tables(request.output, "voxels", ["voxels"], options, selection)
    shards = [(replace(shard, root=request.output), shard, rows) for shard, rows in selection.shards()]
    promised = {target.path("voxels"): len(rows) for target, _, rows in shards}
    faults = storage.find_faulty_files(promised)
    waiting = {target: (source, rows) for target, source, rows in shards if target.path("voxels") in faults}
    if on_scenes:
        on_scenes(sum(len(rows) for target, _, rows in shards if target not in waiting))
    parts, results = [], {target: dict[int, dict]() for target in waiting}
    for source, rows in waiting.values():
        parts += [Part(request, source, rows[k : k + PART_SCENES]) for k in range(0, len(rows), PART_SCENES)]
    for found in map_tasks(voxelize_part, parts):
        target = replace(found.shard, root=request.output)
        result = results[target]
        result.update(found.rows)
        rows = waiting[target][1]
        if len(result) == len(rows):
            storage.write_parquet(make_voxel_table([result[row] for row in rows]), target.path("voxels"))
            del results[target]
        if on_scenes:
            on_scenes(len(found.rows))
    return [target for target, _, _ in shards]
