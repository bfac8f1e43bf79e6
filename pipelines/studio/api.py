"""HTTP interface of the studio: the page, the operations of a session, downloads and access control."""

from __future__ import annotations

import hmac
import json
import secrets
from collections.abc import Callable
from importlib.resources import files
from typing import Literal
from urllib.parse import urlsplit

from fastapi import APIRouter, FastAPI, HTTPException, Request, Response

from pipelines.editing.edit import serialize_edits
from pipelines.io.mesh_export import export_glb
from pipelines.io.opendrive import export_opendrive
from pipelines.studio.requests import EditsRequest, ExtendRequest, GenerateRequest, InpaintRegionRequest, OpenRequest
from pipelines.studio.session import Session, Studio, StudioBusyError

MAX_BODY_BYTES = 256 * 1024  # Maximum size of a request (bytes).
LOOPBACK = ("127.0.0.1", "localhost", "::1")
PAGE_FILES = {
    "/": ("studio.html", "text/html"),
    "/studio.js": ("studio.js", "text/javascript"),
    "/viewer.js": ("viewer.js", "text/javascript"),
}


def build_studio_app(studio: Callable[[], Studio], token: str = "", hosts: tuple[str, ...] = LOOPBACK) -> FastAPI:
    """Build the HTTP interface.

    Args:
        studio: Function that returns the studio; all requests share it.
        token: Token that each request must contain; the first request sends it as ?token=. "" means that no token is
            required.
        hosts: Host names that requests may use. Requests with other host names are refused. Without this check, a page
            of another origin could reach the studio through the host name of that origin.

    Returns:
        FastAPI application.
    """
    app = FastAPI(title="PrITTI studio", docs_url=None, redoc_url=None, openapi_url=None)
    add_access_control(app, token, hosts)
    app.include_router(make_page_router(studio))
    app.include_router(make_session_router(studio))
    return app


def refuse(request: Request, token: str, hosts: tuple[str, ...]) -> Response | None:
    """Return an error response if the request is not allowed, otherwise None."""
    host = urlsplit(f"//{request.headers.get('host', '')}").hostname
    if hosts and host not in hosts:
        return Response("unknown host", 421)
    # Pages of other origins cannot set a custom header.
    if request.method not in ("GET", "HEAD") and request.headers.get("x-studio") != "1":
        return Response("the request does not come from the page of the studio", 403)
    chunked = "chunked" in request.headers.get("transfer-encoding", "")
    if chunked or int(request.headers.get("content-length") or 0) > MAX_BODY_BYTES:
        return Response("the request is too large", 413)
    if token:
        sent = request.query_params.get("token") or request.cookies.get("studio_token") or ""
        if not hmac.compare_digest(sent.encode(), token.encode()):
            return Response("a token is needed; open the address that jobs/serve_studio.py printed", 401)
    return None


def add_access_control(app: FastAPI, token: str, hosts: tuple[str, ...]) -> None:
    """Refuse requests from other origins, and set a cookie for each visitor."""

    @app.middleware("http")
    async def guard(request: Request, call_next):
        refusal = refuse(request, token, hosts)
        if refusal:
            return refusal
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


def serve_file(name: str, media_type: str) -> Callable[[], Response]:
    """Return a route function that serves a file of pipelines/web."""
    content = files("pipelines").joinpath("web", name).read_bytes()

    def respond() -> Response:
        return Response(content, media_type=media_type)

    return respond


def make_page_router(studio: Callable[[], Studio]) -> APIRouter:
    """Return the routes for the page, its scripts, the labels and the list of scenes."""
    router = APIRouter()
    for path, (name, media_type) in PAGE_FILES.items():
        router.get(path)(serve_file(name, media_type))

    @router.get("/api/about")
    def about() -> dict:
        return {"labels": studio().labels, "resolution_m": studio().pipeline.spec.grid.resolution_m}

    @router.get("/api/scenes")
    def scenes(start: int = 0, text: str = "") -> dict:
        return studio().list_scenes(max(0, start), text[:100])

    return router


def make_session_router(studio: Callable[[], Studio]) -> APIRouter:
    """Return the routes for the session of a visitor; each operation returns the new state of the session."""
    router = APIRouter()

    def open_session(request: Request) -> Session:
        visitor = request.cookies.get("studio")
        if not visitor or len(visitor) > 64:
            raise HTTPException(400, "the request has no cookie; open the page of the studio first")
        return studio().open_session(visitor)

    def apply(request: Request, operation: Callable[[Session], None], busy_status: int = 409) -> dict:
        session = open_session(request)
        try:
            operation(session)
        except StudioBusyError as error:
            raise HTTPException(busy_status, str(error)) from error
        except ValueError as error:
            raise HTTPException(400, str(error)) from error
        return session.state()

    @router.get("/api/state")
    def state(request: Request) -> dict:
        return open_session(request).state()

    @router.get("/api/work")
    def work(request: Request) -> dict:
        task = open_session(request).task
        return task.state() if task else {}

    @router.post("/api/cancel")
    def cancel(request: Request) -> dict:
        session = open_session(request)
        if session.task:
            session.task.cancelled = True
        return session.state()

    @router.post("/api/open")
    def open_scene(request: Request, wanted: OpenRequest) -> dict:
        return apply(request, lambda session: studio().open_scene(session.require_idle(), wanted.scene_id))

    @router.post("/api/edit")
    def edit(request: Request, wanted: EditsRequest) -> dict:
        return apply(request, lambda session: studio().edit(session.require_idle(), wanted))

    @router.post("/api/undo")
    def undo(request: Request) -> dict:
        return apply(request, lambda session: session.require_idle().undo())

    @router.post("/api/redo")
    def redo(request: Request) -> dict:
        return apply(request, lambda session: session.require_idle().redo())

    @router.post("/api/generate")
    def generate(request: Request, wanted: GenerateRequest) -> dict:
        return apply(request, lambda session: studio().generate(session, wanted), busy_status=429)

    @router.post("/api/inpaint")
    def inpaint(request: Request, wanted: InpaintRegionRequest) -> dict:
        return apply(request, lambda session: studio().inpaint(session, wanted), busy_status=429)

    @router.post("/api/extend")
    def extend(request: Request, wanted: ExtendRequest) -> dict:
        return apply(request, lambda session: studio().extend(session, wanted), busy_status=429)

    @router.get("/scene.{kind}")
    def download(request: Request, kind: Literal["glb", "xodr", "json"]) -> Response:
        session = open_session(request)
        try:
            scene = session.require_scene()
            content = {
                "glb": lambda: export_glb(scene),
                "xodr": lambda: export_opendrive(scene),
                "json": lambda: json.dumps(serialize_edits(session.edits), indent=1).encode(),
            }[kind]()
        except ValueError as error:
            raise HTTPException(400, str(error)) from error
        name = "".join(letter if letter.isalnum() or letter in "-_" else "-" for letter in scene.scene_id)
        return Response(
            content,
            media_type="application/octet-stream",
            headers={"Content-Disposition": f'attachment; filename="{name}.{kind}"'},
        )

    return router
