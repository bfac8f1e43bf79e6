#!/usr/bin/env python3
"""Serve a studio in the browser to generate, edit, inpaint and extend scenes.

    jobs/serve_studio.py                             http://127.0.0.1:8600, scenes of $PRITTI_HOME/generated
    jobs/serve_studio.py --datasets DIR DIR --model DIR
    jobs/serve_studio.py --host 0.0.0.0 --tls-certificate FILE --tls-key FILE --host-names studio.example.org
    jobs/serve_studio.py --public-url https://studio.example.org               behind a reverse proxy

Every visitor has a separate scene and edit history. The network serves one visitor at a time, in a fair order. A Ray
actor holds the model; this process serves the page and its viewer. The browser loads nothing from other servers.
Visitors need a token, unless the studio runs on a loopback address without --public-url. The job prints an address that
contains the token. Stop the studio with Ctrl-C.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import run
from jobs.support.options import ConstraintsOption, ModelOption


@dataclass(frozen=True)
class Config:
    model: ModelOption = ""
    datasets: tuple[str, ...] = ()
    """Dataset directories from which visitors can open scenes (default: $PRITTI_HOME/generated, if it has scenes)."""
    constraints: ConstraintsOption = None
    host: str = "127.0.0.1"
    """Address to listen on; visitors need a token unless it is a loopback address and --public-url is not set."""
    port: int = 8600
    """Port to listen on."""
    host_names: tuple[str, ...] = ()
    """Host names, in addition to --host, that the address of the studio may contain (default: none)."""
    public_url: str = ""
    """Address that visitors use, such as https://studio.example.org, if a reverse proxy passes requests on (default:
    none)."""
    tls_certificate: str = ""
    """File with the TLS certificate chain, in PEM format, for https without a proxy (default: none)."""
    tls_key: str = ""
    """File with the private key of --tls-certificate, in PEM format (default: none)."""
    token_file: str = ""
    """File with the token that visitors need, at least 16 characters (default: none for a loopback address, otherwise a
    random token)."""
    num_threads: int | None = None
    """Number of CPU threads for the network (default: all cores but one)."""
    max_sessions: int = 256
    """Maximum number of visitors; a visitor who is idle for 15 minutes can be replaced."""
    max_memory_mib: int = 512
    """Maximum size of the scenes and undo histories of all visitors in MiB."""
    max_evaluations: int = 4000
    """Maximum number of network evaluations per request, counted per block; a visitor has five times as many per
    hour."""
    max_area_m2: float = 65536.0
    """Maximum area of a scene in square metres."""


if __name__ == "__main__":
    run("serve_studio")
