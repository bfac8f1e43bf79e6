"""Implementation of jobs/serve_studio.py."""

from __future__ import annotations

import secrets
import socket
import time

from ray import serve as ray_serve

from jobs.serve_studio import Config
from jobs.support.cli import home_path, make_absolute
from jobs.support.model_directories import find_pipeline_directory
from jobs.support.ray_session import start_ray
from pipelines.runtime import storage
from pipelines.schema.tables import find_shards
from pipelines.studio.api import LOOPBACK
from pipelines.studio.serve import make_deployment


def serve_studio(config: Config) -> str:
    """Start the studio and return its address.

    Raises:
        ValueError: A model or a dataset is missing, or the port is in use.
    """
    if not 0 <= config.port < 2**16:
        raise ValueError(f"--port is {config.port}, expected 0 to 65535")
    model = find_pipeline_directory(config.model)
    tables = [make_absolute(table) for table in config.datasets]
    for table in tables:
        find_shards(table)
    if not config.datasets and storage.exists(home_path("generated", "scenes")):
        tables = [home_path("generated")]
    require_free_port(config.host, config.port)
    local = config.host in LOOPBACK
    token = config.token or ("" if local else secrets.token_urlsafe(24))
    hosts = (*LOOPBACK, config.host, *config.host_names) if local or config.host_names else ()
    start_ray()
    quiet = {"log_level": "WARNING", "enable_access_log": False}
    ray_serve.start(http_options={"host": config.host, "port": config.port}, logging_config=quiet)
    ray_serve.run(make_deployment(model, tables, token, hosts, config.num_threads), name="studio", route_prefix="/")
    shown = f"[{config.host}]" if ":" in config.host else config.host
    return f"http://{shown}:{config.port}/" + (f"?token={token}" if token else "")


def require_free_port(host: str, port: int) -> None:
    """Raise an error if a port is in use, because Ray Serve would retry forever.

    Raises:
        ValueError: The port or the address cannot be used.
    """
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as listener:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
    except OSError as error:
        raise ValueError(f"--host {host} --port {port}: {error.strerror or error}; choose another --port") from error


def main(config: Config) -> None:
    print(f"studio: {serve_studio(config)}", flush=True)
    while True:
        time.sleep(3600)
