#!/usr/bin/env python3
"""Serve a studio in the browser to generate, edit, inpaint and extend scenes.

    jobs/serve_studio.py                             http://127.0.0.1:8600, scenes of $PRITTI_HOME/generated
    jobs/serve_studio.py --datasets DIR DIR --model DIR
    jobs/serve_studio.py --host 0.0.0.0 --host-names studio.example.org     prints an address with a token

Runs on Ray Serve. Every visitor has a separate scene and edit history; the network serves one visitor at a time. The
page and its viewer come from this process; nothing is fetched from elsewhere. Stop the studio with Ctrl-C.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import run
from jobs.support.options import ModelOption


@dataclass(frozen=True)
class Config:
    model: ModelOption = ""
    datasets: tuple[str, ...] = ()
    """Dataset directories to open scenes from (default: $PRITTI_HOME/generated, if it has scenes)."""
    host: str = "127.0.0.1"
    """Address to listen on; every address but a loopback address requires a token."""
    port: int = 8600
    """Port to listen on."""
    host_names: tuple[str, ...] = ()
    """Host names, besides --host, under which visitors reach the studio (default: none)."""
    token: str = ""
    """Token that visitors need (default: none on a loopback address, else a random token)."""
    num_threads: int | None = None
    """Number of threads of the network (default: all cores)."""


if __name__ == "__main__":
    run("serve_studio")
