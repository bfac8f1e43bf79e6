"""Serve the studio with Ray Serve: one replica holds the model and the sessions of all visitors."""

from __future__ import annotations

import ray.serve
from fastapi import FastAPI
from ray.serve import Application

from pipelines.studio.api import build_studio_app
from pipelines.studio.session import Studio

REQUESTS = 32  # Maximum numbers of concurrent and of waiting requests; further requests are refused.


def make_deployment(
    model: str, datasets: list[str], token: str, hosts: tuple[str, ...], threads: int | None
) -> Application:
    """Return the application for ray.serve.run; the replica loads the model at its start."""

    def app() -> FastAPI:
        import torch

        if threads:
            torch.set_num_threads(threads)
        studio = Studio(model, datasets)
        return build_studio_app(lambda: studio, token, hosts)

    @ray.serve.deployment(
        name="studio",
        num_replicas=1,
        max_ongoing_requests=REQUESTS,
        max_queued_requests=REQUESTS,
        logging_config={"log_level": "WARNING", "enable_access_log": False},
    )
    @ray.serve.ingress(app)
    class Server:
        pass

    return Server.bind()
