"""Regenerate a region of scenes with a Ray Data graph; each task makes all variants of one scene."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np

from models.composition.extend import inpaint_blocks, split_region
from models.composition.inpaint import Contents, select_around_objects, select_half_plane, select_polygon
from models.execution import SamplingExecution
from models.labels import require_labels
from models.pipeline import PrITTIPipeline
from models.sampling.repaint import InpaintingConfig
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
from pipelines.schema.file_names import make_file_name
from pipelines.schema.ground_surface import from_model_surface, to_model_surface
from pipelines.schema.scene_subset import SceneSubset
from pipelines.schema.tables import Shard, find_unwritten, require_written


@dataclass(frozen=True)
class RegionConfig:
    """Region that is regenerated: the union of polygon, half plane and objects, or the complement of this union.

    Attributes:
        polygon_m: Corners of a polygon as x, y, x, y, ... (m, scene frame).
        half_plane: Direction (x, y) and distance d (m). The half plane begins at distance d from the origin and extends
            in direction (x, y).
        objects: Indices of the primitives that belong to the union.
        margin_m: Margin around the objects (m).
        outside: Whether the complement of the union is regenerated.
    """

    polygon_m: tuple[float, ...] = ()
    half_plane: tuple[float, ...] = ()
    objects: tuple[int, ...] = ()
    margin_m: float = 1.0
    outside: bool = False

    def region(self, scene: Scene) -> np.ndarray:
        """Return the pixels of a scene that are regenerated.

        Args:
            scene: Scene.

        Returns:
            (rows, cols) bool; True means that the pixel is regenerated.

        Raises:
            ValueError: A part of the region is invalid, or no pixel of the scene lies in the region.
        """
        found = np.zeros((scene.grid.rows, scene.grid.cols), bool)
        if self.polygon_m:
            if len(self.polygon_m) % 2:
                raise ValueError(f"a polygon needs pairs x y x y ... in metres, got {len(self.polygon_m)} numbers")
            found |= select_polygon(scene.grid, np.reshape(self.polygon_m, (-1, 2)))
        if self.half_plane:
            if len(self.half_plane) != 3:
                raise ValueError(
                    f"a half plane needs direction x y and distance in metres, got {len(self.half_plane)} numbers"
                )
            found |= select_half_plane(scene.grid, self.half_plane[:2], self.half_plane[2])
        if self.objects:
            if not -1 < min(self.objects) <= max(self.objects) < len(scene):
                raise ValueError(f"scene {scene.scene_id} has primitives 0 to {len(scene) - 1}, not {self.objects}")
            found |= select_around_objects(scene, self.objects, self.margin_m)
        found = found != self.outside
        if not found.any():
            raise ValueError(f"scene {scene.scene_id}: the region contains no pixel of the scene's {scene.grid}")
        return found


@dataclass(frozen=True)
class InpaintRequest(Request):
    """Options of inpainting.

    Attributes:
        where: Region to regenerate.
        contents: Contents that are regenerated: ground, objects or both.
        variants: Number of variants per scene.
        label: Label of the generated region. None: the label of each scene is used.
        seed: Seed of the noise.
        repaint: How known parts are continued.
        guidance_scale: Scale of classifier-free guidance.
        execution: How the model runs.
        constraints: Whether constraints guide sampling. None: the value that the model stores.
        keep: Names of the categories whose objects are kept inside of the region.
    """

    where: RegionConfig
    contents: Contents
    variants: int
    label: str | None
    seed: int
    repaint: InpaintingConfig
    guidance_scale: float
    execution: SamplingExecution = field(default_factory=SamplingExecution)
    constraints: bool | None = None
    keep: tuple[str, ...] = ()


def compute_drift(scene: Scene, raw: Scene, region: np.ndarray) -> dict[str, float]:
    """Sum the errors of the decoder output in the known region, which is the part outside the generated region.

    Args:
        scene: Known scene.
        raw: Decoded scene before compositing.
        region: (rows, cols) bool generated region.

    Returns:
        Sums for `compute_drift_scores`: numbers of ground pixels, squared height errors (m^2), numbers of primitives,
        and IoU3D of matched primitives.
    """
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
    """Compute scores of the known region from the sums over all decoder outputs.

    Args:
        sums: Results of `compute_drift`.

    Returns:
        Ground IoU, height RMSE (m), share of known objects that have a match, and mean IoU3D of the matched objects. A
        ratio 0 / 0 is None.
    """
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
    """Generate all variants of one scene.

    Args:
        pipeline: Pipeline.
        request: Options of inpainting.
        scene: Given scene.
        number: Number of the scene in the run.

    Returns:
        Variants, and the results of `compute_drift` for all blocks.

    Raises:
        ValueError: The region contains no pixel of the scene, or the scene has no label and the request has none.
    """
    scene = resample_to_model_resolution(to_model_surface(scene, pipeline.spec), pipeline.spec)
    count = request.variants
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
        keep=request.keep,
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
    """Return the pixels of the region in a scene, extended to whole latent cells.

    Args:
        pipeline: Pipeline that defines the latent grid.
        scene: Scene in the resolution of the model.
        where: Region to regenerate.

    Returns:
        (rows, cols) bool.
    """
    region = where.region(scene)
    for window, part in split_region(pipeline, scene, region):
        region[scene.grid.intersect(window)[0]] |= part
    return region


class Inpainter:
    """Actor that regenerates one scene per row and writes its shard and its GLB files.

    The input row holds the number of a scene. The output row holds the number of the scene and its drift.
    """

    def __init__(self, request: InpaintRequest, chosen: list[tuple[Shard, int]]) -> None:
        self.request, self.chosen = request, chosen
        self.pipeline = load_pipeline(request.model)
        self.pipeline.use_constraints(request.constraints)
        self.pipeline.set_execution(request.execution)

    def __call__(self, row: dict) -> dict:
        request, shard = self.request, self.request.shard(row["id"])
        source, position = self.chosen[row["id"]]
        given = source.scenes([position])[0]
        made, drifts = inpaint_one(self.pipeline, request, given, row["id"])
        for scene in made:
            path = storage.join_uri(request.output, "glb", request.run, f"{make_file_name(scene.scene_id)}.glb")
            shown = from_model_surface(scene, given, self.pipeline.spec)
            storage.write_whole(path, lambda stream, scene=shown: stream.write(export_glb(scene)))
        storage.write_json(drifts, make_drift_path(request, row["id"]))
        shard.write(made)
        return {"id": row["id"]}


def make_drift_path(request: InpaintRequest, number: int) -> str:
    """Return the path of the file with the drift of a scene.

    Args:
        request: Options of inpainting.
        number: Number of the scene in the run.

    Returns:
        Path of a JSON file.
    """
    return storage.join_uri(request.output, "drift", request.run, f"{number:07d}.json")


def inpaint_scenes(
    request: InpaintRequest,
    selection: SceneSubset,
    num_actors: int = 1,
    pictures: int = 8,
    on_scene: Callable[[], None] | None = None,
) -> dict[str, float | None]:
    """Regenerate a region of the selected scenes; write tables, GLB files and a page; resume an interrupted run.

    Args:
        request: Region, contents and options of the sampler.
        selection: Scenes to inpaint.
        num_actors: Number of pipelines that run concurrently.
        pictures: Maximum number of scenes on the page.
        on_scene: Called after each scene.

    Returns:
        Errors of the decoders in the known region, as returned by `compute_drift_scores`.

    Raises:
        ValueError: The output contains a run of the same name with other options, or the region contains no pixel of a
            scene.
    """
    chosen = [(shard, row) for shard, rows in selection.shards() for row in rows]
    pipeline = load_pipeline(request.model)
    first, row = chosen[0]
    request.where.region(
        resample_to_model_resolution(first.scenes([row])[0], pipeline.spec)
    )  # An invalid region raises its error here, before actors start.
    if request.label:
        require_labels(pipeline.dit.config.label, [request.label])
    request = replace(
        request,
        repaint=pipeline.resolve_inpainting(request.repaint),
        constraints=pipeline.resolve_constraints(request.constraints),
    )
    guard_generation_run(
        request,
        pipeline,
        [storage.join_uri(request.output, "drift", request.run)],
        input=selection.to_record(),
        scenes=selection.files(),
    )

    def list_examples() -> Iterator[InpaintExample]:
        for number, (source, position) in enumerate(chosen[:pictures]):
            given = to_model_surface(source.scenes([position])[0], pipeline.spec)
            given = resample_to_model_resolution(given, pipeline.spec)
            region = find_regenerated_pixels(pipeline, given, request.where)
            yield InpaintExample(given, region, request.shard(number).scenes())

    promised = {request.shard(number): request.variants for number in range(len(chosen))}
    measured = set(storage.list_files(storage.join_uri(request.output, "drift", request.run), ".json"))
    unwritten = {shard.number for shard in find_unwritten(promised)}
    missing = [k for k in range(len(chosen)) if k in unwritten or make_drift_path(request, k) not in measured]
    for _ in chain(range(len(chosen) - len(missing)), map_actors(missing, Inpainter, (request, chosen), num_actors)):
        if on_scene:
            on_scene()
    require_written(promised)
    drifts = [drift for k in range(len(chosen)) for drift in storage.read_json(make_drift_path(request, k))]
    scores = compute_drift_scores(drifts)
    storage.write_text(
        render_inpaint_html(request.run, request.contents, request.variants, list_examples(), scores),
        storage.join_uri(request.output, f"{request.run}.html"),
    )
    return scores
