#!/usr/bin/env python3
"""Train and evaluate the paper's models, and compare the results with the paper's tables.

    jobs/reproduce_paper.py kitti360 --input KITTI-360 --dry-run          the plan, with times and disk space
    jobs/reproduce_paper.py kitti360 --input KITTI-360 --num-workers 4 --inception FILE
    jobs/reproduce_paper.py av2 --input ARGOVERSE2 --num-workers 4 --inception FILE
    jobs/reproduce_paper.py kitti360 --input KITTI-360 --scale mini      a rehearsal on two cores: small networks

The job preprocesses the drives, trains the layout VAE, encodes latents, trains the transformers, samples scenes and
evaluates them. It writes tables.html, tables.md and tables.json. Each row holds the reproduced score and, where they
exist, the paper's number, a ceiling (other real scenes, or scenes converted to layout tensors and back, without a
network) and a control (damaged scenes). A remark names missing values. First it prints the plan: the command
of each stage, its time and the disk space. Run the same command again to resume after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from jobs.support.cli import run
from jobs.support.options import GpusOption, IfBusyOption, LogFormatOption, WaitForResourcesOption


@dataclass(frozen=True)
class PaperOptions:
    """Options of both datasets."""

    input: str
    """Root directory of the raw dataset."""
    scale: Literal["paper", "mini"] = "paper"
    """Size of the networks and number of steps: as in the paper, or a rehearsal with small networks on two cores."""
    output: str = ""
    """Directory to write all files to: data, runs, models, tables, and MLflow's database if it is local (default:
    $PRITTI_HOME/paper-<dataset>, with --scale mini paper-<dataset>-mini)."""
    dry_run: bool = False
    """Print the plan and stop."""
    transformers: tuple[Literal["b", "l", "xl"], ...] = ("b",)
    """Transformers to train: DiT-B, DiT-L, DiT-XL. With --scale mini, all have the same small network."""
    ablations: bool = False
    """Also train the three ablations of the layout VAE of Tab. 2: no latent split, no objects, no ground."""
    inception: str = ""
    """File of Inception weights for precision, recall, FID and Inception score (default: none)."""
    vgg16: str = ""
    """File of VGG16 weights for the distances to the nearest training scene, supplement G (only DiT-B on
    KITTI-360; default: none)."""
    num_workers: int = 1
    """Number of training workers, and of actors that encode, sample and evaluate; use one per GPU."""
    lvae_steps: int | None = None
    """Number of training steps of the layout VAE (default: as in the preset; mini: 1000)."""
    dit_steps: int | None = None
    """Number of training steps of each transformer (default: as in the preset; mini: 1000)."""
    num_scenes: int | None = None
    """Number of scenes to generate per transformer (default: one per training pose; mini: 96)."""
    num_inference_steps: int = 250
    """Number of denoising steps (paper: 250)."""
    skip_unreadable: bool = False
    """Skip unreadable drives and list them in rejects; without this option, the job stops."""
    seed: int = 0
    """Random seed."""
    gpus: GpusOption = None
    wait_for_resources_s: WaitForResourcesOption = 0.0
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"


@dataclass(frozen=True)
class Kitti360(PaperOptions):
    """Reproduce the tables of KITTI-360: voxels, boxes, generation (Tab. 1 to 3) and memorisation (supplement G)."""


@dataclass(frozen=True)
class Av2(PaperOptions):
    """Reproduce the table of Argoverse 2 (supplement); --input holds train/ and val/ of the sensor dataset."""


Config = Annotated[Kitti360, tyro.conf.subcommand("kitti360")] | Annotated[Av2, tyro.conf.subcommand("av2")]


if __name__ == "__main__":
    run("reproduce_paper")
