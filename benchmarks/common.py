"""Functions that the benchmarks share: a description of the machine, interleaved timing and raw data."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipelines.preprocess.sources.drive import Drive
from pipelines.preprocess.sources.town.generator import generate_town, write_kitti360
from pipelines.runtime import provenance

# Seeds of towns with the density of KITTI-360: 240 to 280 primitives and 57 to 69 slabs in a crop.
DENSE_SEEDS = (0, 2, 4, 6)


def describe_machine() -> str:
    """Describe the machine, versions and commit in one line."""
    machine, versions, commit = provenance.describe_machine(), provenance.list_versions(), provenance.find_commit()
    return f"{machine}, {versions}, numpy {np.__version__}, commit {commit}"


def time_interleaved(
    ways: dict[str, Callable[[int], object]], rounds: int, clock: Callable[[], float] = time.process_time
) -> dict[str, list[float]]:
    """Measure each function once per round. The functions run in turn, so a busy machine slows all functions equally.

    Each function is called with the number of the round. The result contains a list of times in seconds for each
    function: CPU time, or time measured by `clock`.
    """
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for k in range(rounds):
        for name, way in ways.items():
            start = clock()
            way(k)
            seconds[name].append(clock() - start)
    return seconds


def spread(values: list[float], scale: float = 1.0, digits: int = 2) -> str:
    """Format values as the median, followed by the lowest and the highest value in brackets."""
    low, middle, high = (scale * f(values) for f in (min, statistics.median, max))
    return f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def format_ratios(slow: list[float], fast: list[float], digits: int = 1) -> str:
    """Format the ratios of `slow` to `fast` over the rounds."""
    return spread([a / b for a, b in zip(slow, fast, strict=True)], digits=digits) + " x"


def with_dense_poses(drive: Drive, spacing_m: float) -> Drive:
    """Return the drive with a pose every `spacing_m` metres along the path; KITTI-360 has a pose every 0.3 to 1.1 m."""
    xyz = drive.world_from_imu[:, :, 3]
    along = np.concatenate([[0.0], np.linalg.norm(np.diff(xyz, axis=0), axis=1).cumsum()])
    at = np.arange(0, along[-1], spacing_m)
    nearest = np.abs(along[:, None] - at).argmin(axis=0)
    matrix = drive.world_from_imu[nearest].copy()
    matrix[:, :, 3] = np.stack([np.interp(at, along, xyz[:, k]) for k in range(3)], axis=1)
    return replace(drive, frame=np.arange(len(at)), world_from_imu=matrix)


def write_raw(root: Path, seeds: tuple[int, ...] = DENSE_SEEDS, spacing_m: float = 1.0) -> None:
    """Write dense towns in KITTI-360's file format under `root`, one sequence per town; keep existing files."""
    for seed in seeds:
        if not (root / f"data_poses/2013_05_28_drive_{seed:04d}_sync/poses.txt").exists():
            write_kitti360(with_dense_poses(generate_town(seed), spacing_m), root)
