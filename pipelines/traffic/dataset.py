"""Simulate the traffic of the scenes of a dataset with Ray, and write the tables tracks and traffic."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from models.layout import SLAB_OFFSET_M
from models.scene import Scene
from pipelines.runtime import storage
from pipelines.runtime.ray_tasks import map_tasks
from pipelines.schema.columns import TRACKS, TRAFFIC, TRAFFIC_TABLES
from pipelines.schema.ground_surface import find_surface
from pipelines.schema.run_guard import guard_tables
from pipelines.schema.scene_subset import SceneSubset
from pipelines.schema.tables import Shard
from pipelines.traffic.demand import KINDS, Demand
from pipelines.traffic.obstacles import close_roads
from pipelines.traffic.simulation import TrafficHealth, simulate_scene
from pipelines.traffic.sumo import check_sumo, require_sumo
from pipelines.traffic.tracks import Tracks

PART_SCENES = 2  # Number of scenes per task.


@dataclass(frozen=True)
class TrafficRequest:
    """Options of a simulation of all scenes.

    Attributes:
        output: Dataset directory to write.
        demand: Traffic.
        seed: Seed; the traffic of a scene depends on it and on the id of the scene.
        slab_offset_m: Height of the ground rasters above the surface on which objects stand (m). None: the value of the
            source; 0.3 m for generated scenes.
        control: Whether a copy of each scene with closed roads is simulated, too.
    """

    output: str
    demand: Demand
    seed: int = 0
    slab_offset_m: float | None = None
    control: bool = True

    def find_slab_offset(self, scene: Scene) -> float:
        """Return the height of the ground rasters above the surface on which objects stand (m).

        Args:
            scene: Scene.

        Returns:
            Height (m).
        """
        if self.slab_offset_m is not None:
            return self.slab_offset_m
        return SLAB_OFFSET_M if find_surface(scene.source, scene.scene_id, "top") == "top" else 0.0


class Part(NamedTuple):
    """Scenes of a shard that one task simulates."""

    request: TrafficRequest
    shard: Shard
    rows: list[int]


class PartResult(NamedTuple):
    """Tables of the scenes of a part, by row number of the scene."""

    shard: Shard
    tracks: dict[int, pa.Table]
    traffic: dict[int, pa.Table]


def make_tracks_table(scene_id: str, tracks: Tracks) -> pa.Table:
    """Convert trajectories to rows of the table tracks.

    Args:
        scene_id: Name of the scene.
        tracks: Trajectories.

    Returns:
        Rows.
    """
    columns: dict[str, Any] = {
        "scene_id": [scene_id] * len(tracks),
        "object_id": tracks.object_id,
        "category": [KINDS[kind].category for kind in tracks.kind],
        "time_s": tracks.time_s,
        **dict(zip(("x_m", "y_m", "z_m"), tracks.center_m.T, strict=True)),
        "yaw_rad": tracks.yaw_rad,
        "speed_mps": tracks.speed_mps,
        **dict(zip(("length_m", "width_m", "height_m"), tracks.size_m.T, strict=True)),
    }
    values = {
        name: np.asarray(column) if name not in ("scene_id", "category") else column for name, column in columns.items()
    }
    return pa.table({field.name: pa.array(values[field.name]).cast(field.type) for field in TRACKS}, schema=TRACKS)


def make_traffic_row(scene_id: str, control: bool, health: TrafficHealth | None, failure: str | None) -> dict:
    """Return a row of the table traffic.

    Args:
        scene_id: Name of the scene.
        control: Whether the row belongs to the damaged copy of the scene.
        health: What happened to the vehicles; None if there is no simulation.
        failure: Reason why there is no simulation, or None.

    Returns:
        Row.
    """
    row = dict.fromkeys(TRAFFIC.names) | {"scene_id": scene_id, "control": control, "failure": failure}
    if health is not None:
        row |= {
            name: None if isinstance(value, float) and np.isnan(value) else value
            for name, value in asdict(health).items()
        }
    return row


def simulate_part(part: Part) -> PartResult:
    """Simulate the scenes of a part. A scene without simulation has the reason in its row of the table traffic.

    Args:
        part: Scenes.

    Returns:
        Tables.

    Raises:
        RuntimeError: SUMO is not installed on this node.
    """
    check_sumo(require_sumo())
    request, (shard, rows) = part.request, part[1:]
    found = PartResult(shard, {}, {})
    for number, scene in zip(rows, shard.scenes(rows), strict=True):
        table, records = TRACKS.empty_table(), []
        for control in (False, True) if request.control else (False,):
            tracks, health, failure = try_scene(scene, request, control)
            records.append(make_traffic_row(scene.scene_id, control, health, failure))
            if tracks is not None and not control:
                table = make_tracks_table(scene.scene_id, tracks)
        found.tracks[number] = table
        found.traffic[number] = pa.Table.from_pylist(records, schema=TRAFFIC)
    return found


def try_scene(
    scene: Scene, request: TrafficRequest, control: bool
) -> tuple[Tracks | None, TrafficHealth | None, str | None]:
    """Simulate a scene.

    Args:
        scene: Scene.
        request: Options.
        control: Whether to simulate the copy of the scene with closed roads.

    Returns:
        Trajectories, health, and None; or None, None, and the reason why there is no simulation.
    """
    try:
        scene = close_roads(scene, request.seed) if control else scene
        offset_m = request.find_slab_offset(scene)
        return *simulate_scene(scene, request.demand, request.seed, offset_m), None
    except Exception as error:  # One scene must not stop the others.
        kind = "" if isinstance(error, (ValueError, RuntimeError)) else f"{type(error).__name__}: "
        return None, None, f"{kind}{error}"[:500]


def simulate_dataset(
    request: TrafficRequest, selection: SceneSubset, on_scenes: Callable[[int], None] | None = None
) -> list[Shard]:
    """Simulate the traffic of the selected scenes; resume an interrupted run.

    Each shard of the tables scenes gets a file of the same number in the tables tracks and traffic.

    Args:
        request: Options.
        selection: Scenes.
        on_scenes: Called with the number of scenes that were finished since the previous call.

    Returns:
        Shards of the tables tracks and traffic.

    Raises:
        RuntimeError: SUMO is not installed.
        ValueError: The output contains tracks with other options.
    """
    check_sumo(require_sumo())
    options = {key: value for key, value in asdict(request).items() if key != "output"}
    guard_tables(request.output, "traffic", TRAFFIC_TABLES, options, selection)
    shards = [(replace(shard, root=request.output), shard, rows) for shard, rows in selection.shards()]
    waiting = {target: (source, rows) for target, source, rows in shards if not is_written(target, rows, request)}
    if on_scenes:
        on_scenes(sum(len(rows) for target, _, rows in shards if target not in waiting))
    parts, results = [], {target: PartResult(target, {}, {}) for target in waiting}
    for source, rows in waiting.values():
        parts += [Part(request, source, rows[k : k + PART_SCENES]) for k in range(0, len(rows), PART_SCENES)]
    for found in map_tasks(simulate_part, parts):
        target = replace(found.shard, root=request.output)
        result = results[target]
        result.tracks.update(found.tracks)
        result.traffic.update(found.traffic)
        rows = waiting[target][1]
        if len(result.traffic) == len(rows):
            for table, content in zip(TRAFFIC_TABLES, (result.tracks, result.traffic), strict=True):
                storage.write_parquet(pa.concat_tables([content[row] for row in rows]), target.path(table))
            del results[target]
        if on_scenes:
            on_scenes(len(found.traffic))
    return [target for target, _, _ in shards]


def is_written(shard: Shard, rows: Sequence[int], request: TrafficRequest) -> bool:
    """Return whether a shard has complete tables tracks and traffic.

    Args:
        shard: Shard of the output.
        rows: Row numbers of its scenes.
        request: Options.

    Returns:
        True if both files can be read, and traffic has the rows of all scenes.
    """
    try:
        storage.read_num_rows(shard.path("tracks"))
        return storage.read_num_rows(shard.path("traffic")) == len(rows) * (2 if request.control else 1)
    except ValueError:
        return False
