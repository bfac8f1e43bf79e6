"""Sessions of the studio, without HTTP.

A visitor generates, edits, inpaints and extends one scene, and can undo each step. Long operations run in threads. Only
one long operation runs at a time, regardless of the number of visitors. Long operations report their progress and can
be cancelled.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

from models.composition.extend import inpaint_blocks, split_region
from models.composition.inpaint import select_polygon
from models.labels import LABELS, require_labels
from models.pipeline import PrITTIPipeline
from models.scene import Scene
from pipelines.editing.edit import parse_edits, replay_edits, serialize_edits
from pipelines.generation.sample import find_scene_label, load_pipeline, resample_to_model_resolution
from pipelines.io.web_export import export_web_scene
from pipelines.rendering.render import render_bev
from pipelines.reporting.report import encode_data_uri
from pipelines.reporting.scene_index import Catalogue
from pipelines.studio.requests import (
    EditsRequest,
    ExtendRequest,
    GenerateRequest,
    InpaintRegionRequest,
    SamplingRequest,
)

MAX_SESSIONS, MAX_HISTORY, MAX_WAITING = 16, 50, 4
MAX_SIDE_M = 512.0  # Maximum side length of an extended scene (m).
THUMBNAIL_PX, SCENES_PER_PAGE = 128, 24


class Cancelled(Exception):
    """Raised when the visitor cancels a task."""


class StudioBusyError(RuntimeError):
    """Raised if a task of the visitor is already running, or if too many tasks are waiting."""


@dataclass
class BackgroundTask:
    """A sampling run in a thread and its progress.

    Attributes:
        name: Name of the operation.
        total: Total number of network evaluations of the operation.
        done: Number of finished network evaluations.
        error: Error message; "" means no error.
        cancelled: Whether the visitor has cancelled the task.
        finished: Whether the thread has ended.
    """

    name: str
    total: int
    done: int = 0
    error: str = ""
    cancelled: bool = False
    finished: bool = False

    def step(self, pipeline: PrITTIPipeline, number: int, timestep: int, values: dict) -> dict:
        """Count one step of the sampler, which calls this function after each step."""
        if self.cancelled:
            raise Cancelled
        self.done += 1
        return values

    def state(self) -> dict:
        """Return the state of the task as plain values."""
        names = ("name", "total", "done", "error", "cancelled", "finished")
        return {name: getattr(self, name) for name in names}


@dataclass
class Session:
    """The scene of a visitor, with earlier states and undone states.

    Attributes:
        scene: Current scene.
        past: Earlier states, each as (name of the next operation, scene, edits).
        future: Undone states.
        edits: Edits since the scene was opened or generated.
        task: Last task.
    """

    scene: Scene | None = None
    past: list[tuple[str, Scene | None, list]] = field(default_factory=list)
    future: list[tuple[str, Scene | None, list]] = field(default_factory=list)
    edits: list = field(default_factory=list)
    task: BackgroundTask | None = None

    def put(self, name: str, scene: Scene, edits: list) -> None:
        """Store the state that results from an operation called `name`."""
        self.past = [*self.past, (name, self.scene, self.edits)][-MAX_HISTORY:]
        self.scene, self.edits, self.future = scene, edits, []

    def undo(self) -> None:
        """Restore the state before the last operation."""
        if self.past:
            name, scene, edits = self.past.pop()
            self.future.append((name, self.scene, self.edits))
            self.scene, self.edits = scene, edits

    def redo(self) -> None:
        """Restore the last undone state."""
        if self.future:
            name, scene, edits = self.future.pop()
            self.past.append((name, self.scene, self.edits))
            self.scene, self.edits = scene, edits

    def require_scene(self) -> Scene:
        """Return the current scene. Raises ValueError if no scene is open."""
        if self.scene is None:
            raise ValueError("no scene is open; open or generate one first")
        return self.scene

    def require_idle(self) -> Session:
        """Return the session. Raises StudioBusyError if a task of the visitor is running."""
        if self.task and not self.task.finished:
            raise StudioBusyError(f"{self.task.name} is still running; wait for it or cancel it")
        return self

    def state(self) -> dict:
        """Return the values that the page shows."""
        return {
            "scene": None
            if self.scene is None
            else export_web_scene(self.scene) | {"label": self.scene.vegetation_density},
            "undo": self.past[-1][0] if self.past else None,
            "redo": self.future[-1][0] if self.future else None,
            "edits": serialize_edits(self.edits),
            "work": self.task.state() if self.task else None,
        }


class Studio:
    """The model, the sessions of all visitors, and the datasets from which scenes can be opened."""

    def __init__(self, model: str, datasets: list[str]) -> None:
        """Load the model and read the datasets.

        Raises:
            ValueError: A directory contains no model, or a dataset contains no scenes.
        """
        self.pipeline = load_pipeline(model)
        self.default_scheduler = self.pipeline.scheduler_config
        self.catalogues = [Catalogue.read(root) for root in datasets]
        self.sessions: OrderedDict[str, Session] = OrderedDict()
        self.sampling, self.num_waiting, self.lock = threading.Lock(), 0, threading.Lock()

    def open_session(self, visitor: str) -> Session:
        """Return the session of a visitor.

        If there are more than MAX_SESSIONS sessions, the least recently used idle session is deleted.
        """
        with self.lock:
            session = self.sessions.pop(visitor, None) or Session()
            self.sessions[visitor] = session
            while len(self.sessions) > MAX_SESSIONS:
                idle = next(
                    (name for name, other in self.sessions.items() if not other.task or other.task.finished), None
                )
                self.sessions.pop(idle or next(iter(self.sessions)))
            return session

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
        if request.label:
            require_labels(kind, [request.label])
            return request.label
        try:
            return find_scene_label(scene, kind) if scene is not None else self.labels[0]
        except ValueError:
            return self.labels[0]

    def start_task(self, session: Session, name: str, total: int, make: Callable[[BackgroundTask], Scene]) -> None:
        """Run `make` in a thread and put the resulting scene into the session.

        Raises:
            StudioBusyError: A task of the visitor is already running, or too many tasks are waiting.
        """
        with self.lock:
            session.require_idle()
            if self.num_waiting >= MAX_WAITING:
                raise StudioBusyError("too many tasks are waiting; try again in a minute")
            self.num_waiting += 1
            task = session.task = BackgroundTask(name, total)

        def run() -> None:
            try:
                with self.sampling:
                    if task.cancelled:
                        raise Cancelled
                    session.put(name, make(task), [])
            except Cancelled:
                pass
            except Exception as error:
                task.error = str(error)
            finally:
                with self.lock:
                    self.num_waiting -= 1
                task.finished = True

        threading.Thread(target=run, daemon=True).start()

    def generate(self, session: Session, request: GenerateRequest) -> None:
        """Start the generation of a scene."""
        label = self.choose_label(request, None)

        def make(task: BackgroundTask) -> Scene:
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

        self.start_task(session, f"generate {label}, seed {request.seed}", request.steps, make)

    def inpaint(self, session: Session, request: InpaintRegionRequest) -> None:
        """Start the regeneration of a region. Raises ValueError if the region contains no pixel of the scene."""
        scene = resample_to_model_resolution(session.require_scene(), self.pipeline.spec)
        region = select_polygon(scene.grid, request.polygon_m)
        if not region.any():
            raise ValueError("the region contains no pixel of the scene; draw a larger region inside the scene")
        label, repaint = self.choose_label(request, scene), request.repaint()
        blocks = len(split_region(self.pipeline, scene, region))

        def make(task: BackgroundTask) -> Scene:
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

        self.start_task(session, f"inpaint {request.contents}", blocks * repaint.num_evaluations, make)

    def extend(self, session: Session, request: ExtendRequest) -> None:
        """Start the extension of the scene on one side. Raises ValueError if the scene already has the maximum size."""
        small = self.pipeline.spec.grid
        scene = resample_to_model_resolution(session.require_scene(), self.pipeline.spec)
        rows, cols = scene.grid.rows, scene.grid.cols
        if max(rows, cols) * small.resolution_m >= MAX_SIDE_M:
            raise ValueError(f"the scene is already {MAX_SIDE_M:.0f} m long; use jobs/outpaint_scenes.py")
        across = cols if request.side in ("ahead", "behind") else rows
        blocks = -(-(across - small.rows) // (small.rows // 2)) + 1
        label, repaint = self.choose_label(request, scene), request.repaint()

        def make(task: BackgroundTask) -> Scene:
            return self.pipeline.outpaint(
                scene, label, request.seed, repaint=repaint, callback_on_step_end=task.step, side=request.side
            )

        self.start_task(session, f"extend {request.side}", blocks * repaint.num_evaluations, make)

    def edit(self, session: Session, request: EditsRequest) -> None:
        """Apply edits to the scene. Raises ValueError if an edit is invalid or uses SQL."""
        edits = parse_edits(request.edits)
        if any(edit.select.where for edit in edits):
            raise ValueError(
                "the studio accepts no SQL; select by number, category or polygon, or use jobs/edit_scenes.py"
            )
        for edit in edits:
            edit.check()
        scene, _ = replay_edits(session.require_scene(), edits)
        session.put(", ".join(edit.name for edit in edits), scene, [*session.edits, *edits])

    def open_scene(self, session: Session, scene_id: str) -> None:
        """Open a scene of a dataset. Raises ValueError if there is no such scene."""
        for catalogue in self.catalogues:
            if scene_id in catalogue.scenes["scene_id"].to_pylist():
                session.put(f"open {scene_id}", read_scene(catalogue, catalogue.find([scene_id])[0]), [])
                return
        raise ValueError(f"no scene {scene_id!r} in the datasets")

    def list_scenes(self, start: int, text: str) -> dict:
        """Return one page of the scenes whose id contains `text`: ids, labels and thumbnails."""
        found = []
        for catalogue in self.catalogues:
            rows = catalogue.scenes.select(["scene_id", "vegetation_density", "num_primitives"]).to_pylist()
            found += [(catalogue, k, row) for k, row in enumerate(rows) if text.lower() in row["scene_id"].lower()]
        page = found[start : start + SCENES_PER_PAGE]
        scenes = [row | {"picture": draw_thumbnail(catalogue, k)} for catalogue, k, row in page]
        return {"total": len(found), "start": start, "scenes": scenes}


def read_scene(catalogue: Catalogue, index: int) -> Scene:
    """Read one scene of a catalogue."""
    return catalogue.shards[catalogue.shard[index]].scenes([int(catalogue.row[index])])[0]


@lru_cache(maxsize=512)
def draw_thumbnail(catalogue: Catalogue, index: int) -> str:
    """Return a thumbnail of a scene as a data URI."""
    return encode_data_uri(render_bev(read_scene(catalogue, index), THUMBNAIL_PX))
