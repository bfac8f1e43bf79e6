"""Tests that run all command blocks and Python blocks of README and docs, except blocks with a stated reason."""

import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
from documents import PAGES, Block, list_blocks
from helpers import ROOT

# Pages with code blocks that other tests run.
TESTED_ELSEWHERE = {
    "docs/reference/tables.md": "tests/unit/test_tables_docs.py",
    "CONTRIBUTING.md": "only targets of make",
}
# Commands that a reader runs before the page, because some pages assume scenes under $PRITTI_HOME/generated.
SAMPLE = "jobs/sample_scenes.py --model town --num-scenes 2 --sampler dpm++ --num-inference-steps 10"
BEFORE = dict.fromkeys(
    ("docs/how_to/edit_scenes.md", "docs/how_to/street_views.md", "docs/how_to/import_scenes.md"), SAMPLE
)
# Pages whose commands take long. Other tests run the same jobs with smaller settings.
SLOW_PAGES = (
    "docs/concepts/sampling.md",
    "docs/getting_started.md",
    "docs/how_to/edit_scenes.md",
    "docs/how_to/import_scenes.md",
    "docs/how_to/own_drives.md",
    "docs/how_to/publish_weights.md",
    "docs/how_to/street_views.md",
)
RUN_PAGES = [
    pytest.param(page, marks=[pytest.mark.slow] if page in SLOW_PAGES else [])
    for page in PAGES
    if page not in TESTED_ELSEWHERE and any(not block.needs for block in list_blocks(page, "sh", "python"))
]


def run_words(words: list[str]) -> None:
    """Run one command of a shell block. A job runs in this process. A target of make runs as a dry run."""
    from jobs.support.cli import run

    if words[0] == "export":
        os.environ.update(word.split("=", 1) for word in words[1:])
    elif words[0] == "make":
        subprocess.run(["make", "--dry-run", "-C", str(ROOT), *words[1:]], check=True, capture_output=True)
    elif words[0] == "pritti":
        run(words[1].replace("-", "_"), words[2:])
    elif re.fullmatch(r"jobs/\w+\.py", words[0]):
        run(Path(words[0]).stem, words[1:])
    else:
        raise ValueError(f"no test runs {words[0]!r}: add it here, or mark the block with '# Needs: ...'")


def run_shell(code: str) -> None:
    """Run the commands of a shell block in order, after the expansion of environment variables."""
    for line in code.replace("\\\n", " ").splitlines():
        if words := shlex.split(os.path.expandvars(line), comments=True):
            run_words(words)


def run_block(block: Block, names: dict) -> None:
    if block.language == "sh":
        run_shell(block.code_to_run)
    else:
        exec(compile(block.code_to_run, block.page, "exec"), names)


@pytest.mark.parametrize("page", RUN_PAGES)
def test_document_blocks_run(page, tmp_path, monkeypatch, cluster):
    for name in ("models", "docs"):  # commands contain the path of the released weights relative to the repository
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PRITTI_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("PWD", str(tmp_path))
    names: dict = {"__name__": "document"}
    run_shell(BEFORE.get(page, ""))
    blocks = [block for block in list_blocks(page, "sh", "python") if not block.needs]
    assert blocks
    for block in blocks:
        run_block(block, names)
    shutil.rmtree(tmp_path / "home", ignore_errors=True)


def test_block_without_command_of_ours_is_refused(monkeypatch):
    with pytest.raises(ValueError, match="no test runs 'curl'"):
        run_shell("curl http://localhost")
