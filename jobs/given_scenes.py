"""Options shared by the jobs that make given scenes anew or larger: which scenes, with which model, and how."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from jobs.command import absolute, home

if TYPE_CHECKING:
    from models.pipeline import Resampling
    from pipelines.selection import Selection


@dataclass(frozen=True)
class GivenScenes:
    """The first scenes of a dataset directory, and what to do with them."""

    model: str = ""
    """Pipeline directory (default: $PRITTI_HOME/models/pritti-town)."""
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
        from pipelines.selection import Selection

        directory = absolute(self.input) if self.input else home("generated")
        return Selection(directory, self.source or None, self.split or None, self.limit, "first")


@dataclass(frozen=True)
class Repainting(GivenScenes):
    """The same with one set of RePaint's numbers (paper, Sec. 3.3 and supplement B.3)."""

    steps: int = 250
    """Denoising steps, those that RePaint repeats not counted."""
    jump_length: int = 10
    """How many steps RePaint rolls back at a time (J of the paper)."""
    resamplings: int = 10
    """How often it passes the same steps (R of the paper)."""

    def resampling(self) -> Resampling:
        from models.pipeline import Resampling

        return Resampling(self.steps, self.jump_length, self.resamplings)


def require_model_labels(model: str, labels: Iterable[str]) -> None:
    """Raises ValueError for a label that the pipeline in a directory does not know; before torch is imported."""
    from models.labels import require_labels

    require_labels(model_label_kind(model), labels)


def model_label_kind(model: str) -> str:
    """What the pipeline in a directory is conditioned on."""
    from pipelines import storage

    return storage.read_json(storage.join(model, "dit/config.json"))["label"]


def pipeline_directory(model: str) -> str:
    """Where an option --model points. Raises ValueError if no trained pipeline is there."""
    from pipelines import storage

    directory = absolute(model) if model else home("models", "pritti-town")
    if not model and not storage.exists(storage.join(directory, "model_index.json")):
        found = storage.list_files(home("models"), "model_index.json")
        if len(found) == 1:  # the only one there is
            return found[0].removesuffix("/model_index.json")
    if not storage.exists(storage.join(directory, "model_index.json")):
        raise ValueError(f"{directory}: no PrITTI pipeline here; run jobs/train_dit.py first")
    return directory
