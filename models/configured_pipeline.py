"""Networks and options of a pipeline: load, save and configure them, in the style of diffusers."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from models.base import Config, read_config, write_config
from models.composition.attachments import AttachmentReport
from models.dit import DiT
from models.execution import SamplingExecution
from models.layout import LayoutSpec
from models.lvae import LayoutVAE
from models.options import Choice, Flag, Integer, Number, Rule, Sequential, Text, check_entries, show_value
from models.pretrained import INDEX_NAME, find_pipeline_path
from models.sampling.constraints import ConstraintConfig, ConstraintGuidance
from models.sampling.diffusion import Denoiser, Diffusion
from models.sampling.repaint import (
    NUM_INFERENCE_STEPS,
    InpaintingConfig,
    RePaintConfig,
    choose_inpainting,
)
from models.sampling.schedulers import SAMPLERS, SchedulerConfig
from models.street_planner import StreetPlanner
from models.tensors import EXISTENCE_THRESHOLD

Pipeline = TypeVar("Pipeline", bound="ConfiguredPipeline")

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
    "pag_drops_label": Flag(),
    "street_pag_factor": Number(0, 1),
}


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


class ConfiguredPipeline:
    """The networks of a pipeline, and the defaults of its options. The files are similar to those of diffusers.

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
        pag_drops_label: Whether the second half of the perturbed network of this guidance has the null label, so the
            guidance also raises the fidelity to labels.
        street_pag_factor: Factor of this scale for outpainted blocks that know all streets, from a plan or a map. Known
            streets support the attention, so the same scale adds too many small objects.
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
        pag_drops_label: bool = False,
        street_pag_factor: float = 1.0,
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
            pag_drops_label=pag_drops_label,
            street_pag_factor=street_pag_factor,
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
    def from_pretrained(
        cls: type[Pipeline], directory: str | os.PathLike, torch_dtype: torch.dtype | None = None
    ) -> Pipeline:
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

    def to(self: Pipeline, *args: Any, **kwargs: Any) -> Pipeline:
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
    def label_kind(self) -> str:
        """Kind of label, a key of `models.labels.LABELS`."""
        return self.dit.config.label

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

    def resolve_inpainting(self, repaint: InpaintingConfig | None, knows_streets: bool = False) -> InpaintingConfig:
        """Return options of inpainting and outpainting, or the default of the model if the argument is None.

        Args:
            repaint: Options; None: the default.
            knows_streets: Whether all streets are known, from a plan or a map.

        Returns:
            The options with all numbers. By default, an inpainting network uses the sampler of the pipeline.
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
        default = self.config.street_pag_factor if knows_streets else 1.0
        return replace(
            repaint,
            num_inference_steps=repaint.num_inference_steps or self.config.num_inference_steps,
            pag_factor=default if repaint.pag_factor is None else repaint.pag_factor,
        )
