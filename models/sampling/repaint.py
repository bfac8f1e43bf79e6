"""Options of inpainting and outpainting.

RePaint (Lugmayr et al., 2022; paper, supplement B.3, Applications) works with every network. Networks that were trained
to continue known parts need no RePaint.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from models.sampling.diffusion import MAX_GUIDANCE_SCALE

NUM_INFERENCE_STEPS = 250  # Paper, supplement B.3.
JUMP_LENGTH, RESAMPLINGS = 10, 10  # J and R of the paper (supplement B.3).


def repaint_transitions(
    num_inference_steps: int, jump_length: int = JUMP_LENGTH, resamplings: int = RESAMPLINGS
) -> list[tuple[int, int]]:
    """List the transitions (from, to) between the states of RePaint.

    After every `jump_length` states, RePaint adds the noise of these states again and repeats the denoising. For
    example, with 250 steps and J = R = 10, RePaint jumps back nine times from each of the states 0, 10, ..., 230. This
    gives 2,410 denoising steps.

    Args:
        num_inference_steps: Number of timesteps that sampling uses.
        jump_length: Number of states by which a jump goes back to more noise (J in the paper).
        resamplings: Number of passes over the same states (R in the paper).

    Returns:
        List of transitions in the order of sampling.

    Raises:
        ValueError: `jump_length` or `resamplings` is below 1.
    """
    if jump_length < 1 or resamplings < 1:
        raise ValueError(f"jump_length {jump_length} and resamplings {resamplings} must be at least 1")
    jumps_left = {state: resamplings - 1 for state in range(0, num_inference_steps - jump_length, jump_length)}
    transitions, state = [], num_inference_steps - 1
    while state >= 0:
        transitions.append((state, state - 1))
        state -= 1
        if jumps_left.get(state, 0) > 0:
            jumps_left[state] -= 1
            transitions += [(state + i, state + i + 1) for i in range(jump_length)]
            state += jump_length
    return transitions


@dataclass(frozen=True)
class TrainedInpainting:
    """Options of inpainting and outpainting with a network that reads the known part (`models.dit.DiT`).

    The sampler is that of the pipeline.

    Attributes:
        num_inference_steps: Number of denoising steps; None: the default of the pipeline.
        known_guidance_scale: Scale of guidance by the known part (`models.sampling.diffusion.with_known`); 1 switches
            this guidance off.
        pag_factor: Factor of the scale of perturbed-attention guidance; None: `street_pag_factor` of the pipeline if
            all streets are known, else 1.

    Raises:
        ValueError: The guidance scale or the factor is out of range.
    """

    num_inference_steps: int | None = None
    known_guidance_scale: float = 1.0
    pag_factor: float | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.known_guidance_scale <= MAX_GUIDANCE_SCALE:
            raise ValueError(
                f"known_guidance_scale is {self.known_guidance_scale}, expected 0 to {MAX_GUIDANCE_SCALE:g}; 1 switches"
                " the guidance off"
            )
        if self.pag_factor is not None and not 0 <= self.pag_factor <= 1:
            raise ValueError(f"pag_factor is {self.pag_factor}, expected 0 to 1")

    @property
    def num_evaluations(self) -> int:
        """Number of denoising steps; `PrITTIPipeline.resolve_inpainting` sets it."""
        return self.num_inference_steps or 0


@dataclass(frozen=True)
class RePaintConfig:
    """Options of inpainting and outpainting with any network. The defaults are those of the paper.

    Attributes:
        num_inference_steps: Number of timesteps that sampling uses.
        jump_length: Number of states by which a jump goes back to more noise (J in the paper).
        resamplings: Number of passes over the same states (R in the paper).
        pseudoinverse_guidance: Weight of pseudo-inverse guidance towards the known region; 0 switches it off.
        eta: Fraction of the noise of DDPM that each step adds, in [0, 1]. If the number of steps is small, this noise
            removes small objects.

    Raises:
        ValueError: A value is out of range.
    """

    num_inference_steps: int = NUM_INFERENCE_STEPS
    jump_length: int = JUMP_LENGTH
    resamplings: int = RESAMPLINGS
    pseudoinverse_guidance: float = 0.0
    eta: float = 1.0

    @classmethod
    def guided(cls, num_inference_steps: int = 50) -> RePaintConfig:
        """Return options with pseudo-inverse guidance instead of resampling.

        Compared with the paper's options, these options give fewer visible seams and more objects, and sampling is 24
        times as fast.

        Args:
            num_inference_steps: Number of timesteps that sampling uses.

        Returns:
            The options.
        """
        return cls(num_inference_steps, resamplings=1, pseudoinverse_guidance=1.0, eta=0.3)

    def __post_init__(self) -> None:
        if not 0 <= self.eta <= 1:
            raise ValueError(f"eta is {self.eta}, expected a number from 0 (no noise) to 1 (as in the paper)")
        if not 0 <= self.pseudoinverse_guidance < math.inf:
            raise ValueError(
                f"pseudoinverse_guidance is {self.pseudoinverse_guidance}, expected 0 (none) or more; 1 is usual"
            )

    def transitions(self) -> list[tuple[int, int]]:
        """Return the transitions between states (see `repaint_transitions`)."""
        return repaint_transitions(self.num_inference_steps, self.jump_length, self.resamplings)

    @property
    def num_evaluations(self) -> int:
        """Number of denoising steps."""
        return sum(to < state for state, to in self.transitions())


InpaintingConfig = RePaintConfig | TrainedInpainting


def choose_inpainting(way: str | None, reads_known: bool, is_of_paper: bool) -> InpaintingConfig:
    """Return options of inpainting and outpainting by name.

    Args:
        way: "trained", "guided" or "repaint". None: "trained" for a network that reads the known part, "repaint" for
            models of the paper's presets, and "guided" for the others.
        reads_known: Whether the network reads the known part.
        is_of_paper: Whether the model belongs to the paper's presets.

    Returns:
        The options.

    Raises:
        ValueError: The network cannot read a known part, or the name is unknown.
    """
    way = way or ("trained" if reads_known else "repaint" if is_of_paper else "guided")
    if way == "trained" and not reads_known:
        raise ValueError(
            "this model is no inpainting model; use guided or repaint, or a model of train_dit.py --inpainting"
        )
    configs = {"trained": TrainedInpainting(), "guided": RePaintConfig.guided(), "repaint": RePaintConfig()}
    if way not in configs:
        raise ValueError(f"inpainting is {way!r}, expected one of: {', '.join(configs)}")
    return configs[way]
