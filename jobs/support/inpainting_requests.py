"""Convert options of jobs that continue known parts of scenes to arguments of pipelines/."""

from __future__ import annotations

from dataclasses import replace

from jobs.support.model_directories import is_inpainting_model, uses_paper_outpainting
from jobs.support.options import RePaintOptions
from models.execution import SamplingExecution
from models.sampling.repaint import InpaintingConfig, TrainedInpainting, choose_inpainting


def make_execution(options: RePaintOptions) -> SamplingExecution:
    """Return how the model runs."""
    return SamplingExecution(options.precision, options.cuda_graphs, options.compile)


def make_inpainting_config(options: RePaintOptions, model: str) -> InpaintingConfig:
    """Return how the pipeline in a directory continues known parts.

    Raises:
        ValueError: The model is no inpainting model, or an option has no effect.
    """
    try:
        start = choose_inpainting(options.inpainting, is_inpainting_model(model), uses_paper_outpainting(model))
    except ValueError as error:
        raise ValueError(f"--inpainting {options.inpainting}, --model {model}: {error}") from error
    of_repaint = {
        "jump_length": options.jump_length,
        "resamplings": options.num_resamplings,
        "pseudoinverse_guidance": options.pseudoinverse_guidance,
        "eta": options.eta,
    }
    given = {name: value for name, value in of_repaint.items() if value is not None}
    if isinstance(start, TrainedInpainting):
        if given:
            names = ", ".join("--" + name.replace("resamplings", "num_resamplings").replace("_", "-") for name in given)
            raise ValueError(f"{names} has no effect with --inpainting trained; add --inpainting repaint or guided")
        if options.known_guidance_scale is not None:
            start = replace(start, known_guidance_scale=options.known_guidance_scale)
        return replace(start, num_inference_steps=options.num_inference_steps)
    if options.known_guidance_scale is not None:
        raise ValueError("--known-guidance-scale has no effect without a network that reads known parts")
    if options.num_inference_steps is not None:
        given["num_inference_steps"] = options.num_inference_steps
    return replace(start, **given)
