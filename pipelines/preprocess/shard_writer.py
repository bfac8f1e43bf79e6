"""Write one shard: read the drives, crop the scenes, and write the tables and a manifest.

A worker keeps at most BATCH_SCENES scenes in memory, even for a long drive.
"""

from __future__ import annotations

import hashlib
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict
from itertools import islice

import numpy as np
import pyarrow as pa

from models.geometry.cholesky import compute_cholesky_parameters
from models.scene import Grid, Scene
from pipelines.preprocess.sharding import ShardPart, ShardTask
from pipelines.preprocess.sources import argoverse2, custom, kitti360, py123d
from pipelines.preprocess.sources.drive import Drive
from pipelines.preprocess.sources.opendrive import reader as opendrive
from pipelines.preprocess.sources.osm import reader as osm
from pipelines.preprocess.sources.town import generator
from pipelines.runtime import storage
from pipelines.schema.columns import MAX_HEIGHT_M
from pipelines.schema.conversion import make_rejects_table, make_scene_tables
from pipelines.schema.dataset import Extremes, merge_extremes
from pipelines.schema.tables import Shard

BATCH_SCENES = 32

ReadDrive = Callable[[str, tuple], tuple[Drive, dict]]


def read_drive(source: str, key: tuple) -> tuple[Drive, dict]:
    """Read a drive, and report the objects that the reader dropped.

    Args:
        source: town, kitti360, av2, py123d, osm, opendrive or own.
        key: Arguments for the reader of this source.

    Returns:
        The drive, and a report on dropped objects as a dictionary. The dictionary is empty for most sources.

    Raises:
        ValueError: A file cannot be read; the message names the file.
    """
    if source == "town":
        seed, num_scenes, version, num_free = key
        drive = generator.generate_town(seed, version, num_free)
        return drive.at(generator.select_town_poses(len(drive), num_scenes, num_free)), {}
    if source == py123d.SOURCE:
        drive, skipped = py123d.read_drive(*key)
        return drive, {"boxes_without_category": skipped}
    if source in (osm.SOURCE, opendrive.SOURCE):
        return (osm if source == osm.SOURCE else opendrive).read_drive(*key)
    if source == "kitti360":
        drive, report = kitti360.read_drive(*key)
        return drive, asdict(report)
    return (argoverse2 if source == "av2" else custom).read_drive(*key), {}


class Rejected(ValueError):
    """Error that makes a scene a reject; the message is the reason."""


def cut_scenes(drive: Drive, pose: int, split: str, grid: Grid) -> Scene:
    """Crop the scene ahead of a pose.

    Args:
        drive: Drive.
        pose: Index of the pose.
        split: Value of the split column.
        grid: Raster grid of the scene.

    Returns:
        The scene.

    Raises:
        Rejected: The scene is empty, or its ground heights exceed the range of the tables.
    """
    try:
        scene = drive.scene(pose, split, grid)
    except ValueError as error:
        raise Rejected(str(error)) from error
    highest_m = np.abs(scene.height_m).max(initial=0)
    if not highest_m <= MAX_HEIGHT_M:
        raise Rejected(
            f"the ground lies {highest_m:.3g} m above or below the vehicle, but tables store at most {MAX_HEIGHT_M:g} m"
        )
    # The paper drops poses without any annotation (supplement A).
    if len(scene) == 0 and not scene.occupied.any():
        raise Rejected("the crop holds no annotation")
    return scene


def _check_poses(drive: Drive, part: ShardPart, poses: tuple[int, ...]) -> Drive:
    """Return the drive. Raise ValueError if the poses of the drive differ from the planned poses of the part."""
    if drive.frame.take(poses, mode="clip").tolist() != list(part.frames or ()):
        raise ValueError(f"the poses of {part.sequence} changed after this run began; run the same command again")
    return drive


class ShardCut:
    """Iterator over the scenes of a task. The iterator collects rejected scenes and unreadable drives."""

    def __init__(self, task: ShardTask, grid: Grid, read: ReadDrive = read_drive) -> None:
        self.task, self.grid, self.read = task, grid, read
        self.rejects: list[dict] = []
        self.unreadable: list[str] = []  # One reason per unreadable drive.
        self.reports: dict[str, dict] = {}  # Report on dropped objects for each sequence.

    def __iter__(self) -> Iterator[Scene]:
        for part in self.task.parts:
            try:
                drive, self.reports[part.sequence] = self.read(self.task.source, part.key)
                if part.poses is not None:
                    drive = _check_poses(drive, part, part.poses).at(np.array(part.poses), self.grid)
            except ValueError as error:
                self.unreadable.append(str(error))
                for frame in part.frames or [None]:
                    self._reject(part, frame, str(error))
                continue
            for pose, frame in enumerate(drive.frame.tolist()):
                try:
                    yield cut_scenes(drive, pose, self.task.split, self.grid)
                except Rejected as error:
                    self._reject(part, frame, str(error))

    def _reject(self, part: ShardPart, frame: int | None, reason: str) -> None:
        name = f"{self.task.source}-{part.sequence}" + ("" if frame is None else f"-{frame:010d}")
        self.rejects.append({"scene_id": name, "sequence": part.sequence, "frame": frame, "reason": reason})


def compute_extremes(scenes: list[Scene]) -> Extremes:
    """Return the lowest and highest values of the quantities that a model normalises.

    Args:
        scenes: Scenes.

    Returns:
        Lowest and highest values of cholesky (m^0.5), height (m) and z (m). Names without values are omitted.
    """
    values = {
        "cholesky": np.concatenate([compute_cholesky_parameters(s.rotation, s.size_m) for s in scenes]),
        "height": np.concatenate([s.height_m[s.occupied] for s in scenes])[:, None],
        "z": np.concatenate([s.center_m[:, 2:] for s in scenes]),
    }
    return {name: [v.min(axis=0).tolist(), v.max(axis=0).tolist()] for name, v in values.items() if len(v)}


def join_tables(parts: list[dict[str, pa.Table]]) -> dict[str, pa.Table]:
    """Concatenate the tables of several scene batches into the tables of one shard.

    Args:
        parts: Tables of each batch, as a map from table name to table.

    Returns:
        Map from table name to the table of the shard, with updated primitive offsets.
    """
    tables = {name: pa.concat_tables([part[name] for part in parts]) for name in parts[0]}
    scenes = tables["scenes"]
    count = scenes["num_primitives"].to_numpy().astype(np.int64)
    place = scenes.schema.get_field_index("primitive_offset")
    tables["scenes"] = scenes.set_column(place, scenes.schema.field(place), pa.array(np.cumsum(count) - count))
    return tables


def make_manifest_path(staging: str, task: ShardTask) -> str:
    """Return the path of the manifest of a task.

    Args:
        staging: Staging directory.
        task: Task.

    Returns:
        Path or URI of the JSON file.
    """
    return storage.join_uri(staging, "manifest", f"{task.source}-{task.split}-{task.number:05d}.json")


def list_promised_rows(manifest: dict, output: str, place_of_scenes: str) -> dict[str, int]:
    """List the files of a shard.

    Args:
        manifest: Manifest of the shard.
        output: Dataset directory.
        place_of_scenes: Directory of the table scenes: the staging directory or the dataset directory.

    Returns:
        Number of rows of each file.
    """
    shard, staged = (
        Shard(root, manifest["source"], manifest["split"], manifest["number"]) for root in (output, place_of_scenes)
    )
    scenes, rejects = manifest["scenes"], sum(manifest["rejects"].values())
    promised = {shard.path("rejects"): rejects} if rejects else {}
    if scenes:
        promised |= {staged.path("scenes"): scenes, shard.path("rasters"): scenes}
        promised |= {shard.path("primitives"): manifest.get("primitives", -1)}  # version 0.2 lacks it
    return promised


def write_shard(task: ShardTask, output: str, staging: str, grid: Grid, read: ReadDrive = read_drive) -> dict:
    """Write one shard and its manifest; a finished shard is not written again.

    The scenes, whose density labels are not known yet, and the manifest go to the staging directory. All other tables
    go to the dataset directory.

    There is one exception: if the parts of the shard have changed since the run began, the shard is written again.
    Parts change if a drive is added or if poses are repaired.

    Args:
        task: Shard to write.
        output: Dataset directory.
        staging: Staging directory.
        grid: Raster grid of the scenes.
        read: Reader of a drive.

    Returns:
        The manifest.
    """
    path = make_manifest_path(staging, task)
    parts = hashlib.blake2b(repr(task.parts).encode(), digest_size=16).hexdigest()
    if storage.exists(path):
        finished = storage.read_json(path)
        is_current = finished.get("parts") == parts
        if is_current and not storage.find_faulty_files(list_promised_rows(finished, output, staging)):
            return finished
    started = time.perf_counter()
    cuts = ShardCut(task, grid, read)
    scenes, tables, measured, classes = iter(cuts), [], [], ()
    while batch := list(islice(scenes, BATCH_SCENES)):
        tables.append(make_scene_tables(batch))
        measured.append(compute_extremes(batch))
        classes = batch[0].ground_classes
    num_scenes = num_primitives = 0
    if tables:
        joined = join_tables(tables)
        num_scenes, num_primitives = len(joined["scenes"]), len(joined["primitives"])
        # The scenes lack density labels. They are written last, because they mark the shard as written.
        for name, root in (("primitives", output), ("rasters", output), ("scenes", staging)):
            storage.write_parquet(joined[name], task.shard(root).path(name))
    if cuts.rejects:
        storage.write_parquet(make_rejects_table(cuts.rejects), task.shard(output).path("rejects"))
    manifest = {
        "source": task.source,
        "split": task.split,
        "number": task.number,
        "parts": parts,
        "scenes": num_scenes,
        "primitives": num_primitives,
        "rejects": dict(Counter(row["reason"] for row in cuts.rejects)),
        "unreadable": cuts.unreadable,
        "reports": cuts.reports,
        "extremes": merge_extremes(measured),
        "ground_classes": list(classes),
        "seconds": time.perf_counter() - started,
    }
    if not cuts.unreadable:  # Without a manifest, the next run writes the shard again.
        storage.write_json(manifest, path)
    return manifest
