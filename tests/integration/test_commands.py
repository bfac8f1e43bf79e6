"""Tests of jobs on the command line: `--help` and error messages."""

import os
import re
import subprocess
from concurrent.futures import ThreadPoolExecutor

import pytest
from helpers import ROOT, run_command

JOBS = sorted(p.name for p in (ROOT / "jobs").glob("*.py") if os.access(p, os.X_OK))


@pytest.mark.parametrize("job", JOBS)
def test_job_help_describes_job(job):
    done = run_command(f"jobs/{job}", "--help")
    assert done.returncode == 0 and job.removesuffix(".py") in done.stdout and len(done.stdout) > 300
    assert not re.search(r"\(default: (None|''|)\)", done.stdout)  # the help states these defaults in words


MISTAKES = {
    ("train_lvae.py", "tiny"): "unknown preset 'tiny', expected one of: smoke, demo, town, town-pixels, kitti360, av2",
    ("train_lvae.py",): "run jobs/preprocess_scenes.py",
    ("train_dit.py", "kitti360"): "run jobs/preprocess_scenes.py",
    ("train_street_planner.py", "large"): "unknown preset 'large', expected one of: smoke, town",
    ("encode_latents.py",): "run jobs/preprocess_scenes.py",
    ("sample_scenes.py", "--model", "nowhere"): "nowhere: no PrITTI pipeline here, and no included weights",
    ("publish_model.py", "--model", "nowhere"): "nowhere: no PrITTI pipeline here",
    ("sample_scenes.py", "--num-scenes", "0"): "--num-scenes is 0",
    ("outpaint_scenes.py", "--num-actors", "0"): "--num-actors is 0, expected at least 1",
    ("inpaint_scenes.py",): "no region; specify --polygon-m, --half-plane or --primitives",
    ("preprocess_scenes.py", "kitti360", "--input", "nowhere"): "--input nowhere: no such directory",
    ("preprocess_scenes.py", "av2", "--input", "tests"): "tests",
}


@pytest.fixture(scope="module")
def mistakes(tmp_path_factory) -> dict[tuple, subprocess.CompletedProcess]:
    """Completed process of each command with a mistake.

    Two commands run concurrently because each needs several seconds to start.
    """
    empty = str(tmp_path_factory.mktemp("empty"))
    with ThreadPoolExecutor(2) as pool:
        done = pool.map(lambda words: run_command(f"jobs/{words[0]}", *words[1:], PRITTI_HOME=empty), MISTAKES)
        return dict(zip(MISTAKES, done, strict=True))


@pytest.mark.parametrize("words", MISTAKES, ids=" ".join)
def test_job_reports_mistake_in_one_line(mistakes, words):
    done = mistakes[words]
    assert done.returncode == 2
    lines = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1 and MISTAKES[words] in lines[0], done.stderr
    assert "Traceback" not in done.stderr
