"""Weights that come with the package: one pipeline directory each, models/weights/<name>, with a model card in it."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

WEIGHTS = Path(__file__).parent / "weights"
INDEX_NAME = "model_index.json"  # makes a directory a pipeline's
CHECKSUMS_NAME = "checksums.json"
TRAINING_NAME = "training.json"  # training facts of the model card, for runs that start from these weights


def list_released() -> list[str]:
    """Names that `PrITTIPipeline.from_pretrained` knows."""
    return sorted(path.parent.name for path in WEIGHTS.glob(f"*/{INDEX_NAME}"))


def find_pipeline_path(model: str | os.PathLike) -> str:
    """The directory that a path or a name means; a path goes first. Raises ValueError where there is neither.

    Never looks beyond this machine.
    """
    model = os.fspath(model)
    if os.path.exists(os.path.join(model, INDEX_NAME)):
        return model
    if model in list_released():
        return str(WEIGHTS / model)
    raise ValueError(
        f"{model}: no PrITTI pipeline here, and none of that name comes with the package ({', '.join(list_released())})"
    )


def compute_checksums(directory: str | os.PathLike) -> dict[str, str]:
    """SHA-256 of every file that is loaded from a pipeline's directory, by its path there."""
    root = Path(directory)
    files = [root / INDEX_NAME, *sorted(path for path in root.glob("*/*") if path.suffix in (".safetensors", ".json"))]
    return {path.relative_to(root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
