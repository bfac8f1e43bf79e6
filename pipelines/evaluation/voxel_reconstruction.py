"""Score reconstructed voxels of any method against true voxels on the full grid (paper, Sec. 4.1, Tab. 1) with Ray.

True voxels are read from voxel files or computed from the scenes of a dataset. Scores are computed from one confusion
matrix, which is summed over all voxels of all scenes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from itertools import chain

import numpy as np
import pyarrow as pa

from pipelines.geometry.voxels import VoxelGrid, voxelize
from pipelines.io.voxel_import import read_voxels
from pipelines.metrics.reconstruction import compute_voxel_confusion, compute_voxel_scores
from pipelines.preprocess.import_external import find_files, make_scene_id
from pipelines.runtime import storage
from pipelines.runtime.ray_tasks import map_tasks
from pipelines.schema.axis_convention import Axes
from pipelines.schema.palette import EMPTY
from pipelines.schema.tables import Shard, find_shards

CHUNK_SCENES = 16
SHOWN = 5  # Maximum number of names in an error message.
SCENE_SCORES = pa.schema(
    [
        ("scene_id", pa.string()),
        ("voxel_iou", pa.float64()),  # Null if both sides are empty.
        ("voxel_miou", pa.float64()),
        ("rebuilt_bytes", pa.int64()),  # Size of the reconstruction file.
        ("stored_bytes", pa.int64()),  # Size of the file that the method stores; null if no such file is given.
    ]
)


@dataclass(frozen=True)
class GroundTruthVoxels:
    """Location of the true voxels of a scene: a file, or a row of a shard."""

    uri: str = ""
    shard: Shard | None = None
    row: int = 0


@dataclass(frozen=True)
class VoxelPair:
    """True voxels and reconstruction of one scene.

    Attributes:
        name: Scene id.
        truth: Location of the true voxels.
        rebuilt: URI of the reconstruction.
        stored: URI of the representation that the method stores. If no such file is given, "".
    """

    name: str
    truth: GroundTruthVoxels
    rebuilt: str
    stored: str = ""


def list_true_scenes(root: str, split: str = "") -> dict[str, GroundTruthVoxels]:
    """Map scene ids to locations in a dataset (one split or all splits) or in a directory of .npz files."""
    if storage.list_files(storage.join_uri(root, "scenes"), ".parquet"):
        shards = find_shards(root, split=split or None)
        ids = [shard.read("scenes", ["scene_id"])["scene_id"].to_pylist() for shard in shards]
        return {
            name: GroundTruthVoxels("", shard, k)
            for shard, names in zip(shards, ids, strict=True)
            for k, name in enumerate(names)
        }
    if split:
        raise ValueError(
            f"{root}: a split ({split!r}) needs a dataset, but the directory holds none; omit the split to"
            " score .npz files"
        )
    return {name: GroundTruthVoxels(uri) for name, uri in group_files_by_scene(root, ".npz").items()}


def group_files_by_scene(pattern: str, suffix: str = "") -> dict[str, str]:
    """Map scene ids to the URIs of the files in a directory, or of the files that match a pattern."""
    base, files = find_files(pattern, suffix)
    return {make_scene_id(file): storage.join_uri(base, file) for file in files}


def pair_files(
    truth: dict[str, GroundTruthVoxels], rebuilt: dict[str, str], stored: dict[str, str] | None, partial: bool
) -> list[VoxelPair]:
    """Pair the scenes that all sides contain, by scene id.

    Args:
        truth: True voxels by scene id.
        rebuilt: Files of the reconstructions by scene id.
        stored: For each scene id, the file of the representation that the method stores. None: there are no such files.
        partial: Whether scenes may be missing from some sides.

    Returns:
        Pairs in the order of the scene ids.

    Raises:
        ValueError: The sides have no common scene, or scenes are missing and `partial` is false. The message lists the
            missing scenes.
    """
    sides = {"truth": truth, "reconstructions": rebuilt} | ({} if stored is None else {"stored files": stored})
    every, common = set().union(*sides.values()), set(truth).intersection(*sides.values())
    missing = {side: sorted(every - set(names)) for side, names in sides.items() if every - set(names)}
    if missing and not (partial and common):
        lacking = "; ".join(
            f"{side} lack {len(names)} of {len(every)} names: {', '.join(names[:SHOWN])}{' ...' * (len(names) > SHOWN)}"
            for side, names in missing.items()
        )
        raise ValueError(f"{lacking}; name files by scene id, or score the common scenes with --allow-missing")
    return [VoxelPair(name, truth[name], rebuilt[name], stored[name] if stored else "") for name in sorted(common)]


def split_chunks(pairs: list[VoxelPair]) -> list[list[VoxelPair]]:
    """Split pairs into chunks of at most CHUNK_SCENES; the true scenes of a chunk are in the same shard."""
    by_shard: dict[Shard | None, list[VoxelPair]] = {}
    for pair in pairs:
        by_shard.setdefault(pair.truth.shard, []).append(pair)
    return [group[k : k + CHUNK_SCENES] for group in by_shard.values() for k in range(0, len(group), CHUNK_SCENES)]


def load_true_voxels(chunk: list[VoxelPair], grid: VoxelGrid, axes: Axes) -> list[np.ndarray]:
    """Return the class ids (256, 256, 32) of each true scene of a chunk."""
    shard = chunk[0].truth.shard
    if shard is None:
        return [read_voxels(pair.truth.uri, axes) for pair in chunk]
    return [voxelize(scene, grid) for scene in shard.scenes([pair.truth.row for pair in chunk])]


def score_chunk(chunk: list[VoxelPair], grid: VoxelGrid, axes: Axes, truth_axes: Axes) -> list[dict]:
    """Compute the confusion matrix and the bytes on disk of each scene of a chunk."""
    return [
        {
            "scene_id": pair.name,
            "confusion": compute_voxel_confusion(truth, read_voxels(pair.rebuilt, axes)),
            "rebuilt_bytes": storage.measure_file_bytes(pair.rebuilt),
            "stored_bytes": storage.measure_file_bytes(pair.stored) if pair.stored else -1,
        }
        for pair, truth in zip(chunk, load_true_voxels(chunk, grid, truth_axes), strict=True)
    ]


def score_voxels(
    pairs: list[VoxelPair],
    grid: VoxelGrid,
    axes: Axes,
    truth_axes: Axes,
    on_scene: Callable[[], None] | None = None,
) -> tuple[dict, pa.Table]:
    """Return the scores over all scenes as a nested dictionary of numbers, and a table with one row per scene."""

    def score(chunk: list[VoxelPair]) -> list[dict]:
        return score_chunk(chunk, grid, axes, truth_axes)

    rows = []
    for row in chain.from_iterable(map_tasks(score, split_chunks(pairs))):
        rows.append(row)
        if on_scene:
            on_scene()
    rows.sort(key=lambda row: row["scene_id"])
    confusions = [row["confusion"] for row in rows]
    scores = {
        "scenes": len(rows),
        "grid": {"rows": grid.shape[0], "cols": grid.shape[1], "levels": grid.shape[2]},
        "voxels": asdict(compute_voxel_scores(np.sum(confusions, axis=0))),
        "rebuilt_bytes": spread_evenly([row["rebuilt_bytes"] for row in rows]),
    }
    if pairs[0].stored:
        scores["stored_bytes"] = spread_evenly([row["stored_bytes"] for row in rows])
    table = [
        {name: row[name] for name in ("scene_id", "rebuilt_bytes")}
        | {"stored_bytes": row["stored_bytes"] if pairs[0].stored else None}
        | compute_scene_scores(confusion)
        for row, confusion in zip(rows, confusions, strict=True)
    ]
    return scores, pa.Table.from_pylist(table, schema=SCENE_SCORES)


def compute_scene_scores(confusion: np.ndarray) -> dict[str, float | None]:
    """Return the voxel scores of one scene, or None if both sides are empty."""
    if confusion.sum() == confusion[EMPTY, EMPTY]:
        return {"voxel_iou": None, "voxel_miou": None}
    scores = compute_voxel_scores(confusion)
    return {"voxel_iou": scores.iou, "voxel_miou": scores.miou}


def spread_evenly(sizes: list[int]) -> dict[str, float]:
    """Return the mean, standard deviation, minimum and maximum of sizes (bytes)."""
    return {name: float(getattr(np, name)(sizes)) for name in ("mean", "std", "min", "max")}
