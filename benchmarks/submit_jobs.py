"""Submit every job with `ray job submit` to a cluster of two nodes that share no disk, with all files on S3.

    python benchmarks/submit_jobs.py                                        a quarter of an hour on two cores
    python benchmarks/submit_jobs.py --diffusion DIR --controlnet DIR       also paint_streets
    python benchmarks/submit_jobs.py --output transcript.md

The S3 server (moto), MLflow and the cluster run on this machine, each node in a mount namespace. Ray uploads the code.
The script prints each command, the last lines of its output and its duration as Markdown, and ends with exit code 1 if
a job fails.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import textwrap
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import tyro
import yaml
from chaos import open_store
from common import describe_machine
from raylets import RAY, ROOT, Cluster

from pipelines.preprocess.sources.town.generator import generate_town, write_kitti360

HOME = "s3://tests/home"
JOB_TIMEOUT_S = 900
SHOWN = 2  # Number of lines of each output.
WIDTH = 112
OTHERS = re.compile(  # Lines of Ray and MLflow, bars of progress and tables.
    r"\(|\d{4}-\d\d-\d\d |[-=]{5}|Job |Next steps|Query|Ask|Tailing|Running entrypoint|🧪|🏃|.*\d+%\||[│└┗╰┏┡┃ ]"
)
# @ is the home directory.
JOBS = """
preprocess_scenes town --num-train 48 --num-test 24
voxelize_scenes --input @/datasets/town
train_baseline semcity --preset smoke --dataset @/datasets/town
sample_baseline --model @/models/semcity-smoke --num-scenes 4
train_lvae smoke --dataset @/datasets/town --name small-lvae --steps 24
encode_latents --dataset @/datasets/town --lvae @/models/small-lvae
train_dit smoke --dataset @/datasets/town --name small --steps 24 --num-workers 2
train_street_planner smoke --model @/models/pritti-small --output @/models/pritti-streets
sample_scenes --model @/models/pritti-small --num-scenes 24 --num-inference-steps 4 --run small --output @/small
sample_scenes --model town --num-scenes 24 --sampler dpm++ --num-inference-steps 10 --run town --output @/town
outpaint_scenes --model town --input @/town --num-inference-steps 8 --extent-m 192 192
inpaint_scenes --model town --input @/town --half-plane 1 0 32 --num-inference-steps 20 --output @/inpainted
edit_scenes remove --category pole --input @/town --output @/edited
evaluate_scenes --real @/datasets/town --generated @/town --run town --lvae @/models/small-lvae --lite0 False
evaluate_seams --generated @/outpainted
evaluate_city --generated @/outpainted --real @/datasets/town --label any-any --num-towns 2
export_scenes --input @/town --max-scenes 4 --formats glb npz xodr --output @/exports
furnish_place --model town --input @/exports/xodr/generated-town-0-0000001.xodr --size-m 64 --output @/furnished
simulate_traffic --input @/outpainted --duration-s 30 --num-examples 1
import_scenes @/exports/glb --name theirs --output @/imported
evaluate_voxels --ground-truth @/exports/npz --reconstructed @/exports/npz --output @/voxels
render_streets --input @/town --max-scenes 2 --spacing-m 16 --width-px 176 --height-px 48 --output @/town
paint_streets --streets @/town/streets/drive --diffusion DIFFUSION --controlnet CONTROLNET --num-inference-steps 2
inspect_scenes report --dataset @/town --num-examples 2
evaluate_scenes --real @/datasets/town --generated @/small --run small --lvae @/models/small-lvae --lite0 False
publish_model --name small --model @/models/pritti-small --evaluation @/evaluations/small --output @/zoo
sample_scenes --model models:/small/1 --num-scenes 4 --num-inference-steps 4 --output @/registered
sweep_samplers --model town --num-scenes 24 --samplers dpm++ --num-inference-steps 4
sweep_seams --model town --input @/town --max-scenes 1 --settings 4 1 1 1 0
sweep_references --real @/datasets/town --generated @/town --reference-sizes 8 --min-distances-m 1 --k 3
ablate_lvae encoding --train-sizes 64 --any-footprint-train-sizes 64 --yaw-only-train-sizes 64 --num-seeds 1 --epochs 1
run_demo --preset smoke --output @/demo
reproduce_paper kitti360 --input RAW --scale mini --lvae-steps 4 --dit-steps 4 --num-scenes 12 --output @/paper
serve_studio --datasets @/town --port 8600
"""


@dataclass(frozen=True)
class Config:
    diffusion: str = ""
    """Local directory of Stable Diffusion for paint_streets."""
    controlnet: str = ""
    """Local directory of a ControlNet for paint_streets."""
    jobs: tuple[str, ...] = ()
    """Names of the jobs to submit, such as sample_scenes (default: all)."""
    output: Path | None = None
    """File to write the transcript to (default: standard output only)."""


def submit(cluster: Cluster, settings: Path, words: list[str], *options: str) -> subprocess.CompletedProcess[str]:
    """Submit a job, and wait for its end unless an option says otherwise."""
    address = f"http://127.0.0.1:{cluster.dashboard_port}"
    command = [RAY, "job", "submit", "--address", address, "--runtime-env", str(settings), *options, "--", *words]
    end = time.monotonic() + 120
    while True:
        found = subprocess.run(
            command, cwd=ROOT, env=cluster.environment, capture_output=True, text=True, timeout=JOB_TIMEOUT_S
        )
        if "No available agent" not in found.stderr or time.monotonic() > end:  # The head has just started.
            return found
        time.sleep(2)


def submit_and_wait(cluster: Cluster, settings: Path, words: list[str]) -> tuple[str, float]:
    """Submit a job and wait for its end; return its output and its duration (s)."""
    started = time.monotonic()
    done = submit(cluster, settings, words)
    if done.returncode:
        raise RuntimeError(f"{' '.join(words)}\n{done.stdout[-4000:]}{done.stderr[-2000:]}")
    return done.stdout, time.monotonic() - started


def format_transcript(words: list[str], output: str, seconds: float) -> str:
    """Return a command and the last lines of its output, without Ray's own lines, bars of progress and tables."""
    lines = re.sub(r"\x1b\[[0-9;]*m", "", output).splitlines()
    ours = [line for line in lines if line.strip() and not OTHERS.match(line)]
    line = "$ ray job submit --runtime-env env.yaml -- " + " ".join(words)
    command = " \\\n    ".join(textwrap.wrap(line, WIDTH, break_on_hyphens=False))
    shown = [command, *(line[:WIDTH] for line in ours[-SHOWN:])]
    return "\n".join([*shown, f"# {seconds:.0f} s", ""])


def submit_studio(cluster: Cluster, settings: Path, words: list[str]) -> tuple[str, float]:
    """Submit the studio, request its page, and stop the job; return its output and the duration (s)."""
    started = time.monotonic()
    found = submit(cluster, settings, words, "--no-wait", "--submission-id", "studio")
    if found.returncode:
        raise RuntimeError(found.stdout + found.stderr)
    address = f"http://127.0.0.1:{cluster.dashboard_port}"
    text, end = "", time.monotonic() + 120
    while "http://127.0.0.1:8600" not in text:
        if time.monotonic() > end:
            raise RuntimeError(text)
        time.sleep(1)
        command = [RAY, "job", "logs", "--address", address, "studio"]
        text = subprocess.run(command, env=cluster.environment, capture_output=True, text=True, check=False).stdout
    with urllib.request.urlopen("http://127.0.0.1:8600/", timeout=30) as page:
        text += f"\n# GET http://127.0.0.1:8600/: status {page.status}"
    subprocess.run([RAY, "job", "stop", "--address", address, "studio"], env=cluster.environment, check=True)
    return text, time.monotonic() - started


def run_jobs(config: Config, folder: Path, failed: list[str]) -> Iterator[str]:
    """Submit all jobs; yield the transcript of each, and add the names of jobs that fail to a list."""
    with open_store("s3", folder / "s3", 2, dashboard=True) as store:
        cluster = store.cluster
        kept = ("AWS_", "PRITTI_", "MLFLOW_", "OMP_", "DO_NOT", "RAY_TRAIN", "RAY_worker")
        variables = {name: value for name, value in cluster.environment.items() if name.startswith(kept)}
        variables |= {"PRITTI_HOME": HOME, "AWS_ENDPOINT_URL": variables["MLFLOW_S3_ENDPOINT_URL"]}
        settings = folder / "env.yaml"
        runtime = yaml.safe_load((ROOT / "infra/runtime_env.yaml").read_text())
        runtime |= {"env_vars": runtime["env_vars"] | variables, "working_dir": str(ROOT)}
        runtime["excludes"] += ["build", "docs"]
        settings.write_text(yaml.safe_dump(runtime))
        settings.chmod(0o600)
        raw = folder / "raw"
        write_kitti360(generate_town(3), raw)
        for line in JOBS.strip().splitlines():
            job, *words = line.split()
            if config.jobs and job not in config.jobs:
                continue
            if job == "paint_streets" and not (config.diffusion and config.controlnet):
                yield "# paint_streets: left out, because --diffusion and --controlnet are missing\n"
                continue
            models = {"DIFFUSION": config.diffusion, "CONTROLNET": config.controlnet, "RAW": str(raw)}
            shown = [f"jobs/{job}.py", *(word.replace("@", "$PRITTI_HOME") for word in words)]
            words = [f"jobs/{job}.py", *(models.get(word, word.replace("@", HOME)) for word in words)]
            run = submit_studio if job == "serve_studio" else submit_and_wait
            try:
                output, seconds = run(cluster, settings, words)
            except (RuntimeError, subprocess.TimeoutExpired) as error:
                failed.append(job)
                print(f"error: {error}", file=sys.stderr)
                continue
            yield format_transcript(shown, output, seconds).replace(HOME, "$PRITTI_HOME")


def main(config: Config) -> int:
    known = {line.split()[0] for line in JOBS.strip().splitlines()}
    if unknown := set(config.jobs) - known:
        print(f"error: unknown job {min(unknown)}; expected some of {', '.join(sorted(known))}", file=sys.stderr)
        return 2
    parts = [f"# {describe_machine()}\n"]
    print(parts[0], flush=True)
    failed: list[str] = []
    with tempfile.TemporaryDirectory(prefix="jobs-") as folder:
        for part in run_jobs(config, Path(folder), failed):
            print(part, flush=True)
            parts.append(part)
    if config.output:
        config.output.write_text("\n".join(parts))
    print(f"{len(failed)} jobs failed{': ' * bool(failed)}{', '.join(failed)}")
    return 1 if failed else 0


if __name__ == "__main__":
    os.environ.setdefault("RAY_AUTH_MODE", "disabled")
    sys.exit(main(tyro.cli(Config, description=__doc__)))
