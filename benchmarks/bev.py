"""Compare two renderers of 256 x 256 pictures from above.

The renderer of this project draws all primitives together. The plain renderer draws one primitive after the other.

    python benchmarks/bev.py                      # dense towns
    python benchmarks/bev.py --dataset DIRECTORY  # scenes selected evenly from a dataset

The plain renderer is vectorised over the pixels inside the bounds of one primitive. It has no tolerance at edges. Times
are CPU seconds of one thread, without the time to read scenes. Before you run the benchmark, set the environment
variables MALLOC_MMAP_MAX_=0 and MALLOC_TRIM_THRESHOLD_=-1. jobs/support/cli.py sets the same variables for the workers
of jobs. With these values, a process keeps freed memory.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import tyro
from common import DENSE_SEEDS, describe_machine, format_ratios, spread, time_interleaved

from models.scene import ELLIPSOID, Grid, Scene
from pipelines.preprocess.sources.town.generator import generate_town
from pipelines.rendering.render import render_bev
from pipelines.schema.palette import CATEGORY_IDS, CLASS_COLORS, EMPTY, GROUND_CLASS_ID
from pipelines.schema.scene_subset import SceneSubset

ROUNDS = 7
SCENES = 32
PICTURES, CORES = 50_000, 2  # size of an evaluation whose time is estimated


def render_plainly(scene: Scene, supersample: int) -> np.ndarray:
    """Draw a scene like `render_bev` at one pixel per raster pixel, one primitive at a time."""
    grid = scene.grid
    fine = Grid(
        grid.front_m, grid.left_m, grid.resolution_m / supersample, grid.rows * supersample, grid.cols * supersample
    )
    x, y = fine.x_m(), fine.y_m()
    height, class_id = np.full((grid.rows, grid.cols), -np.inf), np.full((grid.rows, grid.cols), EMPTY)
    for k, name in enumerate(scene.ground_classes):
        higher = scene.occupied[k] & (scene.height_m[k] >= height)
        height[higher], class_id[higher] = scene.height_m[k][higher], GROUND_CLASS_ID[name]
    height, class_id = (
        np.kron(raster, np.ones((supersample, supersample), raster.dtype)) for raster in (height, class_id)
    )
    # Draw boxes from last to first, then ellipsoids from last to first. A primitive replaces only lower content.
    for i in sorted(range(len(scene)), key=lambda i: (scene.category[i] == ELLIPSOID, -i)):
        center, rotation, half = (part[i].astype(float) for part in (scene.center_m, scene.rotation, scene.size_m / 2))
        reach = np.abs(rotation) @ half
        rows, cols = (
            np.flatnonzero(np.abs(x - center[0]) <= reach[0]),
            np.flatnonzero(np.abs(y - center[1]) <= reach[1]),
        )
        if len(rows) == 0 or len(cols) == 0:
            continue
        part = slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1)
        dx, dy = (x[part[0]] - center[0])[:, None, None], (y[part[1]] - center[1])[:, None]
        # In units of the primitive's half axes, the vertical line through a pixel has the points foot + z * along.
        foot, along = (dx * rotation[0] + dy * rotation[1]) / half, rotation[2] / half
        with np.errstate(divide="ignore", invalid="ignore"):
            if scene.category[i] == ELLIPSOID:
                a, b, c = (along**2).sum(), (foot * along).sum(-1), (foot**2).sum(-1) - 1
                top = center[2] + (np.sqrt(b**2 - a * c) - b) / a
                hit = b**2 >= a * c
            else:
                ends = np.stack([(-1 - foot) / along, (1 - foot) / along])
                top = center[2] + ends.max(0).min(-1)
                hit = ends.max(0).min(-1) >= ends.min(0).max(-1)
        hit &= top > height[part]
        height[part] = np.where(hit, top, height[part])
        class_id[part] = np.where(hit, CATEGORY_IDS[scene.category[i]], class_id[part])
    blocks = CLASS_COLORS[class_id].reshape(grid.rows, supersample, grid.cols, supersample, 3)
    return np.round(blocks.mean(axis=(1, 3))).astype(np.uint8)


def main(dataset: str = "") -> None:
    print(describe_machine())
    if dataset:
        chosen = SceneSubset(dataset, limit=SCENES).shards()
        scenes = [scene for shard, rows in chosen for scene in shard.scenes(rows)]
    else:
        scenes = [
            drive.scene(k)
            for drive in map(generate_town, DENSE_SEEDS)
            for k in np.linspace(0, len(drive) - 1, SCENES // len(DENSE_SEEDS)).astype(int)
        ]
    print(
        f"{len(scenes)} scenes with {np.mean([len(s) for s in scenes]):.0f} primitives and "
        f"{np.mean([s.occupied.any(axis=(1, 2)).sum() for s in scenes]):.1f} ground classes each"
    )
    for supersample in (1, 2):
        differ = [
            (render_plainly(s, supersample) != render_bev(s, supersample=supersample)).any(axis=-1) for s in scenes
        ]
        seconds = time_interleaved(
            {
                "plain": lambda _, k=supersample: [render_plainly(s, k) for s in scenes],
                "ours": lambda _, k=supersample: [render_bev(s, supersample=k) for s in scenes],
            },
            ROUNDS,
        )
        per_scene = {way: [1e3 * s / len(scenes) for s in values] for way, values in seconds.items()}
        minutes = [ms / 1e3 * PICTURES / CORES / 60 for ms in per_scene["ours"]]
        print(
            f"supersampling {supersample}: plain {spread(per_scene['plain'], 1, 1)} ms, "
            f"ours {spread(per_scene['ours'])} ms a scene and core: "
            f"{format_ratios(seconds['plain'], seconds['ours'])}; "
            f"{PICTURES:,} pictures on {CORES} cores {spread(minutes, 1, 1)} minutes; "
            f"{np.sum(differ)} of {np.size(differ)} pixels differ"
        )


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
