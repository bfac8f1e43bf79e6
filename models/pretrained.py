"""Weights included in the package. Each model has a pipeline directory models/weights/<name> with a model card."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

WEIGHTS = Path(__file__).parent / "weights"
INDEX_NAME = "model_index.json"  # Every pipeline directory contains this file.
CHECKSUMS_NAME = "checksums.json"
TRAINING_NAME = "training.json"  # Facts about the training. Runs that start from these weights read this file.


def list_released() -> list[str]:
    """Return the names of the included weights, which `PrITTIPipeline.from_pretrained` accepts."""
    return sorted(path.parent.name for path in WEIGHTS.glob(f"*/{INDEX_NAME}"))


def find_pipeline_path(model: str | os.PathLike) -> str:
    """Find the local directory of a pipeline; nothing is downloaded.

    Args:
        model: Path of a pipeline directory or name of included weights. If both exist, the path is used.

    Returns:
        Path of the directory.

    Raises:
        ValueError: `model` is neither an existing directory nor the name of included weights.
    """
    model = os.fspath(model)
    if os.path.exists(os.path.join(model, INDEX_NAME)):
        return model
    if model in list_released():
        return str(WEIGHTS / model)
    raise ValueError(
        f"{model}: no PrITTI pipeline here, and no included weights have this name ({', '.join(list_released())})"
    )


def compute_checksums(directory: str | os.PathLike) -> dict[str, str]:
    """Compute the SHA-256 digest of every file that a pipeline loads.

    Args:
        directory: Pipeline directory.

    Returns:
        Mapping from path (relative to `directory`) to hexadecimal digest.
    """
    root = Path(directory)
    files = [root / INDEX_NAME, *sorted(path for path in root.glob("*/*") if path.suffix in (".safetensors", ".json"))]
    return {path.relative_to(root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
