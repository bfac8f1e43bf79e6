"""Convert raw drives to Parquet tables in two passes (paper, supplement A).

Each pass is one Ray Data graph. Pass 1 creates scenes. Each task writes the files of one shard: the table `scenes` and
a manifest to a staging directory, all other tables to the dataset directory. Files appear as a whole. A killed task
therefore leaves no partial file, and a finished shard is not written again. Pass 2 needs the whole training split.
Pass 2 computes density thresholds, slots per category and value bounds. Pass 2 then labels the scenes and writes the
table `scenes` to the dataset directory. The file dataset.json is written last and marks the dataset as complete. The
driver process reads only manifests, not scenes. No file is moved, because object storage would copy it.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import asdict, dataclass

import ray
import ray.data

from models.scene import Grid
from pipelines.preprocess.shard_writer import list_promised_rows, make_manifest_path, read_drive, write_shard
from pipelines.preprocess.sharding import ShardTask
from pipelines.preprocess.sources.drive import Drive
from pipelines.runtime import storage
from pipelines.runtime.ray_tasks import MAX_RETRIES, map_rows
from pipelines.schema.attribution import find_attribution
from pipelines.schema.columns import SCENE_TABLES, SCENES, SCHEMA_VERSION
from pipelines.schema.dataset import DESCRIPTION, Statistics, compute_training_statistics, label_scenes
from pipelines.schema.run_guard import compare_options
from pipelines.schema.tables import Shard

STAGING = ".staging"


# ------------------------------------------------------------------------------------------------------- pass 1


def _read_drive_or_reason(source: str, key: tuple) -> tuple[Drive, dict] | str:
    """Ray task that reads a drive into the object store.

    All shards of the drive share the result. If reading fails, the result is the reason (str).
    """
    try:
        return read_drive(source, key)
    except ValueError as error:
        return str(error)


def write_shards(tasks: list[ShardTask], output: str, staging: str, grid: Grid) -> Iterator[dict]:
    """Yield manifests in order of completion, from one Ray task per shard.

    If a drive has several shards, one additional task reads the drive.

    Args:
        tasks: Shards to write.
        output: Dataset directory.
        staging: Staging directory.
        grid: Raster grid of the scenes.

    Yields:
        Manifest of each shard.
    """
    finished = set(storage.list_files(storage.join_uri(staging, "manifest"), ".json"))
    todo = [task for task in tasks if make_manifest_path(staging, task) not in finished]
    shards_of = Counter((task.source, part.key) for task in todo for part in task.parts)
    load = ray.remote(num_cpus=1, max_retries=MAX_RETRIES)(_read_drive_or_reason)
    shared = {drive: load.remote(*drive) for drive, shards in shards_of.items() if shards > 1}

    def read(source: str, key: tuple) -> tuple[Drive, dict]:
        if (source, key) not in shared:
            return read_drive(source, key)
        found = ray.get(shared[source, key])
        if isinstance(found, str):
            raise ValueError(found)
        return found

    def write(row: dict) -> dict:
        """Write the shard of the task whose number is in the row, and return the manifest."""
        return {"manifest": json.dumps(write_shard(tasks[row["task"]], output, staging, grid, read))}

    dataset = ray.data.from_items([{"task": k} for k in range(len(tasks))], override_num_blocks=len(tasks))
    for row in map_rows(dataset, write).iter_rows():
        yield json.loads(row["manifest"])


# ------------------------------------------------------------------------------------------------------- pass 2


def publish_shards(root: str, staging: str, manifests: list[dict], statistics: Statistics) -> None:
    """Label the scenes and write them to the dataset directory.

    Files of earlier plans, which have no scenes now, are deleted. The function can run again after a crash at any
    point.

    Args:
        root: Dataset directory.
        staging: Staging directory.
        manifests: Manifests of all shards.
        statistics: Statistics of the training split.
    """

    def publish(row: dict) -> dict:
        """Label the scenes of the shard whose number is in the row."""
        staged, final = (Shard(base, row["source"], row["split"], row["number"]) for base in (staging, root))
        storage.write_parquet(
            label_scenes(staged.read("scenes"), statistics.vegetation, statistics.vehicle).cast(SCENES),
            final.path("scenes"),
        )
        return row

    promised = {path: rows for m in manifests for path, rows in list_promised_rows(m, root, root).items()}
    delete_other_files(root, manifests[0]["source"], promised)
    rows = [{k: m[k] for k in ("source", "split", "number")} for m in manifests if m["scenes"]]
    blocks = min(len(rows), max(2, 4 * int(ray.cluster_resources().get("CPU", 1))))
    map_rows(ray.data.from_items(rows, override_num_blocks=blocks), publish).materialize()
    storage.require_rows(promised)


def delete_other_files(root: str, source: str, wanted: Collection[str]) -> None:
    """Delete the files of shards that an interrupted run with another plan wrote.

    Args:
        root: Dataset directory.
        source: Value of the source column.
        wanted: Files of all shards of this run.
    """
    for table in (*SCENE_TABLES, "rejects"):
        for path in storage.list_files(storage.join_uri(root, table, f"source={source}"), ".parquet"):
            if path not in wanted:
                storage.delete_file(path)


# ---------------------------------------------------------------------------------------------------------- run


@dataclass(frozen=True)
class IngestResult:
    """Result of a run of `ingest_drives`.

    Attributes:
        scenes: Number of scenes per split.
        rejects: Number of rejected scenes per reason.
        duplicates: Number of dropped duplicate objects.
        seconds: Duration of the run (s).
        already_complete: Whether an earlier run already completed the dataset.
    """

    scenes: dict[str, int]
    rejects: dict[str, int]
    duplicates: int
    seconds: float
    already_complete: bool = False


def ingest_drives(
    tasks: list[ShardTask],
    root: str,
    options: dict,
    slots: tuple[int, ...] | float = 95.0,
    grid: Grid | None = None,
    skip_unreadable: bool = False,
    on_shard: Callable[[dict], None] | None = None,
) -> IngestResult:
    """Write a dataset directory.

    A second call resumes an interrupted run.

    Args:
        tasks: Shards to write.
        root: Dataset directory.
        options: User options, which are recorded in dataset.json.
        slots: Number of slots per category, or percentile of the category's count in the training scenes.
        grid: Raster grid of the scenes (default: the paper's).
        skip_unreadable: Whether unreadable drives become rejects. If False, an unreadable drive raises an error after
            all other drives are in the staging directory.
        on_shard: Function that is called with the manifest of each finished shard.

    Returns:
        Number of scenes and rejects.

    Raises:
        ValueError: The directory belongs to a run with other options, no drive exists, or a drive is unreadable.
    """
    started = time.perf_counter()
    grid = grid or Grid()
    description, staging = storage.join_uri(root, DESCRIPTION), storage.join_uri(root, STAGING)
    _refuse_other_options(root, options)
    if storage.exists(description):
        storage.delete_directory(staging)  # If a run is killed during its last step, the staging directory remains.
        made = storage.read_json(description)
        rejects, duplicates = made.get("rejects", {}), made.get("duplicates", 0)
        return IngestResult(made["scenes"], rejects, duplicates, time.perf_counter() - started, already_complete=True)
    if not tasks:
        raise ValueError("no drive was found; check the input directory")
    storage.clean_temporaries(root)
    storage.write_json(options, storage.join_uri(staging, "options.json"))

    manifests = []
    for manifest in write_shards(tasks, root, staging, grid):
        manifests.append(manifest)
        if on_shard:
            on_shard(manifest)
    manifests.sort(key=lambda m: (m["source"], m["split"], m["number"]))
    unreadable = sorted({reason for m in manifests for reason in m["unreadable"]})
    if unreadable and not skip_unreadable:
        more = f" (and {len(unreadable) - 1} more)" if len(unreadable) > 1 else ""
        raise ValueError(
            f"{unreadable[0]}{more}. All other drives are in the staging directory. Repair the file and "
            "run the same command again, or add --skip-unreadable to skip the drive"
        )
    statistics = ray.get(ray.remote(compute_training_statistics).remote(manifests, staging, grid, slots))
    publish_shards(root, staging, manifests, statistics)

    totals, reasons = Counter(), Counter()
    for manifest in manifests:
        totals[manifest["split"]] += manifest["scenes"]
        reasons.update(manifest["rejects"])
    reports = {sequence: report for m in manifests for sequence, report in m["reports"].items() if report}
    duplicates = sum(report.get("duplicates", 0) for report in reports.values())
    content = {
        "schema_version": SCHEMA_VERSION,
        "source": tasks[0].source,
        "options": options,
        "scenes": totals,
        "rejects": reasons,
        "duplicates": duplicates,
        "layout": statistics.spec.to_dict(),
        "vegetation_thresholds": asdict(statistics.vegetation),
        "vehicle_thresholds": asdict(statistics.vehicle),
        "reports": reports,
    }
    if attribution := find_attribution(tasks[0].source):
        content["attribution"] = attribution
    storage.write_json(content, description)
    storage.delete_directory(staging)
    return IngestResult(totals, reasons, duplicates, time.perf_counter() - started)


def _refuse_other_options(root: str, options: dict) -> None:
    """Raise ValueError if an earlier run wrote to `root` with other options."""
    for names in ((DESCRIPTION,), (STAGING, "options.json")):
        path = storage.join_uri(root, *names)
        if storage.exists(path):
            recorded = storage.read_json(path)
            recorded = recorded["options"] if names == (DESCRIPTION,) else recorded
            if difference := compare_options(recorded, options):
                raise ValueError(f"{root} was made with {difference}; choose another --output")
