"""PrITTIPipeline combines the layout VAE and the DiT and generates Scenes, in the style of diffusers."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from tqdm.auto import tqdm

from models.base import Config, read_config, write_config
from models.composition.attachments import (
    AttachmentReport,
    decode_with_spare_poles,
    resolve_attachments,
)
from models.composition.block_grid import BlockIndex, choose_arrangement, label_blocks
from models.composition.deduplicate import find_lower_confidence_duplicates
from models.composition.extend import Side, extend_scene
from models.composition.generator import StepCallback
from models.composition.inpaint import Contents, composite_scenes, grow_to_cells, make_latent_mask
from models.composition.outpaint import outpaint_scene, uses_street_plan
from models.composition.road_sketch import RoadMap, SketchedRoad, Streets
from models.composition.street_plan import StreetPlan, convert_label
from models.dit import DiT
from models.execution import SamplingExecution
from models.labels import FREE, find_label_index, split_label
from models.layout import LayoutSpec
from models.limits import require_within
from models.lvae import LayoutVAE
from models.options import Choice, Flag, Integer, Number, Rule, Sequential, Text, check_entries, show_value
from models.pretrained import INDEX_NAME, find_pipeline_path
from models.sampling.constraints import ConstraintConfig, ConstraintGuidance
from models.sampling.diffusion import (
    GENERATE,
    INPAINT,
    MAX_GUIDANCE_SCALE,
    Denoiser,
    Diffusion,
    InpaintCondition,
    OnStep,
    SamplingSchedule,
    SceneKey,
    SceneNoise,
    sample,
    sample_with_scheduler,
    scale_noise,
    switch_at_timestep,
    with_guidance,
    with_known,
)
from models.sampling.repaint import (
    NUM_INFERENCE_STEPS,
    InpaintingConfig,
    RePaintConfig,
    TrainedInpainting,
    choose_inpainting,
)
from models.sampling.schedulers import SAMPLERS, SchedulerConfig
from models.scene import Scene
from models.street_planner import StreetPlanner
from models.tensors import EXISTENCE_THRESHOLD, make_empty_scene, make_layout_batch

COMPONENTS = {"lvae": LayoutVAE, "dit": DiT}
STREET_PLANNER = "street_planner"  # Name of an optional component.
NEIGHBOUR_LATENTS = ("reencode", "copy", "paper")
SCHEDULER_CONFIG = "scheduler/scheduler_config.json"
MAX_PAG_SCALE = 20.0
PAG_START = 0.2  # Lowest timestep with perturbed-attention guidance, as a share of the number of timesteps.
INDEX_RULES: dict[str, Rule] = {
    **dict.fromkeys((*COMPONENTS, STREET_PLANNER, "scheduler"), Sequential(Text(), 2, 2)),
    "num_inference_steps": Integer(1, 2**31),
    "noise_scaling": Number(0.9, 1.1),
    "existence_threshold": Number(0, 1),
    "neighbour_latents": Choice(NEIGHBOUR_LATENTS),
    "constraints": Flag(),
    "attach": Flag(),
    "pag_scale": Number(0, MAX_PAG_SCALE),
}


def draw_seeds(
    generator: torch.Generator | Sequence[torch.Generator] | None, seed: int | Sequence[int], count: int
) -> list[int]:
    """Return one seed per scene.

    Args:
        generator: One generator per scene, or a single generator, which draws one common seed for all scenes. None:
            `seed` is used.
        seed: One seed for all scenes, or one per scene.
        count: Number of scenes.

    Returns:
        `count` seeds.

    Raises:
        ValueError: The number of generators is neither 1 nor `count`.
    """
    if generator is None:
        return [seed] * count if isinstance(seed, int) else list(seed)
    drawn = [
        int(torch.randint(2**31, (), generator=one, device=one.device))
        for one in ([generator] if isinstance(generator, torch.Generator) else generator)
    ]
    if len(drawn) not in (1, count):
        raise ValueError(f"{len(drawn)} generators for {count} scenes: expected one, or one per scene")
    return drawn * (count // len(drawn))


def check_noise_scaling(noise_scaling: float) -> float:
    """Return a noise scaling after checking that it is between 0.9 and 1.1.

    Args:
        noise_scaling: Divisor of the predicted noise.

    Returns:
        The same number.

    Raises:
        ValueError: The number is not between 0.9 and 1.1.
    """
    if not 0.9 <= noise_scaling <= 1.1:
        raise ValueError(f"noise_scaling is {noise_scaling}, expected 0.9 to 1.1; 1 means no scaling")
    return noise_scaling


def _get_version(weight: Tensor) -> int:
    """Return a number that each change of a tensor in place raises. Tensors of the inference mode have none."""
    return 0 if weight.is_inference() else weight._version


class PrITTIPipeline:
    """Generate, inpaint and outpaint Scenes. Methods and file formats are similar to those of diffusers pipelines.

    Args:
        lvae: Layout VAE.
        dit: Diffusion transformer that was trained on the latents of `lvae`.
        scheduler: Noise schedule and sampler, given as a SchedulerConfig or a diffusers scheduler. None: DDPM, as in
            the paper.
        num_inference_steps: Default number of denoising steps; the paper uses 250.
        noise_scaling: Divisor of the predicted noise (`diffusion.scale_noise`) for all samplers except DDPM. The paper
            does not scale the noise.
        existence_threshold: Only primitives with a higher existence probability are kept; the paper uses 0.3.
        neighbour_latents: How outpainting uses neighbouring blocks by default: "reencode", "copy" or "paper"
            (jobs/outpaint_scenes.py).
        constraints: Whether constraints guide sampling by default (models/sampling/constraints.py). The paper has none.
        attach: Whether decoding attaches signs and poles by default (models/composition/attachments.py). The paper does
            not do this.
        pag_scale: Default scale of perturbed-attention guidance (`DiT.apply_modulations`) at noisy timesteps; 0
            switches it off, as in the paper.
        street_planner: Network that plans the streets of large scenes (models/composition/street_plan.py); None: blocks
            do not follow a plan, as in the paper.

    Raises:
        ValueError: The LayoutSpec or the shape of the latents of the DiT differs from that of `lvae`, or the
            noise schedule of the scheduler from that of the DiT.
    """

    def __init__(
        self,
        lvae: LayoutVAE,
        dit: DiT,
        scheduler: Any = None,
        noise_scaling: float = 1.0,
        existence_threshold: float = EXISTENCE_THRESHOLD,
        neighbour_latents: str = "reencode",
        constraints: bool = False,
        attach: bool = True,
        pag_scale: float = 0.0,
        num_inference_steps: int = NUM_INFERENCE_STEPS,
        street_planner: StreetPlanner | None = None,
    ) -> None:
        self.lvae, self.dit = lvae.eval().requires_grad_(False), dit.eval().requires_grad_(False)
        self.street_planner: StreetPlanner | None = None
        if street_planner is not None:
            self.street_planner = street_planner.eval().requires_grad_(False)
        self.scheduler = SchedulerConfig.ddpm(dit.diffusion)
        if scheduler is not None:
            self.scheduler = scheduler
        self.config = Config(
            num_inference_steps=num_inference_steps,
            noise_scaling=noise_scaling,
            existence_threshold=existence_threshold,
            neighbour_latents=neighbour_latents,
            constraints=constraints,
            attach=attach,
            pag_scale=pag_scale,
        )
        self.execution = SamplingExecution()
        # What the last denoiser depends on, its labels, and the denoiser.
        self._denoiser: tuple[tuple, set[int], Denoiser] | None = None
        self._progress_bar: dict[str, Any] = {}
        if dit.config.layout is not None:
            self.spec.require(LayoutSpec.from_dict(dit.config.layout), "the DiT")
        if (shape := (dit.config.channels, dit.config.size, dit.config.size)) != lvae.latent_shape:
            raise ValueError(f"the DiT generates latents of the shape {shape}, but the layout VAE {lvae.latent_shape}")
        self.attachments = AttachmentReport()
        self.guidance: ConstraintGuidance | None = None
        self.use_constraints(None)
        self.use_pag(None)

    @classmethod
    def from_pretrained(cls, directory: str | os.PathLike, torch_dtype: torch.dtype | None = None) -> PrITTIPipeline:
        """Load a pipeline from a directory, or load included weights by name. Model hubs are not asked.

        Args:
            directory: Directory written by `save_pretrained` or jobs/train_dit.py, as a path or as a URI such as
                s3://bucket/folder; or a name such as "town" (models/pretrained.py).
            torch_dtype: Data type of the parameters; None: the stored data type.

        Returns:
            The pipeline in evaluation mode on the CPU.

        Raises:
            ValueError: The directory does not contain a complete pipeline, or a file is damaged.
        """
        path = Path(find_pipeline_path(directory))
        index = read_config(path / INDEX_NAME, cls.__name__)
        kinds = COMPONENTS | ({STREET_PLANNER: StreetPlanner} if STREET_PLANNER in index else {})
        for name, kind in kinds.items():
            if index.get(name) != (expected := [kind.__module__, kind.__name__]):
                raise ValueError(f"{path / INDEX_NAME}: {name} is {show_value(index.get(name))}, expected {expected}")
        try:
            check_entries(index, INDEX_RULES, required=("scheduler",))
        except ValueError as error:
            raise ValueError(f"{path / INDEX_NAME}: {error}") from error
        library, class_name = index["scheduler"]
        if library != "diffusers":
            raise ValueError(f"{path / INDEX_NAME}: scheduler is {index['scheduler']}, expected a class of diffusers")
        options = read_config(path / SCHEDULER_CONFIG, class_name)
        try:
            scheduler = SchedulerConfig.parse(class_name, options)
        except ValueError as error:
            raise ValueError(f"{path / SCHEDULER_CONFIG}: {error}") from error
        components = {name: kind.from_pretrained(path / name, torch_dtype) for name, kind in kinds.items()}
        names = INDEX_RULES.keys() - COMPONENTS.keys() - {"scheduler", STREET_PLANNER}
        defaults = {name: index[name] for name in names if name in index}
        try:
            return cls(**components, scheduler=scheduler, **defaults)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    def save_pretrained(self, directory: str | os.PathLike) -> None:
        """Write model_index.json and one directory per component.

        Args:
            directory: Output directory. The directory is created if it does not exist.
        """
        path = Path(directory)
        self.lvae.save_pretrained(path / "lvae")
        self.dit.save_pretrained(path / "dit")
        if self.street_planner is not None:
            self.street_planner.save_pretrained(path / STREET_PLANNER)
        scheduler = path / SCHEDULER_CONFIG
        scheduler.parent.mkdir(exist_ok=True)
        write_config(self.scheduler_config.class_name, self.scheduler_config.config, scheduler)
        kinds = COMPONENTS | ({} if self.street_planner is None else {STREET_PLANNER: StreetPlanner})
        index = {name: [kind.__module__, kind.__name__] for name, kind in kinds.items()}
        index["scheduler"] = ["diffusers", self.scheduler_config.class_name]
        write_config(type(self).__name__, index | self.config, path / INDEX_NAME)

    @property
    def scheduler(self) -> Any:
        """The diffusers scheduler; diffusers is imported on first use."""
        if self._scheduler is None:
            self._scheduler = self.scheduler_config.build()
        return self._scheduler

    @scheduler.setter
    def scheduler(self, scheduler: Any) -> None:
        """Set the scheduler.

        Args:
            scheduler: A SchedulerConfig or a scheduler of diffusers.

        Raises:
            ValueError: The noise schedule differs from that of the DiT.
        """
        config, built = scheduler, None
        if not isinstance(scheduler, SchedulerConfig):
            plain = json.loads(scheduler.to_json_string())
            options = {name: value for name, value in plain.items() if not name.startswith("_")}
            config, built = SchedulerConfig(type(scheduler).__name__, options), scheduler
        config.require_schedule(self.dit.diffusion)
        self.scheduler_config, self._scheduler = config, built

    def use_sampler(self, name: str) -> None:
        """Select a sampler by name, with its default number of steps if it is not the current sampler.

        To use any other diffusers scheduler, assign it to `scheduler`.

        Args:
            name: Key of `models.sampling.schedulers.SAMPLERS`; "ddpm" is the paper's sampler.

        Raises:
            ValueError: The name is unknown.
        """
        if name != self.scheduler_config.sampler:
            self.scheduler = self.scheduler_config.with_sampler(name)
            self.register_to_config(num_inference_steps=SAMPLERS[name].num_inference_steps)

    @property
    def uses_ddpm(self) -> bool:
        """True if the sampler is that of the paper (DDPM)."""
        return self.scheduler_config.class_name == "DDPMScheduler"

    def register_modules(self, **components: Any) -> None:
        """Replace `lvae`, `dit`, `scheduler` or `street_planner`.

        Args:
            **components: New components by name.

        Raises:
            ValueError: The noise schedules of the DiT and of the scheduler differ.
        """
        for name, component in components.items():
            setattr(self, name, component)
        self.scheduler_config.require_schedule(self.dit.diffusion)

    def register_to_config(self, **changes: Any) -> None:
        """Replace entries of `config`, such as `noise_scaling`.

        Call `use_constraints(None)` and `use_pag(None)` afterwards to apply new defaults of these two.

        Args:
            **changes: New values by name.
        """
        self.config = Config(self.config | changes)

    @property
    def components(self) -> dict[str, Any]:
        """Layout VAE, DiT, scheduler, and street planner if there is one, by name."""
        planner = {} if self.street_planner is None else {STREET_PLANNER: self.street_planner}
        return {"lvae": self.lvae, "dit": self.dit, "scheduler": self.scheduler} | planner

    def to(self, *args: Any, **kwargs: Any) -> PrITTIPipeline:
        """Move the networks to a device or data type.

        Args:
            *args: Arguments of `torch.nn.Module.to`.
            **kwargs: Keyword arguments of `torch.nn.Module.to`.

        Returns:
            This pipeline.
        """
        self.lvae.to(*args, **kwargs)
        self.dit.to(*args, **kwargs)
        if self.street_planner is not None:
            self.street_planner.to(*args, **kwargs)
        return self

    def set_execution(self, execution: SamplingExecution) -> None:
        """Select precision, CUDA graphs, compilation and the batch size of decoding.

        Args:
            execution: Options. The precision and the compilation cannot be taken back, so load the pipeline again.

        Raises:
            ValueError: The GPU has no bfloat16.
        """
        execution.prepare(self.dit)
        self.execution = execution

    def set_constraints(self, config: ConstraintConfig | None) -> None:
        """Guide sampling, inpainting and outpainting by constraints, or stop the guidance.

        `guidance.report` counts guided steps, and steps without a finite gradient.

        Args:
            config: Options; None: no guidance.

        Raises:
            ValueError: A requested constraint is unknown, or the model lacks its categories.
        """
        self.guidance = None
        if config is not None:
            self.guidance = ConstraintGuidance(config, self.lvae, self._moments, self.diffusion)

    def use_constraints(self, constraints: bool | None) -> None:
        """Guide sampling by all constraints that the model's categories allow, or stop the guidance.

        Args:
            constraints: Whether to guide sampling; None: the default of the pipeline.
        """
        self.set_constraints(ConstraintConfig() if self.resolve_constraints(constraints) else None)

    def resolve_constraints(self, constraints: bool | None) -> bool:
        """Return whether constraints guide sampling, or the default of the pipeline if the argument is None.

        Args:
            constraints: Whether to guide sampling; None: the default.

        Returns:
            Whether to guide sampling.
        """
        return self.config.constraints if constraints is None else constraints

    def use_pag(self, pag_scale: float | None) -> None:
        """Set the scale of perturbed-attention guidance for sampling, inpainting and outpainting.

        Args:
            pag_scale: Scale from 0 (no guidance) to MAX_PAG_SCALE; None: the default of the pipeline.

        Raises:
            ValueError: The scale is out of range.
        """
        self.pag_scale = self.resolve_pag_scale(pag_scale)

    def resolve_pag_scale(self, pag_scale: float | None) -> float:
        """Return a scale of perturbed-attention guidance, or the default of the pipeline if the argument is None.

        Args:
            pag_scale: Scale; None: the default.

        Returns:
            The scale.

        Raises:
            ValueError: The scale is out of range.
        """
        scale = self.config.pag_scale if pag_scale is None else pag_scale
        if not 0 <= scale <= MAX_PAG_SCALE:
            raise ValueError(f"pag_scale is {scale}, expected 0 to {MAX_PAG_SCALE:g}; 0 switches the guidance off")
        return scale

    @contextmanager
    def _guide(
        self, model: Denoiser, timesteps: np.ndarray | Tensor, condition: InpaintCondition | None = None
    ) -> Iterator[Denoiser]:
        """Yield the denoiser with the guidance of the constraints, if any; log failures of the guidance at the end."""
        if self.guidance is None:
            yield model
            return
        before = self.guidance.report.fallbacks
        yield self.guidance.wrap(model, timesteps.tolist(), condition)
        self.guidance.warn_of_fallbacks(before)

    @property
    def device(self) -> torch.device:
        """Device of the networks."""
        return self.dit.device

    @property
    def dtype(self) -> torch.dtype:
        """Data type of the networks."""
        return self.dit.dtype

    def set_progress_bar_config(self, **options: Any) -> None:
        """Set options of the progress bar.

        Args:
            **options: Options of tqdm; `disable=True` hides the progress bar.
        """
        self._progress_bar = options

    @property
    def spec(self) -> LayoutSpec:
        """Layout of the scenes."""
        return self.lvae.spec

    @property
    def has_split_latent(self) -> bool:
        """True if the first half of the channels of a latent belongs to the ground, the second half to the objects."""
        return self.lvae.config.split_latent

    @property
    def latent_shape(self) -> tuple[int, int, int]:
        """Shape (c, h, w) of a latent."""
        return self.lvae.latent_shape

    @property
    def diffusion(self) -> Diffusion:
        """Noise schedule, which the DiT defines."""
        return self.dit.diffusion

    def _moments(self) -> tuple[Tensor, Tensor]:
        """Return the shift and the scale of the latents, each of shape (c, 1, 1)."""
        channels = self.dit.config.channels
        shift, scale = self.dit.config.shift or [0.0] * channels, self.dit.config.scale or [1.0] * channels
        shift, scale = (torch.tensor(values, device=self.device)[:, None, None] for values in (shift, scale))
        return shift, scale

    @torch.no_grad()
    def encode(self, scenes: Sequence[Scene]) -> Float[Tensor, "b c h w"]:
        """Encode scenes to posterior means, and normalise these means for the diffusion model.

        Args:
            scenes: Scenes that cover the area of the model's grid.

        Returns:
            Latents.
        """
        shift, scale = self._moments()
        return (self.lvae.encode(make_layout_batch(list(scenes), self.spec).to(self.device)).mean - shift) / scale

    @torch.no_grad()
    def decode(
        self,
        latents: Float[Tensor, "b c h w"],
        identities: Sequence[Scene],
        existence_threshold: float | None = None,
        deduplicate: bool = True,
        attach: bool | None = None,
        raster_px: int | None = None,
    ) -> list[Scene]:
        """Decode latents to scenes.

        By default, latents are decoded one at a time. Each scene is therefore bit-identical for any batch size. With
        `SamplingExecution.decode_batch_size`, scenes are equal up to rounding.

        Args:
            latents: Latents.
            identities: Scenes whose ids and labels are copied to the results.
            existence_threshold: Only primitives with a higher existence probability are kept; None: the threshold of
                the pipeline.
            deduplicate: A cell decoder may propose the same object in two cells. If True, only the proposal with the
                higher existence probability is kept.
            attach: Whether signs are attached to poles, walls and buildings, and poles are put on the ground
                (models/composition/attachments.py); None: the default of the pipeline. `attachments` counts the
                changes.
            raster_px: Number of rows and of columns of the rasters; None: that of the model's grid. Only models whose
                ground consists of level sets decode another resolution.

        Returns:
            One scene per latent.

        Raises:
            ValueError: The threshold is not between 0 and 1, a latent holds NaN or infinity, or the model has no level
                sets and `raster_px` is not its resolution.
        """
        threshold = self.resolve_existence_threshold(existence_threshold)
        shift, scale = self._moments()
        if not torch.isfinite(latents).all():  # Decoded, such a latent would give an empty scene.
            raise ValueError("a latent holds NaN or infinity: the weights of the model are damaged")
        attach = self.config.attach if attach is None else attach
        spec, parts = self.spec, latents.split(self.execution.decode_batch_size)
        if raster_px is not None:
            require_within("raster_pixels", raster_px**2 * len(spec.ground_classes), "raster_px")
            spec = spec.with_resolution(raster_px)
        layouts = [
            layout for part in parts for layout in self.lvae.decode(part * scale + shift, raster_px=raster_px).layouts()
        ]
        scenes = []
        for layout, identity in zip(layouts, identities, strict=True):
            scene, spare = decode_with_spare_poles(layout, spec, identity, threshold)
            if deduplicate and self.lvae.proposes_duplicates:
                scene = scene.select(~find_lower_confidence_duplicates(scene))
            scenes.append(resolve_attachments(scene, spare, spec.slab_offset_m, self.attachments) if attach else scene)
        return scenes

    def new_identity(self, run: str, seed: int, index: int, label: str) -> Scene:
        """Return an empty Scene that has the id and the labels of the generated scene.

        Args:
            run: Run name.
            seed: Seed of the run.
            index: Index of the scene within the run.
            label: Label of the scene.

        Returns:
            The empty scene.
        """
        vegetation, vehicle = split_label(self.dit.config.label, label)
        return make_empty_scene(
            f"generated-{run}-{seed}-{index:07d}",
            f"generated-{run}",
            str(seed),
            index,
            self.spec,
            vegetation_density=vegetation,
            vehicle_density=vehicle,
            free_pose=label.endswith(FREE),
        )

    def label_tensor(self, labels: Sequence[str]) -> Tensor:
        """Convert labels to class indices.

        Args:
            labels: Names of labels.

        Returns:
            (b,) class indices.

        Raises:
            ValueError: A label is unknown to the model, or `labels` is empty or one string.
        """
        if isinstance(labels, str) or not len(labels):
            raise ValueError(f"labels is {labels!r}, expected a list with one label per scene")
        return torch.tensor([find_label_index(self.dit.config.label, name) for name in labels], device=self.device)

    def make_denoiser(
        self,
        timesteps: np.ndarray | Tensor,
        label: Int[Tensor, " b"],
        guidance_scale: float = 1.0,
        pag_scale: float | None = None,
    ) -> Denoiser:
        """Return the DiT with guidance and precomputed modulations, run as `set_execution` says.

        Perturbed-attention guidance applies to the conditional and to the unconditional noise, and only to timesteps
        from PAG_START on (a limited interval; Kynkäänniemi et al., NeurIPS 2024).

        The last denoiser is kept for batches with the same timesteps, so they share a CUDA graph. It is made again if a
        batch has a new label, or if weights change; changes through `weight.data` are not noticed.

        Args:
            timesteps: All timesteps that the denoiser will receive.
            label: Class index of each scene.
            guidance_scale: Scale of classifier-free guidance; 1 switches guidance off.
            pag_scale: Scale of perturbed-attention guidance; None: the scale of `use_pag`.

        Returns:
            Function that maps latents (b, c, h, w), timesteps (b,) and labels (b,) to noise.

        Raises:
            ValueError: The guidance scale is out of range.
        """
        if not 0 <= guidance_scale <= MAX_GUIDANCE_SCALE:
            raise ValueError(
                f"guidance_scale is {guidance_scale}, expected 0 to {MAX_GUIDANCE_SCALE:g}; 1 switches the guidance off"
            )
        pag_scale = self.pag_scale if pag_scale is None else pag_scale
        null = self.dit.null_label
        labels = {*label.tolist()} if guidance_scale == 1.0 else {*label.tolist(), null}
        weights = tuple((weight.data_ptr(), _get_version(weight)) for weight in self.dit.parameters())
        key = tuple(sorted({*timesteps.tolist()})), guidance_scale, pag_scale, self.execution, weights
        if self._denoiser is not None and self._denoiser[0] == key:
            if labels <= self._denoiser[1]:
                return self._denoiser[2]
            labels |= self._denoiser[1]
        self._denoiser = None  # Free the old graph before the next capture.

        def build(steps: list[int], scale: float) -> Denoiser:
            with self.execution.autocast(self.device):
                model = self.dit.precompute_conditioning(steps, labels, scale)
            return self.execution.wrap(with_guidance(model, null, guidance_scale), self.device)

        start = PAG_START * self.diffusion.num_timesteps if pag_scale else float("inf")
        guided, plain = ([int(t) for t in timesteps if (t >= start) == side] for side in (True, False))
        if not guided or not plain:
            model = build(guided or plain, pag_scale if guided else 0.0)
        else:
            model = switch_at_timestep(start, build(guided, pag_scale), build(plain, 0.0))
        self._denoiser = key, labels, model
        return model

    def resolve_noise_scaling(self, noise_scaling: float | None) -> float:
        """Return a noise scaling, or the default of the current sampler if the argument is None.

        Args:
            noise_scaling: Divisor of the predicted noise; None: the default.

        Returns:
            The divisor. For DDPM, the default is 1.

        Raises:
            ValueError: The number is not between 0.9 and 1.1.
        """
        if noise_scaling is None:
            return 1.0 if self.uses_ddpm else self.config.noise_scaling
        return check_noise_scaling(noise_scaling)

    def resolve_existence_threshold(self, existence_threshold: float | None) -> float:
        """Return an existence threshold, or the default of the pipeline if the argument is None.

        Args:
            existence_threshold: Threshold; None: the default.

        Returns:
            The threshold.

        Raises:
            ValueError: The number is not between 0 and 1.
        """
        if existence_threshold is None:
            return self.config.existence_threshold
        if not 0 < existence_threshold < 1:
            raise ValueError(f"existence_threshold is {existence_threshold}, expected between 0 and 1")
        return existence_threshold

    def resolve_inpainting(self, repaint: InpaintingConfig | None) -> InpaintingConfig:
        """Return options of inpainting and outpainting, or the default of the model if the argument is None.

        Args:
            repaint: Options; None: the default.

        Returns:
            The options with a number of steps. By default, an inpainting network uses the sampler of the pipeline.
            Pipelines of the paper's presets use RePaint as in the paper, the others `RePaintConfig.guided()`.

        Raises:
            ValueError: The network cannot read a known part.
        """
        if not isinstance(repaint, RePaintConfig):
            way, is_of_paper = repaint and "trained", self.config.neighbour_latents == "paper"
            chosen = choose_inpainting(way, self.dit.config.inpainting, is_of_paper)
            repaint = repaint or chosen
        if isinstance(repaint, RePaintConfig):
            return repaint
        return replace(repaint, num_inference_steps=repaint.num_inference_steps or self.config.num_inference_steps)

    @contextmanager
    def _step_callback(self, num_evaluations: int, callback: StepCallback | None) -> Iterator[OnStep]:
        """Yield a function for the sampler to call after each step.

        The function advances the progress bar and calls the user's callback.
        """
        with tqdm(total=num_evaluations, **self._progress_bar) as bar:

            def on_step(number: int, timestep: int, latents: Tensor) -> Tensor:
                bar.update()
                return callback(self, number, timestep, {"latents": latents})["latents"] if callback else latents

            yield on_step

    def sample_latents(
        self,
        labels: Sequence[str],
        seed: int | Sequence[int],
        indices: Sequence[SceneKey],
        num_inference_steps: int | None = None,
        guidance_scale: float = 1.0,
        callback_on_step_end: StepCallback | None = None,
        noise_scaling: float | None = None,
        purpose: int = GENERATE,
        condition: InpaintCondition | None = None,
        known_guidance_scale: float = 1.0,
    ) -> Float[Tensor, "b c h w"]:
        """Sample latents. Each latent depends only on the seed, its index, its label and its condition.

        Args:
            labels: Label of each scene.
            seed: One seed for all scenes, or one per scene.
            indices: Index of each scene within the run, or another key; the noise depends on the seed and this key.
            num_inference_steps: Number of denoising steps; None: the default of the pipeline.
            guidance_scale: Scale of classifier-free guidance; 1 switches guidance off.
            callback_on_step_end: See `generate`.
            noise_scaling: Divisor of the predicted noise; None: the default of the pipeline.
            purpose: Purpose of the noise: GENERATE, OUTPAINT or INPAINT (models/sampling/diffusion.py).
            condition: Known part of the latents, which an inpainting network continues.
            known_guidance_scale: Scale of guidance by the known part; 1 switches this guidance off.

        Returns:
            Latents.

        Raises:
            ValueError: A label is unknown, a number is out of range, the scheduler uses fractional timesteps, or the
                network cannot read a known part.
        """
        noise = SceneNoise(seed, indices, self.latent_shape, self.device, purpose)
        label, noise_scaling = self.label_tensor(labels), self.resolve_noise_scaling(noise_scaling)
        steps: int = self.config.num_inference_steps if num_inference_steps is None else num_inference_steps
        timesteps = self._select_timesteps(steps)
        model = scale_noise(self.make_denoiser(timesteps, label, guidance_scale), noise_scaling)
        if condition is not None:
            model = with_known(model, condition, self.diffusion, known_guidance_scale)
        with (
            self._step_callback(steps, callback_on_step_end) as on_step,
            self._guide(model, timesteps, condition) as guided,
        ):
            if self.uses_ddpm:
                latents = sample(guided, SamplingSchedule(self.diffusion, steps), noise, label, on_step=on_step)
            else:
                latents = sample_with_scheduler(guided, self.scheduler, noise, label, on_step)
        return latents if condition is None else torch.where(condition.mask.bool(), latents, condition.latent)

    def _select_timesteps(self, num_inference_steps: int) -> np.ndarray | Tensor:
        """Return the timesteps of the sampler, and prepare the scheduler of diffusers for them."""
        # Raise an error for an invalid number of steps; diffusers would accept it.
        timesteps = self.diffusion.select_timesteps(num_inference_steps)
        if self.uses_ddpm:
            return timesteps
        self.scheduler.set_timesteps(num_inference_steps, device=self.device)
        if self.scheduler.timesteps.is_floating_point():
            raise ValueError(
                f"{self.scheduler_config.class_name} uses fractional timesteps, which the DiT does not support; "
                "use DPM-Solver++ or DDIM"
            )
        return self.scheduler.timesteps

    def generate(
        self,
        labels: Sequence[str],
        seed: int = 0,
        indices: Sequence[int] | None = None,
        num_inference_steps: int | None = None,
        guidance_scale: float = 1.0,
        run: str = "run",
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
        callback_on_step_end: StepCallback | None = None,
        noise_scaling: float | None = None,
        existence_threshold: float | None = None,
    ) -> list[Scene]:
        """Generate one Scene per label.

        Scene i depends only on the seed, indices[i] and labels[i], but not on the other scenes of the batch.

        Args:
            labels: Label of each scene, such as "low-medium".
            seed: Seed of the run.
            indices: Index of each scene within the run (default: 0, 1, ...).
            num_inference_steps: Number of denoising steps; None: the default of the pipeline.
            guidance_scale: Scale of classifier-free guidance; 1 switches guidance off.
            run: Run name; it is part of the scene ids.
            generator: One generator for all scenes, or one per scene. None: `seed` is used; otherwise, `seed` is
                ignored.
            callback_on_step_end: Function f(pipeline, step, timestep, {"latents": ...}), called after each step. The
                function returns a dictionary {"latents": ...} for the next step.
            noise_scaling: Divisor of the predicted noise; None: the default of the pipeline.
            existence_threshold: Only primitives with a higher existence probability are kept; None: the threshold of
                the pipeline.

        Returns:
            The scenes in the order of the labels.

        Raises:
            ValueError: A label is unknown or a number is out of range.
        """
        indices = range(len(labels)) if indices is None else indices
        seeds = draw_seeds(generator, seed, len(labels))
        latents = self.sample_latents(
            labels, seeds, indices, num_inference_steps, guidance_scale, callback_on_step_end, noise_scaling
        )
        scenes = zip(seeds, indices, labels, strict=True)
        return self.decode(latents, [self.new_identity(run, *scene) for scene in scenes], existence_threshold)

    __call__ = generate

    def inpaint_latents(
        self,
        condition: InpaintCondition,
        labels: Sequence[str],
        seed: int | Sequence[int],
        indices: Sequence[SceneKey],
        repaint: InpaintingConfig | None = None,
        guidance_scale: float = 1.0,
        callback_on_step_end: StepCallback | None = None,
        purpose: int = GENERATE,
    ) -> Float[Tensor, "b c h w"]:
        """Sample latents with RePaint (paper, Sec. 3.3), or with an inpainting network.

        Where the mask of the condition is 0, the latents are bit-identical to the condition.

        Args:
            condition: Known latents and masks.
            labels: Label of each scene.
            seed: One seed for all scenes, or one per scene.
            indices: Key of each scene; the noise depends on the seed and this key.
            repaint: Options of inpainting; None: see `resolve_inpainting`.
            guidance_scale: Scale of classifier-free guidance; 1 switches guidance off.
            callback_on_step_end: See `generate`.
            purpose: Purpose of the noise: GENERATE, OUTPAINT or INPAINT (models/sampling/diffusion.py).

        Returns:
            Latents.

        Raises:
            ValueError: A label is unknown, a number is out of range, or the network cannot read a known part.
        """
        repaint = self.resolve_inpainting(repaint)
        if isinstance(repaint, TrainedInpainting):
            return self.sample_latents(
                labels,
                seed,
                indices,
                repaint.num_inference_steps,
                guidance_scale,
                callback_on_step_end,
                purpose=purpose,
                condition=condition,
                known_guidance_scale=repaint.known_guidance_scale,
            )
        schedule = SamplingSchedule(self.diffusion, repaint.num_inference_steps, repaint.eta)
        noise = SceneNoise(seed, indices, self.latent_shape, self.device, purpose)
        label = self.label_tensor(labels)
        scaling = 1.0 if repaint.eta == 1 else self.config.noise_scaling
        # Perturbed-attention guidance would add too many objects (docs/experiments/town2_weights.md, Outpainting).
        model = scale_noise(self.make_denoiser(schedule.timesteps, label, guidance_scale, 0.0), scaling)
        with (
            self._step_callback(repaint.num_evaluations, callback_on_step_end) as on_step,
            self._guide(model, schedule.timesteps, condition) as guided,
        ):
            return sample(
                guided,
                schedule,
                noise,
                label,
                repaint.transitions(),
                condition,
                on_step,
                repaint.pseudoinverse_guidance,
            )

    def inpaint(
        self,
        scenes: Sequence[Scene],
        regions: Sequence[np.ndarray],
        labels: Sequence[str],
        contents: Contents = "both",
        seed: int = 0,
        indices: Sequence[SceneKey] | None = None,
        repaint: InpaintingConfig | None = None,
        guidance_scale: float = 1.0,
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
        callback_on_step_end: StepCallback | None = None,
        composite: bool = True,
    ) -> list[Scene]:
        """Regenerate a region of each scene; regions are enlarged to whole latent cells (paper, Sec. 3.3).

        Args:
            scenes: Scenes on the model's grid.
            regions: One mask (rows, cols) per scene; True marks the pixels to regenerate
                (models/composition/inpaint.py).
            labels: Label of each scene.
            contents: "objects": regenerate objects on the known ground. "ground": regenerate the ground under the known
                objects. "both": regenerate ground and objects. With a local frame, object latents hold no absolute yaw
                and height, so "ground" knows only the places and shapes of the objects.
            seed: Seed of the run.
            indices: Key of each scene; the noise depends on it (default: 0, 1, ...).
            repaint: Options of inpainting; None: see `resolve_inpainting`.
            guidance_scale: Scale of classifier-free guidance; 1 switches guidance off.
            generator: See `generate`.
            callback_on_step_end: See `generate`.
            composite: If True, copy everything outside the regions from the input. If False, the decoders also
                reconstruct the area outside the regions.

        Returns:
            The regenerated scenes.

        Raises:
            ValueError: A scene is not on the model's grid, or the latent is not split and `contents` is not "both".
        """
        indices = range(len(scenes)) if indices is None else indices
        for scene in scenes:
            self.require_grid(scene)
        if contents != "both" and not self.has_split_latent:
            raise ValueError(f"this model's latent mixes ground and objects, so it cannot regenerate only {contents}")
        shape = self.latent_shape
        mask = make_latent_mask(regions, shape, contents).to(self.device)
        seeds = draw_seeds(generator, seed, len(scenes))
        condition = InpaintCondition(self.encode(scenes), mask)
        latents = self.inpaint_latents(
            condition,
            labels,
            seeds,
            indices,
            repaint,
            guidance_scale,
            callback_on_step_end,
            INPAINT,
        )
        generated = self.decode(latents, scenes)
        if not composite:
            return generated
        return [
            composite_scenes(scene, new, grow_to_cells(region, scene.grid, shape[-1]), contents)
            for scene, new, region in zip(scenes, generated, regions, strict=True)
        ]

    def outpaint(
        self,
        scene: Scene,
        label: str | Mapping[BlockIndex, str],
        seed: int = 0,
        index: int = 0,
        overlap: float | None = None,
        mode: str | None = None,
        num_blocks: tuple[int, int, int, int] = (1, 1, 1, 1),
        repaint: InpaintingConfig | None = None,
        guidance_scale: float = 1.0,
        callback_on_step_end: StepCallback | None = None,
        side: Side | None = None,
        order: str | None = None,
        free_blocks: str | None = None,
        roads: Sequence[Streets] = (),
        margin: float | None = None,
        plan_streets: bool | None = None,
    ) -> Scene:
        """Extend a scene by generated blocks; the input content is unchanged (paper, supplement B.3).

        Args:
            scene: Scene on the model's grid. If `side` is set, the scene may be larger than one block.
            label: One label for all blocks, or a mapping from block index (steps ahead, steps to the left) to label.
            seed: Seed of the run.
            index: Index of the scene within the run.
            overlap: Fraction of a block that overlaps its neighbour; it must correspond to a whole number of latent
                cells. None: see `models.composition.block_grid.choose_arrangement`; 0.5 with `side`.
            mode: "copy" copies the shifted latents of the neighbours. "reencode" transforms the decoded content of the
                neighbours into the frame of the block and encodes it again. Object latents contain absolute centres,
                which a copy does not change. "paper" is the outpainting of the paper: a copy, without blending of the
                ground and without removal of duplicates. None: the mode that the pipeline stores (`neighbour_latents`).
            num_blocks: Number of blocks to add ahead, behind, to the left and to the right. The paper adds one block on
                every side.
            repaint: Options of inpainting; None: see `resolve_inpainting`.
            guidance_scale: Scale of classifier-free guidance; 1 switches guidance off.
            callback_on_step_end: See `generate`.
            side: "ahead", "behind", "left" or "right". If `side` is set, the scene is extended only on this side, by
                (1 - overlap) of a block, and `num_blocks`, `mode`, `order` and `free_blocks` are ignored: the
                neighbours are encoded again.
            order: "outward" or "colours"; None: see `choose_arrangement`.
            free_blocks: Blocks that count as crops at any place and heading, instead of views of a vehicle: "none",
                "off-street" or "all"; None: see `choose_arrangement`. Ignored if `label` is a mapping.
            roads: Roads that the generated blocks contain, in the frame of the scene; ignored with `side`.
            margin: Width of the outermost part of a block that its neighbours generate again, as a fraction of a block;
                None: see `choose_arrangement`.
            plan_streets: Whether streets are planned before blocks; None: if the model can do this and there is more
                than one block on a side (`models.composition.outpaint.uses_street_plan`). Ignored with `side`.

        Returns:
            One scene that covers all blocks.

        Raises:
            ValueError: The scene does not fit the model, the overlap is not a whole number of cells, a road contradicts
                the ground of the scene, or the model cannot plan streets.
        """
        if side is not None:
            if not isinstance(label, str):
                raise ValueError("to extend a scene on one side, pass one label for all blocks")
            share = 0.5 if overlap is None else overlap
            return extend_scene(self, scene, side, label, seed, share, repaint, guidance_scale, callback_on_step_end)
        self.require_grid(scene)
        mode = str(mode or self.config.neighbour_latents)
        has_plan = uses_street_plan(self, roads, mode, max(num_blocks) > 1, plan_streets)
        is_planned = has_plan or any(isinstance(one, RoadMap) for one in roads)
        cells = self.latent_shape[-1] * is_planned
        arrangement = choose_arrangement(num_blocks, order, overlap, free_blocks, margin, cells)
        if isinstance(label, str):
            label = label_blocks(self.dit.config.label, label, num_blocks, arrangement.free_blocks)
        return outpaint_scene(
            self,
            scene,
            label,
            seed,
            index,
            arrangement,
            mode,
            num_blocks,
            repaint,
            guidance_scale,
            callback_on_step_end,
            roads,
            has_plan,
        )

    @property
    def plans_streets(self) -> bool:
        """True if the pipeline has a street planner."""
        return self.street_planner is not None

    def plan_streets(
        self,
        scene: Scene | None,
        label_at: Callable[[float, float], str],
        seed: int = 0,
        index: int = 0,
        sketches: Sequence[SketchedRoad] = (),
    ) -> StreetPlan:
        """Plan the streets around a scene over any distance, before blocks are generated.

        Args:
            scene: Scene that the plan continues; None: the plan starts from nothing.
            label_at: Function that maps x and y (m, frame of the scene) to the label of the block there.
            seed: Seed of the noise.
            index: Index of the scene; the noise depends on the seed and this index.
            sketches: Sketched roads that the plan contains, in the frame of the scene.

        Returns:
            The plan, which generates its windows on demand.

        Raises:
            ValueError: The pipeline has no street planner, or the scene has other ground classes or another grid.
        """
        if self.street_planner is None:
            raise ValueError("this pipeline has no street planner; add one with train_street_planner.py")
        kind = self.dit.config.label

        def convert(x_m: float, y_m: float) -> str:
            return convert_label(kind, label_at(x_m, y_m))

        return StreetPlan(self.street_planner, scene, convert, seed, index, sketches=sketches)

    def require_grid(self, scene: Scene) -> None:
        """Raise an error if the grid or the ground classes of a scene differ from those of the model.

        Args:
            scene: Scene.

        Raises:
            ValueError: The grid or the ground classes differ.
        """
        if scene.grid != self.spec.grid or scene.ground_classes != self.spec.ground_classes:
            raise ValueError(
                f"scene {scene.scene_id} has {scene.grid} and ground classes {scene.ground_classes}; "
                f"the model needs {self.spec.grid} and {self.spec.ground_classes}"
            )
