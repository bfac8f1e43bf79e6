"""Regenerate scenes inside a region: one Ray Data graph, a pipeline per actor, all variants of a scene per task."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from models.composition.extend import inpaint_blocks, split_region
from models.composition.inpaint import Contents, select_around_objects, select_half_plane, select_polygon
from models.labels import require_labels
from models.pipeline import PrITTIPipeline
from models.sampling.repaint import RePaintConfig
from models.scene import Scene, merge_scenes
from pipelines.generation.sample import (
    Request,
    find_scene_label,
    guard_generation_run,
    load_pipeline,
    resample_to_model_resolution,
)
from pipelines.io.mesh_export import export_glb
from pipelines.metrics.reconstruction import sum_pairs
from pipelines.reporting.inpaint_report import InpaintExample, render_inpaint_html
from pipelines.runtime import storage
from pipelines.runtime.ray_tasks import map_actors
from pipelines.schema.scene_subset import SceneSubset
from pipelines.schema.tables import Shard


@dataclass(frozen=True)
class RegionConfig:
    """The region: the union of the given parts, or with `outside` its complement."""

    polygon_m: tuple[float, ...] = ()  # x, y, x, y, ...
    half_plane: tuple[float, ...] = ()  # direction x, y, and the metres along it where it begins
    objects: tuple[int, ...] = ()  # primitives of a scene by number
    margin_m: float = 1.0  # around objects
    outside: bool = False

    def region(self, scene: Scene) -> np.ndarray:
        """(rows, cols) bool pixels of a scene, True: regenerate. Raises ValueError for an invalid region."""
        found = np.zeros((scene.grid.rows, scene.grid.cols), bool)
        if self.polygon_m:
            if len(self.polygon_m) % 2:
                raise ValueError(f"a polygon of {len(self.polygon_m)} numbers: expected x y x y ... in metres")
            found |= select_polygon(scene.grid, np.reshape(self.polygon_m, (-1, 2)))
        if self.half_plane:
            if len(self.half_plane) != 3:
                raise ValueError(f"a half plane of {len(self.half_plane)} numbers: expected direction x y, and metres")
            found |= select_half_plane(scene.grid, self.half_plane[:2], self.half_plane[2])
        if self.objects:
            if not -1 < min(self.objects) <= max(self.objects) < len(scene):
                raise ValueError(f"scene {scene.scene_id} has primitives 0 to {len(scene) - 1}, not {self.objects}")
            found |= select_around_objects(scene, self.objects, self.margin_m)
        found = found != self.outside
        if not found.any():
            raise ValueError(f"scene {scene.scene_id}: the region holds no pixel of its {scene.grid}")
        return found


@dataclass(frozen=True)
class InpaintRequest(Request):
    """Options of inpainting: region and contents, `variants` per scene; `label` None keeps each scene's label."""

    where: RegionConfig
    contents: Contents
    variants: int
    label: str | None
    seed: int
    repaint: RePaintConfig
    guidance_scale: float


def compute_drift(scene: Scene, raw: Scene, region: np.ndarray) -> dict[str, float]:
    """Sum the errors of a raw decode outside the region: pixels, squared metres, primitives and their IoU3D."""
    given, made = (merge_scenes([s], [~region], s) for s in (scene, raw))
    both = given.occupied & made.occupied
    sums = sum_pairs(given, made)
    return {
        "pixels_both": float(both.sum()),
        "pixels_either": float((given.occupied | made.occupied).sum()),
        "squared_m2": float(np.square((given.height_m - made.height_m)[both], dtype=np.float64).sum()),
        "objects": float(sums.truths.sum()),
        "found": float(sums.pairs.sum()),
        "iou3d": float(sums.iou.sum()),
    }


def compute_drift_scores(sums: Sequence[Mapping[str, float]]) -> dict[str, float | None]:
    """Compute ground IoU, height RMSE, share of objects found and their mean IoU3D from all sums; None for 0 / 0."""
    total = {name: sum(row[name] for row in sums) for name in sums[0]}

    def share(above: str, below: str) -> float | None:
        return total[above] / total[below] if total[below] else None

    squared_m2 = share("squared_m2", "pixels_both")
    return {
        "ground_iou": share("pixels_both", "pixels_either"),
        "height_rmse_m": None if squared_m2 is None else squared_m2**0.5,
        "objects_found": share("found", "objects"),
        "mean_iou3d": share("iou3d", "found"),
    }


def inpaint_one(
    pipeline: PrITTIPipeline, request: InpaintRequest, scene: Scene, number: int
) -> tuple[list[Scene], list[dict[str, float]]]:
    """Generate all variants of scene `number` of a run, and the drift of each raw decode of a block."""
    scene, count = resample_to_model_resolution(scene, pipeline.spec), request.variants
    drifts: list[dict[str, float]] = []
    for step in inpaint_blocks(
        pipeline,
        scene,
        request.where.region(scene),
        request.label or find_scene_label(scene, pipeline.dit.config.label),
        request.contents,
        request.seed,
        range(number * count, (number + 1) * count),
        request.repaint,
        request.guidance_scale,
    ):
        drifts += [
            compute_drift(known, raw, step.region) for known, raw in zip(step.known, step.generated, strict=True)
        ]
    made = [
        replace(
            canvas,
            scene_id=f"{request.source}-{request.seed}-{number:07d}-{k}",
            source=request.source,
            split="generated",
            frame=number,
        )
        for k, canvas in enumerate(step.canvases)
    ]
    return made, drifts


def find_regenerated_pixels(pipeline: PrITTIPipeline, scene: Scene, where: RegionConfig) -> np.ndarray:
    """(rows, cols) pixels of a scene's region, extended to whole latent cells."""
    region = where.region(scene)
    for window, part in split_region(pipeline, scene, region):
        region[scene.grid.intersect(window)[0]] |= part
    return region


class Inpainter:
    """Actor. Row in: number of a scene. Row out: its drift. Generates its variants; writes shard and GLB files."""

    def __init__(self, request: InpaintRequest, chosen: list[tuple[Shard, int]]) -> None:
        self.request, self.chosen = request, chosen
        self.pipeline = load_pipeline(request.model)

    def __call__(self, row: dict) -> dict:
        request, shard = self.request, self.request.shard(row["id"])
        record = storage.join_uri(request.output, "drift", request.run, f"{row['id']:07d}.json")
        if not (shard.is_written() and storage.exists(record)):
            source, position = self.chosen[row["id"]]
            made, drifts = inpaint_one(self.pipeline, request, source.scenes([position])[0], row["id"])
            for scene in made:
                path = storage.join_uri(request.output, "glb", request.run, f"{scene.scene_id}.glb")
                storage.write_whole(path, lambda stream, scene=scene: stream.write(export_glb(scene)))
            storage.write_json(drifts, record)
            shard.write(made)
        return {"id": row["id"], "drift": storage.read_json(record)}


def inpaint_scenes(
    request: InpaintRequest,
    selection: SceneSubset,
    num_actors: int = 1,
    pictures: int = 8,
    on_scene: Callable[[], None] | None = None,
) -> dict[str, float | None]:
    """Regenerate a region of the selected scenes; write tables, GLB files and a page. An interrupted run resumes.

    Args:
        request: The region, what to regenerate in it, and how.
        selection: The scenes.
        num_actors: Number of pipelines that work concurrently.
        pictures: Maximum number of scenes on the page.
        on_scene: Called after each scene.

    Returns:
        How far the decoders' output is off outside the region (`compute_drift_scores`).

    Raises:
        ValueError: The output holds a run made with other options, or a scene has no pixel in the region.
    """
    chosen = [(shard, row) for shard, rows in selection.shards() for row in rows]
    pipeline = load_pipeline(request.model)
    first, row = chosen[0]
    request.where.region(resample_to_model_resolution(first.scenes([row])[0], pipeline.spec))  # fails early
    if request.label:
        require_labels(pipeline.dit.config.label, [request.label])
    guard_generation_run(
        request,
        pipeline,
        [storage.join_uri(request.output, "drift", request.run)],
        input=asdict(selection),
        scenes=selection.files(),
    )

    def list_examples() -> Iterator[InpaintExample]:
        for number, (source, position) in enumerate(chosen[:pictures]):
            given = resample_to_model_resolution(source.scenes([position])[0], pipeline.spec)
            region = find_regenerated_pixels(pipeline, given, request.where)
            yield InpaintExample(given, region, request.shard(number).scenes())

    drifts = []
    for row in map_actors(range(len(chosen)), Inpainter, (request, chosen), num_actors):
        drifts += row["drift"]
        if on_scene:
            on_scene()
    scores = compute_drift_scores(drifts)
    storage.write_text(
        render_inpaint_html(request.run, request.contents, request.variants, list_examples(), scores),
        storage.join_uri(request.output, f"{request.run}.html"),
    )
    return scores
