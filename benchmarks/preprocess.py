"""Measure preprocessing on one core: speed per stage, agreement with ray casting, file size, memory, reading speed.

    python benchmarks/preprocess.py                    # about four minutes; raw data are written once
    python benchmarks/preprocess.py --raw KITTI-360    # any directory in KITTI-360's layout

The default data are dense towns in KITTI-360's file format.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import multiprocessing
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import trimesh
import tyro
from common import describe_machine, format_ratios, spread, time_interleaved, with_dense_poses, write_raw

from models.scene import Grid
from pipelines.preprocess import shard_writer
from pipelines.preprocess.sharding import plan_kitti360
from pipelines.preprocess.sources import kitti360
from pipelines.preprocess.sources.drive import Drive
from pipelines.preprocess.sources.town.generator import generate_town, write_kitti360
from pipelines.runtime import storage
from pipelines.schema.conversion import make_scene_tables
from pipelines.schema.dataset import compute_training_statistics
from pipelines.schema.tables import Shard
from pipelines.training.data_loader import LayoutReader

pa.set_cpu_count(1)
pa.set_io_thread_count(1)
BATCH = 32  # number of scenes in one timing of the rasteriser; a timing of ray casting uses one scene


@dataclass(frozen=True)
class Config:
    raw: str = ""
    """KITTI-360 root (default: dense towns, written once under the temporary directory)."""
    scenes: int = 512
    """Number of scenes to cut for the measurement of speed."""
    rays: int = 8
    """Scenes to cast rays for."""


def measure_density(drive: Drive, poses: np.ndarray, grid: Grid) -> tuple[float, float]:
    """Return the mean number of primitives and the mean number of slabs in a crop."""
    primitives, slabs = [], []
    for k in poses:
        local = drive.pose(int(k)).to_ego(drive.ground.vertices_m)
        slabs.append(len(np.unique(drive.ground.vertex_slab[grid.contains(local[:, 0], local[:, 1])])))
        primitives.append(len(drive.scene(int(k), "train", grid)))
    return float(np.mean(primitives)), float(np.mean(slabs))


def cast_rays(drive: Drive, index: int, grid: Grid) -> np.ndarray:
    """Return heights (G, H, W) from one vertical ray per pixel centre (trimesh with embree); -inf means no ground."""
    pose, ground = drive.pose(index), drive.ground
    local = pose.to_ego(ground.vertices_m)
    inside = np.zeros(len(ground.slab_class), bool)
    inside[ground.vertex_slab[grid.contains(local[:, 0], local[:, 1])]] = True
    x, y = np.meshgrid(grid.x_m(), grid.y_m(), indexing="ij")
    origins = np.stack([x, y, np.full_like(x, 100.0)], -1).reshape(-1, 3)
    down = np.tile([0.0, 0.0, -1.0], (len(origins), 1))
    height = np.full((len(drive.ground_classes), len(origins)), -np.inf)
    owner = ground.vertex_slab[ground.triangles[:, 0]]
    for k in range(len(height)):
        faces = ground.triangles[inside[owner] & (ground.slab_class[owner] == k)]
        if len(faces):
            mesh = trimesh.Trimesh(local, faces, process=False)
            hits, ray, _ = mesh.ray.intersects_location(origins, down)
            np.maximum.at(height[k], ray, hits[:, 2])
    return height.reshape(-1, grid.rows, grid.cols)


def measure_speed(drive: Drive, poses: np.ndarray, grid: Grid, out: str) -> dict[str, float]:
    """Measure the CPU time per scene in milliseconds for each stage, for shards of 256 scenes (as in pass 1)."""
    spent = dict.fromkeys(("cut and rasterise", "to tables", "write Parquet"), 0.0)
    for number, start in enumerate(range(0, len(poses), 256)):
        clock = time.process_time()
        near = drive.at(poses[start : start + 256], grid)
        tables = []
        for first in range(0, len(near), shard_writer.BATCH_SCENES):
            batch = [
                near.scene(k, "train", grid) for k in range(first, min(first + shard_writer.BATCH_SCENES, len(near)))
            ]
            now = time.process_time()
            spent["cut and rasterise"] += now - clock
            tables.append(make_scene_tables(batch))
            shard_writer.compute_extremes(batch)
            clock = time.process_time()
            spent["to tables"] += clock - now
        shard = Shard(out, "kitti360", "train", number)
        for name, table in shard_writer.join_tables(tables).items():
            storage.write_parquet(table, shard.path(name))
        spent["write Parquet"] += time.process_time() - clock
    return {name: 1e3 * seconds / len(poses) for name, seconds in spent.items()}


def measure_agreement(drive: Drive, indices: np.ndarray, grid: Grid) -> tuple[float, float, float]:
    """Compare occupied pixels and heights of rasters with ray casting.

    Returns:
        Three values. The first value is the share of pixels, over all ground classes, for which both methods agree on
        the occupancy. The other two values use only pixels that are occupied in both methods. They are the share of
        pixels with a height error below 1 cm and the largest height error in metres.
    """
    same, within, worst = [], [], 0.0
    for index in indices:
        scene = drive.scene(int(index), "train", grid)
        rays = cast_rays(drive, int(index), grid)
        hit = np.isfinite(rays)
        both = hit & scene.occupied
        error = np.abs(scene.height_m[both] - rays[both])
        same.append((hit == scene.occupied).mean())
        within.append((error < 0.01).mean())
        worst = max(worst, float(error.max()))
    return float(np.mean(same)), float(np.mean(within)), worst


def measure_storage_error(drive: Drive, poses: np.ndarray, grid: Grid, out: str) -> tuple[bool, float]:
    """Return True if the tables contain all masks exactly, and return the largest height error in metres."""
    stored = Shard(out, "kitti360", "train", 0).scenes()[: len(poses)]
    masks, worst = True, 0.0
    for scene, index in zip(stored, poses, strict=False):
        fresh = drive.scene(int(index), "train", grid)
        masks &= bool(np.array_equal(scene.occupied, fresh.occupied))
        worst = max(worst, float(np.abs(scene.height_m - fresh.height_m).max()))
    return masks, worst


def measure_peak_memory(spacing_m: float, results: multiprocessing.Queue) -> None:
    """Return the number of poses of a sequence, and the peak resident memory in megabytes.

    A separate process reads the sequence and writes one shard.
    """
    with tempfile.TemporaryDirectory() as folder:
        write_kitti360(with_dense_poses(generate_town(4), spacing_m), folder + "/raw")
        child = multiprocessing.get_context("spawn").Process(target=_write_one_shard, args=(folder, results))
        child.start()
        child.join()


def _write_one_shard(folder: str, results: multiprocessing.Queue) -> None:
    tasks = plan_kitti360(folder + "/raw", split=False)
    shard_writer.write_shard(tasks[0], folder + "/out", folder + "/out", Grid())
    poses = sum(len(task.parts[0].poses) for task in tasks)
    peak = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    results.put((poses, int(peak.split()[1]) / 1024))


def main(config: Config) -> None:
    grid = Grid()
    raw = Path(config.raw or Path(tempfile.gettempdir()) / "pritti-benchmark-raw")
    if not config.raw:
        write_raw(raw)
    sequence = kitti360.list_sequences(raw)[-1]
    print(describe_machine())
    xml = raw / f"data_3d_bboxes/train_full/2013_05_28_drive_{sequence}_sync.xml"
    clock = time.process_time()
    drive, report = kitti360.read_drive(raw, sequence)
    parse = time.process_time() - clock
    megabytes = xml.stat().st_size / 1e6
    print(
        f"read      sequence {sequence}: {megabytes:.0f} MB of XML, {report.objects} objects in {parse:.1f} s, "
        f"{megabytes / parse:.1f} MB/s"
    )
    poses = np.linspace(0, len(drive) - 1, min(config.scenes, len(drive))).astype(int)
    primitives, slabs = measure_density(drive, poses[:: max(1, len(poses) // 50)], grid)
    print(
        f"density   {primitives:.0f} primitives and {slabs:.0f} slabs "
        f"in a crop of {grid.rows} x {grid.cols} x {len(drive.ground_classes)}"
    )
    with tempfile.TemporaryDirectory() as out:
        rounds = [measure_speed(drive, poses, grid, f"{out}/{k}") for k in range(3)]
        for stage in rounds[0]:
            print(f"speed     {stage}: {spread([r[stage] for r in rounds])} ms per scene")
        reading = 1e3 * parse / len(drive)
        total = [sum(r.values()) + reading for r in rounds]
        print(f"speed     reading the XML, shared by {len(drive)} poses: {reading:.2f} ms per scene")
        print(
            f"speed     all stages: {spread(total)} ms per scene, "
            f"{spread([1e3 / t for t in total], digits=0)} scenes/s per core"
        )

        some = poses[:: max(1, len(poses) // config.rays)][: config.rays]
        near, shard = drive.at(poses[:256], grid), np.arange(min(256, len(poses)))
        order = np.random.default_rng(0).permutation(shard)
        seconds = time_interleaved(
            {
                "rays": lambda k: cast_rays(near, int(order[k]), grid),
                "ours": lambda k: [
                    near.ground.rasterise(near.pose(int(i)), grid, len(near.ground_classes)) for i in shard[:BATCH]
                ],
            },
            config.rays,
        )
        seconds["ours"] = [value / BATCH for value in seconds["ours"]]
        print(
            f"rays      trimesh with embree {spread(seconds['rays'], 1e3, 0)} ms, "
            f"ours {spread(seconds['ours'], 1e3, 1)} ms: {format_ratios(seconds['rays'], seconds['ours'])}"
        )
        same, within, worst = measure_agreement(drive, some, grid)
        print(
            f"rays      occupied or not: equal for {100 * same:.4f} % of pixels and classes; heights:  "
            f"{100 * within:.4f} % of the pixels filled by both "
            f"differ by less than 1 cm (largest difference {1000 * worst:.2f} mm)"
        )

        masks, worst = measure_storage_error(drive, poses[:64], grid, f"{out}/0")
        sizes = {
            name: sum(p.stat().st_size for p in Path(out, "0", name).rglob("*.parquet")) / len(poses) / 1e3
            for name in ("scenes", "primitives", "rasters")
        }
        print(
            f"size      {sum(sizes.values()):.1f} kB per scene "
            f"({', '.join(f'{k} {v:.1f}' for k, v in sizes.items())}); "
            f"masks exact: {masks}, heights within {1000 * worst:.1f} mm"
        )

        shards = [Shard(f"{out}/0", "kitti360", "train", k) for k in range(-(-len(poses) // 256))]
        manifest = {
            "source": "kitti360",
            "split": "train",
            "number": 0,
            "scenes": 1,
            "ground_classes": list(drive.ground_classes),
        }
        manifest["extremes"] = shard_writer.compute_extremes([drive.scene(int(k), "train", grid) for k in poses[:50]])
        spec = compute_training_statistics([manifest], f"{out}/0", grid, 95.0).spec
        for pixels in (256, 128):
            reader, rates = LayoutReader(spec.with_resolution(pixels)), []
            for _ in range(3):
                clock = time.process_time()
                for shard in shards:
                    reader(shard, np.arange(min(256, len(poses) - 256 * shard.number)))
                rates.append(len(poses) / (time.process_time() - clock))
            print(f"read back training layouts of {pixels} x {pixels}: {spread(rates, digits=0)} scenes/s per core")

    results = multiprocessing.get_context("spawn").Queue()
    for spacing_m in (10.0, 0.5):
        measure_peak_memory(spacing_m, results)
        count, peak = results.get()
        print(
            f"memory    sequence of {count} poses: peak {peak:.0f} MB in the process that reads it and writes a shard"
        )


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
