"""Convert shared options to arguments of pipelines/: the scenes to read and the RePaint settings."""

from __future__ import annotations

from dataclasses import replace

from jobs.support.cli import resolve_path
from jobs.support.options import RePaintOptions, SceneOptions
from models.execution import SamplingExecution
from models.sampling.repaint import RePaintConfig
from pipelines.schema.scene_subset import SceneSubset


def select_scenes(options: SceneOptions) -> SceneSubset:
    """Return the subset of scenes that the options select."""
    directory = resolve_path(options.input, "generated")
    return SceneSubset(directory, options.source or None, options.split or None, options.max_scenes, "first")


def make_execution(options: RePaintOptions) -> SamplingExecution:
    """Return how the model runs."""
    return SamplingExecution(options.precision, options.cuda_graphs, options.compile)


def make_repaint_config(options: RePaintOptions) -> RePaintConfig:
    """Return the RePaint settings of the paper or of --guided, after changing the values that other options set."""
    given = {
        "num_inference_steps": options.num_inference_steps,
        "jump_length": options.jump_length,
        "resamplings": options.num_resamplings,
        "pseudoinverse_guidance": options.pseudoinverse_guidance,
        "eta": options.eta,
    }
    start = RePaintConfig.guided() if options.guided else RePaintConfig()
    return replace(start, **{name: value for name, value in given.items() if value is not None})
