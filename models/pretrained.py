"""Weights included in the package. Each model has a pipeline directory models/weights/<name> with a model card."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from models.local_copy import make_local_copy
from models.uris import is_uri

WEIGHTS = Path(__file__).parent / "weights"
INDEX_NAME = "model_index.json"  # Every pipeline directory contains this file.
CHECKSUMS_NAME = "checksums.json"
TRAINING_NAME = "training.json"  # Facts about the training. Runs that start from these weights read this file.


def list_released() -> list[str]:
    """Return the names of the included weights, which `PrITTIPipeline.from_pretrained` accepts."""
    return sorted(path.parent.name for path in WEIGHTS.glob(f"*/{INDEX_NAME}"))


def find_pipeline_path(model: str | os.PathLike) -> str:
    """Find the local directory of a pipeline. Model hubs are not asked.

    Args:
        model: Path of a pipeline directory, URI of a pipeline directory, or name of included weights. If both a path
            and a name exist, the path is used. A URI is copied to the local cache (models/local_copy.py).

    Returns:
        Path of the directory.

    Raises:
        ValueError: `model` is neither an existing directory nor the name of included weights.
    """
    model = os.fspath(model)
    if is_uri(model):
        copy = make_local_copy(model, is_pipeline_file)
        if not os.path.exists(os.path.join(copy, INDEX_NAME)):
            raise ValueError(f"{model}: no PrITTI pipeline here; {INDEX_NAME} is missing")
        return copy
    if os.path.exists(os.path.join(model, INDEX_NAME)):
        return model
    if model in list_released():
        return str(WEIGHTS / model)
    raise ValueError(
        f"{model}: no PrITTI pipeline here, and no included weights have this name ({', '.join(list_released())})"
    )


def is_pipeline_file(name: str) -> bool:
    """Return whether a pipeline loads a file.

    Args:
        name: Path of the file relative to the pipeline directory.

    Returns:
        Whether the file belongs to a pipeline.
    """
    return name == INDEX_NAME or (name.count("/") == 1 and name.endswith((".safetensors", ".json")))


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
