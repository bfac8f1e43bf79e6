"""Scenes -> larger scenes: one Ray Data graph, a pipeline per actor, one extended scene per task and shard."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import ray.data

from models.pipeline import PrITTIPipeline, Resampling
from models.scene import Scene
from pipelines import storage
from pipelines.encode import gpus_per_actor
from pipelines.generate import claim_run, label_of, load_pipeline, on_model_grid, pipeline_digest
from pipelines.scenes.mesh import scene_glb
from pipelines.scenes.tables import Shard
from pipelines.selection import Selection


@dataclass(frozen=True)
class OutpaintRequest:
    """How to extend scenes; `label` None means each scene's own."""

    model: str
    output: str
    run: str
    label: str | None
    seed: int
    overlap: float
    mode: str
    resampling: Resampling
    guidance_scale: float

    @property
    def source(self) -> str:
        return f"generated-{self.run}"


def outpaint_one(pipeline: PrITTIPipeline, request: OutpaintRequest, scene: Scene, index: int) -> Scene:
    """The extended scene number `index` of a run."""
    extended = pipeline.outpaint(
        on_model_grid(scene, pipeline.spec),
        request.label or label_of(scene, pipeline.dit.config.label),
        seed=request.seed,
        index=index,
        overlap=request.overlap,
        mode=request.mode,
        resampling=request.resampling,
        guidance_scale=request.guidance_scale,
    )
    name = f"{request.source}-{request.seed}-{index:07d}"
    return replace(extended, scene_id=name, source=request.source, split="generated", frame=index)


class Outpainter:
    """Actor. Row in: number of a scene. Row out: the same. Extends it, writes its shard and its GLB."""

    def __init__(self, request: OutpaintRequest, chosen: list[tuple[Shard, int]]) -> None:
        self.request, self.chosen = request, chosen
        self.pipeline = load_pipeline(request.model)

    def __call__(self, row: dict) -> dict:
        shard = Shard(self.request.output, self.request.source, "generated", row["id"])
        if not shard.is_written():
            source, position = self.chosen[row["id"]]
            scene = outpaint_one(self.pipeline, self.request, source.scenes([position])[0], row["id"])
            path = storage.join(self.request.output, "glb", self.request.run, f"{scene.scene_id}.glb")
            storage.write_whole(path, lambda stream: stream.write(scene_glb(scene)))
            shard.write([scene])
        return row


def outpaint_scenes(
    request: OutpaintRequest, selection: Selection, num_actors: int = 1, on_scene: Callable[[], None] | None = None
) -> int:
    """Extend the selected scenes; how many there are. Goes on where it stopped.

    Raises ValueError if the output holds a run made with other options.
    """
    chosen = [(shard, row) for shard, rows in selection.shards() for row in rows]
    pipeline = load_pipeline(request.model)
    options = asdict(request) | {"input": asdict(selection), "weights": pipeline_digest(pipeline)}
    claim_run(request.output, request.run, options)
    graph = ray.data.range(len(chosen), override_num_blocks=len(chosen)).map(
        Outpainter,
        fn_constructor_args=(request, chosen),
        compute=ray.data.ActorPoolStrategy(size=min(num_actors, len(chosen))),
        num_gpus=gpus_per_actor(),
    )
    for _ in graph.iter_rows():
        if on_scene:
            on_scene()
    return len(chosen)
