#!/usr/bin/env python3
"""Convert raw drives to Parquet scene tables.

    jobs/preprocess_scenes.py                                              the built-in town, 10,000 + 1,000 scenes
    jobs/preprocess_scenes.py town --num-train 500 --num-test 100
    jobs/preprocess_scenes.py kitti360 --input KITTI-360 --output DIR
    jobs/preprocess_scenes.py av2 --input AV2 --output DIR
    jobs/preprocess_scenes.py py123d --input PY123D_DATA_ROOT --output DIR     nuScenes, nuPlan, Waymo, PandaSet, ...
    jobs/preprocess_scenes.py osm --input city.osm.pbf --origin 52.474 13.440 --radius-m 500 --output DIR
    jobs/preprocess_scenes.py opendrive --input town.xodr --output DIR
    jobs/preprocess_scenes.py own --input DRIVES --output DIR             your own drives: docs/how_to/own_drives.md

The job writes the tables scenes, primitives, rasters and rejects, and dataset.json. Run the same command again to
resume after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from jobs.support.cli import run
from jobs.support.options import IfBusyOption, LogFormatOption


@dataclass(frozen=True)
class Town:
    """Generate the procedural town, which needs no download and no licence."""

    output: str = ""
    """Dataset directory or URI to write (default: $PRITTI_HOME/datasets/town)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    num_train: int = 10_000
    """Number of training scenes."""
    num_test: int = 1_000
    """Number of test scenes, which come from separate towns."""
    seed: int = 0
    """Random seed."""
    town_version: Literal[1, 2] = 2
    """Version of the town. Version 2 is nearer to real streets (docs/experiments/town2.md)."""
    free_pose_share: float | None = None
    """Share of the scenes that are crops at any place and heading, instead of views of a vehicle (default: 0.25 for
    version 2, 0 for version 1)."""
    slots: Literal["p95", "p99.5", "paper"] | None = None
    """Rule for the number of slots per category: a percentile over the training split, or the paper's 514 slots in
    total. Models do not learn objects beyond these slots (default: p99.5 for version 2, p95 for version 1)."""


@dataclass(frozen=True)
class Kitti360:
    """Read KITTI-360: data_3d_bboxes/train_full and data_poses under --input."""

    input: str
    """Root directory of KITTI-360."""
    output: str = ""
    """Dataset directory or URI to write (default: $PRITTI_HOME/datasets/kitti360)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    make_split: bool = True
    """Split each drive into training and test segments as in the paper; --no-make-split trains on every pose."""
    slots: Literal["p95", "p99.5", "paper"] = "p95"
    """Rule for the number of slots per category: a percentile over the training split, or the paper's 514 slots in
    total. Models do not learn objects beyond these slots."""
    skip_unreadable: bool = False
    """Skip sequences with unreadable XML and list them in rejects; without this option, the job stops."""


@dataclass(frozen=True)
class Av2:
    """Read the Argoverse 2 sensor dataset: train/<log> and val/<log> under --input."""

    input: str
    """Directory that contains train/ and val/."""
    output: str = ""
    """Dataset directory or URI to write (default: $PRITTI_HOME/datasets/av2)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    skip_unreadable: bool = False
    """Skip logs with unreadable files and list them in rejects; without this option, the job stops."""


@dataclass(frozen=True)
class Py123d:
    """Read logs that py123d converted from nuScenes, nuPlan, Waymo and others (docs/how_to/py123d.md)."""

    input: str
    """Directory into which py123d-conversion wrote: it contains logs/ and maps/ (PY123D_DATA_ROOT)."""
    output: str = ""
    """Dataset directory or URI to write (default: $PRITTI_HOME/datasets/py123d)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    slots: Literal["p95", "p99.5", "paper"] = "p95"
    """Rule for the number of slots per category: a percentile over the training split, or the paper's 514 slots in
    total. Models do not learn objects beyond these slots."""
    skip_unreadable: bool = False
    """Skip logs with unreadable files and list them in rejects; without this option, the job stops."""


@dataclass(frozen=True)
class Osm:
    """Read extracts of OpenStreetMap: real roads, buildings and trees (docs/how_to/real_places.md)."""

    input: tuple[str, ...]
    """Extracts (.osm, .osm.gz, .osm.bz2 or .osm.pbf), or directories of extracts."""
    output: str = ""
    """Dataset directory or URI to write (default: $PRITTI_HOME/datasets/osm)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    bbox: tuple[float, float, float, float] | None = None
    """Region: west, south, east and north in degrees (default: the whole extract)."""
    origin: tuple[float, float] | None = None
    """Latitude and longitude of the middle of a square region, instead of --bbox (default: the whole extract)."""
    radius_m: float = 500.0
    """Half of the side of the square around --origin."""
    spacing_m: float = 10.0
    """Distance between successive poses along a street."""
    free_pose_share: float = 0.25
    """Share of the scenes that are crops at any heading near the streets, instead of views of a vehicle."""
    test_share: float = 0.1
    """Maximum share of the scenes that lie in test squares of 400 m; 0 makes no test split."""
    drive_on: Literal["right", "left"] = "right"
    """Side of the road on which vehicles drive."""
    furnish: bool = False
    """Add parked vehicles, pedestrians, plants, lamps, signals, signs, sidewalks and front gardens that the extract
    lacks, with the rules of the town. The labels of added objects begin with "furnished"."""
    unmapped_ground: Literal["none", "terrain"] = "none"
    """Ground class of land that the map leaves open, except below buildings and water."""
    seed: int = 0
    """Random seed of free poses and added objects."""
    slots: Literal["p95", "p99.5", "paper"] = "p99.5"
    """Rule for the number of slots per category: a percentile over the training split, or the paper's 514 slots in
    total. Models do not learn objects beyond these slots."""


@dataclass(frozen=True)
class OpenDrive:
    """Read OpenDRIVE files: lanes, junctions, objects and signals (docs/how_to/real_places.md)."""

    input: tuple[str, ...]
    """OpenDRIVE files (.xodr or .xodr.gz), or directories of such files."""
    output: str = ""
    """Dataset directory or URI to write (default: $PRITTI_HOME/datasets/opendrive)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    spacing_m: float = 10.0
    """Distance between successive poses along a lane."""
    unmapped_ground: Literal["none", "terrain"] = "none"
    """Ground class of land that the file leaves open, except below buildings."""
    test_share: float = 0.1
    """Maximum share of the scenes that lie in test squares of 400 m; 0 makes no test split."""
    slots: Literal["p95", "p99.5", "paper"] = "p99.5"
    """Rule for the number of slots per category: a percentile over the training split, or the paper's 514 slots in
    total. Models do not learn objects beyond these slots."""


@dataclass(frozen=True)
class Own:
    """Read your own drives from Parquet or JSON files under --input/DRIVE (docs/how_to/own_drives.md)."""

    input: str
    """Directory that contains one directory per drive."""
    output: str = ""
    """Dataset directory or URI to write (default: $PRITTI_HOME/datasets/own)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    make_split: bool = True
    """Split each drive into training and test segments as in the paper; --no-make-split trains on every pose."""
    slots: Literal["p95", "p99.5", "paper"] = "p95"
    """Rule for the number of slots per category: a percentile over the training split, or the paper's 514 slots in
    total. Models do not learn objects beyond these slots."""
    skip_unreadable: bool = False
    """Skip unreadable drives and list them in rejects; without this option, the job stops."""


Config = (
    Annotated[Town, tyro.conf.subcommand("town")]
    | Annotated[Kitti360, tyro.conf.subcommand("kitti360")]
    | Annotated[Av2, tyro.conf.subcommand("av2")]
    | Annotated[Py123d, tyro.conf.subcommand("py123d")]
    | Annotated[Osm, tyro.conf.subcommand("osm")]
    | Annotated[OpenDrive, tyro.conf.subcommand("opendrive")]
    | Annotated[Own, tyro.conf.subcommand("own")]
)
DEFAULT = Town()  # source if the command line does not name a source


if __name__ == "__main__":
    run("preprocess_scenes")
