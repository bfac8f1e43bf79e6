"""Options shared by the jobs that make given scenes anew or larger: which scenes, with which model, and how."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import tyro

from jobs.support.cli import absolute, home

if TYPE_CHECKING:
    from models.pipeline import Resampling
    from pipelines.schema.scene_subset import Selection


ModelOption = Annotated[
    str,
    tyro.conf.arg(
        help="Pipeline: a directory, a name (town comes with the package), models:/NAME/VERSION or an MLflow run of "
        "jobs/publish_model.py (default: the one trained under $PRITTI_HOME, or town)."
    ),
]


@dataclass(frozen=True)
class GivenScenes:
    """The first scenes of a dataset directory, and what to do with them."""

    model: ModelOption = ""
    input: str = ""
    """Dataset directory with the scenes (default: $PRITTI_HOME/generated)."""
    source: str = ""
    """Source of the scenes (default: whatever is there)."""
    split: str = ""
    """Split of the scenes (default: whatever is there)."""
    limit: int = 1
    """How many scenes, from the first on."""
    label: str = ""
    """Label to aim at (default: the scene's own)."""
    seed: int = 0
    """Another seed, other results."""
    guidance: float = 1.0
    """Classifier-free guidance scale; 1 is none."""
    actors: int = 1
    """Pipelines at work at once; one per GPU."""

    def selection(self) -> Selection:
        from pipelines.schema.scene_subset import Selection

        directory = absolute(self.input) if self.input else home("generated")
        return Selection(directory, self.source or None, self.split or None, self.limit, "first")


@dataclass(frozen=True)
class Repainting(GivenScenes):
    """The same with one set of RePaint's numbers (paper, Sec. 3.3 and supplement B.3)."""

    guided: bool = False
    """50 steps without RePaint's resamplings and with little noise, drawn to what is known: joins better than the paper's numbers and
    keeps more objects, for a twenty-fourth of the work. The options below still change its numbers."""
    steps: int | None = None
    """Denoising steps, those that RePaint repeats not counted (default: the paper's 250, or 50)."""
    jump_length: int | None = None
    """How many steps RePaint rolls back at a time (J of the paper, 10)."""
    resamplings: int | None = None
    """How often it passes the same steps (R of the paper: 10, or 1)."""
    known_guidance: float | None = None
    """How strongly what is made is drawn to what is known (default: 0, not at all, or 1); a step then costs about two."""
    eta: float | None = None
    """How much noise a step adds: 1 as DDPM (the paper), 0 none (default: 1, or 0.3 with --guided)."""

    def resampling(self) -> Resampling:
        from models.pipeline import Resampling

        given = {
            "num_steps": self.steps,
            "jump_length": self.jump_length,
            "resamplings": self.resamplings,
            "known_guidance": self.known_guidance,
            "eta": self.eta,
        }
        start = Resampling.guided() if self.guided else Resampling()
        return replace(start, **{name: value for name, value in given.items() if value is not None})


def require_model_labels(model: str, labels: Iterable[str]) -> None:
    """Raises ValueError for a label that the pipeline in a directory does not know; before torch is imported."""
    from models.labels import require_labels

    require_labels(model_label_kind(model), labels)


def model_label_kind(model: str) -> str:
    """What the pipeline in a directory is conditioned on."""
    from pipelines.runtime import storage

    return storage.read_json(storage.join(model, "dit/config.json"))["label"]


def pipeline_directory(model: str) -> str:
    """Where an option --model points; what MLflow holds is brought to this machine. Raises ValueError if nothing is there.

    Without it: $PRITTI_HOME/models/pritti-town, or the only pipeline trained there, or the weights that come with the
    package.
    """
    from models.pretrained import INDEX, pipeline_path
    from pipelines.runtime import storage

    if not model:
        found = [path.removesuffix(f"/{INDEX}") for path in storage.list_files(home("models"), INDEX)]
        if (town := home("models", "pritti-town")) in found:
            return town
        if len(found) > 1:
            raise ValueError(f"no --model, and several were trained here; name one of: {', '.join(sorted(found))}")
        return found[0] if found else pipeline_path("town")
    for directory in (absolute(model), home("zoo", model)):
        if storage.exists(storage.join(directory, INDEX)):
            return directory
    if re.fullmatch(r"models:/.+|[0-9a-f]{32}", model):
        from jobs.support.registry import downloaded

        return downloaded(model)
    return pipeline_path(model)
