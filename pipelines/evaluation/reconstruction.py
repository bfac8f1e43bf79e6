"""Evaluate layout-VAE reconstruction with Ray: actors encode and decode scenes, and tasks score them.

The graph writes one record per scene. Records can be added, and one task computes the scores from the sum.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import reduce

import numpy as np
import pyarrow as pa
import ray
import ray.data
import torch

from models.composition.deduplicate import find_lower_confidence_duplicates
from models.layout import LayoutSpec
from models.scene import CATEGORIES, Scene
from models.tensors import EXISTENCE_THRESHOLD, DecodedLayout, decode_layout, make_layout_batch, resample_scene_ground
from pipelines.evaluation.features import READER_CPUS, judge_labels
from pipelines.geometry.voxels import NUM_CLASSES, OutsideCounts, VoxelGrid, count_outside, voxelize
from pipelines.metrics.controls import RECONSTRUCTION_CONTROL, damage_scene
from pipelines.metrics.reconstruction import (
    CEILING_AND_CONTROL,
    MAX_DETECTIONS,
    MEMORY,
    SCORED,
    THRESHOLDS,
    BoundsCounts,
    GroundSums,
    Matches,
    PairSums,
    compute_detection_scores,
    compute_ground_scores,
    compute_pair_scores,
    compute_voxel_confusion,
    compute_voxel_scores,
    count_outside_bounds,
    join_matches,
    match_scene,
    measure_memory_bytes,
    sum_ground,
    sum_pairs,
)
from pipelines.metrics.validity import LABEL_MEASURES, compute_validity_rates
from pipelines.rendering.render import render_3d, render_bev
from pipelines.runtime import storage
from pipelines.runtime.ray_tasks import MAX_RETRIES, flat_map_dataset, make_actor_graph, map_dataset, map_tasks
from pipelines.runtime.resources import find_device
from pipelines.schema.dataset import Dataset
from pipelines.schema.ground_surface import to_model_surface
from pipelines.schema.run_guard import guard_options
from pipelines.schema.scene_subset import SceneSubset
from pipelines.schema.tables import Shard
from pipelines.training.latents import digest_weights, load_lvae

Chunk = tuple[Shard, list[int]]  # A shard and some of its rows.
SCENES_PER_TASK = 32
AP_VARIANTS = {
    "ranked": {},  # AP3D ranks all proposals, without a minimum existence probability.
    "ranked_100": {"max_detections": MAX_DETECTIONS},
    "threshold": {"min_score": EXISTENCE_THRESHOLD},
    "threshold_100": {"min_score": EXISTENCE_THRESHOLD, "max_detections": MAX_DETECTIONS},
}
VOXEL_PX = 256  # Paper, Tab. 1.
VOXEL_RANGE_M = (VoxelGrid.bottom_m, VoxelGrid.top_m)
PICTURE_PX = 480
RECORDS_VERSION = 2  # Version of the records; files with another version are computed again.
SCENE_SCORES = pa.schema(
    [("scene_id", pa.string()), ("primitives", pa.int64()), ("rebuilt_primitives", pa.int64())]
    + [
        (name, pa.float64())
        for name in (
            "ground_iou",
            "height_mae_m",
            "height_rmse_m",
            "mean_iou3d",
            "matched_recall",
            "matched_precision",
            "voxel_iou",
            "voxel_miou",
        )
    ]
)


def make_voxel_grid(spec: LayoutSpec, range_m: tuple[float, float] = VOXEL_RANGE_M) -> VoxelGrid:
    """Make the paper's grid of 256 x 256 x 32 voxels, which covers the scene at any raster resolution."""
    return VoxelGrid(spec.with_resolution(VOXEL_PX).grid, *range_m)


def split_chunks(selection: SceneSubset, size: int) -> list[Chunk]:
    """Split a selection into chunks of at most `size` scenes."""
    return [(shard, rows[k : k + size]) for shard, rows in selection.shards() for k in range(0, len(rows), size)]


class Reconstructor:
    """Actor that encodes and decodes scenes, one chunk per row.

    The input row holds the number of a chunk. The output row holds the stacked latent means and the stacked decoded
    layouts of the scenes in the chunk.
    """

    def __init__(self, chunks: list[Chunk], lvae: str) -> None:
        self.chunks, self.model = chunks, load_lvae(lvae)
        self.device = find_device()
        self.model.to(self.device)

    @torch.no_grad()
    def __call__(self, row: dict) -> dict:
        shard, rows = self.chunks[row["id"]]
        scenes = read_model_scenes(shard, rows, self.model.spec)
        latent = self.model.encode(make_layout_batch(scenes, self.model.spec).to(self.device)).mean
        layouts = self.model.decode(latent).layouts()
        fields = DecodedLayout.__dataclass_fields__
        stacked = {name: np.stack([getattr(layout, name) for layout in layouts]) for name in fields}
        return {"id": row["id"], "latent": latent.float().cpu().numpy()} | stacked


def read_model_scenes(shard: Shard, rows: list[int], spec: LayoutSpec) -> list[Scene]:
    """Read scenes, with ground heights on the reference surface of a model."""
    return [to_model_surface(scene, spec) for scene in shard.scenes(rows)]


def unstack_layouts(
    row: dict, chunks: list[Chunk], spec: LayoutSpec
) -> Iterator[tuple[int, Scene, DecodedLayout, np.ndarray]]:
    """Yield (row of the shard, true scene, decoded layout, latent) per scene in an output row of a Reconstructor."""
    shard, rows = chunks[row["id"]]
    for k, (number, scene) in enumerate(zip(rows, read_model_scenes(shard, rows, spec), strict=True)):
        layout = DecodedLayout(**{name: row[name][k] for name in DecodedLayout.__dataclass_fields__})
        yield number, scene, layout, row["latent"][k]


@dataclass(frozen=True)
class SceneRecord:
    """Sums over one scene, from which reconstruction scores are computed.

    Attributes:
        ground: Per-class sums of ground errors, at the resolution of the true scene.
        raster: Per-class sums of ground errors at the resolution of the model, to which the true scene is resampled.
        matches: Matched detections.
        pairs: Per-category sums over pairs of matched primitives.
        confusion: (classes, classes) number of voxels; rows are true classes, and columns are predicted classes.
        outside: Numbers of ground pixels and of objects outside the voxel grid.
        bounds: Numbers of ground pixels and of objects outside the bounds of the model.
        memory: Size of the scene in each representation of MEMORY (bytes).
        labels: (measures, 2) label fidelity: whether the reconstruction and the true scene have the same label. If this
            is unknown, the values are 0.
    """

    ground: GroundSums
    raster: GroundSums
    matches: Matches
    pairs: PairSums
    confusion: np.ndarray
    outside: OutsideCounts
    bounds: BoundsCounts
    memory: np.ndarray
    labels: np.ndarray

    def to_row(self) -> dict:
        """Return the sums as flat arrays for Arrow."""
        out = {"confusion": self.confusion.ravel(), "memory": self.memory, "labels": self.labels.ravel()}
        for part in ("ground", "raster", "matches", "pairs", "outside", "bounds"):
            value = getattr(self, part)
            out |= {f"{part}_{name}": np.ravel(getattr(value, name)) for name in value.__dataclass_fields__}
        return out

    @classmethod
    def from_row(cls, row: dict) -> SceneRecord:
        """Make the record from a row of flat arrays."""

        def part(name: str, kind: type, **shapes: tuple[int, ...]):
            values = {field: np.asarray(row[f"{name}_{field}"]) for field in kind.__dataclass_fields__}
            return kind(**{field: value.reshape(shapes.get(field, -1)) for field, value in values.items()})

        return cls(
            ground=part("ground", GroundSums),
            raster=part("raster", GroundSums),
            matches=part("matches", Matches, hit=(-1, len(THRESHOLDS))),
            pairs=part("pairs", PairSums),
            confusion=np.asarray(row["confusion"]).reshape(NUM_CLASSES, NUM_CLASSES),
            outside=part("outside", OutsideCounts, objects=(-1, 3)),
            bounds=part("bounds", BoundsCounts),
            memory=np.asarray(row["memory"]),
            labels=np.asarray(row["labels"]).reshape(-1, 2),
        )


def make_scene_record(
    truth: Scene,
    layout: DecodedLayout,
    latent: np.ndarray,
    spec: LayoutSpec,
    voxels: VoxelGrid,
    dataset: Dataset | None = None,
    deduplicate: bool = False,
    label_threshold: float = EXISTENCE_THRESHOLD,
) -> SceneRecord:
    """Compare a scene with its reconstruction. The ground is compared at the resolutions of the scene and of the model.

    The scores cover all true primitives, including primitives without a slot. AP3D ranks all proposals. Pairs and
    voxels are computed from the decoded scene, which contains only proposals above the existence threshold. If
    `deduplicate` is True, duplicates among these are removed for all scores, as in generation. Labels are judged from
    the proposals above `label_threshold`.
    """
    decoded_m = spec.height_bounds_m.restore(layout.height[..., None])[..., 0].astype(np.float32)
    proposals = decode_layout(layout, spec, truth, threshold=-1.0)
    if deduplicate:
        likely = np.flatnonzero(proposals.existence > EXISTENCE_THRESHOLD)
        kept = np.ones(len(proposals), bool)
        kept[likely[find_lower_confidence_duplicates(proposals.select(likely))]] = False
        proposals = proposals.select(kept)
    rebuilt = proposals.select(proposals.existence > EXISTENCE_THRESHOLD)
    everywhere = replace(rebuilt, height_m=decoded_m, occupied=np.ones_like(rebuilt.occupied))
    true_height_m, true_occupied = resample_scene_ground(truth, spec.ground_classes, truth.grid)
    _, occupied = resample_scene_ground(rebuilt, spec.ground_classes, truth.grid)
    height_m, _ = resample_scene_ground(everywhere, spec.ground_classes, truth.grid)
    coarse_height_m, coarse_occupied = resample_scene_ground(truth, spec.ground_classes, spec.grid)
    true_voxels = voxelize(truth, voxels)
    return SceneRecord(
        ground=sum_ground(true_occupied, true_height_m, occupied, height_m),
        raster=sum_ground(coarse_occupied, coarse_height_m, rebuilt.occupied, decoded_m),
        matches=match_scene(truth, proposals),
        pairs=sum_pairs(truth, rebuilt),
        confusion=compute_voxel_confusion(true_voxels, voxelize(rebuilt, voxels)),
        outside=count_outside(truth, voxels),
        bounds=count_outside_bounds(truth, spec),
        memory=measure_memory_bytes(make_layout_batch([truth], spec), latent, true_voxels),
        labels=judge_labels(proposals.select(proposals.existence > label_threshold), dataset),
    )


def score_chunk(
    row: dict,
    chunks: list[Chunk],
    directory: str,
    spec: LayoutSpec,
    voxels: VoxelGrid,
    dataset: Dataset | None,
    deduplicate: bool,
    label_threshold: float,
) -> dict:
    """Write one record per scene of an output row of a Reconstructor; return the number of scenes."""
    rows = [
        {"row": number, "scene_id": scene.scene_id}
        | make_scene_record(scene, layout, latent, spec, voxels, dataset, deduplicate, label_threshold).to_row()
        for number, scene, layout, latent in unstack_layouts(row, chunks, spec)
    ]
    storage.write_parquet(pa.Table.from_pylist(rows), make_records_path(directory, row["id"]))
    return {"id": row["id"], "scenes": len(rows)}


def guard_records(directory: str, selection: SceneSubset, options: dict) -> None:
    """Delete the records in a directory if they belong to other scenes or options."""
    guard_options(
        storage.join_uri(directory, "records.json"),
        options | {"version": RECORDS_VERSION, "selection": asdict(selection), "files": selection.files()},
        is_in_use=lambda: False,
        discard=lambda: storage.delete_directory(directory),
        describe=str,
    )


def make_records_path(directory: str, number: int) -> str:
    """Return the path of the file with the records of a chunk."""
    return storage.join_uri(directory, f"chunk-{number:05d}.parquet")


def draw_chunk(row: dict, chunks: list[Chunk], spec: LayoutSpec) -> list[dict]:
    """Render each scene in an output row of a Reconstructor as pictures (H, W, 3) uint8 of equal size."""
    out = []
    for _, scene, layout, _ in unstack_layouts(row, chunks, spec):
        sides = {"truth": scene, "rebuilt": decode_layout(layout, spec, scene)}
        above = {f"{name}_above": render_bev(side, PICTURE_PX, supersample=2) for name, side in sides.items()}
        oblique = {f"{name}_oblique": render_3d(side, PICTURE_PX, PICTURE_PX) for name, side in sides.items()}
        out.append({"scene_id": scene.scene_id} | above | oblique)
    return out


def reconstruct_chunks(
    chunks: list[Chunk], lvae: str, num_actors: int, numbers: Sequence[int] | None = None
) -> ray.data.Dataset:
    """Build the graph that reconstructs chunks; tasks with READER_CPUS process its rows."""
    spare = {"CPU": READER_CPUS}
    numbers = range(len(chunks)) if numbers is None else numbers
    return make_actor_graph(numbers, Reconstructor, (chunks, lvae), num_actors, READER_CPUS, spare=spare)


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Reconstruction scores of a dataset and of each scene.

    Attributes:
        scores: Nested dictionary of the scores of the dataset.
        scenes: One row of scores per scene, in order of decreasing voxel mIoU.
        places: Location of each scene, as a chunk with one row. The order is the same as in `scenes`.
    """

    scores: dict
    scenes: pa.Table
    places: list[Chunk]


def evaluate_reconstruction(
    selection: SceneSubset,
    lvae: str,
    directory: str,
    num_actors: int = 1,
    batch_size: int = 8,
    voxel_range_m: tuple[float, float] = VOXEL_RANGE_M,
    dataset: Dataset | None = None,
    on_scenes: Callable[[int], None] | None = None,
    label_threshold: float = EXISTENCE_THRESHOLD,
) -> Reconstruction:
    """Compute the reconstruction scores of an LVAE from the latent means of selected scenes (paper, Sec. 4.1).

    Tasks write the records of the scenes to files. To resume an interrupted evaluation, call this function again.

    Args:
        selection: Scenes.
        lvae: Directory of the layout VAE.
        directory: Directory for the records. Files that belong to other scenes, weights or options are deleted.
        num_actors: Maximum number of actors; each actor holds a model.
        batch_size: Maximum number of scenes per forward pass.
        voxel_range_m: Bottom and top of the voxel grid (m, scene frame).
        dataset: Dataset with the thresholds of density labels. None: label fidelity is not scored.
        on_scenes: Called with the number of scenes of each finished chunk.
        label_threshold: Minimum existence probability of the primitives that determine density labels. Generated
            scenes are compared with these labels, so it should be the threshold of generation. All other scores use
            the paper's threshold.

    Returns:
        Scores of the dataset and of each scene.
    """
    model, chunks = load_lvae(lvae), split_chunks(selection, batch_size)
    spec, deduplicate = model.spec, model.proposes_duplicates
    voxels = make_voxel_grid(spec, voxel_range_m)
    options = {"deduplicate": deduplicate, "label_threshold": label_threshold}
    labels = dataset and [asdict(dataset.vegetation), asdict(dataset.vehicle)]
    inputs = {"weights": digest_weights(model), "batch_size": batch_size, "voxel_range_m": list(voxel_range_m)}
    guard_records(directory, selection, options | inputs | {"labels": labels})
    promised = {make_records_path(directory, number): len(rows) for number, (_, rows) in enumerate(chunks)}
    faulty = storage.find_faulty_files(promised)
    missing = [number for number, path in enumerate(promised) if path in faulty]
    if on_scenes:
        on_scenes(sum(promised.values()) - sum(promised[path] for path in faulty))
    if missing:
        arguments = {"chunks": chunks, "directory": directory, "spec": spec, "voxels": voxels, "dataset": dataset}
        graph = map_dataset(
            reconstruct_chunks(chunks, lvae, num_actors, missing),
            score_chunk,
            fn_kwargs=arguments | options,
            num_cpus=READER_CPUS,
        )
        for row in graph.iter_rows():
            if on_scenes:
                on_scenes(row["scenes"])
    storage.require_rows(promised)
    scores, table, places = ray.get(merge_records.remote(list(promised), spec, voxels))
    scores["memory_bytes"]["tables"] = measure_table_bytes(chunks)
    scores["label_existence_threshold"] = label_threshold
    return Reconstruction(scores, table, [(chunks[number][0], [row]) for number, row in places])


@ray.remote(num_cpus=1, max_retries=MAX_RETRIES)
def merge_records(
    paths: list[str], spec: LayoutSpec, voxels: VoxelGrid
) -> tuple[dict, pa.Table, list[tuple[int, int]]]:
    """Compute the scores from all records. The records of many scenes are too large for the driver.

    Returns:
        Scores, one row of scores per scene, and the chunk and row of each scene. The scenes are in order of decreasing
        voxel mIoU.
    """
    rows = [row | {"id": number} for number, path in enumerate(paths) for row in storage.read_parquet(path).to_pylist()]
    records = [SceneRecord.from_row(row) for row in rows]
    table = compute_scene_scores([row["scene_id"] for row in rows], records)
    # Empty scenes have NaN and are sorted to the end.
    order = np.argsort(-table["voxel_miou"].to_numpy(), kind="stable")
    places = [(rows[k]["id"], int(rows[k]["row"])) for k in order]
    return compute_reconstruction_scores(records, spec, voxels), table.take(order), places


def draw_scenes(
    places: list[Chunk], lvae: str, num_actors: int = 1, on_scene: Callable[[], None] | None = None
) -> list[dict]:
    """Draw each scene of `places` and its reconstruction, from above and in an oblique view."""
    graph = flat_map_dataset(
        reconstruct_chunks(places, lvae, num_actors),
        draw_chunk,
        fn_kwargs={"chunks": places, "spec": load_lvae(lvae).spec},
        num_cpus=READER_CPUS,
    )
    drawn = {}
    for row in graph.iter_rows():
        drawn[row["scene_id"]] = row
        if on_scene:
            on_scene()
    return [drawn[shard.scenes(rows)[0].scene_id] for shard, rows in places]


def compute_reconstruction_scores(records: list[SceneRecord], spec: LayoutSpec, voxels: VoxelGrid) -> dict:
    """Return the scores over all scenes as a nested dictionary of numbers, including scores per class."""
    low, high = (list(getattr(spec.height_bounds_m, side)) for side in ("low", "high"))
    ground, raster = (
        compute_ground_scores(_sum(parts), spec.ground_classes, np.array([*low, *high]))
        for parts in ((r.ground for r in records), (r.raster for r in records))
    )
    matches = join_matches([r.matches for r in records])
    detection = {name: compute_detection_scores(matches, **options) for name, options in AP_VARIANTS.items()}
    left_out, bounds = _sum(r.outside for r in records), _sum(r.bounds for r in records)
    num_objects, num_partly, num_wholly = left_out.objects.T
    present = np.flatnonzero(num_objects)
    return {
        "scenes": len(records),
        "raster_px": spec.grid.rows,
        "raster_ground_iou": raster.iou,
        "raster_height_rmse_m": raster.height_rmse_m,
        "ground_iou": ground.iou,
        "ground_mean_iou": ground.mean_iou,
        "height_mae_m": ground.height_mae_m,
        "height_rmse_m": ground.height_rmse_m,
        "height_mse_normalised": ground.height_mse,
        "height_bounds_m": {"low": low[0], "high": high[0]},
        "ground_outside_bounds": float(bounds.ground[1] / max(bounds.ground[0], 1)),
        "objects_outside_bounds": float(bounds.objects[1] / max(bounds.objects[0], 1)),
        "ground_class_iou": ground.class_iou,
        "class_height_mae_m": ground.class_height_mae_m,
        "class_height_rmse_m": ground.class_height_rmse_m,
        "class_height_mse_normalised": ground.class_height_mse,
        "ap3d": detection["threshold"].ap3d,
        "ap3d_50": detection["threshold"].ap3d_50,
        "ap3d_ranked": detection["ranked"].ap3d,
        "ap3d_50_ranked": detection["ranked"].ap3d_50,
        "detection": {
            name: {
                "ap3d": found.ap3d,
                "ap3d_50": found.ap3d_50,
                "ap3d_at": found.at_threshold,
                "category_ap3d": found.category_ap3d,
                "category_ap3d_50": found.category_ap3d_50,
            }
            for name, found in detection.items()
        },
        "matched": asdict(compute_pair_scores(_sum(r.pairs for r in records))),
        "voxels": asdict(compute_voxel_scores(np.sum([r.confusion for r in records], axis=0)))
        | {
            "bottom_m": voxels.bottom_m,
            "top_m": voxels.top_m,
            "ground_outside": float(left_out.ground[1] / max(left_out.ground[0], 1)),
            "objects_partly_outside": float(num_partly.sum() / max(num_objects.sum(), 1)),
            "objects_outside": float(num_wholly.sum() / max(num_objects.sum(), 1)),
            "category_partly_outside": {CATEGORIES[c]: float(num_partly[c] / num_objects[c]) for c in present},
            "category_outside": {CATEGORIES[c]: float(num_wholly[c] / num_objects[c]) for c in present},
        },
        "memory_bytes": dict(zip(MEMORY, np.mean([r.memory for r in records], axis=0).tolist(), strict=True)),
        "label_fidelity": compute_validity_rates(np.stack([r.labels for r in records]), LABEL_MEASURES),
        "truths": {CATEGORIES[c]: int(num_objects[c]) for c in present},
    }


def score_ceiling_and_control(
    selection: SceneSubset,
    spec: LayoutSpec,
    directory: str,
    voxel_range_m: tuple[float, float] = VOXEL_RANGE_M,
    on_scenes: Callable[[int], None] | None = None,
) -> dict[str, dict]:
    """Score the ceiling and the control of the reconstruction, without a network.

    The ceiling converts each scene to layout tensors and back. It loses objects without a slot, the part of centres and
    Cholesky parameters outside the bounds, and detail below the resolution. Heights are not clipped. The control does
    the same with a damaged copy of the scene (RECONSTRUCTION_CONTROL). Tasks write records to files. To resume, call
    this function again.

    Args:
        selection: Scenes to score.
        spec: Layout of the model.
        directory: Directory for the records. Files that belong to other scenes or options are deleted.
        voxel_range_m: Lowest and highest z of the voxels (m).
        on_scenes: Called with the number of scenes of each finished chunk.

    Returns:
        Scores as those of `evaluate_reconstruction`, by the names "ceiling" and "control".
    """
    voxels, chunks = make_voxel_grid(spec, voxel_range_m), split_chunks(selection, SCENES_PER_TASK)
    inputs = {"layout": spec.fingerprint(), "voxel_range_m": list(voxel_range_m), "control": RECONSTRUCTION_CONTROL}
    guard_records(directory, selection, inputs)
    paths = {
        name: [make_records_path(storage.join_uri(directory, name), number) for number in range(len(chunks))]
        for name in CEILING_AND_CONTROL
    }
    promised = {of[number]: len(rows) for of in paths.values() for number, (_, rows) in enumerate(chunks)}
    faulty = storage.find_faulty_files(promised)
    missing = [number for number in range(len(chunks)) if any(of[number] in faulty for of in paths.values())]
    if on_scenes:
        on_scenes(sum(len(rows) for number, (_, rows) in enumerate(chunks) if number not in missing))

    def score_scenes(number: int) -> int:
        shard, rows = chunks[number]
        found: dict[str, list[dict]] = {name: [] for name in CEILING_AND_CONTROL}
        for row, scene in zip(rows, read_model_scenes(shard, rows, spec), strict=True):
            moved = damage_scene("moved", scene, scene, (shard.number, row))
            damaged = damage_scene("ground_shifted", moved, moved, (shard.number, row))
            for name, source in zip(CEILING_AND_CONTROL, (scene, damaged), strict=True):
                record = make_scene_record(scene, represent_scene(source, spec), np.zeros((1, 1, 1)), spec, voxels)
                found[name].append({"row": row, "scene_id": scene.scene_id} | record.to_row())
        for name, records in found.items():
            storage.write_parquet(pa.Table.from_pylist(records), paths[name][number])
        return len(rows)

    for count in map_tasks(score_scenes, missing):
        if on_scenes:
            on_scenes(count)
    storage.require_rows(promised)
    merged = ray.get([merge_records.remote(paths[name], spec, voxels) for name in CEILING_AND_CONTROL])
    return {name: scores for name, (scores, _, _) in zip(CEILING_AND_CONTROL, merged, strict=True)}


def represent_scene(scene: Scene, spec: LayoutSpec) -> DecodedLayout:
    """Return a scene as the output of a perfect decoder: each slot with a primitive exists with probability 1."""
    batch = make_layout_batch([scene], spec)
    height, occupied, features, real = (
        getattr(batch, name)[0].numpy() for name in ("height", "occupied", "features", "real")
    )
    return DecodedLayout(occupied, height, features, real.astype(np.float32), spec.slot_category)


def _sum(parts: Iterable):
    return reduce(operator.add, parts)


def compute_scene_scores(scene_ids: list[str], records: list[SceneRecord]) -> pa.Table:
    """Return one row of scores per scene; undefined scores are null (e.g. height errors if there is no ground)."""

    def share(part: float, whole: float) -> float | None:
        return float(part / whole) if whole else None

    rows = []
    for scene_id, r in zip(scene_ids, records, strict=True):
        ground, boxes = r.ground, list(SCORED)
        pairs, iou = r.pairs.pairs[boxes].sum(), r.pairs.iou[boxes].sum()
        filled = r.confusion.sum() > r.confusion[0, 0]
        voxel = compute_voxel_scores(r.confusion) if filled else None
        mean_square_m2 = share(ground.squared_m2.sum(), ground.pixels.sum())
        rows.append(
            {
                "scene_id": scene_id,
                "primitives": int(r.pairs.truths.sum()),
                "rebuilt_primitives": int(r.pairs.predictions.sum()),
                "ground_iou": share(ground.intersection.sum(), ground.union.sum()),
                "height_mae_m": share(ground.absolute_m.sum(), ground.pixels.sum()),
                "height_rmse_m": mean_square_m2 and mean_square_m2**0.5,
                "mean_iou3d": share(iou, pairs),
                "matched_recall": share(pairs, r.pairs.truths[boxes].sum()),
                "matched_precision": share(pairs, r.pairs.predictions[boxes].sum()),
                "voxel_iou": voxel and voxel.iou,
                "voxel_miou": voxel and voxel.miou,
            }
        )
    return pa.Table.from_pylist(rows, schema=SCENE_SCORES)


def measure_table_bytes(chunks: list[Chunk]) -> float:
    """Return the mean number of bytes per scene in the Parquet files of scenes, primitives and rasters."""
    total, scenes = 0.0, 0
    for shard, rows in chunks:
        written = sum(storage.measure_file_bytes(shard.path(table)) for table in ("scenes", "primitives", "rasters"))
        total += written / shard.read("scenes", ["scene_id"]).num_rows * len(rows)
        scenes += len(rows)
    return total / scenes
