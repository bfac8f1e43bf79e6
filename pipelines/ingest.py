"""Raw drives -> Parquet tables: one Ray Data graph, two passes (paper, supplement A).

Pass 1 cuts scenes: one task per shard reads a drive and writes its own files to a staging directory, by temporary
name and move, so that a killed task leaves nothing and a finished shard is never redone. Pass 2 knows the whole
training split: it fixes density thresholds, slot counts and bounds, labels the scenes, and moves everything into
place; dataset.json comes last and means "complete".
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import lru_cache

import numpy as np
import pyarrow as pa
import ray.data

from models.cholesky import cholesky_parameters
from models.layout import Bounds, LayoutSpec
from models.scene import CATEGORIES, GROUND_CLASSES, VEGETATION, VEHICLES, Grid, Scene
from pipelines import storage
from pipelines.labels import DensityThresholds, density, density_thresholds
from pipelines.scenes.tables import SCENES, Shard, encode_ground, rejects_table
from pipelines.sources import argoverse2, kitti360, town
from pipelines.sources.drive import Drive
from pipelines.splits import ARGOVERSE2_SPLIT, no_split, split_poses

SHARD_SCENES = 256
LOGS_PER_SHARD = 2  # Argoverse 2: about 160 sweeps each
STAGING = ".staging"
# What ground heights are: tops of slabs, 0.3 m above what objects stand on, or that surface itself.
SURFACE = {"town": "top", "kitti360": "top", "av2": "surface"}


# --------------------------------------------------------------------------------------------------------- plan


@dataclass(frozen=True)
class Part:
    """Some poses of one drive: `key` is what its source needs to read it; `poses` None means all."""

    key: tuple
    sequence: str
    poses: tuple[int, ...] | None
    frames: tuple[int, ...] | None  # for rejects of a drive that cannot be read


@dataclass(frozen=True)
class Task:
    """One shard to write: its source, split and number, and the parts it is cut from."""

    source: str
    split: str
    number: int
    parts: tuple[Part, ...]

    def shard(self, root: str) -> Shard:
        return Shard(root, self.source, self.split, self.number)


def plan_town(num_train: int, num_test: int, seed: int) -> list[Task]:
    """A task per town."""
    tasks, numbers = [], {}
    for town_seed, split, count in town.town_plan(num_train, num_test, seed):
        numbers[split] = number = numbers.get(split, -1) + 1
        tasks.append(Task("town", split, number, (Part((town_seed, count), f"{town_seed:05d}", None, None),)))
    return tasks


def plan_kitti360(root: str, split: bool = True) -> list[Task]:
    """Tasks of at most SHARD_SCENES poses of one sequence and one side of the split."""
    poses = {sequence: kitti360.read_poses(root, sequence) for sequence in kitti360.sequences(root)}
    labels = (split_poses if split else no_split)({s: matrix[:, :, 3] for s, (_, matrix) in poses.items()})
    tasks = []
    for side in ("train", "test", "unused"):
        number = 0
        for sequence, (frames, _) in poses.items():
            members = np.flatnonzero(labels[sequence] == side)
            for start in range(0, len(members), SHARD_SCENES):
                chosen = members[start : start + SHARD_SCENES]
                part = Part((root, sequence), sequence, tuple(chosen.tolist()), tuple(frames[chosen].tolist()))
                tasks.append(Task("kitti360", side, number, (part,)))
                number += 1
    return tasks


def plan_argoverse2(root: str) -> list[Task]:
    """Tasks of a few logs each; AV2's own train is train, its val is test."""
    tasks = []
    for theirs, side in ARGOVERSE2_SPLIT.items():
        logs = [log for split, log in argoverse2.logs(root) if split == theirs]
        for number, start in enumerate(range(0, len(logs), LOGS_PER_SHARD)):
            parts = tuple(Part((root, theirs, log), log, None, None) for log in logs[start : start + LOGS_PER_SHARD])
            tasks.append(Task("av2", side, number, parts))
    return tasks


# ------------------------------------------------------------------------------------------------------- pass 1


@lru_cache(maxsize=1)
def _read_kitti360(root: str, sequence: str) -> tuple[Drive, dict]:
    """Consecutive tasks of a worker mostly share their sequence: the last one stays in memory."""
    drive, report = kitti360.read_drive(root, sequence)
    return drive, asdict(report)


def read_part(source: str, part: Part) -> tuple[Drive, np.ndarray, dict]:
    """The drive of a part, the pose indices to cut, and what its reader dropped. ValueError if unreadable."""
    if source == "town":
        seed, count = part.key
        drive = town.town_drive(seed)
        return drive, town.take(len(drive), count), {}
    if source == "kitti360":
        drive, report = _read_kitti360(*part.key)
        return drive, np.array(part.poses), report
    drive = argoverse2.read_drive(*part.key)
    return drive, np.arange(len(drive)), {}


def _reject(sequence: str, frame: int | None, source: str, reason: str) -> dict:
    name = f"{source}-{sequence}" if frame is None else f"{source}-{sequence}-{frame:010d}"
    return {"scene_id": name, "sequence": sequence, "frame": frame, "reason": reason}


def cut_scenes(task: Task, grid: Grid) -> tuple[list[Scene], list[dict], list[str], dict]:
    """Scenes of a task, rejected scenes, unreadable drives (reasons) and the readers' reports by sequence."""
    scenes, rejects, unreadable, reports = [], [], [], {}
    for part in task.parts:
        try:
            drive, poses, reports[part.sequence] = read_part(task.source, part)
        except ValueError as error:
            unreadable.append(str(error))
            rejects += [_reject(part.sequence, frame, task.source, str(error)) for frame in part.frames or [None]]
            continue
        for pose in poses:
            try:
                scene = drive.scene(int(pose), task.split, grid)
                encode_ground(scene)  # heights beyond what a table holds
            except ValueError as error:
                rejects.append(_reject(part.sequence, int(drive.frame[pose]), task.source, str(error)))
                continue
            # The paper drops poses without any annotation (supplement A).
            if len(scene) == 0 and not scene.occupied.any():
                rejects.append(_reject(part.sequence, scene.frame, task.source, "nothing is annotated in the crop"))
            else:
                scenes.append(scene)
    return scenes, rejects, unreadable, reports


def summarise(scenes: list[Scene]) -> dict:
    """What pass 2 needs of a shard beyond its scenes table: extremes of what will be normalised."""
    parameters = [cholesky_parameters(s.rotation, s.size_m) for s in scenes if len(s)]
    heights = [s.height_m[s.occupied] for s in scenes if s.occupied.any()]
    z = [s.center_m[:, 2] for s in scenes if len(s)]
    return {
        "cholesky": _extremes(np.concatenate(parameters)) if parameters else None,
        "height": _extremes(np.concatenate(heights)[:, None]) if heights else None,
        "z": _extremes(np.concatenate(z)[:, None]) if z else None,
        "ground_classes": list(scenes[0].ground_classes) if scenes else None,
    }


def _extremes(values: np.ndarray) -> list[list[float]]:
    return [values.min(axis=0).tolist(), values.max(axis=0).tolist()]


def _manifest_path(staging: str, task: Task) -> str:
    return storage.join(staging, "manifest", f"{task.source}-{task.split}-{task.number:05d}.json")


def write_shard(task: Task, staging: str, grid: Grid) -> dict:
    """Row in: a task. Row out: its manifest. One shard per task; a finished one is not redone."""
    manifest_path, shard = _manifest_path(staging, task), task.shard(staging)
    if storage.exists(manifest_path):
        return storage.read_json(manifest_path)
    started = time.perf_counter()
    scenes, rejects, unreadable, reports = cut_scenes(task, grid)
    if scenes:
        shard.write(scenes)
    manifest = {
        "source": task.source,
        "split": task.split,
        "number": task.number,
        "scenes": len(scenes),
        "rejects": rejects,
        "unreadable": unreadable,
        "reports": reports,
        "summary": summarise(scenes),
        "seconds": time.perf_counter() - started,
    }
    if not unreadable:  # a file that gets repaired is read again
        storage.write_json(manifest, manifest_path)
    return manifest


def write_shards(tasks: list[Task], staging: str, grid: Grid) -> Iterator[dict]:
    """Manifests as they are done, in any order; one Ray task per shard."""
    dataset = ray.data.from_items([{"task": k} for k in range(len(tasks))], override_num_blocks=len(tasks))

    def write(row: dict) -> dict:
        return {"manifest": storage.json.dumps(write_shard(tasks[row["task"]], staging, grid))}

    for row in dataset.map(write, num_cpus=1).iter_rows():
        yield storage.json.loads(row["manifest"])


# ------------------------------------------------------------------------------------------------------- pass 2


@dataclass(frozen=True)
class Statistics:
    """What the training split says: label thresholds and the LayoutSpec."""

    vegetation: DensityThresholds
    vehicle: DensityThresholds
    spec: LayoutSpec


def group_count(scenes: pa.Table, group: tuple[int, ...]) -> np.ndarray:
    """(n,) primitives of a group of categories per row of `scenes`."""
    return sum(scenes[f"num_{CATEGORIES[k]}"].to_numpy() for k in group)


def training_statistics(manifests: list[dict], staging: str, grid: Grid, slots: tuple[int, ...] | None) -> Statistics:
    """Thresholds, p95 counts and bounds of the training split. ValueError if it is empty.

    `slots` fixes the counts (the paper's N = 514) instead of the 95th percentile.
    """
    training = [m for m in manifests if m["split"] == "train" and m["scenes"]]
    if not training:
        raise ValueError("the training split is empty; give more data, or preprocess without a split")
    shards = [Shard(staging, m["source"], m["split"], m["number"]) for m in training]
    scenes = pa.concat_tables([shard.read("scenes") for shard in shards])
    counts = np.stack([scenes[f"num_{name}"].to_numpy() for name in CATEGORIES], axis=1)
    present = counts.sum(axis=0) > 0
    p95 = np.ceil(np.percentile(counts, 95, axis=0)).clip(1).astype(int)
    chosen = np.array(slots) if slots else p95

    def bounds(name: str) -> Bounds:
        found = [m["summary"][name] for m in training if m["summary"][name]]
        low = np.min([f[0] for f in found], axis=0) if found else np.zeros(1)
        high = np.max([f[1] for f in found], axis=0) if found else np.ones(1)
        margin = np.maximum(0.01 * (high - low), 1e-3)
        return Bounds(tuple((low - margin).tolist()), tuple((high + margin).tolist()))

    z = bounds("z")
    classes = {name for m in training for name in m["summary"]["ground_classes"]}
    spec = LayoutSpec(
        categories=tuple(name for name, keep in zip(CATEGORIES, present, strict=True) if keep),
        slots=tuple(int(n) for n in chosen[present]),
        ground_classes=tuple(name for name in GROUND_CLASSES if name in classes),
        grid=grid,
        center_bounds_m=Bounds((grid.back_m, grid.right_m, *z.low), (grid.front_m, grid.left_m, *z.high)),
        cholesky_bounds=bounds("cholesky"),
        height_bounds_m=bounds("height"),
        surface=SURFACE[training[0]["source"]],
    )
    thresholds = [
        density_thresholds(group_count(scenes, group), scenes[volume].to_numpy())
        for group, volume in ((VEGETATION, "vegetation_volume_m3"), (VEHICLES, "vehicle_volume_m3"))
    ]
    return Statistics(*thresholds, spec)


def label_scenes(scenes: pa.Table, statistics: Statistics) -> pa.Table:
    """The scenes table with both density labels."""
    groups = (("vegetation", VEGETATION, statistics.vegetation), ("vehicle", VEHICLES, statistics.vehicle))
    for name, group, thresholds in groups:
        labels = density(group_count(scenes, group), scenes[f"{name}_volume_m3"].to_numpy(), thresholds)
        column = f"{name}_density"
        scenes = scenes.set_column(
            scenes.column_names.index(column), SCENES.field(column), pa.array(labels, pa.string())
        )
    return scenes.cast(SCENES)


def publish(root: str, staging: str, manifests: list[dict], statistics: Statistics) -> None:
    """Label the scenes and move every staged file into place. Safe to repeat after a crash at any point."""
    for manifest in manifests:
        where = (manifest["source"], manifest["split"], manifest["number"])
        staged, final = Shard(staging, *where), Shard(root, *where)
        if manifest["scenes"]:
            for table in ("primitives", "rasters"):
                if storage.exists(staged.path(table)):
                    storage.move(staged.path(table), final.path(table))
            storage.write_parquet(label_scenes(staged.read("scenes"), statistics), final.path("scenes"))
        if manifest["rejects"]:
            storage.write_parquet(rejects_table(manifest["rejects"]), final.path("rejects"))


@dataclass(frozen=True)
class IngestResult:
    """What a run of `ingest` did."""

    scenes: dict[str, int]  # split -> scenes
    rejects: dict[str, int]  # reason -> scenes
    duplicates: int
    seconds: float
    already_complete: bool = False


def ingest(
    tasks: list[Task],
    root: str,
    options: dict,
    slots: tuple[int, ...] | None = None,
    grid: Grid | None = None,
    skip_unreadable: bool = False,
    on_shard: Callable[[dict], None] | None = None,
) -> IngestResult:
    """Write the dataset directory `root`. The same call again goes on where it stopped.

    `options` is what the user asked for; it is kept in dataset.json, and a directory made with other options is
    refused. A drive that cannot be read stops the run after everything else is staged (ValueError), unless
    `skip_unreadable`.
    """
    started = time.perf_counter()
    grid = grid or Grid()
    description, staging = storage.join(root, "dataset.json"), storage.join(root, STAGING)
    options_path = storage.join(staging, "options.json")
    for path in (description, options_path):
        if storage.exists(path):
            made = storage.read_json(path)
            made = made["options"] if path == description else made
            if made != options:
                raise ValueError(f"{root} was made with {made}, asked for {options}; choose another --output")
    if storage.exists(description):
        totals = storage.read_json(description)["scenes"]
        return IngestResult(totals, {}, 0, time.perf_counter() - started, already_complete=True)
    if not tasks:
        raise ValueError("there is nothing to preprocess: no drive was found")
    storage.clean_temporaries(root)
    storage.write_json(options, options_path)

    manifests = []
    for manifest in write_shards(tasks, staging, grid):
        manifests.append(manifest)
        if on_shard:
            on_shard(manifest)
    manifests.sort(key=lambda m: (m["source"], m["split"], m["number"]))
    unreadable = [reason for m in manifests for reason in m["unreadable"]]
    if unreadable and not skip_unreadable:
        more = f" (and {len(unreadable) - 1} more)" if len(unreadable) > 1 else ""
        raise ValueError(
            f"{unreadable[0]}{more}. All other drives are staged: repair the file and run the same command again, "
            "or add --skip-unreadable to leave it out"
        )
    statistics = training_statistics(manifests, staging, grid, slots)
    publish(root, staging, manifests, statistics)

    totals: dict[str, int] = {}
    reasons: dict[str, int] = {}
    for manifest in manifests:
        totals[manifest["split"]] = totals.get(manifest["split"], 0) + manifest["scenes"]
        for row in manifest["rejects"]:
            reasons[row["reason"]] = reasons.get(row["reason"], 0) + 1
    reports = {sequence: report for m in manifests for sequence, report in m["reports"].items() if report}
    storage.write_json(
        {
            "schema_version": "1",
            "source": tasks[0].source,
            "options": options,
            "scenes": totals,
            "layout": statistics.spec.to_dict(),
            "vegetation_thresholds": asdict(statistics.vegetation),
            "vehicle_thresholds": asdict(statistics.vehicle),
            "reports": reports,
        },
        description,
    )
    storage.delete_directory(staging)
    duplicates = sum(report["duplicates"] for report in reports.values())
    return IngestResult(totals, reasons, duplicates, time.perf_counter() - started)


@dataclass(frozen=True)
class Dataset:
    """A dataset directory that is complete: its dataset.json, read and checked."""

    root: str
    source: str
    scenes: dict[str, int]
    spec: LayoutSpec
    vegetation: DensityThresholds
    vehicle: DensityThresholds

    @classmethod
    def open(cls, root: str) -> Dataset:
        """Raises ValueError if `root` holds no complete dataset."""
        path = storage.join(root, "dataset.json")
        if not storage.exists(path):
            raise ValueError(f"{root}: no dataset.json here; run jobs/preprocess_scenes.py with --output {root} first")
        content = storage.read_json(path)
        try:
            return cls(
                root=root,
                source=content["source"],
                scenes=content["scenes"],
                spec=LayoutSpec.from_dict(content["layout"]),
                vegetation=DensityThresholds(**content["vegetation_thresholds"]),
                vehicle=DensityThresholds(**content["vehicle_thresholds"]),
            )
        except (KeyError, TypeError) as error:
            raise ValueError(f"{path}: not a dataset description ({error!r}); preprocess again") from error
