"""Apply a list of edits to the scenes of a dataset, with one Ray task per shard, and render a page of the changes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
import pyarrow as pa

from models.composition.inpaint import select_around_objects
from models.scene import Scene
from pipelines.editing.edit import Edit, ObjectChange, replay_edits, serialize_edits
from pipelines.rendering.render import render_bev, render_outlined_bev
from pipelines.reporting.report import Picture, Pictures, Section, Table, render_report_html
from pipelines.runtime import storage
from pipelines.runtime.ray_tasks import map_tasks
from pipelines.schema.columns import EDITS, TABLES
from pipelines.schema.conversion import make_rejects_table
from pipelines.schema.run_guard import guard_run
from pipelines.schema.scene_subset import SceneSubset
from pipelines.schema.tables import Shard, require_written

PICTURE_PX = 512
OUTLINE_M = 0.4  # Margin between changed objects and their outline (m).


@dataclass(frozen=True)
class EditRequest:
    """Edits of a run. The edited scenes have the source edited-<run> and the split of the input scene.

    Attributes:
        edits: Edits, in the order in which they are applied.
        output: Dataset directory of the edited scenes.
        run: Run name.
    """

    edits: tuple[Edit, ...]
    output: str
    run: str

    @property
    def source(self) -> str:
        """Return the source of the edited scenes."""
        return f"edited-{self.run}"

    def shard(self, number: int, given: Shard) -> Shard:
        """Return the shard for the edited scenes of an input shard.

        Args:
            number: Number of the new shard.
            given: Shard of the input scenes.

        Returns:
            New shard of the run, with the split of the input shard.
        """
        return Shard(self.output, self.source, given.split, number)

    def guard(self, selection: SceneSubset) -> None:
        """Bind the source to the edits and the selected scenes (run_guard.py).

        Args:
            selection: Scenes to edit.

        Raises:
            ValueError: The output contains a run of the same name with other edits or other scenes.
        """
        chosen = {
            "input": selection.root,
            "source": selection.source,
            "split": selection.split,
            "limit": selection.limit,
        } | ({"ids": selection.ids} if selection.ids else {})
        guard_run(self.output, self.source, self.run, {"edits": serialize_edits(self.edits)} | chosen)


def edit_shard(scene: Scene, request: EditRequest) -> tuple[Scene, list[pa.Table]]:
    """Apply the edits to one scene.

    Args:
        scene: Given scene.
        request: Edits and run name.

    Returns:
        Edited scene, and the rows of the edits table for this scene.

    Raises:
        ValueError: An edit fails. The message names the edit.
    """
    after, done = replay_edits(scene, request.edits)
    rows = []
    for step, (edit, changes) in enumerate(zip(request.edits, done, strict=True)):
        count = len(changes.primitive)
        about = {"scene_id": [scene.scene_id] * count, "step": [step] * count, "edit": [edit.name] * count}
        rows.append(pa.table(about | changes._asdict()).cast(EDITS))
    return replace(after, source=request.source), rows


def write_edited(row: dict, request: EditRequest, parts: list[tuple[Shard, list[int]]]) -> dict:
    """Edit the scenes of one shard and write its tables.

    Args:
        row: Row with the number of a shard, and whether its edits table and its rejects table exist.
        request: Edits and the location of the edited scenes.
        parts: Input shards, each with its selected rows.

    Returns:
        Row with the number of the shard, and the numbers of scenes and of rejected scenes.
    """
    given, rows = parts[row["shard"]]
    shard = request.shard(row["shard"], given)
    if row["is_written"]:
        rejected = len(shard.read("rejects", ["reason"])) if row["has_rejects"] else 0
        if rejected == len(rows) or not shard.find_fault(len(rows) - rejected):
            return {"shard": row["shard"], "scenes": len(rows), "rejects": rejected}
    scenes, done, rejects = [], [EDITS.empty_table()], []
    for scene in given.scenes(rows):
        try:
            after, changes = edit_shard(scene, request)
            scenes.append(after)
            done += changes
        except ValueError as error:
            about = {"scene_id": scene.scene_id, "sequence": scene.sequence, "frame": scene.frame}
            rejects.append(about | {"reason": str(error)})
    if rejects:
        storage.write_parquet(make_rejects_table(rejects), shard.path("rejects"))
    if scenes:
        shard.write(scenes)
    # The edits table is written last and marks the shard as complete.
    storage.write_parquet(pa.concat_tables(done), shard.path("edits"))
    return {"shard": row["shard"], "scenes": len(rows), "rejects": len(rejects)}


@dataclass(frozen=True)
class EditResult:
    """Result of a run of edits.

    Attributes:
        scenes: Number of edited scenes.
        rejects: Number of rejected scenes.
        table: Table of the changes that each edit made.
        page: Path of the HTML page.
    """

    scenes: int
    rejects: int
    table: Table
    page: str


def edit_scenes(
    request: EditRequest, selection: SceneSubset, pictures: int = 8, on_shard: Callable[[int], None] | None = None
) -> EditResult:
    """Edit scenes; write the edited tables, the edits table and a page; resume an interrupted run.

    Args:
        request: Edits and the location of the edited scenes.
        selection: Scenes to edit.
        pictures: Maximum number of changed scenes on the page.
        on_shard: Called with the number of scenes of each finished shard.

    Returns:
        Numbers of scenes, the table of changes and the path of the page.

    Raises:
        ValueError: The output contains a run of the same name with other edits, all scenes are rejected, or no edit
            changes a scene.
    """
    if not request.edits:
        raise ValueError("the list of edits is empty")
    for edit in request.edits:
        edit.check()
    parts = selection.shards()
    request.guard(selection)
    shards = [request.shard(k, given) for k, (given, _) in enumerate(parts)]
    there = {path for t in ("edits", "rejects") for path in storage.list_files(storage.join_uri(request.output, t), "")}
    todo = [
        {"shard": k, "is_written": shard.path("edits") in there, "has_rejects": shard.path("rejects") in there}
        for k, shard in enumerate(shards)
    ]

    def edit_shard(row: dict) -> dict:
        return write_edited(row, request, parts)

    found = []
    for row in map_tasks(edit_shard, todo):
        found.append(row)
        if on_shard:
            on_shard(row["scenes"])
    rejects = sum(row["rejects"] for row in found)
    scenes = sum(row["scenes"] for row in found) - rejects
    require_written({shards[row["shard"]]: n for row in found if (n := row["scenes"] - row["rejects"])})
    if not scenes:
        reason = shards[0].read("rejects")["reason"][0].as_py()
        raise ValueError(f"all {rejects} scenes were rejected; the first: {reason}")
    changes = pa.concat_tables([shard.read("edits") for shard in shards])
    if not len(changes):
        for table in TABLES:
            storage.delete_directory(storage.join_uri(request.output, table, f"source={request.source}"))
        raise ValueError(f"no primitive in {scenes} scene(s) matches the selection; nothing was written")
    table = _sum_changes(request.edits, changes)
    sections: list[Section] = [table]
    if pictures:
        sections.append(_draw_before_after(request, parts, pictures))
    page = storage.join_uri(request.output, f"{request.run}.html")
    storage.write_text(render_report_html("Edited scenes", sections, request.run), page)
    return EditResult(scenes, rejects, table, page)


def _sum_changes(edits: Sequence[Edit], changes: pa.Table) -> Table:
    """Tabulate the numbers of scenes and primitives and the sizes of the changes, per edit and kind of change."""
    rows = []
    for step, edit in enumerate(edits):
        of_step = changes.filter(pa.array(changes["step"].to_numpy() == step))
        for change in of_step["change"].unique().to_pylist() or [None]:
            here = [value == change for value in of_step["change"].to_pylist()]
            part = of_step.filter(pa.array(here)) if change else of_step
            moved_m, turned_rad, resized = (_find_maximum(part[n]) for n in ("moved_m", "turned_rad", "resized"))
            turned_deg = None if turned_rad is None else float(np.degrees(turned_rad))
            scenes = len(part["scene_id"].unique())
            rows.append((step, edit.name, change, scenes, len(part), moved_m, turned_deg, resized))
    columns = (
        "step",
        "edit",
        "change",
        "scenes",
        "primitives",
        "maximum displacement, m",
        "maximum rotation, deg",
        "maximum relative size change",
    )
    return Table("Edits", columns, rows)


def _find_maximum(column: pa.ChunkedArray) -> float | None:
    """Return the maximum of the values that are not null, or None if there are none."""
    return max((value for value in column.to_pylist() if value is not None), default=None)


def _draw_before_after(request: EditRequest, parts: Sequence[tuple[Shard, list[int]]], count: int) -> Pictures:
    """Show the first changed scenes before and after the edits; outline the objects that the first edit changes."""
    shown: list[Picture] = []
    for scene, after, changes in islice(_list_changed(request, parts), count):
        region = select_around_objects(scene, changes.primitive, OUTLINE_M)
        shown.append(Picture(scene.scene_id, render_outlined_bev(scene, region, PICTURE_PX), "given"))
        shown.append(Picture(scene.scene_id, render_bev(after, PICTURE_PX, 2), "edited"))
    note = (
        "The left picture shows the input scene. Red outlines mark the objects that the first edit changes. The "
        "right picture shows the scene after all edits."
    )
    return Pictures("Before and after", shown, 4, note)


def _list_changed(
    request: EditRequest, parts: Sequence[tuple[Shard, list[int]]]
) -> Iterator[tuple[Scene, Scene, ObjectChange]]:
    """For each changed scene, yield the input scene, the edited scene and the changes of the first edit."""
    for given, rows in parts:
        for scene in given.scenes(rows):
            with suppress(ValueError):  # Rejected scenes are skipped.
                after, done = replay_edits(scene, request.edits)
                if any(len(changes.primitive) for changes in done):
                    yield scene, after, done[0]
