"""Describe the origin of a result: command, commit and machine, but no host names or absolute paths."""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import subprocess
import sys
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).parents[2]


def describe_machine() -> str:
    """Return the processor, cores, memory and GPUs, such as "AMD EPYC, 2 cores, 24 GiB"."""
    import torch  # Jobs without models do not need this module, whose import takes two seconds.

    information = Path("/proc/cpuinfo")
    lines = information.read_text().splitlines() if information.exists() else []
    processor = next((line.split(":")[1].strip() for line in lines if "model name" in line), platform.machine())
    memory_gib = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    gpus = [torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count())]
    return ", ".join([processor, f"{os.cpu_count()} cores", f"{memory_gib:.0f} GiB", *gpus])


def find_commit() -> str:
    """Return the commit of this code, with "+" if files have changed, or "unknown" outside a git checkout."""

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", "-C", ROOT, *arguments], capture_output=True, text=True, check=True
        ).stdout.strip()

    try:
        return git("rev-parse", "--short=10", "HEAD") + ("+" if git("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


@lru_cache(maxsize=1)
def digest_code() -> str:
    """Return 12 hexadecimal digits of a hash of all Python files of this package."""
    digest = hashlib.sha256()
    for path in sorted(path for package in ("jobs", "models", "pipelines") for path in ROOT.glob(f"{package}/**/*.py")):
        digest.update(f"{path.relative_to(ROOT)}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def format_command() -> str:
    """Return the command line with shortened paths.

    Paths under $PRITTI_HOME and under this checkout become relative. All other absolute paths are reduced to their last
    part.
    """
    roots = [(Path(os.environ.get("PRITTI_HOME") or Path.home() / "pritti"), "$PRITTI_HOME"), (ROOT, ".")]

    def public(word: str) -> str:
        option, equals, value = word.partition("=") if word.startswith("--") else ("", "", word)
        path = Path(value)
        if not path.is_absolute():
            return word
        for root, name in roots:
            if path.is_relative_to(root):
                return option + equals + os.path.normpath(Path(name, path.relative_to(root)))
        return option + equals + f".../{path.name}"

    return " ".join(word if "$PRITTI_HOME" in word else shlex.quote(word) for word in map(public, sys.argv))


def list_versions() -> str:
    """Return the versions of Python and torch."""
    return f"Python {platform.python_version()}, torch {version('torch')}"
