"""The studio: each visitor generates, edits, inpaints and extends one scene, and can undo every step.

`Session` holds a visitor's scene and its history, independent of HTTP; `build_studio_app` is the HTTP interface. Long
operations run in a thread, one at a time over all visitors, report their progress and can be cancelled.
"""

from __future__ import annotations

import hmac
import json
import secrets
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.resources import files
from typing import Literal
from urllib.parse import urlsplit

from fastapi import FastAPI, HTTPException, Request, Response
from pydantic import BaseModel, ConfigDict, Field

from models.composition.extend import Side, inpaint_blocks, split_region
from models.composition.inpaint import Contents, select_polygon
from models.labels import LABELS, require_labels
from models.pipeline import PrITTIPipeline
from models.sampling.repaint import RePaintConfig
from models.scene import Scene
from pipelines.editing.edit import parse_edits, replay_edits, serialize_edits
from pipelines.generation.sample import find_scene_label, load_pipeline, resample_to_model_resolution
from pipelines.io.mesh_export import export_glb
from pipelines.io.opendrive import export_opendrive
from pipelines.io.web_export import export_web_scene
from pipelines.rendering.render import render_bev
from pipelines.reporting.report import encode_data_uri
from pipelines.reporting.scene_index import Catalogue

VISITORS, HISTORY, WAITING = 16, 50, 4
MAX_BODY = 256 * 1024  # bytes of a request
MAX_SIDE_M = 512.0  # of a scene that is extended
THUMBNAIL_PX, PAGE = 128, 24
LOOPBACK = ("127.0.0.1", "localhost", "::1")


class Cancelled(Exception):
    """The visitor has changed their mind."""


@dataclass
class BackgroundTask:
    """Something that takes a while."""

    name: str
    total: int  # evaluations of the network
    done: int = 0
    error: str = ""
    cancelled: bool = False
    finished: bool = False

    def step(self, pipeline: PrITTIPipeline, number: int, timestep: int, values: dict) -> dict:
        """What the sampler calls after each step."""
        if self.cancelled:
            raise Cancelled
        self.done += 1
        return values

    def state(self) -> dict:
        names = ("name", "total", "done", "error", "cancelled", "finished")
        return {name: getattr(self, name) for name in names}


@dataclass
class Session:
    """A visitor's scene, what it was before, and what was undone."""

    scene: Scene | None = None
    past: list[tuple[str, Scene | None, list]] = field(default_factory=list)
    future: list[tuple[str, Scene | None, list]] = field(default_factory=list)
    edits: list = field(default_factory=list)  # since the scene was opened or made, where it is all edits
    work: BackgroundTask | None = None

    def put(self, name: str, scene: Scene, edits: list) -> None:
        """A new state after a step called `name`."""
        self.past = [*self.past, (name, self.scene, self.edits)][-HISTORY:]
        self.scene, self.edits, self.future = scene, edits, []

    def undo(self) -> None:
        if self.past:
            name, scene, edits = self.past.pop()
            self.future.append((name, self.scene, self.edits))
            self.scene, self.edits = scene, edits

    def redo(self) -> None:
        if self.future:
            name, scene, edits = self.future.pop()
            self.past.append((name, self.scene, self.edits))
            self.scene, self.edits = scene, edits

    def require(self) -> Scene:
        if self.scene is None:
            raise ValueError("no scene is open; open or generate one first")
        return self.scene

    def state(self) -> dict:
        """What the page shows."""
        return {
            "scene": None
            if self.scene is None
            else export_web_scene(self.scene) | {"label": self.scene.vegetation_density},
            "undo": self.past[-1][0] if self.past else None,
            "redo": self.future[-1][0] if self.future else None,
            "edits": serialize_edits(self.edits),
            "work": self.work.state() if self.work else None,
        }


class StudioRequest(BaseModel):
    model_config = ConfigDict(extra="forbid")


class OpenRequest(StudioRequest):
    scene_id: str = Field(max_length=200)


class SamplingRequest(StudioRequest):
    label: str = Field("", max_length=40)  # "": the scene's own, or the first
    seed: int = Field(0, ge=0, lt=2**31)
    steps: int = Field(20, ge=1, le=1000)


class GenerateRequest(SamplingRequest):
    sampler: Literal["ddpm", "ddim", "dpm++", "sde-dpm++"] = "dpm++"


class RepaintRequest(SamplingRequest):
    jump_length: int = Field(1, ge=1, le=100)
    resamplings: int = Field(1, ge=1, le=20)
    pseudoinverse_guidance: float = Field(1.0, ge=0, le=10)
    eta: float = Field(0.0, ge=0, le=1)

    def repaint(self) -> RePaintConfig:
        return RePaintConfig(self.steps, self.jump_length, self.resamplings, self.pseudoinverse_guidance, self.eta)


class InpaintRequest(RepaintRequest):
    polygon_m: list[tuple[float, float]] = Field(min_length=3, max_length=500)
    contents: Contents = "both"


class ExtendRequest(RepaintRequest):
    side: Side


class EditsRequest(StudioRequest):
    edits: list[dict] = Field(min_length=1, max_length=100)


class Studio:
    """Desks of all visitors, the tables to open scenes from, and the model."""

    def __init__(self, model: str, tables: list[str]) -> None:
        """Raises ValueError for a directory without a model, or tables without scenes."""
        self.pipeline = load_pipeline(model)
        self.default_scheduler = self.pipeline.scheduler_config
        self.catalogues = [Catalogue.read(root) for root in tables]
        self.desks: OrderedDict[str, Session] = OrderedDict()
        self.busy, self.waiting, self.lock = threading.Lock(), 0, threading.Lock()

    def open_session(self, visitor: str) -> Session:
        """A visitor's desk; of too many the one longest unused goes."""
        with self.lock:
            desk = self.desks.pop(visitor, None) or Session()
            self.desks[visitor] = desk
            while len(self.desks) > VISITORS:
                idle = next((name for name, other in self.desks.items() if not other.work or other.work.finished), None)
                self.desks.pop(idle or next(iter(self.desks)))
            return desk

    @property
    def labels(self) -> tuple[str, ...]:
        return LABELS[self.pipeline.dit.config.label]

    def label(self, asked: SamplingRequest, scene: Scene | None) -> str:
        kind = self.pipeline.dit.config.label
        if asked.label:
            require_labels(kind, [asked.label])
            return asked.label
        try:
            return find_scene_label(scene, kind) if scene is not None else self.labels[0]
        except ValueError:
            return self.labels[0]

    def start(self, desk: Session, name: str, total: int, make: Callable[[BackgroundTask], Scene]) -> None:
        """Run `make` in a thread and put its scene on the desk. HTTP 429 if the visitor or everybody is busy."""
        with self.lock:
            if desk.work and not desk.work.finished:
                raise HTTPException(429, f"{desk.work.name} is still at work; wait for it or cancel it")
            if self.waiting >= WAITING:
                raise HTTPException(429, "others are waiting already; try again in a minute")
            self.waiting += 1
            work = desk.work = BackgroundTask(name, total)

        def run() -> None:
            try:
                with self.busy:
                    if work.cancelled:
                        raise Cancelled
                    desk.put(name, make(work), [])
            except Cancelled:
                pass
            except Exception as error:
                work.error = str(error)
            finally:
                with self.lock:
                    self.waiting -= 1
                work.finished = True

        threading.Thread(target=run, daemon=True).start()

    def generate(self, desk: Session, asked: GenerateRequest) -> None:
        label = self.label(asked, None)

        def make(work: BackgroundTask) -> Scene:
            self.pipeline.use_sampler(asked.sampler)
            try:
                return self.pipeline.generate(
                    [label], asked.seed, num_inference_steps=asked.steps, run="studio", callback_on_step_end=work.step
                )[0]
            finally:
                self.pipeline.scheduler = self.default_scheduler

        self.start(desk, f"generate {label}, seed {asked.seed}", asked.steps, make)

    def inpaint(self, desk: Session, asked: InpaintRequest) -> None:
        scene = resample_to_model_resolution(desk.require(), self.pipeline.spec)
        region = select_polygon(scene.grid, asked.polygon_m)
        if not region.any():
            raise ValueError("the region holds no pixel of the scene; draw a larger one")
        label, repaint = self.label(asked, scene), asked.repaint()
        blocks = len(split_region(self.pipeline, scene, region))

        def make(work: BackgroundTask) -> Scene:
            for step in inpaint_blocks(
                self.pipeline,
                scene,
                region,
                label,
                asked.contents,
                asked.seed,
                repaint=repaint,
                callback_on_step_end=work.step,
            ):
                canvas = step.canvases[0]
            return canvas

        self.start(desk, f"inpaint {asked.contents}", blocks * repaint.num_evaluations, make)

    def extend(self, desk: Session, asked: ExtendRequest) -> None:
        small = self.pipeline.spec.grid
        scene = resample_to_model_resolution(desk.require(), self.pipeline.spec)
        rows, cols = scene.grid.rows, scene.grid.cols
        if max(rows, cols) * small.resolution_m >= MAX_SIDE_M:
            raise ValueError(f"the scene is {MAX_SIDE_M:.0f} m long already; the studio stops there")
        across = cols if asked.side in ("ahead", "behind") else rows
        blocks = -(-(across - small.rows) // (small.rows // 2)) + 1
        label, repaint = self.label(asked, scene), asked.repaint()

        def make(work: BackgroundTask) -> Scene:
            return self.pipeline.outpaint(
                scene, label, asked.seed, repaint=repaint, callback_on_step_end=work.step, side=asked.side
            )

        self.start(desk, f"extend {asked.side}", blocks * repaint.num_evaluations, make)

    def edit(self, desk: Session, asked: EditsRequest) -> None:
        edits = parse_edits(asked.edits)
        if any(edit.select.where for edit in edits):
            raise ValueError(
                "conditions in SQL are for jobs/edit_scenes.py; select by number, category or polygon here"
            )
        for edit in edits:
            edit.check()
        scene, _ = replay_edits(desk.require(), edits)
        desk.put(", ".join(edit.name for edit in edits), scene, [*desk.edits, *edits])

    def open(self, desk: Session, scene_id: str) -> None:
        for catalogue in self.catalogues:
            if scene_id in catalogue.scenes["scene_id"].to_pylist():
                index = catalogue.find([scene_id])[0]
                scene = catalogue.shards[catalogue.shard[index]].scenes([int(catalogue.row[index])])[0]
                desk.put(f"open {scene_id}", scene, [])
                return
        raise ValueError(f"no scene {scene_id!r} in the tables")

    def page(self, start: int, text: str) -> dict:
        """Some scenes of the tables: names, labels, small pictures."""
        found = []
        for catalogue in self.catalogues:
            rows = catalogue.scenes.select(["scene_id", "vegetation_density", "num_primitives"]).to_pylist()
            found += [(catalogue, k, row) for k, row in enumerate(rows) if text.lower() in row["scene_id"].lower()]
        shown = [row | {"picture": draw_thumbnail(catalogue, k)} for catalogue, k, row in found[start : start + PAGE]]
        return {"total": len(found), "start": start, "scenes": shown}


@lru_cache(maxsize=512)
def draw_thumbnail(catalogue: Catalogue, index: int) -> str:
    """A data URI."""
    scene = catalogue.shards[catalogue.shard[index]].scenes([int(catalogue.row[index])])[0]
    return encode_data_uri(render_bev(scene, THUMBNAIL_PX))


def build_studio_app(studio: Callable[[], Studio], token: str = "", hosts: tuple[str, ...] = LOOPBACK) -> FastAPI:
    """Build the HTTP interface.

    Args:
        studio: Returns the one Studio.
        token: Token that every request must send, the first one as ?token=; "" for none.
        hosts: Host names that requests may use. Others are refused, so that a foreign page cannot reach the studio
            through its own host name.
    """
    app = FastAPI(title="PrITTI studio", docs_url=None, redoc_url=None, openapi_url=None)

    @app.middleware("http")
    async def guard(request: Request, call_next):
        host = urlsplit(f"//{request.headers.get('host', '')}").hostname
        if hosts and host not in hosts:
            return Response("unknown host", 421)
        if request.method not in ("GET", "HEAD") and request.headers.get("x-studio") != "1":
            return Response("not from the studio's page", 403)  # other pages cannot set a header of their own
        if int(request.headers.get("content-length") or 0) > MAX_BODY or "chunked" in request.headers.get(
            "transfer-encoding", ""
        ):
            return Response("the request is too large", 413)
        if token:
            shown = request.query_params.get("token") or request.cookies.get("studio_token") or ""
            if not hmac.compare_digest(shown.encode(), token.encode()):
                return Response("a token is needed: open the address that jobs/serve_studio.py printed", 401)
        response = await call_next(request)
        response.headers["Content-Security-Policy"] = (
            "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'"
        )
        response.headers["X-Content-Type-Options"] = "nosniff"
        if token:
            response.set_cookie("studio_token", token, httponly=True, samesite="strict")
        if "studio" not in request.cookies:
            response.set_cookie("studio", secrets.token_urlsafe(16), httponly=True, samesite="strict")
        return response

    def desk_of(request: Request) -> Session:
        visitor = request.cookies.get("studio")
        if not visitor or len(visitor) > 64:
            raise HTTPException(400, "no cookie; open the studio's page first")
        return studio().open_session(visitor)

    def answered(request: Request, act: Callable[[Session], None]) -> dict:
        desk = desk_of(request)
        try:
            act(desk)
        except ValueError as error:
            raise HTTPException(400, str(error)) from error
        return desk.state()

    def settled(desk: Session) -> Session:
        if desk.work and not desk.work.finished:
            raise HTTPException(409, f"{desk.work.name} is at work; wait for it or cancel it")
        return desk

    def file(name: str, kind: str) -> Response:
        return Response(files("pipelines").joinpath("web", name).read_bytes(), media_type=kind)

    app.get("/")(lambda: file("studio.html", "text/html"))
    app.get("/studio.js")(lambda: file("studio.js", "text/javascript"))
    app.get("/viewer.js")(lambda: file("viewer.js", "text/javascript"))
    app.get("/api/about")(lambda: {"labels": studio().labels, "resolution_m": studio().pipeline.spec.grid.resolution_m})
    app.get("/api/scenes")(lambda start=0, text="": studio().page(max(0, int(start)), str(text)[:100]))

    @app.get("/api/state")
    def state(request: Request) -> dict:
        return desk_of(request).state()

    @app.get("/api/work")
    def work(request: Request) -> dict:
        desk = desk_of(request)
        return desk.work.state() if desk.work else {}

    @app.post("/api/cancel")
    def cancel(request: Request) -> dict:
        desk = desk_of(request)
        if desk.work:
            desk.work.cancelled = True
        return desk.state()

    @app.post("/api/open")
    def open_scene(request: Request, asked: OpenRequest) -> dict:
        return answered(request, lambda desk: studio().open(settled(desk), asked.scene_id))

    @app.post("/api/edit")
    def edit(request: Request, asked: EditsRequest) -> dict:
        return answered(request, lambda desk: studio().edit(settled(desk), asked))

    @app.post("/api/undo")
    def undo(request: Request) -> dict:
        return answered(request, lambda desk: settled(desk).undo())

    @app.post("/api/redo")
    def redo(request: Request) -> dict:
        return answered(request, lambda desk: settled(desk).redo())

    @app.post("/api/generate")
    def generate(request: Request, asked: GenerateRequest) -> dict:
        return answered(request, lambda desk: studio().generate(desk, asked))

    @app.post("/api/inpaint")
    def inpaint(request: Request, asked: InpaintRequest) -> dict:
        return answered(request, lambda desk: studio().inpaint(settled(desk), asked))

    @app.post("/api/extend")
    def extend(request: Request, asked: ExtendRequest) -> dict:
        return answered(request, lambda desk: studio().extend(settled(desk), asked))

    @app.get("/scene.{kind}")
    def download(request: Request, kind: Literal["glb", "xodr", "json"]) -> Response:
        desk = desk_of(request)
        try:
            scene = desk.require()
            content = {
                "glb": lambda: export_glb(scene),
                "xodr": lambda: export_opendrive(scene),
                "json": lambda: json.dumps(serialize_edits(desk.edits), indent=1).encode(),
            }[kind]()
        except ValueError as error:
            raise HTTPException(400, str(error)) from error
        name = "".join(letter if letter.isalnum() or letter in "-_" else "-" for letter in scene.scene_id)
        return Response(
            content,
            media_type="application/octet-stream",
            headers={"Content-Disposition": f'attachment; filename="{name}.{kind}"'},
        )

    return app
