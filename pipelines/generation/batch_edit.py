"""A list of edits over a whole table: one Ray Data graph, one task per shard; and a page of before and after."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import ray.data

from models.composition.inpaint import select_around_objects
from models.scene import Scene
from pipelines.editing.edit import Edit, ObjectChange, replay_edits, serialize_edits
from pipelines.rendering.render import render_bev, render_outlined_bev
from pipelines.reporting.report import Picture, Pictures, Section, Table, render_report_html
from pipelines.runtime import storage
from pipelines.runtime.ray_tasks import map_rows
from pipelines.schema.run_guard import guard_run
from pipelines.schema.scene_subset import SceneSubset
from pipelines.schema.tables import EDITS, TABLES, Shard, make_rejects_table

PICTURE_PX = 512
OUTLINE_M = 0.4  # around what an edit changed


@dataclass(frozen=True)
class EditRequest:
    """Which edits, and where the edited scenes go: source edited-<run>, each in its split."""

    edits: tuple[Edit, ...]
    output: str
    run: str

    @property
    def source(self) -> str:
        return f"edited-{self.run}"

    def shard(self, number: int, given: Shard) -> Shard:
        """Where the scenes of the given shard go; they are the run's number-th."""
        return Shard(self.output, self.source, given.split, number)

    def claim(self, selection: SceneSubset) -> None:
        """Keep the source for these edits of these scenes (claims.py)."""
        chosen = {
            "input": selection.root,
            "source": selection.source,
            "split": selection.split,
            "limit": selection.limit,
        }
        guard_run(self.output, self.source, self.run, {"edits": serialize_edits(self.edits)} | chosen)


def edit_shard(scene: Scene, request: EditRequest) -> tuple[Scene, list[pa.Table]]:
    """The scene after the request's edits, and its rows of the edits table. Raises ValueError, naming the edit."""
    after, done = replay_edits(scene, request.edits)
    rows = []
    for step, (edit, changes) in enumerate(zip(request.edits, done, strict=True)):
        count = len(changes.primitive)
        about = {"scene_id": [scene.scene_id] * count, "step": [step] * count, "edit": [edit.name] * count}
        rows.append(pa.table(about | changes._asdict()).cast(EDITS))
    return replace(after, source=request.source), rows


def write_edited(row: dict, request: EditRequest, parts: list[tuple[Shard, list[int]]]) -> dict:
    """Row in: number of a shard. Row out: how many scenes, and how many of them are rejected. Writes its tables."""
    given, rows = parts[row["shard"]]
    shard = request.shard(row["shard"], given)
    if not storage.exists(shard.path("edits")):
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
        storage.write_parquet(pa.concat_tables(done), shard.path("edits"))  # last: the shard is done
    rejected = len(shard.read("rejects", ["reason"])) if storage.exists(shard.path("rejects")) else 0
    return {"scenes": len(rows), "rejects": rejected}


@dataclass(frozen=True)
class EditResult:
    """What a run did: scenes written and rejected, and what each step of the list changed."""

    scenes: int
    rejects: int
    table: Table
    page: str


def edit_scenes(
    request: EditRequest, selection: SceneSubset, pictures: int = 8, on_shard: Callable[[int], None] | None = None
) -> EditResult:
    """Write the edited tables, the edits table and a page. Goes on where it stopped.

    Raises ValueError if the output holds a run of other edits, for a list that no scene can take, or one that changes
    nothing anywhere.
    """
    if not request.edits:
        raise ValueError("the list of edits is empty")
    for edit in request.edits:
        edit.check()
    parts = selection.shards()
    request.claim(selection)
    rows = ray.data.from_items([{"shard": k} for k in range(len(parts))], override_num_blocks=len(parts))
    found = []
    for row in map_rows(rows, lambda row: write_edited(row, request, parts)).iter_rows():
        found.append(row)
        if on_shard:
            on_shard(row["scenes"])
    rejects = sum(row["rejects"] for row in found)
    scenes = sum(row["scenes"] for row in found) - rejects
    shards = [request.shard(k, given) for k, (given, _) in enumerate(parts)]
    if not scenes:
        reason = shards[0].read("rejects")["reason"][0].as_py()
        raise ValueError(f"none of the {rejects} scenes can be edited so; the first: {reason}")
    changes = pa.concat_tables([shard.read("edits") for shard in shards])
    if not len(changes):
        for table in TABLES:
            storage.delete_directory(storage.join_uri(request.output, table, f"source={request.source}"))
        raise ValueError(
            f"nothing is changed: no primitive in {scenes} scene(s) fits the selection; nothing is written"
        )
    table = _sum_changes(request.edits, changes)
    sections: list[Section] = [table]
    if pictures:
        sections.append(_draw_before_after(request, parts, pictures))
    page = storage.join_uri(request.output, f"{request.run}.html")
    storage.write_text(render_report_html("Edited scenes", sections, request.run), page)
    return EditResult(scenes, rejects, table, page)


def _sum_changes(edits: Sequence[Edit], changes: pa.Table) -> Table:
    """A row per edit and kind of change: scenes, primitives, and how much they were changed."""
    rows = []
    for step, edit in enumerate(edits):
        of_step = changes.filter(pc.equal(changes["step"], step))
        for change in pc.unique(of_step["change"]).to_pylist() or [None]:
            part = of_step.filter(pc.equal(of_step["change"], change)) if change else of_step
            moved_m, turned_rad, resized = (pc.max(part[name]).as_py() for name in ("moved_m", "turned_rad", "resized"))
            turned_deg = None if turned_rad is None else float(np.degrees(turned_rad))
            scenes = pc.count_distinct(part["scene_id"]).as_py()
            rows.append((step, edit.name, change, scenes, len(part), moved_m, turned_deg, resized))
    columns = (
        "step",
        "edit",
        "change",
        "scenes",
        "primitives",
        "moved at most, m",
        "turned at most, deg",
        "resized at most",
    )
    return Table("Edits", columns, rows)


def _draw_before_after(request: EditRequest, parts: Sequence[tuple[Shard, list[int]]], count: int) -> Pictures:
    """The first scenes that an edit changed, each as given and as edited; what was changed first is outlined."""
    shown: list[Picture] = []
    for scene, after, changes in islice(_list_changed(request, parts), count):
        region = select_around_objects(scene, changes.primitive, OUTLINE_M)
        shown.append(Picture(scene.scene_id, render_outlined_bev(scene, region, PICTURE_PX), "given"))
        shown.append(Picture(scene.scene_id, render_bev(after, PICTURE_PX, 2), "edited"))
    note = "Left as given, what the first edit changed outlined in red; right after all edits."
    return Pictures("Before and after", shown, 4, note)


def _list_changed(
    request: EditRequest, parts: Sequence[tuple[Shard, list[int]]]
) -> Iterator[tuple[Scene, Scene, ObjectChange]]:
    """Scenes that the edits change, before and after, and what the first edit did; one at a time."""
    for given, rows in parts:
        for scene in given.scenes(rows):
            with suppress(ValueError):  # a scene that is rejected
                after, done = replay_edits(scene, request.edits)
                if any(len(changes.primitive) for changes in done):
                    yield scene, after, done[0]
