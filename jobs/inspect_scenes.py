#!/usr/bin/env python3
"""Inspect a dataset directory: pictures of scenes, contact sheets, a report, a 3D gallery.

    jobs/inspect_scenes.py scene town-00002-0000000035 --dataset DIR       one PNG with every view; --glb for the mesh
    jobs/inspect_scenes.py scene --max-scenes 5 --seed 1 --dataset DIR     five random scenes
    jobs/inspect_scenes.py sheet --dataset DIR --sort vegetation           64 scenes by increasing vegetation
    jobs/inspect_scenes.py sheet --dataset DIR --sort num_human --pick highest --view 3d
    jobs/inspect_scenes.py report --dataset DIR                            one self-contained HTML page
    jobs/inspect_scenes.py gallery --dataset DIR --max-scenes 200          an HTML page with filters and scenes in 3D

The job works for real and generated scenes and reads only the tables. The job writes to $PRITTI_HOME/inspect/<dataset>
unless --output is given.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from jobs.support.cli import run


@dataclass(frozen=True)
class DatasetOptions:
    """Options for the dataset to inspect."""

    dataset: str = ""
    """Dataset directory or URI (default: $PRITTI_HOME/datasets/town)."""
    source: str = ""
    """Read only scenes of this source (default: all sources)."""
    split: str = ""
    """Read only scenes of this split (default: all splits)."""


@dataclass(frozen=True)
class OneScene(DatasetOptions):
    """Draw one PNG per scene with every view: from above, in 3D, ground classes, ground height, primitives."""

    ids: tyro.conf.Positional[tuple[str, ...]] = ()
    """Scene ids (default: --max-scenes random scenes)."""
    max_scenes: int = 1
    """Maximum number of random scenes if no id is given."""
    seed: int = 0
    """Random seed for the choice of scenes."""
    glb: bool = False
    """Also write each scene's mesh as <id>.glb."""
    output: str = ""
    """Directory to write to (default: $PRITTI_HOME/inspect/<dataset>)."""


@dataclass(frozen=True)
class Sheet(DatasetOptions):
    """Draw a contact sheet of many scenes."""

    max_scenes: int = 64
    """Maximum number of scenes."""
    sort: str = "drive"
    """Order: drive, random, vegetation, vehicles, primitives, or a numeric column of the scenes table such as
    num_pole."""
    pick: Literal["uniform", "lowest", "highest"] = "uniform"
    """Scenes to select after sorting: evenly spaced scenes, the scenes with the lowest values, or the scenes with the
    highest values."""
    view: Literal["bev", "3d"] = "bev"
    """View: bird's-eye or oblique."""
    size_px: int = 256
    """Width of each picture in pixels."""
    num_columns: int = 0
    """Number of columns; 0 chooses an aspect ratio of about 5 : 4."""
    seed: int = 0
    """Random seed for --sort random."""
    output: str = ""
    """PNG file to write (default: $PRITTI_HOME/inspect/<dataset>/sheet.png)."""


@dataclass(frozen=True)
class Report(DatasetOptions):
    """Write one HTML page: totals, splits, counts, sizes, ground, labels, rejects, example scenes."""

    num_examples: int = 8
    """Number of scenes shown, ordered by increasing vegetation; with 0, the job does not start Ray."""
    output: str = ""
    """HTML file to write (default: $PRITTI_HOME/inspect/<dataset>/report.html)."""


@dataclass(frozen=True)
class Gallery(DatasetOptions):
    """Write one HTML page for publication: scenes in 3D, with filters by label and by statistics (35 kB per scene)."""

    max_scenes: int = 100
    """Maximum number of scenes, selected evenly from the dataset."""
    title: str = "Scenes"
    """Title of the page."""
    output: str = ""
    """HTML file to write (default: $PRITTI_HOME/inspect/<dataset>/gallery.html)."""


Config = (
    Annotated[OneScene, tyro.conf.subcommand("scene")]
    | Annotated[Sheet, tyro.conf.subcommand("sheet")]
    | Annotated[Report, tyro.conf.subcommand("report")]
    | Annotated[Gallery, tyro.conf.subcommand("gallery")]
)


if __name__ == "__main__":
    run("inspect_scenes")
