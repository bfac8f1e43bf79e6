"""The studio without HTTP: it generates, edits, inpaints and extends the scene of each visitor."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from pydantic import BaseModel

from models.composition.extend import inpaint_blocks, split_region
from models.composition.inpaint import select_polygon
from models.labels import LABELS, require_labels
from models.scene import Grid, Scene
from pipelines.editing.edit import Duplicate, parse_edits, replay_edits, serialize_edits
from pipelines.generation.sample import (
    find_scene_label,
    load_pipeline,
    resample_to_model_resolution,
)
from pipelines.geometry.parked_vehicles import find_driving_vehicles
from pipelines.io.mesh_export import export_glb
from pipelines.io.opendrive import export_opendrive
from pipelines.io.web_export import export_ground, export_web_scene, export_web_tracks
from pipelines.rendering.render import render_bev
from pipelines.reporting.report import encode_data_uri
from pipelines.reporting.scene_index import Catalogue
from pipelines.runtime import storage
from pipelines.schema.conversion import parse_scenes
from pipelines.schema.file_names import make_file_name
from pipelines.schema.ground_surface import to_model_surface
from pipelines.schema.tables import Shard
from pipelines.schema.tracks import read_tracks, select_tracks
from pipelines.studio.limits import StudioError, StudioLimits
from pipelines.studio.requests import (
    EditsRequest,
    ExtendRequest,
    GenerateRequest,
    InpaintRegionRequest,
    ListRequest,
    OpenRequest,
    SamplingRequest,
)
from pipelines.studio.sessions import Session, SessionStore
from pipelines.studio.tasks import BackgroundTask, TaskQueue

MAX_SIDE_M = 512.0  # Maximum side length of an extended scene (m).
THUMBNAIL_PX, SCENES_PER_PAGE = 128, 24
JSON_TYPE, FILE_TYPE = "application/json", "application/octet-stream"
DOWNLOADS = ("glb", "xodr", "json")
logger = logging.getLogger(__name__)


class Answer(NamedTuple):
    """Response to a request.

    Attributes:
        content: Body.
        media_type: Media type of the body.
        status: HTTP status.
        file_name: Name under which a browser stores the body; "" means that the body is not a download.
        retry_after_s: Seconds after which the visitor should try again; 0 means no advice.
    """

    content: bytes
    media_type: str = JSON_TYPE
    status: int = 200
    file_name: str = ""
    retry_after_s: int = 0


def make_json_answer(value: object, status: int = 200, retry_after_s: int = 0) -> Answer:
    """Return an answer with JSON."""
    return Answer(json.dumps(value, separators=(",", ":")).encode(), status=status, retry_after_s=retry_after_s)


class Studio:
    """The model, the sessions of all visitors, and the datasets from which scenes can be opened."""

    def __init__(
        self, model: str, datasets: list[str], limits: StudioLimits | None = None, constraints: bool | None = None
    ) -> None:
        """Load the model and read the datasets.

        Args:
            model: Pipeline directory.
            datasets: Dataset directories. Damaged shards are left out, and the log names them.
            limits: Limits of memory and computing time (default: StudioLimits()).
            constraints: Whether constraints guide sampling, if a request does not state it. None: the value that the
                model stores.

        Raises:
            ValueError: A directory contains no model, or a dataset contains no readable scenes.
        """
        self.limits = limits or StudioLimits()
        self.pipeline = load_pipeline(model)
        self.constraints = self.pipeline.resolve_constraints(constraints)
        self.default_scheduler = self.pipeline.scheduler_config
        self.catalogues = [Catalogue.read(root, skip_damaged=True) for root in datasets]
        for path, reason in (item for one in self.catalogues for item in one.damaged.items()):
            logger.warning("studio: %s is left out (%s)", path, reason)
        self.listed = [
            (row["scene_id"].lower(), catalogue, index, row)
            for catalogue in self.catalogues
            for index, row in enumerate(
                catalogue.scenes.select(["scene_id", "vegetation_density", "num_primitives"]).to_pylist()
            )
        ]
        roots: dict[str, str] = {}
        for _, catalogue, _, row in self.listed:
            if (root := roots.setdefault(row["scene_id"], catalogue.root)) is not catalogue.root:
                raise ValueError(
                    f"scene {row['scene_id']!r} is in {root} and in {catalogue.root}; give one of these directories, or"
                    " sample again with another --run"
                )
        self.sessions, self.tasks = SessionStore(self.limits), TaskQueue(self.limits)

    def answer(self, operation: str, visitor: str, request: BaseModel | None = None) -> Answer:
        """Carry out one request of a visitor.

        Args:
            operation: Name of the operation: about, scenes, state, work, tracks, cancel, open, edit, undo, redo,
                generate, inpaint, extend, or one of DOWNLOADS.
            visitor: Id of the visitor.
            request: Values of the request, for the operations that have values.

        Returns:
            The response. An error that the visitor can correct is a response, too.
        """
        try:
            return self._answer(operation, visitor, request)
        except StudioError as error:
            return make_json_answer({"detail": str(error)}, error.status, error.retry_after_s)
        except Exception:
            logger.exception("studio: %s failed", operation)
            return make_json_answer({"detail": f"{operation} failed; the log of the studio has the reason"}, 500)

    def _answer(self, operation: str, visitor: str, request: BaseModel | None) -> Answer:
        if operation == "about":
            about = {"labels": self.labels, "resolution_m": self.pipeline.spec.grid.resolution_m}
            return make_json_answer(about | {"constraints": self.constraints})
        if isinstance(request, ListRequest):
            return make_json_answer(self.list_scenes(request))
        session = self.sessions.open(visitor)
        if operation == "work":
            return make_json_answer(self.tasks.describe(session.task) if session.task else {})
        if operation in DOWNLOADS:
            return self.export(session, operation)
        if operation == "tracks":
            return make_json_answer(self.find_tracks(session))
        if operation == "cancel":
            if session.task:
                self.tasks.cancel(session.task)
        elif operation in ("undo", "redo"):
            getattr(session.require_idle(), operation)()
        elif operation != "state":
            self._change(session, visitor, request)
            self.sessions.trim(session)
        return self.describe(session)

    def _change(self, session: Session, visitor: str, request: BaseModel | None) -> None:
        """Apply a request that changes the scene, or start its task."""
        with session.lock:
            session.require_idle(429 if isinstance(request, SamplingRequest) else 409)
            if isinstance(request, OpenRequest):
                self.open_scene(session, request.scene_id)
            elif isinstance(request, EditsRequest):
                self.edit(session, request)
            elif isinstance(request, GenerateRequest):
                self.generate(session, visitor, request)
            elif isinstance(request, InpaintRegionRequest):
                self.inpaint(session, visitor, request)
            elif isinstance(request, ExtendRequest):
                self.extend(session, visitor, request)
            else:
                raise StudioError(f"unknown request {type(request).__name__}", 404)

    def describe(self, session: Session) -> Answer:
        """Return the values that the page shows."""
        with session.lock:
            scene, edits = session.state
            if session.shown is None and scene is not None:
                ground = session.ground
                if ground is None or ground[0] is not scene.height_m or ground[1] is not scene.occupied:
                    ground = session.ground = scene.height_m, scene.occupied, export_ground(scene)
                shown = export_web_scene(scene, ground[2]) | {"label": scene.vegetation_density}
                session.shown = json.dumps(shown, separators=(",", ":")).encode()
            values = {
                "undo": session.past[-1][0] if session.past else None,
                "redo": session.future[-1][0] if session.future else None,
                "edits": serialize_edits(edits),
                "work": self.tasks.describe(session.task) if session.task else None,
            }
            content = json.dumps(values, separators=(",", ":")).encode()
            return Answer(b'{"scene":' + (session.shown or b"null") + b"," + content[1:])

    def export(self, session: Session, kind: str) -> Answer:
        """Return the scene as a file."""
        scene, edits = session.state
        scene = session.require_scene()
        try:
            content = {
                "glb": lambda: export_glb(scene),
                "xodr": lambda: export_opendrive(scene),
                "json": lambda: json.dumps(serialize_edits(edits), indent=1).encode(),
            }[kind]()
        except ValueError as error:
            raise StudioError(str(error)) from error
        return Answer(content, FILE_TYPE, file_name=f"{make_file_name(scene.scene_id)}.{kind}")

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the labels of the model."""
        return LABELS[self.pipeline.dit.config.label]

    def choose_label(self, request: SamplingRequest, scene: Scene | None) -> str:
        """Return the requested label.

        If the request has no label, return the label of the scene. If the scene has no label either, return the first
        label of the model.
        """
        kind = self.pipeline.dit.config.label
        try:
            if request.label:
                require_labels(kind, [request.label])
                return request.label
        except ValueError as error:
            raise StudioError(str(error)) from error
        try:
            return find_scene_label(scene, kind) if scene is not None else self.labels[0]
        except ValueError:
            return self.labels[0]

    def require_area(self, grid: Grid) -> None:
        """Raise StudioError if a scene is too large for the studio."""
        sides_m = grid.rows * grid.resolution_m, grid.cols * grid.resolution_m
        if max(sides_m) > MAX_SIDE_M or sides_m[0] * sides_m[1] > self.limits.max_area_m2:
            raise StudioError(
                f"a scene of {sides_m[0]:.0f} m x {sides_m[1]:.0f} m is too large for the studio, which accepts"
                f" {self.limits.max_area_m2:,.0f} m² and {MAX_SIDE_M:.0f} m; use jobs/outpaint_scenes.py"
            )

    def require_size(self, scene: Scene, more: int = 0) -> Scene:
        """Return the scene. Raises StudioError if it has too many primitives or too large an area."""
        self.require_area(scene.grid)
        if (count := len(scene) + more) > self.limits.max_primitives:
            raise StudioError(
                f"the scene would have {count:,} primitives, and the studio accepts {self.limits.max_primitives:,}"
            )
        return scene

    def start_task(
        self, session: Session, visitor: str, name: str, total: int, make: Callable[[BackgroundTask], Scene]
    ) -> None:
        """Run `make` as a task and put the resulting scene into the session.

        Raises:
            StudioError: The queue does not accept the task.
        """

        def run(task: BackgroundTask) -> None:
            scene = self.require_size(make(task))
            session.put(name, scene, (), self.limits.session_bytes)
            self.sessions.trim(session)

        task = BackgroundTask(visitor, name, total, run)
        self.tasks.put(task)
        session.task = task

    def use_constraints(self, request: SamplingRequest) -> None:
        """Guide the pipeline as a request states. Only the thread that samples calls this function."""
        self.pipeline.use_constraints(self.constraints if request.constraints is None else request.constraints)

    def generate(self, session: Session, visitor: str, request: GenerateRequest) -> None:
        """Start the generation of a scene."""
        label = self.choose_label(request, None)

        def make(task: BackgroundTask) -> Scene:
            self.use_constraints(request)
            self.pipeline.use_sampler(request.sampler)
            try:
                return self.pipeline.generate(
                    [label],
                    request.seed,
                    num_inference_steps=request.steps,
                    run="studio",
                    callback_on_step_end=task.step,
                )[0]
            finally:
                self.pipeline.scheduler = self.default_scheduler

        self.start_task(session, visitor, f"generate {label}, seed {request.seed}", request.steps, make)

    def inpaint(self, session: Session, visitor: str, request: InpaintRegionRequest) -> None:
        """Start the regeneration of a region. Raises StudioError if the region contains no pixel of the scene."""
        scene = resample_to_model_resolution(session.require_scene(), self.pipeline.spec)
        try:
            region = select_polygon(scene.grid, request.polygon_m)
        except ValueError as error:
            raise StudioError(str(error)) from error
        if not region.any():
            raise StudioError("the region contains no pixel of the scene; draw a larger region inside the scene")
        label, repaint = self.choose_label(request, scene), request.repaint(self.pipeline.dit.config.inpainting)
        blocks = len(split_region(self.pipeline, scene, region))

        def make(task: BackgroundTask) -> Scene:
            self.use_constraints(request)
            for step in inpaint_blocks(
                self.pipeline,
                scene,
                region,
                label,
                request.contents,
                request.seed,
                repaint=repaint,
                callback_on_step_end=task.step,
            ):
                canvas = step.canvases[0]
            return canvas

        self.start_task(session, visitor, f"inpaint {request.contents}", blocks * repaint.num_evaluations, make)

    def extend(self, session: Session, visitor: str, request: ExtendRequest) -> None:
        """Start the extension of the scene on one side. Raises StudioError if the result would be too large."""
        small = self.pipeline.spec.grid
        scene = resample_to_model_resolution(session.require_scene(), self.pipeline.spec)
        step = small.rows // 2
        is_along = request.side in ("ahead", "behind")
        rows, cols = scene.grid.rows + step * is_along, scene.grid.cols + step * (not is_along)
        self.require_area(Grid(0.0, 0.0, scene.grid.resolution_m, rows, cols))
        across = cols if is_along else rows
        blocks = -(-(across - small.rows) // step) + 1
        label, repaint = self.choose_label(request, scene), request.repaint(self.pipeline.dit.config.inpainting)

        def make(task: BackgroundTask) -> Scene:
            self.use_constraints(request)
            return self.pipeline.outpaint(
                scene, label, request.seed, repaint=repaint, callback_on_step_end=task.step, side=request.side
            )

        self.start_task(session, visitor, f"extend {request.side}", blocks * repaint.num_evaluations, make)

    def edit(self, session: Session, request: EditsRequest) -> None:
        """Apply edits to the scene. Raises StudioError if an edit is invalid, uses SQL or exceeds a limit."""
        scene, before = session.require_scene(), session.state.edits
        if len(before) + len(request.edits) > self.limits.max_edits:
            raise StudioError(
                f"the scene has {len(before):,} edits, and the studio accepts {self.limits.max_edits:,}; download the"
                " scene, or open it again"
            )
        try:
            edits = parse_edits(request.edits)
            if any(edit.select.where for edit in edits):
                raise StudioError(
                    "the studio accepts no SQL; select by number, category or polygon, or use jobs/edit_scenes.py"
                )
            for edit in edits:
                edit.check()
            for edit in edits:
                if isinstance(edit, Duplicate):
                    self.require_size(scene, int(edit.select.select_primitives(scene).sum()))
                scene, _ = replay_edits(scene, [edit])
        except StudioError:
            raise
        except ValueError as error:
            raise StudioError(str(error)) from error
        names = ", ".join(dict.fromkeys(edit.name for edit in edits))
        session.put(names, scene, (*before, *edits), self.limits.session_bytes)

    def open_scene(self, session: Session, scene_id: str) -> None:
        """Open a scene of a dataset. Raises StudioError if there is no such scene or if its tables are damaged."""
        place = self.find_scene(scene_id)
        if place is None:
            raise StudioError(f"no scene {scene_id!r} in the datasets")
        try:
            scene = to_model_surface(read_scene(*place), self.pipeline.spec)
        except ValueError as error:
            logger.warning("studio: scene %r cannot be read: %s", scene_id, error)
            raise StudioError("the tables of this scene are damaged; the log of the studio names the file") from error
        session.put(f"open {scene_id}", self.require_size(scene), (), self.limits.session_bytes)

    def find_tracks(self, session: Session) -> dict:
        """Return the simulated traffic of the scene, and the indices of its vehicles that are in traffic.

        There is no traffic if the scene comes from no dataset, or jobs/simulate_traffic.py has not simulated it.
        """
        scene = session.state.scene
        place = None if scene is None else self.find_scene(scene.scene_id)
        if scene is None or place is None:
            return {"objects": [], "driving": []}
        catalogue, index = place
        shard = catalogue.shards[catalogue.shard[index]]
        if not storage.exists(shard.path("tracks")):
            return {"objects": [], "driving": []}
        try:
            tracks = select_tracks(read_tracks(shard), scene.scene_id)
        except ValueError as error:
            logger.warning("studio: no traffic of scene %r: %s", scene.scene_id, error)
            raise StudioError("the tracks of this scene are damaged; the log of the studio names the file") from error
        driving = np.flatnonzero(find_driving_vehicles(scene))
        return {"objects": export_web_tracks(tracks), "driving": driving.tolist()}

    def find_scene(self, scene_id: str) -> tuple[Catalogue, int] | None:
        """Return the catalogue and the index of a scene of the datasets; None if there is no such scene."""
        return next(((c, k) for _, c, k, row in self.listed if row["scene_id"] == scene_id), None)

    def list_scenes(self, request: ListRequest) -> dict:
        """Return one page of the scenes whose id contains `text`: ids, labels and thumbnails."""
        text = request.text.lower()
        found = [(catalogue, index, row) for name, catalogue, index, row in self.listed if text in name]
        page = found[request.start : request.start + SCENES_PER_PAGE]
        scenes = [row | {"picture": draw_thumbnail(catalogue, index)} for catalogue, index, row in page]
        return {"total": len(found), "start": request.start, "scenes": scenes}


def read_scene(catalogue: Catalogue, index: int) -> Scene:
    """Read one scene of a catalogue."""
    shard = catalogue.shards[catalogue.shard[index]]
    return next(parse_scenes(*read_tables(shard), shard.source, shard.split, [int(catalogue.row[index])]))


@lru_cache(maxsize=32)
def read_tables(shard: Shard) -> tuple[pa.Table, pa.Table, pa.Table]:
    """Read the tables of a shard; the last shards stay in memory, because visitors often open scenes of one shard."""
    return shard.read_tables()


@lru_cache(maxsize=4096)
def draw_thumbnail(catalogue: Catalogue, index: int) -> str:
    """Return a thumbnail of a scene as a data URI; "" if the scene cannot be read."""
    try:
        return encode_data_uri(render_bev(read_scene(catalogue, index), THUMBNAIL_PX))
    except ValueError as error:
        logger.warning("studio: no thumbnail: %s", error)
        return ""
