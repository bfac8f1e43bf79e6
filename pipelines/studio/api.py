"""HTTP interface of the studio: the page, the operations of a session and downloads."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from importlib.resources import files
from typing import Annotated, Protocol, runtime_checkable

from fastapi import APIRouter, FastAPI, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel

from pipelines.studio.access import HEADERS, Gate
from pipelines.studio.requests import (
    EditsRequest,
    ExtendRequest,
    GenerateRequest,
    InpaintRegionRequest,
    ListRequest,
    OpenRequest,
)
from pipelines.studio.studio import DOWNLOADS, Answer, make_json_answer

PAGE_FILES = {
    "/": ("studio.html", "text/html"),
    "/studio.js": ("studio.js", "text/javascript"),
    "/viewer.js": ("viewer.js", "text/javascript"),
}
ANSWER_S = 60.0  # Maximum time until a request is answered (s).


@runtime_checkable
class Backend(Protocol):
    """Answers the requests of visitors."""

    async def answer(self, operation: str, visitor: str, request: BaseModel | None = None) -> Answer:
        """Carry out one request (`Studio.answer`)."""
        ...


def build_studio_app(backend: Backend, gate: Gate) -> FastAPI:
    """Build the HTTP interface.

    Args:
        backend: Object that answers the requests; all visitors share it.
        gate: Access control.

    Returns:
        FastAPI application.
    """
    app = FastAPI(title="PrITTI studio", docs_url=None, redoc_url=None, openapi_url=None)

    @app.middleware("http")
    async def guard(request: Request, call_next):
        response = gate.refuse(request) or gate.exchange_token(request)
        if response is None:
            visitor = request.state.visitor = gate.read_visitor(request)
            path = request.url.path
            if visitor or (not gate.token and path in PAGE_FILES):
                response = await call_next(request)
                if not visitor and path == "/":
                    gate.issue_cookie(response)
            else:
                fix = "open the address that jobs/serve_studio.py printed" if gate.token else "reload the page"
                response = to_response(
                    make_json_answer({"detail": f"your cookie is missing or has expired; {fix}"}, 401)
                )
        response.headers.update(HEADERS)
        return response

    @app.exception_handler(RequestValidationError)
    async def explain(_: Request, error: RequestValidationError) -> Response:
        # The default answer repeats the values of the request, which can be NaN or large.
        shown = [
            {"loc": [str(part)[:80] for part in one["loc"]], "msg": one["msg"][:300]} for one in error.errors()[:10]
        ]
        return to_response(make_json_answer({"detail": shown}, 422))

    app.include_router(make_page_router())
    app.include_router(make_session_router(backend))
    return app


def to_response(answer: Answer) -> Response:
    """Convert an answer to an HTTP response."""
    headers = {}
    if answer.file_name:
        headers["Content-Disposition"] = f'attachment; filename="{answer.file_name}"'
    if answer.retry_after_s:
        headers["Retry-After"] = str(answer.retry_after_s)
    return Response(answer.content, answer.status, headers, answer.media_type)


def serve_file(name: str, media_type: str) -> Callable[[], Response]:
    """Return a route function that serves a file of pipelines/web."""
    content = files("pipelines").joinpath("web", name).read_bytes()

    def respond() -> Response:
        return Response(content, media_type=media_type)

    return respond


def make_page_router() -> APIRouter:
    """Return the routes for the page and its scripts."""
    router = APIRouter()
    for path, (name, media_type) in PAGE_FILES.items():
        router.get(path)(serve_file(name, media_type))
    return router


def make_session_router(backend: Backend) -> APIRouter:
    """Return the routes for the operations of a visitor; operations that change the scene return its new state."""
    router = APIRouter()

    async def ask(request: Request, operation: str, wanted: BaseModel | None = None) -> Response:
        try:
            answer = await asyncio.wait_for(backend.answer(operation, request.state.visitor, wanted), ANSWER_S)
        except TimeoutError:
            answer = make_json_answer({"detail": "the studio is overloaded; try again"}, 429, 10)
        return to_response(answer)

    def get(operation: str, path: str) -> None:
        async def respond(request: Request) -> Response:
            return await ask(request, operation)

        router.get(path)(respond)

    def post(operation: str, kind: type[BaseModel]) -> None:
        async def respond(request: Request, wanted) -> Response:
            return await ask(request, operation, wanted)

        respond.__annotations__ = {"request": Request, "wanted": kind, "return": Response}
        router.post(f"/api/{operation}")(respond)

    def post_without_values(operation: str) -> None:
        async def respond(request: Request) -> Response:
            return await ask(request, operation)

        router.post(f"/api/{operation}")(respond)

    for operation in ("about", "state", "work", "tracks"):
        get(operation, f"/api/{operation}")
    for kind in DOWNLOADS:
        get(kind, f"/scene.{kind}")
    for operation in ("cancel", "undo", "redo"):
        post_without_values(operation)
    for operation, kind in {
        "open": OpenRequest,
        "edit": EditsRequest,
        "generate": GenerateRequest,
        "inpaint": InpaintRegionRequest,
        "extend": ExtendRequest,
    }.items():
        post(operation, kind)

    @router.get("/api/scenes")
    async def scenes(request: Request, wanted: Annotated[ListRequest, Query()]) -> Response:
        return await ask(request, "scenes", wanted)

    return router
