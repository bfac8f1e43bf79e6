#!/usr/bin/env python3
"""Serve a studio in the browser to generate, edit, inpaint and extend scenes.

    jobs/serve_studio.py                             http://127.0.0.1:8600, scenes of $PRITTI_HOME/generated
    jobs/serve_studio.py --datasets DIR DIR --model DIR
    jobs/serve_studio.py --host 0.0.0.0 --host-names studio.example.org     prints an address with a token

The studio runs on Ray Serve. Every visitor has a separate scene and edit history. The network serves one visitor at a
time. This process serves the page and its viewer. The browser loads nothing from other servers. Stop the studio with
Ctrl-C.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import run
from jobs.support.options import ModelOption


@dataclass(frozen=True)
class Config:
    model: ModelOption = ""
    datasets: tuple[str, ...] = ()
    """Dataset directories from which visitors can open scenes (default: $PRITTI_HOME/generated, if it has scenes)."""
    host: str = "127.0.0.1"
    """Address to listen on; every address but a loopback address requires a token."""
    port: int = 8600
    """Port to listen on."""
    host_names: tuple[str, ...] = ()
    """Host names, in addition to --host, that the address of the studio may contain (default: none)."""
    token: str = ""
    """Token that visitors need (default: none for a loopback address, otherwise a random token)."""
    num_threads: int | None = None
    """Number of CPU threads for the network (default: all cores)."""


if __name__ == "__main__":
    run("serve_studio")
