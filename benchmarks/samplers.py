"""Measure the errors of samplers with few steps on Gaussian data, where the optimal noise prediction is known.

    python benchmarks/samplers.py

A sampler that adds no noise is linear on such data. For an exact sampler, the standard deviation of the samples divided
by that of the data is 1. Computations use float64, so the results are the same on every machine.
"""

from __future__ import annotations

import warnings
from types import SimpleNamespace

import numpy as np
import torch
from diffusers import DDIMScheduler, DPMSolverMultistepScheduler, SchedulerMixin

from models.sampling.diffusion import Diffusion, sample_with_scheduler
from models.sampling.schedulers import SAMPLERS, SchedulerConfig

DEVIATIONS = (0.02, 0.1, 0.3, 1.0)  # standard deviations of the data, as in components of the latents
STEPS = (10, 20, 25, 50)


def measure_kept_deviation(solver: SchedulerMixin, steps: int, deviation: float) -> float:
    """Return the standard deviation of the samples divided by the standard deviation of the data."""
    alpha_bar = Diffusion().alpha_bar

    def model(latent: torch.Tensor, timestep: torch.Tensor, label: torch.Tensor) -> torch.Tensor:
        a = np.interp(float(timestep[0]), np.arange(len(alpha_bar)), alpha_bar)
        return (1 - a) ** 0.5 * latent / (a * deviation**2 + 1 - a)

    solver.set_timesteps(steps)
    one = SimpleNamespace(draw=lambda: torch.ones((1, 1, 1, 1), dtype=torch.float64))
    drawn = sample_with_scheduler(model, solver, one, torch.zeros(1, dtype=torch.long))
    return drawn.item() / deviation


def main() -> None:
    warnings.filterwarnings("ignore", module="diffusers")
    paper = SchedulerConfig.ddpm()
    base = paper.config
    # The other samplers add noise.
    ways = {name: paper.with_sampler(name).build() for name in SAMPLERS if name not in ("ddpm", "sde-dpm++")}
    ways |= {f"DDIM, {way}": DDIMScheduler.from_config(base, timestep_spacing=way) for way in ("trailing", "linspace")}
    dpm = DPMSolverMultistepScheduler
    ways |= {
        "DPM-Solver++, even in time (trailing)": dpm.from_config(base, timestep_spacing="trailing"),
        "DPM-Solver++, Karras": dpm.from_config(base, use_karras_sigmas=True),
        "third-order DPM-Solver++ with the options of dpm++": dpm.from_config(
            base, use_lu_lambdas=True, solver_order=3
        ),
    }
    print(f"{'steps':>5}  {'deviation of the data':40}", *(f"{deviation:6}" for deviation in DEVIATIONS))
    for steps in STEPS:
        for name, solver in ways.items():
            print(
                f"{steps:5}  {name:40}",
                *(f"{measure_kept_deviation(solver, steps, deviation):6.2f}" for deviation in DEVIATIONS),
            )


if __name__ == "__main__":
    main()
