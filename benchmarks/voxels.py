"""Compare two ways to compute 256 x 256 x 32 voxels: vertical runs per column, and tests of the voxel centres.

    python benchmarks/voxels.py

The plain voxelisation is vectorised over the voxels inside the bounds of one primitive. Times are CPU seconds of one
thread.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from dataclasses import replace

import numpy as np
from common import DENSE_SEEDS, describe_machine, format_ratios, spread, time_interleaved
from scipy.spatial.transform import Rotation

from models.scene import CATEGORY_INDEX, ELLIPSOID, Scene
from pipelines.geometry.voxels import PRECEDENCE, VoxelGrid, voxelize
from pipelines.metrics.reconstruction import compute_voxel_confusion
from pipelines.preprocess.sources.town.generator import generate_town
from pipelines.schema.palette import CLASS_ID, EMPTY

ROUNDS = 7
PAPER_OBJECTS = 514


def voxelize_plainly(scene: Scene, voxels: VoxelGrid) -> np.ndarray:
    """Compute the same voxels as `voxelize`, but test the voxel centres for each primitive."""
    out = np.zeros(voxels.shape, np.uint8)
    grid = voxels.columns
    surface, winner = scene.surface()
    for k, name in enumerate(scene.ground_classes):
        row, col = np.nonzero(winner == k)
        level = np.floor((surface[row, col].astype(np.float64) - voxels.bottom_m) / voxels.step_m).astype(int)
        inside = (level >= 0) & (level < voxels.levels)
        out[row[inside], col[inside], level[inside]] = CLASS_ID[name]
    x, y, z = grid.x_m(), grid.y_m(), voxels.z_m()
    for name in reversed(PRECEDENCE):
        for i in np.flatnonzero(scene.category == CATEGORY_INDEX[name]):
            center, rotation = scene.center_m[i].astype(float), scene.rotation[i].astype(float)
            half = scene.size_m[i].astype(float) / 2
            reach = np.abs(rotation) @ half
            at = [np.flatnonzero(np.abs(axis - c) <= r) for axis, c, r in zip((x, y, z), center, reach, strict=True)]
            offset = np.stack(np.meshgrid(x[at[0]], y[at[1]], z[at[2]], indexing="ij"), axis=-1) - center
            local = offset @ rotation / half
            inside = (local**2).sum(-1) <= 1 if scene.category[i] == ELLIPSOID else (np.abs(local) <= 1).all(-1)
            part = out[np.ix_(*at)]
            part[inside] = CLASS_ID[name]
            out[np.ix_(*at)] = part
    return out


def tilt_primitives(scene: Scene, rng: np.random.Generator) -> Scene:
    """Tilt every primitive of a scene by a few degrees, because decoded primitives are also tilted."""
    axis = rng.normal(size=(len(scene), 3))
    return replace(scene, rotation=(Rotation.from_rotvec(0.05 * axis).as_matrix() @ scene.rotation).astype(np.float32))


def merge_scenes(scenes: list[Scene]) -> Scene:
    """Merge the primitives of several scenes into one scene, and keep the first PAPER_OBJECTS primitives."""
    joined = {
        name: np.concatenate([getattr(s, name) for s in scenes])
        for name in ("category", "center_m", "rotation", "size_m", "existence", "heading_rad", "instance_id", "label")
    }
    return replace(scenes[0], **joined).select(np.arange(PAPER_OBJECTS))


def main() -> None:
    print(describe_machine())
    rng, voxels = np.random.default_rng(0), VoxelGrid()
    dense = [drive.scene(len(drive) // 2) for drive in map(generate_town, DENSE_SEEDS)]
    leaning = [tilt_primitives(scene, rng) for scene in dense]
    for name, scenes in (
        ("dense towns", dense),
        ("the same, leaning", leaning),
        (f"{PAPER_OBJECTS} primitives from several towns, moved to the same position", [merge_scenes(leaning)]),
    ):
        differ = sum(int((voxelize(s, voxels) != voxelize_plainly(s, voxels)).sum()) for s in scenes)
        seconds = time_interleaved(
            {
                "plain": lambda _, scenes=scenes: [voxelize_plainly(s, voxels) for s in scenes],
                "ours": lambda _, scenes=scenes: [voxelize(s, voxels) for s in scenes],
            },
            ROUNDS,
        )
        per_scene = {way: [1e3 * s / len(scenes) for s in values] for way, values in seconds.items()}
        filled = np.mean([(voxelize(s, voxels) != EMPTY).mean() for s in scenes])
        print(
            f"{name} ({', '.join(str(len(s)) for s in scenes)} primitives, {100 * filled:.0f} % filled): "
            f"plain {spread(per_scene['plain'], 1, 0)} ms, ours {spread(per_scene['ours'], 1, 1)} ms a scene and core: "
            f"{format_ratios(seconds['plain'], seconds['ours'])}; {differ} voxels differ"
        )
    truth, found = voxelize(dense[0], voxels), voxelize(leaning[0], voxels)
    confusion = time_interleaved({"confusion": lambda _: compute_voxel_confusion(truth, found)}, ROUNDS)["confusion"]
    print(f"confusion matrix of two grids: {spread(confusion, 1e3, 1)} ms")


if __name__ == "__main__":
    main()
