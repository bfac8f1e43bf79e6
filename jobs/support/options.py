"""Option classes that several jobs share. This module imports no heavy packages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

ModelOption = Annotated[
    str,
    tyro.conf.arg(
        help="Pipeline: a directory, a name (town is included in the package), models:/NAME/VERSION, or the id of an "
        "MLflow run of jobs/publish_model.py (default: the pipeline trained under $PRITTI_HOME, or town)."
    ),
]


IfBusyOption = Annotated[
    Literal["refuse", "wait", "join"],
    tyro.conf.arg(
        help="If another job writes the same output: refuse and name that job, wait until it ends and resume its work, "
        "or join: wait and fail if it fails."
    ),
]


ConstraintsOption = Annotated[
    bool | None,
    tyro.conf.arg(
        help="Guide sampling by constraints, so that objects overlap, float and block roads less often and follow the"
        " streets; write --constraints or --no-constraints (default: as the model stores)."
    ),
]
PagScaleOption = Annotated[
    float | None,
    tyro.conf.arg(
        help="Scale of perturbed-attention guidance from 0 (off) to 20. It brings scenes of town models nearer to the"
        " data (default: as the model stores)."
    ),
]
AddDatasetsOption = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        help="Further dataset directories to train on. The layout covers all datasets; with --start-from, it is that of"
        " the start model (default: none)."
    ),
]
DatasetWeightsOption = Annotated[
    tuple[float, ...],
    tyro.conf.arg(
        help="Relative sampling weights of --dataset and of each of --add-datasets. A dataset with weight 0 is not"
        " sampled; in train_lvae, it widens the layout (default: equal)."
    ),
]
GpusOption = Annotated[
    float | None,
    tyro.conf.arg(
        help="Number of GPUs per model, that is, per actor or training worker; 0 uses CPUs only (default: 1 if the"
        " cluster has a GPU)."
    ),
]
WaitForResourcesOption = Annotated[
    float,
    tyro.conf.arg(
        name="wait-for-resources",
        help="Time in seconds to wait for CPUs and GPUs that the cluster does not have, for example until an autoscaler"
        " has added nodes; 0 fails with a message.",
    ),
]
LogFormatOption = Annotated[
    Literal["text", "json"],
    tyro.conf.arg(help="Format of all lines that the job prints: text, or one JSON object per line."),
]


@dataclass(frozen=True)
class SceneOptions:
    """Options for the scenes that a job reads from a dataset directory."""

    input: str = ""
    """Dataset directory with the scenes (default: $PRITTI_HOME/generated)."""
    source: str = ""
    """Read only scenes of this source (default: all sources)."""
    split: str = ""
    """Read only scenes of this split (default: all splits)."""
    scene_ids: tuple[str, ...] = ()
    """Read only the scenes with these ids; --max-scenes then has no effect (default: the first scenes)."""
    max_scenes: int | None = None
    """Maximum number of scenes; the first scenes are used (default: all)."""


@dataclass(frozen=True)
class PipelineOptions:
    """Options for the pipeline and for the actors that run it."""

    model: ModelOption = ""
    seed: int = 0
    """Random seed."""
    guidance_scale: float = 1.0
    """Classifier-free guidance scale; 1 switches guidance off."""
    constraints: ConstraintsOption = None
    num_actors: int = 1
    """Number of pipelines that run in parallel; use one per GPU."""
    gpus: GpusOption = None
    wait_for_resources_s: WaitForResourcesOption = 0.0


@dataclass(frozen=True)
class GenerationOptions(PipelineOptions, SceneOptions):
    """Options for the scenes to change and for the pipeline."""

    max_scenes: int | None = 1
    """Maximum number of scenes; the first scenes are used."""
    label: str = ""
    """Density label of the generated content (default: the label of each scene)."""


@dataclass(frozen=True)
class RePaintOptions(GenerationOptions):
    """Options for the scenes to change, the pipeline and how it continues the known part of a scene."""

    inpainting: Literal["trained", "guided", "repaint"] | None = None
    """How the model continues known parts. trained: the network reads them, with the sampler that the model stores.
    repaint: RePaint with the options of the paper (Sec. 3.3 and supplement B.3). guided: 50 steps with pseudoinverse
    guidance, eta 0.3 and no resampling (default: trained for models of train_dit.py --inpainting, repaint for the
    paper's presets, else guided)."""
    num_inference_steps: int | None = None
    """Number of denoising steps, without the repetitions of RePaint (default: as the model stores with trained, 250 as
    in the paper with repaint, 50 with guided)."""
    known_guidance_scale: float | None = None
    """Scale of guidance by the known part with --inpainting trained; 1 switches this guidance off (default: 1)."""
    jump_length: int | None = None
    """Jump length of RePaint in steps, J in the paper (default: 10)."""
    num_resamplings: int | None = None
    """Number of times that RePaint passes each step, R in the paper (default: 10 with repaint, 1 with guided)."""
    pseudoinverse_guidance: float | None = None
    """Weight of pseudoinverse guidance towards the known region (default: 0 with repaint, 1 with guided)."""
    eta: float | None = None
    """Share of DDPM's noise that a step adds, 0 to 1 (default: 1 with repaint, as in the paper; 0.3 with guided)."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """Precision of the transformer. bf16 is faster on GPUs and changes scenes by rounding."""
    cuda_graphs: bool = False
    """Replay each denoising step as one CUDA graph; not used in steps with pseudoinverse guidance or without a GPU."""
    compile: bool = False
    """Compile the transformer's block with torch.compile, which takes some seconds; useful on GPUs."""
