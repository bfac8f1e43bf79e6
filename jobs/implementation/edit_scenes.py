"""Implementation of jobs/edit_scenes.py."""

from __future__ import annotations

from jobs.edit_scenes import (
    Duplicate,
    Relabel,
    Remove,
    Repair,
    Replay,
    Rotate,
    Scale,
    SelectOptions,
    Snap,
    Translate,
)
from jobs.support.cli import make_absolute
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from jobs.support.scene_requests import select_scenes
from jobs.support.terminal import print_table
from jobs.support.value_names import EDIT_FRAMES
from pipelines.editing import edit
from pipelines.generation import batch_edit
from pipelines.runtime import storage


def read_edits(config: SelectOptions | Replay) -> list[edit.Edit]:
    """Return the edits of the command line or of a file.

    Raises:
        ValueError: The file is missing or contains no list of edits.
    """
    if isinstance(config, Replay):
        if not config.edits:
            raise ValueError("the command `replay` needs a JSON file with the list of edits")
        content = storage.read_json(make_absolute(config.edits))
        content = content.get("edits") if isinstance(content, dict) else content
        try:
            return edit.parse_edits(content)
        except ValueError as error:
            raise ValueError(f"{config.edits}: {error}") from error
    names = ("category", "primitives", "instances", "polygon_m", "where")
    select = edit.Select(**{name: getattr(config, name) for name in names})
    match config:
        case Remove():
            return [edit.Remove(select)]
        case Duplicate():
            return [edit.Duplicate(select, config.offset_m)]
        case Translate():
            return [edit.Translate(select, config.offset_m, EDIT_FRAMES[config.frame])]
        case Rotate():
            return [edit.Rotate(select, config.angle_deg, config.pivot_m)]
        case Scale():
            return [edit.Scale(select, config.factors, config.anchor)]
        case Relabel():
            return [edit.Relabel(select, config.to, config.class_name)]
        case Snap():
            return [edit.Snap(select, config.slab_offset_m)]
        case Repair():
            limits = config.max_push_m, config.min_shrink
            return [edit.Repair(select, config.slab_offset_m, config.ground, *limits, config.drop)]
    raise ValueError(f"no edit: {config!r}")


def edit_scenes(config: SelectOptions | Replay) -> batch_edit.EditResult:
    """Edit scenes, write them, and return the changes."""
    if config.num_examples < 0 or not config.run or set(config.run) & set("/=\\"):
        raise ValueError(
            f"--num-examples is {config.num_examples}, --run is {config.run!r}: "
            "expected at least 0 examples, and a run name without /, = and \\"
        )
    edits = read_edits(config)
    for step in edits:
        step.check()
    selection = select_scenes(config)
    total = sum(len(rows) for _, rows in selection.shards())
    with hold_output(config.output_directory(), f"edited-{config.run}", config), JobProgress() as bar:
        shown = bar.add_task("edit scenes", total=total)
        request = batch_edit.EditRequest(tuple(edits), config.output_directory(), config.run)
        return batch_edit.edit_scenes(request, selection, config.num_examples, lambda count: bar.advance(shown, count))


def main(config: SelectOptions | Replay) -> None:
    made = edit_scenes(config)
    print_table(made.table)
    rejected = f"; {made.rejects} scenes rejected, see the rejects table" if made.rejects else ""
    print(f"{made.scenes} scenes, source edited-{config.run}, in {config.output_directory()}{rejected}")
    print(f"before and after: {made.page}")
