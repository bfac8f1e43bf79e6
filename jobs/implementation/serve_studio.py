"""Implementation of jobs/serve_studio.py."""

from __future__ import annotations

import os
import secrets
import signal
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from urllib.parse import urlsplit

import uvicorn

from jobs.serve_studio import Config
from jobs.support.cli import home_path, make_absolute, require_positive
from jobs.support.model_directories import find_pipeline_directory
from jobs.support.ray_session import start_ray
from pipelines.runtime import storage
from pipelines.schema.tables import find_shards
from pipelines.studio.access import LOOPBACK, Gate
from pipelines.studio.actor import ActorBackend
from pipelines.studio.api import build_studio_app
from pipelines.studio.limits import StudioLimits

MAX_CONNECTIONS = 1024
START_S = 60.0
OBJECT_STORE_BYTES = 128 * 2**20  # Answers of more than 100 kB pass through the object store.


@dataclass(frozen=True)
class RunningStudio:
    """A studio that answers requests.

    Attributes:
        address: Address that visitors open; it contains the token, if there is one.
        server: HTTP server.
        thread: Thread of the HTTP server.
        backend: Actor that answers the requests.
    """

    address: str
    server: uvicorn.Server
    thread: threading.Thread
    backend: ActorBackend

    def stop(self) -> None:
        """Stop the HTTP server and the actor."""
        self.server.should_exit = True
        self.thread.join(10)
        self.backend.stop()


def serve_studio(config: Config) -> RunningStudio:
    """Start the studio.

    Raises:
        ValueError: A model, a dataset or a file is missing, an option is invalid, or the port is in use.
    """
    if not 0 <= config.port < 2**16:
        raise ValueError(f"--port is {config.port}, expected 0 to 65535")
    require_positive(config, "max_sessions", "max_memory_mib", "max_evaluations")
    if bool(config.tls_certificate) != bool(config.tls_key):
        raise ValueError("--tls-certificate and --tls-key belong together: give both or none")
    for option in ("tls_certificate", "tls_key"):
        if (path := getattr(config, option)) and not os.path.isfile(path):
            raise ValueError(f"--{option.replace('_', '-')} {path}: no such file")
    public = parse_public_url(config.public_url)
    model = find_pipeline_directory(config.model)
    tables = [make_absolute(table) for table in config.datasets]
    for table in tables:
        find_shards(table)
    if not config.datasets and storage.exists(home_path("generated", "scenes")):
        tables = [home_path("generated")]
    is_local = config.host in LOOPBACK and not public
    token = read_token(config.token_file) or ("" if is_local else secrets.token_urlsafe(24))
    names = (*config.host_names, *([public] if public else []))
    hosts = (*LOOPBACK, config.host, *names) if config.host in LOOPBACK or names else ()
    gate = Gate(token, hosts, bool(config.tls_certificate) or config.public_url.startswith("https://"))
    listener = open_port(config.host, config.port)
    start_ray(object_store_bytes=OBJECT_STORE_BYTES)
    limits = StudioLimits(
        max_sessions=config.max_sessions,
        total_bytes=config.max_memory_mib * 2**20,
        request_evaluations=config.max_evaluations,
        visitor_evaluations=5 * config.max_evaluations,
        max_area_m2=config.max_area_m2,
    )
    threads = config.num_threads or max(1, (os.cpu_count() or 1) - 1)
    backend = ActorBackend(model, tables, limits, threads, config.constraints)
    # The access log would contain the token. Addresses in X-Forwarded headers are not used.
    options = uvicorn.Config(
        build_studio_app(backend, gate),
        log_level="warning",
        access_log=False,
        server_header=False,
        proxy_headers=False,
        limit_concurrency=MAX_CONNECTIONS,
        timeout_keep_alive=30,
        ssl_certfile=config.tls_certificate or None,
        ssl_keyfile=config.tls_key or None,
    )
    server = uvicorn.Server(options)
    thread = threading.Thread(target=server.run, args=([listener],), daemon=True)
    thread.start()
    wait_until(lambda: server.started or not thread.is_alive(), START_S)
    if not server.started:
        raise ValueError(f"the HTTP server of the studio did not start on {config.host} port {config.port}")
    shown = f"[{config.host}]" if ":" in config.host else config.host
    scheme = "https" if config.tls_certificate else "http"
    base = config.public_url.rstrip("/") or f"{scheme}://{shown}:{listener.getsockname()[1]}"
    return RunningStudio(f"{base}/" + (f"?token={token}" if token else ""), server, thread, backend)


def parse_public_url(url: str) -> str:
    """Return the host name of --public-url, or "" without this option. Raises ValueError if the address is invalid."""
    if not url:
        return ""
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname or parts.path not in ("", "/") or parts.query:
        raise ValueError(f"--public-url is {url!r}, expected an address such as https://studio.example.org")
    return parts.hostname


def read_token(path: str) -> str:
    """Return the token in a file, or "" if there is no file. Raises ValueError if the file is missing or empty."""
    if not path:
        return ""
    try:
        with open(path, encoding="utf-8") as stream:
            token = stream.read(4096).strip()
    except (OSError, ValueError) as error:
        raise ValueError(f"--token-file {path}: cannot be read ({error})") from error
    if not token:
        raise ValueError(f"--token-file {path}: the file is empty")
    return token


def open_port(host: str, port: int) -> socket.socket:
    """Return a socket that is bound to a port; port 0 means any free port.

    Raises:
        ValueError: The port or the address cannot be used.
    """
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, socket.SOCK_STREAM)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
        except OSError:
            listener.close()
            raise
    except OSError as error:
        raise ValueError(f"--host {host} --port {port}: {error.strerror or error}; choose another --port") from error
    return listener


def wait_until(condition: Callable[[], bool], seconds: float) -> None:
    """Wait until a condition holds, at most a number of seconds."""
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.02)


def format_address(address: str, token_file: str) -> str:
    """Return an address that others on the network can open; a token of the user's own does not appear in logs."""
    for wildcard in ("//0.0.0.0:", "//[::]:"):
        address = address.replace(wildcard, f"//{socket.gethostname()}:")
    return f"{address.split('?')[0]}?token=TOKEN, with the content of {token_file}" if token_file else address


def main(config: Config) -> None:
    studio = serve_studio(config)
    print(f"studio: {format_address(studio.address, config.token_file)}", flush=True)
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())  # A service manager stops the studio with SIGTERM.
    try:
        while studio.thread.is_alive() and not ended.wait(0.5):
            pass
    except KeyboardInterrupt:
        print("the studio ends; the scenes of its visitors are lost")
    finally:
        studio.stop()
