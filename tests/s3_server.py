"""An S3 server for tests (moto) that records its requests and can fail on demand."""

from __future__ import annotations

import logging
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

WRITING = ("PUT", "POST")
KEYS = {"AWS_ACCESS_KEY_ID": "testing", "AWS_SECRET_ACCESS_KEY": "testing", "AWS_EC2_METADATA_DISABLED": "true"}


@dataclass
class S3Server:
    """Running server.

    Attributes:
        url: Address, such as http://127.0.0.1:5000.
        requests: Method, path and query of each request.
        intercept: Function that returns an HTTP status instead of the answer of the server, or 0.
    """

    url: str
    requests: list[tuple[str, str, str]] = field(default_factory=list)
    intercept: Callable[[str, str], int] = lambda method, path: 0

    def uri(self, *parts: str) -> str:
        """Return a URI in the bucket `tests`, with the address of this server as option."""
        return "/".join(["s3://tests", *parts]) + f"?endpoint_override={self.url}&region=us-east-1"

    def list_writes(self) -> list[str]:
        """Return the paths of all requests that write objects; deletions are free of charge and not counted."""
        return [path for method, path, query in self.requests if method in WRITING and query != "delete="]


@contextmanager
def run_s3_server() -> Iterator[S3Server]:
    """Start a server on a free port of the loopback interface, with the bucket `tests`; stop it at the end."""
    import boto3
    from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import make_server

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    application = DomainDispatcherApplication(create_backend_app)
    server = S3Server("")

    def record(environment: dict, start_response: Callable) -> object:
        method, path, query = (environment[name] for name in ("REQUEST_METHOD", "PATH_INFO", "QUERY_STRING"))
        server.requests.append((method, path, query))
        if status := server.intercept(method, path):
            start_response(f"{status} Fault", [("Content-Length", "0")])
            return [b""]
        return application(environment, start_response)

    http = make_server("127.0.0.1", 0, record, threaded=True)
    server.url = f"http://127.0.0.1:{http.server_port}"
    thread = threading.Thread(target=http.serve_forever, daemon=True)
    thread.start()
    keys = {"aws_access_key_id": "testing", "aws_secret_access_key": "testing", "region_name": "us-east-1"}
    boto3.client("s3", endpoint_url=server.url, **keys).create_bucket(Bucket="tests")
    try:
        yield server
    finally:
        http.shutdown()
        thread.join()


@contextmanager
def record_connections() -> Iterator[tuple[str, list[bytes]]]:
    """Listen as an HTTP proxy that refuses all requests; yield its URL and the list of first lines of the requests."""
    lines: list[bytes] = []
    server = socket.create_server(("127.0.0.1", 0))

    def listen() -> None:
        while True:
            try:
                connection, _ = server.accept()
            except OSError:  # The server is closed.
                return
            with connection:
                lines.append(connection.recv(1000).split(b"\r\n")[0])
                connection.sendall(b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\n\r\n")

    threading.Thread(target=listen, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.getsockname()[1]}", lines
    finally:
        server.close()
