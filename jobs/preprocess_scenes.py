#!/usr/bin/env python3
"""Raw drives -> Parquet scene tables (scenes, primitives, rasters, rejects, dataset.json).

    jobs/preprocess_scenes.py                                              the built-in town, 10,000 + 1,000 scenes
    jobs/preprocess_scenes.py town --num-train 500 --num-test 100
    jobs/preprocess_scenes.py kitti360 --input KITTI-360 --output DIR
    jobs/preprocess_scenes.py av2 --input AV2 --output DIR
    jobs/preprocess_scenes.py own --input DRIVES --output DIR             your own drives: docs/own_drives.md

Run it again with the same options to go on after an interruption.
"""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from typing import Annotated, Literal

import tyro

from jobs.support.cli import absolute, home, run, start_ray


@dataclass(frozen=True)
class Town:
    """The procedural town: no download, no licence."""

    output: str = ""
    """Dataset directory or URI (default: $PRITTI_HOME/datasets/town)."""
    num_train: int = 10_000
    """Training scenes."""
    num_test: int = 1_000
    """Test scenes, from other towns."""
    seed: int = 0
    slots: Literal["p95", "paper"] = "p95"
    """Slots per category: 95th percentile of the training split, or the paper's 514."""


@dataclass(frozen=True)
class Kitti360:
    """KITTI-360: data_3d_bboxes/train_full and data_poses under --input."""

    input: str
    """The KITTI-360 root directory."""
    output: str = ""
    """Dataset directory or URI (default: $PRITTI_HOME/datasets/kitti360)."""
    split: bool = True
    """The paper's 100-segment split; --no-split trains on every pose."""
    slots: Literal["p95", "paper"] = "p95"
    """Slots per category: 95th percentile of the training split, or the paper's 514."""
    skip_unreadable: bool = False
    """Leave out sequences whose XML cannot be read (they are listed in rejects) instead of stopping."""


@dataclass(frozen=True)
class Av2:
    """Argoverse 2 sensor dataset: train/<log> and val/<log> under --input."""

    input: str
    """The directory that holds train/ and val/."""
    output: str = ""
    """Dataset directory or URI (default: $PRITTI_HOME/datasets/av2)."""
    skip_unreadable: bool = False
    """Leave out logs whose files cannot be read (they are listed in rejects) instead of stopping."""


@dataclass(frozen=True)
class Own:
    """Your own drives: boxes, polygons and poses as Parquet or JSON under --input/DRIVE (docs/own_drives.md)."""

    input: str
    """The directory that holds a directory per drive."""
    output: str = ""
    """Dataset directory or URI (default: $PRITTI_HOME/datasets/own)."""
    split: bool = True
    """The paper's split along the distance driven, unless there is a splits.json; --no-split trains on every pose."""
    slots: Literal["p95", "paper"] = "p95"
    """Slots per category: 95th percentile of the training split, or the paper's 514."""
    skip_unreadable: bool = False
    """Leave out drives that cannot be read (they are listed in rejects) instead of stopping."""


Config = (
    Annotated[Town, tyro.conf.subcommand("town")]
    | Annotated[Kitti360, tyro.conf.subcommand("kitti360")]
    | Annotated[Av2, tyro.conf.subcommand("av2")]
    | Annotated[Own, tyro.conf.subcommand("own")]
)


def main(config: Town | Kitti360 | Av2 | Own) -> None:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from models.layout import PAPER_SLOTS
    from pipelines.preprocess import sharding
    from pipelines.preprocess.ingest import ingest
    from pipelines.preprocess.sources.town.generator import TOWN_VERSION

    source = type(config).__name__.lower()
    options = asdict(config) | {"source": source}
    del options["output"]
    output = absolute(config.output) if config.output else home("datasets", source)
    skip = options.pop("skip_unreadable", False)
    if isinstance(config, Town):
        options["town_version"] = TOWN_VERSION
        tasks = sharding.plan_town(config.num_train, config.num_test, config.seed)
    else:
        options["input"] = absolute(config.input)
        if "://" not in config.input and not os.path.isdir(options["input"]):
            raise ValueError(f"--input {config.input}: no such directory; give the dataset's root")
        if isinstance(config, Av2):
            tasks = sharding.plan_argoverse2(options["input"])
        else:
            plan_drives = sharding.plan_kitti360 if isinstance(config, Kitti360) else sharding.plan_own
            tasks = plan_drives(options["input"], config.split, skip)
    slots = PAPER_SLOTS if options.get("slots") == "paper" else None

    start_ray()
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("shards"),
        TimeRemainingColumn(),
    )
    with Progress(*columns) as bar:
        shown = bar.add_task(f"preprocess {source}", total=len(tasks))
        result = ingest(tasks, output, options, slots, skip_unreadable=skip, on_shard=lambda _: bar.advance(shown))
    if result.already_complete:
        print(f"{output} is complete already: {dict(result.scenes)}, {sum(result.rejects.values())} rejected")
        return
    total = sum(result.scenes.values())
    for reason, count in sorted(result.rejects.items(), key=lambda item: -item[1])[:10]:
        print(f"  rejected {count}: {reason}")
    print(
        f"{output}: {total} scenes {dict(result.scenes)}, {sum(result.rejects.values())} rejected, "
        f"{result.duplicates} duplicate objects dropped, {result.seconds:.1f} s ({total / result.seconds:.0f} scenes/s)"
    )


if __name__ == "__main__":
    run(main, Config, description=__doc__, default=Town())
