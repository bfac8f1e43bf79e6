"""Samplers by name. Samplers as schedulers of diffusers. The module imports diffusers only to build a scheduler.

The sampler of the paper, DDPM, is implemented by `diffusion.sample` and does not need diffusers.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

from models.options import LARGE, Choice, Flag, Integer, Number, Rule, check_entries, check_entry, show_value
from models.sampling.diffusion import PAPER_SCHEDULE, Diffusion
from models.sampling.repaint import NUM_INFERENCE_STEPS

# Options of the class `DDPMScheduler` of the library `diffusers` without those of the noise schedule.
DDPM_CONFIG = {
    "variance_type": "fixed_small",
    "clip_sample": False,
    "clip_sample_range": 1.0,
    "prediction_type": "epsilon",
    "thresholding": False,
    "dynamic_thresholding_ratio": 0.995,
    "sample_max_value": 1.0,
    "timestep_spacing": "leading",
    "steps_offset": 0,
    "rescale_betas_zero_snr": False,
}


class Sampler(NamedTuple):
    """A sampler of diffusers.

    Attributes:
        class_name: Name of the scheduler's class in diffusers.
        options: Options of the class without those of the noise schedule.
        num_inference_steps: Default number of steps; for DDPM, that of the paper.
    """

    class_name: str
    options: dict[str, Any]
    num_inference_steps: int


# DPM-Solver++ uses timesteps that are uniform in log signal-to-noise ratio. A test
# samples a Gaussian distribution with a tenth of the latent's standard deviation. With 20 of these timesteps, the
# samples have 93 % of the true standard deviation. With 20 timesteps that are uniform in time, the samples have 31 % of
# the true standard deviation.
DPM_SOLVER = "DPMSolverMultistepScheduler"
SAMPLERS = {
    "ddpm": Sampler("DDPMScheduler", {"timestep_spacing": "leading"}, NUM_INFERENCE_STEPS),
    "ddim": Sampler("DDIMScheduler", {"timestep_spacing": "leading"}, NUM_INFERENCE_STEPS),
    "dpm++": Sampler(DPM_SOLVER, {"use_lu_lambdas": True, "algorithm_type": "dpmsolver++"}, 20),
    "sde-dpm++": Sampler(DPM_SOLVER, {"use_lu_lambdas": True, "algorithm_type": "sde-dpmsolver++"}, 20),
}


# Schedulers of diffusers that a stored pipeline may name: integer timesteps, and no noise that they draw themselves.
SCHEDULERS = (
    "DDPMScheduler",
    "DDIMScheduler",
    "DPMSolverMultistepScheduler",
    "DPMSolverSinglestepScheduler",
    "DEISMultistepScheduler",
    "UniPCMultistepScheduler",
    "PNDMScheduler",
)
# Rules of stored options. `require_schedule` compares the options of the noise schedule with those of the DiT. Other
# options must be plain values; diffusers ignores unknown names.
RULES: dict[str, Rule] = {
    "num_train_timesteps": Integer(1, 2**31),
    "beta_start": Number(0, 1),
    "beta_end": Number(0, 1),
    "prediction_type": Choice(("epsilon",)),
    "timestep_spacing": Choice(("leading", "linspace", "trailing")),
    "steps_offset": Integer(0, 1),
    "solver_order": Integer(1, 3),
    **dict.fromkeys(
        ("clip_sample", "thresholding", "rescale_betas_zero_snr", "use_lu_lambdas", "use_karras_sigmas"), Flag()
    ),
}
PLAIN_TEXT = re.compile(r"[A-Za-z0-9_.+-]{1,100}")


def _is_plain(value: object) -> bool:
    """Return whether an option of a scheduler is null, a flag, a finite number, a name, or a short list of these."""
    if isinstance(value, list):
        return len(value) <= 100 and all(not isinstance(entry, list) and _is_plain(entry) for entry in value)
    if type(value) in (int, float):
        return bool(-LARGE <= cast(float, value) <= LARGE)
    return value is None or type(value) is bool or (isinstance(value, str) and bool(PLAIN_TEXT.fullmatch(value)))


def list_schedule_options(diffusion: Diffusion) -> dict[str, Any]:
    """Return a noise schedule as options of a diffusers scheduler.

    Args:
        diffusion: Noise schedule.

    Returns:
        Options by name.
    """
    return {
        "num_train_timesteps": diffusion.num_timesteps,
        "beta_start": diffusion.beta_start,
        "beta_end": diffusion.beta_end,
        "beta_schedule": "linear",
        "trained_betas": None,
    }


@dataclass(frozen=True)
class SchedulerConfig:
    """Class name and options of a diffusers scheduler.

    Attributes:
        class_name: Name of the class in diffusers.
        config: Options of the class.
    """

    class_name: str
    config: dict[str, Any]

    @classmethod
    def ddpm(cls, diffusion: Diffusion | None = None) -> SchedulerConfig:
        """Return the paper's sampler, DDPM.

        Args:
            diffusion: Noise schedule; None: that of the paper.

        Returns:
            The config.
        """
        return cls("DDPMScheduler", DDPM_CONFIG | list_schedule_options(diffusion or PAPER_SCHEDULE))

    @classmethod
    def parse(cls, class_name: object, config: dict[str, Any]) -> SchedulerConfig:
        """Check a stored scheduler.

        Args:
            class_name: Name of the class in model_index.json.
            config: Options of the class.

        Returns:
            The config.

        Raises:
            ValueError: The class is unknown, or an option has an invalid value.
        """
        check_entry("the class of the scheduler", class_name, Choice(SCHEDULERS))
        check_entries(config, RULES, others=True)
        for name, value in config.items():
            if name not in RULES and not _is_plain(value):
                raise ValueError(f"{show_value(name)} is {show_value(value)}, expected a plain value")
        return cls(str(class_name), config)

    def require_schedule(self, diffusion: Diffusion) -> None:
        """Raise an error if the scheduler has another noise schedule.

        Args:
            diffusion: Noise schedule with which a model was trained.

        Raises:
            ValueError: An option differs.
        """
        for name, value in list_schedule_options(diffusion).items():
            if self.config.get(name) != value:
                raise ValueError(
                    f"{self.class_name}: {name} is {self.config.get(name)}, but the DiT was trained with {value}"
                )

    @property
    def sampler(self) -> str:
        """Name of the sampler, a key of `SAMPLERS`; for any other scheduler, the name of its class."""
        for name, sampler in SAMPLERS.items():
            if self.class_name == sampler.class_name and self.config | sampler.options == self.config:
                return name
        return self.class_name

    def with_sampler(self, name: str) -> SchedulerConfig:
        """Return a config with the same noise schedule but another sampler.

        Args:
            name: Name of the sampler, a key of `SAMPLERS`; the current name returns this config.

        Returns:
            The new config.

        Raises:
            ValueError: The name is unknown.
        """
        if name == self.sampler:
            return self
        if name not in SAMPLERS:
            raise ValueError(f"sampler {name!r} is unknown, expected one of: {', '.join(SAMPLERS)}")
        return SchedulerConfig(SAMPLERS[name].class_name, self.config | SAMPLERS[name].options)

    def build(self) -> Any:
        """Import diffusers and build the scheduler (a SchedulerMixin).

        Raises:
            ValueError: diffusers has no scheduler with this name, or does not accept the options.
        """
        import diffusers  # DDPM does not need this import, which takes seconds.
        from diffusers.schedulers.scheduling_utils import SchedulerMixin

        kind: Any = getattr(diffusers, self.class_name, None)
        if not (isinstance(kind, type) and issubclass(kind, SchedulerMixin)):
            raise ValueError(f"diffusers has no scheduler {self.class_name!r}")
        try:
            return cast(Any, kind).from_config(self.config)
        except Exception as error:  # The type of the error depends on the scheduler.
            raise ValueError(f"{self.class_name}: diffusers does not accept the options ({error})") from error
