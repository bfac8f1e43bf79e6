"""Console script: `pritti JOB` runs an executable of jobs/, and `pritti --help` lists all jobs.

The list is read from the docstrings in the files, because the import of the job modules would take longer.
"""

from __future__ import annotations

import ast
import difflib
import sys
from importlib.util import find_spec
from pathlib import Path

from pritti import __version__


def list_job_files() -> dict[str, Path]:
    """Return the executables of the installed jobs package by command name, such as sample-scenes."""
    spec = find_spec("jobs")
    if spec is None or not spec.submodule_search_locations:
        raise ValueError("the package jobs is not installed; install pritti-on-ray again")
    (directory,) = spec.submodule_search_locations
    files = sorted(path for path in Path(directory).glob("*.py") if path.stem != "__init__")
    return {path.stem.replace("_", "-"): path for path in files}


def summarize_job(path: Path) -> str:
    """Return the first line of a file's docstring."""
    return (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").split("\n", 1)[0]


def describe_usage() -> str:
    """Return the help text with one line per job."""
    files = list_job_files()
    width = max(map(len, files))
    lines = [f"  {name:{width}}  {summarize_job(path)}" for name, path in files.items()]
    return "\n".join(
        [
            "usage: pritti JOB [OPTIONS]",
            "       pritti JOB --help",
            "",
            "Generate, edit and evaluate 3D semantic urban scenes. Data and models are kept in $PRITTI_HOME (default:",
            "~/pritti).",
            "",
            "jobs:",
            *lines,
        ]
    )


def main() -> None:
    """Run the job named by the first argument, and pass the other arguments to the job."""
    name, *args = sys.argv[1:] or ["--help"]
    if name in ("-h", "--help"):
        print(describe_usage())
        return
    if name == "--version":
        print(f"pritti {__version__}")
        return
    files = list_job_files()
    path = files.get(name.replace("_", "-"))
    if path is None:
        near = difflib.get_close_matches(name.replace("_", "-"), files, n=3)
        hint = f"did you mean {' or '.join(near)}?" if near else "pritti --help lists the jobs"
        print(f"error: unknown job {name!r}; {hint}", file=sys.stderr)
        sys.exit(2)
    from jobs.support.cli import run  # imported only here: the list of jobs does not need tyro

    sys.argv[0] = "pritti"  # the recorded command of a run should not contain a directory of this machine
    run(path.stem, args, prog=f"pritti {name}")


if __name__ == "__main__":
    main()
