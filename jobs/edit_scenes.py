#!/usr/bin/env python3
"""Edit objects of scenes, one scene or a whole table: remove, duplicate, translate, rotate, scale, relabel, snap, repair.

    jobs/edit_scenes.py remove --category human two_wheelers --input DIR
    jobs/edit_scenes.py translate --by-m 5 0 0 --along own --where "category = 'vehicle_small' and length_m > 4"
    jobs/edit_scenes.py rotate --by-deg 90 --primitives 3 17 --limit 1
    jobs/edit_scenes.py scale --by 1 1 2 --polygon-m 10 -20 50 -20 50 5 10 5 --category construction_big
    jobs/edit_scenes.py relabel --to vehicle_big --where "category = 'vehicle_small' and length_m > 6"
    jobs/edit_scenes.py snap --category vehicle_small                  onto the ground
    jobs/edit_scenes.py repair                                         overlaps, floating and sunken things, as little as it takes
    jobs/edit_scenes.py replay edits.json --input DIR                  a list of any of these, one after another

A selection is what fits all that it names; --where "true" is everything. Writes the same tables, source=edited-<run>,
edits/ with what each step changed, edited-<run>.json with the list for `replay`, and <run>.html with pictures.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from jobs.support.cli import absolute, home, print_table, run, start_ray

if TYPE_CHECKING:
    from pipelines.editing.edit import Edit
    from pipelines.generation.batch_edit import Edited


@dataclass(frozen=True)
class Scenes:
    """Which scenes, and where the edited ones go."""

    input: str = ""
    """Dataset directory with the scenes (default: $PRITTI_HOME/generated)."""
    source: str = ""
    """Source of the scenes (default: whatever is there)."""
    split: str = ""
    """Split of the scenes (default: whatever is there)."""
    limit: int | None = None
    """So many scenes, from the first on (default: all)."""
    output: str = ""
    """Dataset directory (default: $PRITTI_HOME/edited/<run>)."""
    run: str = "edited"
    """Name of the run: scenes get source=edited-<run>."""
    pictures: int = 8
    """So many scenes on the page, as given and as edited."""

    def output_directory(self) -> str:
        return absolute(self.output) if self.output else home("edited", self.run)


@dataclass(frozen=True)
class Chosen(Scenes):
    """Which primitives: those that fit all that is named."""

    category: tuple[str, ...] = ()
    """Of one of these categories."""
    primitives: tuple[int, ...] = ()
    """By number, as in the scene's rows of the primitives table, from 0."""
    instances: tuple[int, ...] = ()
    """By instance_id."""
    polygon_m: tuple[float, ...] = ()
    """Centre inside a polygon: x y of its corners in metres, x ahead, y left."""
    where: str = ""
    """A condition in SQL on columns of the primitives table, such as "length_m > 4 and y_m < 0"; "true" for all."""


@dataclass(frozen=True)
class Remove(Chosen):
    """Take primitives out."""


@dataclass(frozen=True)
class Duplicate(Chosen):
    """Put copies beside the originals."""

    by_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the copies go from there: x (ahead), y (left), z (up)."""


@dataclass(frozen=True)
class Translate(Chosen):
    """Move primitives."""

    by_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """x (ahead), y (left), z (up); with --along own along each one's length, width and height."""
    along: Literal["scene", "own"] = "scene"
    """The scene's axes, or each primitive's own."""


@dataclass(frozen=True)
class Rotate(Chosen):
    """Turn primitives about the vertical."""

    by_deg: float = 0.0
    """Counter-clockwise seen from above."""
    about_m: tuple[float, float] | None = None
    """x and y of the axis (default: each one's centre)."""


@dataclass(frozen=True)
class Scale(Chosen):
    """Make primitives larger or smaller."""

    by: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors of length, width and height."""
    hold: Literal["bottom", "centre"] = "bottom"
    """What stays where it is."""


@dataclass(frozen=True)
class Relabel(Chosen):
    """Give primitives another category."""

    to: str = "object"
    """The category; vegetation_ellipsoid makes ellipsoids, every other cuboids."""
    label: str | None = None
    """The dataset's own class name (default: the category's)."""


@dataclass(frozen=True)
class Snap(Chosen):
    """Put primitives on the ground; what is over no known ground stays."""

    slab_offset_m: float = 0.3
    """How far the ground's heights lie above the surface: 0.3 in KITTI-360 and the town, 0 in Argoverse 2."""


@dataclass(frozen=True)
class Repair(Chosen):
    """Mend faults as evaluate_scenes counts them: floating and sunken things onto the ground, overlapping ones apart."""

    where: str = "true"
    """As elsewhere, but everything by default."""
    slab_offset_m: float = 0.3
    """As for snap."""
    ground: Literal["both", "floating", "sunken", "none"] = "both"
    """What to put on the ground."""
    push_m: float = 0.25
    """How far overlapping things may be pushed, each."""
    shrink: float = 0.95
    """To what share of its size a thing may shrink where pushing is not enough."""
    drop: bool = True
    """Take out one of two that overlap all the same, the less certain one."""


@dataclass(frozen=True)
class Replay(Scenes):
    """Do what a list of edits says, one after another."""

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


def edits_of(config: Chosen | Replay) -> list[Edit]:
    """The edits that the command line or a file asks for. Raises ValueError for a list that is none."""
    from pipelines.editing import edit
    from pipelines.runtime import storage

    if isinstance(config, Replay):
        if not config.edits:
            raise ValueError("replay of no file: give the JSON file with the list of edits")
        content = storage.read_json(absolute(config.edits))
        content = content.get("edits") if isinstance(content, dict) else content
        try:
            return edit.edits_from_json(content)
        except ValueError as error:
            raise ValueError(f"{config.edits}: {error}") from error
    names = ("category", "primitives", "instances", "polygon_m", "where")
    select = edit.Select(**{name: getattr(config, name) for name in names})
    match config:
        case Remove():
            return [edit.Remove(select)]
        case Duplicate():
            return [edit.Duplicate(select, config.by_m)]
        case Translate():
            return [edit.Translate(select, config.by_m, config.along)]
        case Rotate():
            return [edit.Rotate(select, config.by_deg, config.about_m)]
        case Scale():
            return [edit.Scale(select, config.by, config.hold)]
        case Relabel():
            return [edit.Relabel(select, config.to, config.label)]
        case Snap():
            return [edit.Snap(select, config.slab_offset_m)]
        case Repair():
            return [edit.Repair(select, config.slab_offset_m, config.ground, config.push_m, config.shrink, config.drop)]
    raise ValueError(f"no edit: {config!r}")


def edit_scenes(config: Chosen | Replay) -> Edited:
    """Edit, write, and return what was changed."""
    from pipelines.schema.scene_subset import Selection

    if config.pictures < 0 or not config.run or set(config.run) & set("/=\\"):
        raise ValueError(f"--pictures is {config.pictures}, --run {config.run!r}: expected 0 or more, a plain word")
    edits = edits_of(config)
    for edit in edits:
        edit.check()
    directory = absolute(config.input) if config.input else home("generated")
    selection = Selection(directory, config.source or None, config.split or None, config.limit, "first")
    total = sum(len(rows) for _, rows in selection.shards())
    from rich.progress import Progress

    from pipelines.generation import batch_edit as graph

    start_ray()
    with Progress() as bar:
        shown = bar.add_task("edit scenes", total=total)
        request = graph.EditRequest(tuple(edits), config.output_directory(), config.run)
        return graph.edit_scenes(request, selection, config.pictures, lambda count: bar.advance(shown, count))


def main(config: Chosen | Replay) -> None:
    made = edit_scenes(config)
    print_table(made.table)
    rejected = f"; {made.rejects} scenes rejected, see the rejects table" if made.rejects else ""
    print(f"{made.scenes} scenes, source edited-{config.run}, in {config.output_directory()}{rejected}")
    print(f"before and after: {made.page}")


if __name__ == "__main__":
    run(main, Config, description=__doc__)
