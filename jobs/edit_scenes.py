#!/usr/bin/env python3
"""Edit objects: remove, duplicate, translate, rotate, scale, relabel, snap or repair.

    jobs/edit_scenes.py remove --category human two_wheelers --input DIR
    jobs/edit_scenes.py translate --offset-m 5 0 0 --frame object --where "category = 'vehicle_small' and length_m > 4"
    jobs/edit_scenes.py rotate --angle-deg 90 --primitives 3 17 --max-scenes 1
    jobs/edit_scenes.py scale --factors 1 1 2 --polygon-m 10 -20 50 -20 50 5 10 5 --category construction_big
    jobs/edit_scenes.py relabel --to vehicle_big --where "category = 'vehicle_small' and length_m > 6"
    jobs/edit_scenes.py snap --category vehicle_small                  onto the ground
    jobs/edit_scenes.py repair                                         overlapping, floating and sunken objects
    jobs/edit_scenes.py replay edits.json --input DIR                  a list of edits, one after another

An edit changes the primitives that match all selection options. With --where "true", an edit changes every primitive.
The job writes scene tables with source=edited-<run>, and lists the changes of each step in edits/. The job also writes
the list of edits for `replay` to edited-<run>.json, and pictures to <run>.html.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from jobs.support.cli import resolve_path, run
from jobs.support.options import IfBusyOption, LogFormatOption, SceneOptions


@dataclass(frozen=True)
class EditOptions(SceneOptions):
    """Options for the scenes to edit and for the output."""

    output: str = ""
    """Dataset directory to write (default: $PRITTI_HOME/edited/<run>)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    run: str = "edited"
    """Name of the run: scenes get source=edited-<run>."""
    num_examples: int = 8
    """Number of scenes that the page shows before and after the edit."""

    def output_directory(self) -> str:
        return resolve_path(self.output, "edited", self.run)


@dataclass(frozen=True)
class SelectOptions(EditOptions):
    """Options that select the primitives to edit; a primitive must match all given options."""

    category: tuple[str, ...] = ()
    """Select primitives of these categories (default: all)."""
    primitives: tuple[int, ...] = ()
    """Select primitives by index in the scene; the first row of the scene in the primitives table is 0 (default:
    all)."""
    instances: tuple[int, ...] = ()
    """Select primitives by instance_id (default: all)."""
    polygon_m: tuple[float, ...] = ()
    """Select primitives with their centre in a polygon: x y of each corner in metres, x to the front, y to the left
    (default: all)."""
    where: str = ""
    """Select by an SQL condition on columns of the primitives table; "true" selects all (default: none)."""


@dataclass(frozen=True)
class Remove(SelectOptions):
    """Remove primitives."""


@dataclass(frozen=True)
class Duplicate(SelectOptions):
    """Copy primitives."""

    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Offset of the copies in metres: x (ahead), y (left), z (up)."""


@dataclass(frozen=True)
class Translate(SelectOptions):
    """Move primitives."""

    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Offset in metres along x (ahead), y (left), z (up), or along the axes of each primitive with --frame object."""
    frame: Literal["scene", "object"] = "scene"
    """Axes of the offset: the axes of the scene frame, or the axes of each primitive."""


@dataclass(frozen=True)
class Rotate(SelectOptions):
    """Rotate primitives about the vertical axis."""

    angle_deg: float = 0.0
    """Angle in degrees; a positive angle turns counter-clockwise as seen from above."""
    pivot_m: tuple[float, float] | None = None
    """x and y of the rotation axis in metres (default: the centre of each primitive)."""


@dataclass(frozen=True)
class Scale(SelectOptions):
    """Scale primitives."""

    factors: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Scale factors for length, width and height."""
    anchor: Literal["bottom", "centre"] = "bottom"
    """Point of a primitive that keeps its position."""


@dataclass(frozen=True)
class Relabel(SelectOptions):
    """Change the category of primitives."""

    to: str = "object"
    """New category; vegetation_ellipsoid makes ellipsoids, every other category makes cuboids."""
    class_name: str | None = None
    """New class name, which must be a label of the source (default: the name of the category)."""


@dataclass(frozen=True)
class Snap(SelectOptions):
    """Put primitives on the ground; primitives over unknown ground keep their position."""

    slab_offset_m: float = 0.3
    """Height in metres of the stored ground above the real surface: 0.3 in KITTI-360 and the town, 0 in Argoverse 2."""


@dataclass(frozen=True)
class Repair(SelectOptions):
    """Repair the faults that evaluate_scenes counts: floating, sunken and overlapping objects."""

    where: str = "true"
    """Select primitives by an SQL condition on columns of the primitives table."""
    slab_offset_m: float = 0.3
    """Height in metres of the stored ground above the real surface, as for the edit `snap`."""
    ground: Literal["both", "floating", "sunken", "none"] = "both"
    """Objects to put on the ground."""
    max_push_m: float = 0.25
    """Maximum distance in metres by which an overlapping object is pushed."""
    min_shrink: float = 0.95
    """Smallest factor by which an object may be scaled if pushing is not enough."""
    drop: bool = True
    """If two objects still overlap, remove the one with the lower existence probability."""


@dataclass(frozen=True)
class Replay(EditOptions):
    """Apply a list of edits, one after another."""

    edits: tyro.conf.Positional[str] = ""
    """JSON file: a list of edits, or the edited-<run>.json of an earlier run."""


Config = (
    Annotated[Remove, tyro.conf.subcommand("remove")]
    | Annotated[Duplicate, tyro.conf.subcommand("duplicate")]
    | Annotated[Translate, tyro.conf.subcommand("translate")]
    | Annotated[Rotate, tyro.conf.subcommand("rotate")]
    | Annotated[Scale, tyro.conf.subcommand("scale")]
    | Annotated[Relabel, tyro.conf.subcommand("relabel")]
    | Annotated[Snap, tyro.conf.subcommand("snap")]
    | Annotated[Repair, tyro.conf.subcommand("repair")]
    | Annotated[Replay, tyro.conf.subcommand("replay")]
)


if __name__ == "__main__":
    run("edit_scenes")
