"""Find SUMO and run its programs.

SUMO is not a dependency; the Python package `eclipse-sumo` (extra `traffic`) or an installation with $SUMO_HOME
provides it.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from functools import lru_cache
from pathlib import Path
from xml.etree.ElementTree import Element

from defusedxml import ElementTree

TIMEOUT_S = 600


def find_sumo() -> Path | None:
    """Return the home directory of SUMO: $SUMO_HOME or that of the package `eclipse-sumo`; None if there is none."""
    home = os.environ.get("SUMO_HOME", "")
    if not home and (spec := importlib.util.find_spec("sumo")) and spec.submodule_search_locations:
        home = spec.submodule_search_locations[0]
    return Path(home) if home and (Path(home) / "bin").is_dir() else None


def require_sumo() -> Path:
    """Return the home directory of SUMO.

    Returns:
        Directory.

    Raises:
        RuntimeError: SUMO is not installed.
    """
    home = find_sumo()
    if home is None:
        raise RuntimeError(
            "SUMO is not installed; install the extra traffic (pip install 'pritti-on-ray[traffic]') or set SUMO_HOME"
        )
    return home


@lru_cache
def check_sumo(home: Path) -> None:
    """Check that the programs of SUMO start, once per process.

    Args:
        home: Home directory of SUMO.

    Raises:
        RuntimeError: A program does not start, for example because a library is missing.
    """
    for program in ("bin/netconvert", "bin/sumo"):
        run_program(home, program, "--version")


def run_program(home: Path, program: str, *arguments: object) -> str:
    """Run a program of SUMO.

    Args:
        home: Home directory of SUMO.
        program: Path of the program below this directory, such as bin/netconvert.
        *arguments: Arguments.

    Returns:
        Messages on standard error.

    Raises:
        RuntimeError: The program fails, crashes or exceeds TIMEOUT_S. The message contains the end of its output.
    """
    command = [str(home / program), *map(str, arguments)]
    if program.endswith(".py"):
        command.insert(0, sys.executable)
    variables = os.environ | {"SUMO_HOME": str(home), "PYTHONPATH": str(home / "tools")}
    try:
        done = subprocess.run(command, env=variables, capture_output=True, text=True, timeout=TIMEOUT_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise RuntimeError(f"{command[0]}: {error}") from error
    if done.returncode:
        raise RuntimeError(
            f"{program} of SUMO failed with code {done.returncode}: {(done.stderr or done.stdout)[-600:]}"
        )
    return done.stderr


def read_xml(path: Path) -> Element:
    """Read a file that SUMO wrote.

    Args:
        path: XML file.

    Returns:
        Root element.

    Raises:
        RuntimeError: The file is missing or is no XML.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError) as error:
        raise RuntimeError(f"{path.name} of SUMO: {error}") from error
    if root is None:
        raise RuntimeError(f"{path.name} of SUMO has no content")
    return root


def read_float(element: Element, name: str, default: float = 0.0) -> float:
    """Read a number from an attribute.

    Args:
        element: Element.
        name: Name of the attribute.
        default: Value if the attribute is missing.

    Returns:
        Number.
    """
    text = element.get(name)
    return default if text is None else float(text)
