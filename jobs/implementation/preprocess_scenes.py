"""Implementation of jobs/preprocess_scenes.py."""

from __future__ import annotations

from dataclasses import asdict

from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

from jobs.implementation.checks import check_preprocess_scenes
from jobs.preprocess_scenes import Av2, Kitti360, OpenDrive, Osm, Own, Py123d, Town
from jobs.support.cli import make_absolute, resolve_path
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from models.layout import PAPER_SLOTS
from pipelines.preprocess import sharding
from pipelines.preprocess.ingest import ingest_drives
from pipelines.preprocess.sources.opendrive.reader import OpenDriveOptions
from pipelines.preprocess.sources.osm.extract import Region
from pipelines.preprocess.sources.osm.reader import OsmOptions
from pipelines.schema.attribution import find_attribution

NOT_RECORDED = ("output", "skip_unreadable", "if_busy", "log_format")
SLOTS = {"p95": 95.0, "p99.5": 99.5, "paper": PAPER_SLOTS}  # Percentile, or number of slots per category.
FREE_POSE_SHARE = 0.25  # Default for version 2 of the town.
RECORDED_AS = {"make_split": "split"}  # keys in dataset.json


def find_free_pose_share(config: Town) -> float:
    """Return the share of free poses, or its default for the version of the town."""
    default = FREE_POSE_SHARE if config.town_version > 1 else 0.0
    return default if config.free_pose_share is None else config.free_pose_share


Config = Town | Kitti360 | Av2 | Py123d | Osm | OpenDrive | Own


def make_osm_options(config: Osm) -> OsmOptions:
    """Return the options of the reader."""
    return OsmOptions(
        Region(config.bbox, config.origin, config.radius_m),
        config.spacing_m,
        config.free_pose_share,
        config.drive_on == "left",
        config.furnish,
        config.seed,
        find_unmapped_ground(config),
    )


def find_unmapped_ground(config: Osm | OpenDrive) -> str | None:
    """Return the ground class of land that a map leaves open."""
    return None if config.unmapped_ground == "none" else config.unmapped_ground


def plan_shards(config: Config) -> list:
    """Return the shards to write."""
    if isinstance(config, Town):
        share = find_free_pose_share(config)
        return sharding.plan_town(config.num_train, config.num_test, config.seed, config.town_version, share)
    if isinstance(config, Osm):
        inputs = tuple(make_absolute(path) for path in config.input)
        return sharding.plan_osm(inputs, make_osm_options(config), config.test_share)
    if isinstance(config, OpenDrive):
        inputs = tuple(make_absolute(path) for path in config.input)
        return sharding.plan_opendrive(
            inputs, OpenDriveOptions(config.spacing_m, find_unmapped_ground(config)), config.test_share
        )
    root = make_absolute(config.input)
    if isinstance(config, Av2 | Py123d):
        return (sharding.plan_argoverse2 if isinstance(config, Av2) else sharding.plan_py123d)(root)
    plan_drives = sharding.plan_kitti360 if isinstance(config, Kitti360) else sharding.plan_custom
    return plan_drives(root, config.make_split, config.skip_unreadable)


def make_recorded_options(config: Config) -> dict:
    """Return the options that dataset.json records; a run with other options cannot resume."""
    options = {RECORDED_AS.get(k, k): v for k, v in asdict(config).items() if k not in NOT_RECORDED}
    options["source"] = type(config).__name__.lower()
    if isinstance(config, Town):
        # Datasets of version 1 do not record the share, as in earlier versions of this job.
        share = {"free_pose_share": find_free_pose_share(config)} if config.town_version > 1 else {}
        slots = config.slots or ("p99.5" if config.town_version > 1 else "p95")
        return {name: value for name, value in options.items() if name != "free_pose_share"} | share | {"slots": slots}
    if isinstance(config, Osm | OpenDrive):
        if config.unmapped_ground == "none":  # Earlier versions had no such option.
            del options["unmapped_ground"]
        return options | {"input": [make_absolute(path) for path in config.input]}
    return options | {"input": make_absolute(config.input)}


def main(config: Config) -> None:
    check_preprocess_scenes(config)
    options, shards = make_recorded_options(config), plan_shards(config)
    source = options["source"]
    output = resolve_path(config.output, "datasets", source)
    skip = getattr(config, "skip_unreadable", False)
    slots = SLOTS[options.get("slots", "p95")]
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("shards"),
        TimeRemainingColumn(),
    )
    with hold_output(output, "dataset", config), JobProgress(*columns) as bar:
        shown = bar.add_task(f"preprocess {source}", total=len(shards))
        result = ingest_drives(
            shards, output, options, slots, skip_unreadable=skip, on_shard=lambda _: bar.advance(shown)
        )
    if result.already_complete:
        print(f"{output} is already complete: {dict(result.scenes)}, {sum(result.rejects.values())} rejected")
        return
    if notice := find_attribution(source):
        print(f"licence of the data, which publications and exports must state: {notice}")
    total = sum(result.scenes.values())
    for reason, count in sorted(result.rejects.items(), key=lambda item: -item[1])[:10]:
        print(f"  rejected {count}: {reason}")
    print(
        f"{output}: {total} scenes {dict(result.scenes)}, {sum(result.rejects.values())} rejected, "
        f"{result.duplicates} duplicate objects dropped, {result.seconds:.1f} s ({total / result.seconds:.0f} scenes/s)"
    )
