#!/usr/bin/env python3
"""A studio in the browser, on Ray Serve: generate, look, edit, inpaint, extend, undo, download.

    jobs/serve_studio.py                                      http://127.0.0.1:8600, the scenes under $PRITTI_HOME/generated
    jobs/serve_studio.py --tables DIR DIR --model DIR
    jobs/serve_studio.py --host 0.0.0.0 --names studio.example.org       for others: prints an address with a token

Every visitor has a scene and a history of their own; the network works for one at a time. Ends with Ctrl-C. Nothing is
fetched from elsewhere: the page and its viewer come from this process.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

from jobs.support.cli import absolute, home, run, start_ray
from jobs.support.options import ModelOption, pipeline_directory


@dataclass(frozen=True)
class Config:
    model: ModelOption = ""
    tables: tuple[str, ...] = ()
    """Dataset directories to open scenes from (default: $PRITTI_HOME/generated, if there are scenes)."""
    host: str = "127.0.0.1"
    """Address to listen on; any but a loopback address asks visitors for a token."""
    port: int = 8600
    names: tuple[str, ...] = ()
    """Host names under which visitors reach it, besides --host."""
    token: str = ""
    """What visitors must bear (default: none on a loopback address, else one made for this run)."""
    threads: int | None = None
    """Of the network (default: all cores)."""


def serve(config: Config) -> str:
    """Start the studio; returns its address. Raises ValueError for a missing model or table."""
    if not 0 <= config.port < 2**16:
        raise ValueError(f"--port is {config.port}, expected 0 to 65535")
    model = pipeline_directory(config.model)
    from pipelines.runtime import storage
    from pipelines.schema.tables import find_shards

    tables = [absolute(table) for table in config.tables]
    for table in tables:
        find_shards(table)
    if not config.tables and storage.exists(home("generated", "scenes")):
        tables = [home("generated")]
    require_free(config.host, config.port)
    import secrets

    from pipelines.studio.session import LOOPBACK

    local = config.host in LOOPBACK
    token = config.token or ("" if local else secrets.token_urlsafe(24))
    hosts = (*LOOPBACK, config.host, *config.names) if local or config.names else ()
    start_ray()
    from pipelines.studio.session.serve import deployment
    from ray import serve as ray_serve

    quiet = {"log_level": "WARNING", "enable_access_log": False}
    ray_serve.start(http_options={"host": config.host, "port": config.port}, logging_config=quiet)
    ray_serve.run(deployment(model, tables, token, hosts, config.threads), name="studio", route_prefix="/")
    shown = f"[{config.host}]" if ":" in config.host else config.host
    return f"http://{shown}:{config.port}/" + (f"?token={token}" if token else "")


def require_free(host: str, port: int) -> None:
    """Raises ValueError if nobody can listen there: Ray Serve would try again and again."""
    import socket

    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as listener:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
    except OSError as error:
        raise ValueError(f"--host {host} --port {port}: {error.strerror or error}; choose another --port") from error


def main(config: Config) -> None:
    print(f"studio: {serve(config)}", flush=True)
    while True:
        time.sleep(3600)


if __name__ == "__main__":
    run(main, Config, description=__doc__)
