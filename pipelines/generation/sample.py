"""Generate scenes from labels and seeds with a Ray Data graph; each task writes one output shard."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import chain
from typing import Any

import numpy as np
import torch

from models.execution import SamplingExecution
from models.labels import LABELS, compose_label, require_labels
from models.layout import LayoutSpec
from models.pipeline import PrITTIPipeline
from models.sampling.constraints import GuidanceReport
from models.scene import Grid, Scene
from models.tensors import resample_scene_ground
from pipelines.editing.edit import Repair
from pipelines.runtime import storage
from pipelines.runtime.ray_tasks import map_actors
from pipelines.runtime.resources import find_device
from pipelines.schema.columns import SCENE_TABLES
from pipelines.schema.run_guard import guard_run
from pipelines.schema.tables import Shard, find_unwritten, require_written
from pipelines.training.latents import digest_weights


@dataclass(frozen=True)
class Request:
    """Run of a pipeline; its scenes are written as source generated-<run> of a dataset directory.

    Attributes:
        model: Directory of a PrITTIPipeline.
        output: Dataset directory.
        run: Run name.
    """

    model: str
    output: str
    run: str

    @property
    def source(self) -> str:
        """Return the source of the generated scenes."""
        return f"generated-{self.run}"

    def shard(self, number: int) -> Shard:
        """Return a shard of the run.

        Args:
            number: Number of the shard.

        Returns:
            Shard of split "generated".
        """
        return Shard(self.output, self.source, "generated", number)


@dataclass(frozen=True)
class SampleRequest(Request):
    """Scenes to generate. Scene i depends only on the seed, i and the options.

    Attributes:
        num_scenes: Number of scenes.
        labels: Labels; scene i gets label labels[i mod len(labels)].
        seed: Seed of the noise.
        num_inference_steps: Number of steps of the sampler. None: the default of the sampler or of the model.
        guidance_scale: Scale of classifier-free guidance.
        sampler: Name of the sampler. None: the sampler that the model stores.
        noise_scaling: Noise scaling. None: the value that the model stores.
        existence_threshold: Minimum existence probability. None: the value that the model stores.
        constraints: Whether constraints guide sampling. None: the value that the model stores.
        pag_scale: Scale of perturbed-attention guidance. None: the value that the model stores.
        repair: Whether floating, sunken and overlapping primitives are moved; none are removed
            (pipelines/editing/edit.py).
        shard_scenes: Number of scenes per shard.
        execution: How the model runs: precision, CUDA graphs, compilation and decoding.
    """

    num_scenes: int
    labels: tuple[str, ...]
    seed: int
    num_inference_steps: int | None
    guidance_scale: float
    sampler: str | None = None
    noise_scaling: float | None = None
    existence_threshold: float | None = None
    constraints: bool | None = None
    pag_scale: float | None = None
    repair: bool = False
    shard_scenes: int = 64
    execution: SamplingExecution = field(default_factory=SamplingExecution)

    def shards(self) -> list[Shard]:
        """Return all shards of the run."""
        return [self.shard(k) for k in range(-(-self.num_scenes // self.shard_scenes))]

    def indices(self, shard: Shard) -> range:
        """Return the scene numbers of a shard.

        Args:
            shard: Shard of the run.

        Returns:
            Range of scene numbers.
        """
        start = shard.number * self.shard_scenes
        return range(start, min(start + self.shard_scenes, self.num_scenes))


def load_pipeline(directory: str) -> PrITTIPipeline:
    """Load a pipeline onto the GPU, or onto the CPU if there is no GPU.

    Args:
        directory: Directory of a PrITTIPipeline.

    Returns:
        Pipeline without progress bar.

    Raises:
        ValueError: The directory does not contain a complete pipeline.
    """
    try:
        pipeline = PrITTIPipeline.from_pretrained(directory)
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{directory}: no PrITTI pipeline here ({error}); run jobs/train_dit.py first") from error
    pipeline.set_progress_bar_config(disable=True)
    return pipeline.to(find_device())


def guard_generation_run(request: Request, pipeline: PrITTIPipeline, parts: Sequence[str] = (), **also: object) -> None:
    """Ensure that the source generated-<run> of a dataset directory has one request and one model (run_guard.py).

    Args:
        request: Request of the run.
        pipeline: Loaded model.
        parts: Further directories of the run.
        **also: Further options of the run.

    Raises:
        ValueError: The directory contains a run of the same name with other options or other weights.
    """
    options: dict[str, Any] = asdict(request) | also
    options["weights"] = f"{digest_weights(pipeline.lvae)}-{digest_weights(pipeline.dit)}"
    del options["model"]  # The model is identified by digests, because its directory may change.
    options.setdefault("existence_threshold", pipeline.config.existence_threshold)
    if "execution" in options:
        del options["execution"]["cuda_graphs"]  # CUDA graphs run the same kernels.
    # Records written by earlier versions lack these options.
    execution = {"precision": "fp32", "compile": False, "decode_batch_size": 1}
    defaults = {"constraints": False, "pag_scale": 0.0, "repair": False, "execution": execution}
    defaults |= {"labels_map": None, "free_blocks": "none", "tile_m": None, "roads": (), "margin": 0.0}
    defaults |= {"plan_streets": False, "keep": ()}
    if options.get("plan_streets") and pipeline.street_planner is not None:
        options["street_planner"] = digest_weights(pipeline.street_planner)
    options = {name: value for name, value in options.items() if name not in defaults or value != defaults[name]}
    # RePaint uses the noise scaling only if eta is not 1.
    if options.get("repaint", {}).get("known_guidance_scale") == 1:
        del options["repaint"]["known_guidance_scale"]
    if "repaint" in options and options["repaint"].get("eta") != 1:
        options["noise_scaling"] = pipeline.config.noise_scaling
    if "repaint" in options and "eta" not in options["repaint"]:
        options["sampler"] = pipeline.scheduler_config.class_name
        options["pag_scale"] = pipeline.pag_scale * options["repaint"].pop("pag_factor")
    if options.get("pag_scale") and pipeline.config.pag_drops_label:
        options["pag_drops_label"] = True
    guard_run(options.pop("output"), request.source, request.run, options, parts)


def resample_to_model_grid(scene: Scene, spec: LayoutSpec, grid: Grid | None = None) -> Scene:
    """Convert the ground of a scene to the ground classes and the grid of the model.

    Args:
        scene: Scene.
        spec: Layout of the model.
        grid: Another grid with the same area. None: the grid of the model is used.

    Returns:
        Scene with resampled rasters; primitives are unchanged.
    """
    grid = grid or spec.grid
    height, occupied = resample_scene_ground(scene, spec.ground_classes, grid)
    return replace(scene, ground_classes=spec.ground_classes, grid=grid, height_m=height, occupied=occupied)


def resample_to_model_resolution(scene: Scene, spec: LayoutSpec) -> Scene:
    """Convert the ground of a scene to the ground classes and the resolution of the model; keep its area.

    Args:
        scene: Scene.
        spec: Layout of the model.

    Returns:
        Scene with resampled rasters; primitives are unchanged.

    Raises:
        ValueError: The resolution of the scene is not a multiple or a divisor of the resolution of the model.
    """
    own, wanted_m = scene.grid, spec.grid.resolution_m
    sides = {name: round(getattr(own, name) * own.resolution_m / wanted_m) for name in ("rows", "cols")}
    return resample_to_model_grid(scene, spec, replace(own, resolution_m=wanted_m, **sides))


def find_scene_label(scene: Scene, kind: str) -> str:
    """Return the label of a scene for a model that is conditioned on a kind of label.

    Args:
        scene: Scene.
        kind: Kind of label, a key of LABELS.

    Returns:
        Label.

    Raises:
        ValueError: The scene has no such label.
    """
    label = compose_label(kind, scene.vegetation_density, scene.vehicle_density, scene.free_pose)
    if label is None or label not in LABELS[kind]:
        raise ValueError(
            f"scene {scene.scene_id} has no {kind} label; give one with --label ({', '.join(LABELS[kind])})"
        )
    return label


class Sampler:
    """Actor that generates and writes scenes, one shard per row.

    The input row holds a shard number. The output row holds the shard number, the count of scenes and the duration (s).
    It also holds the numbers of guided steps and of fallbacks (`GuidanceReport`).
    """

    def __init__(self, request: SampleRequest, batch_size: int) -> None:
        self.request, self.batch_size = request, batch_size
        self.pipeline = load_pipeline(request.model)
        if request.sampler is not None:
            self.pipeline.use_sampler(request.sampler)
        self.pipeline.use_pag(request.pag_scale)
        self.pipeline.set_execution(request.execution)
        self.repair = Repair(slab_offset_m=self.pipeline.spec.slab_offset_m, drop=False)

    def __call__(self, row: dict) -> dict:
        request, started = self.request, time.perf_counter()
        self.pipeline.use_constraints(request.constraints)  # Start new counts.
        shard = request.shards()[row["id"]]
        indices = request.indices(shard)
        scenes = []
        for start in range(0, len(indices), self.batch_size):
            scenes += self.generate(indices[start : start + self.batch_size])
        if request.repair:
            scenes = [self.repair.apply_to(scene, np.ones(len(scene), bool))[0] for scene in scenes]
        shard.write(scenes)
        report = self.pipeline.guidance.report if self.pipeline.guidance else GuidanceReport()
        row = {"id": shard.number, "scenes": len(indices), "seconds": time.perf_counter() - started}
        return row | {"guided": report.guided, "fallbacks": report.fallbacks}

    def generate(self, indices: Sequence[int]) -> list[Scene]:
        """Generate the scenes of a batch.

        Args:
            indices: Numbers of the scenes.

        Returns:
            Scenes in the order of the numbers.

        Raises:
            ValueError: The batch does not fit into the memory of the GPU. The message names the remedy.
        """
        request = self.request
        try:
            return self.pipeline.generate(
                labels=[request.labels[i % len(request.labels)] for i in indices],
                seed=request.seed,
                indices=indices,
                num_inference_steps=request.num_inference_steps,
                guidance_scale=request.guidance_scale,
                noise_scaling=request.noise_scaling,
                existence_threshold=request.existence_threshold,
                run=request.run,
            )
        except torch.OutOfMemoryError as error:
            raise ValueError(
                f"{len(indices)} scenes do not fit into the memory of {self.pipeline.device}; use a --batch-size below"
                f" {len(indices)}, or --precision bf16"
            ) from error


def sample_scenes(
    request: SampleRequest, num_actors: int = 1, batch_size: int = 8, on_shard: Callable[[dict], None] | None = None
) -> int:
    """Generate the requested scenes and write them as tables. To resume an interrupted run, call this function again.

    Args:
        request: Options of the scenes, and the dataset directory.
        num_actors: Maximum number of actors; each actor holds a pipeline.
        batch_size: Number of scenes per batch.
        on_shard: Called with the row of each finished shard.

    Returns:
        Number of scenes.

    Raises:
        ValueError: A label is unknown to the model, the output contains a run of the same name with other options, or
            a shard is not in the output.
    """
    pipeline = load_pipeline(request.model)
    require_labels(pipeline.dit.config.label, request.labels)
    if request.sampler is not None:
        pipeline.use_sampler(request.sampler)
    steps = pipeline.config.num_inference_steps if request.num_inference_steps is None else request.num_inference_steps
    request = replace(
        request,
        sampler=pipeline.scheduler_config.sampler,
        num_inference_steps=steps,
        noise_scaling=pipeline.resolve_noise_scaling(request.noise_scaling),
        existence_threshold=pipeline.resolve_existence_threshold(request.existence_threshold),
        constraints=pipeline.resolve_constraints(request.constraints),
        pag_scale=pipeline.resolve_pag_scale(request.pag_scale),
    )
    guard_generation_run(request, pipeline)
    for shard in request.shards()[:1]:
        for table in SCENE_TABLES:
            storage.clean_temporaries(shard.place(table))
    promised = {shard: len(request.indices(shard)) for shard in request.shards()}
    missing = [shard.number for shard in find_unwritten(promised)]
    written = [shard for shard in promised if shard.number not in missing]
    nothing = {"seconds": 0.0, "guided": 0, "fallbacks": 0}
    rows = ({"id": shard.number, "scenes": promised[shard]} | nothing for shard in written)
    total = 0
    for row in chain(rows, map_actors(missing, Sampler, (request, batch_size), num_actors)):
        total += row["scenes"]
        if on_shard:
            on_shard(row)
    require_written(promised)
    return total
