"""Find the pipeline that --model names. Importing this module imports neither torch nor MLflow."""

from __future__ import annotations

import re
from collections.abc import Iterable

from jobs.support.cli import home_path, make_absolute
from models.labels import LABELS, require_labels
from models.options import Choice, check_entries
from models.pretrained import INDEX_NAME, find_pipeline_path
from models.uris import is_uri, split_name
from pipelines.runtime import storage


def require_model_labels(model: str, labels: Iterable[str]) -> None:
    """Check labels against the pipeline in a directory.

    Raises:
        ValueError: The pipeline does not know a label.
    """
    require_labels(read_label_kind(model), labels)


def read_label_kind(model: str) -> str:
    """Return the kind of label that the pipeline in a directory is conditioned on.

    Raises:
        ValueError: The config of the DiT is missing or damaged, or its label is unknown.
    """
    path = storage.join_uri(model, "dit/config.json")
    try:
        check_entries(storage.read_json(path), {"label": Choice(tuple(LABELS))}, required=("label",), others=True)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return storage.read_json(path)["label"]


def is_inpainting_model(model: str) -> bool:
    """Return whether the transformer of the pipeline in a directory reads known parts of a scene."""
    return storage.read_json(storage.join_uri(model, "dit/config.json")).get("inpainting", False) is True


def uses_paper_outpainting(model: str) -> bool:
    """Return whether the pipeline in a directory inpaints and outpaints as in the paper by default."""
    return storage.read_json(storage.join_uri(model, INDEX_NAME)).get("neighbour_latents") == "paper"


def find_pipeline_directory(model: str) -> str:
    """Return the directory of the pipeline that --model names; a pipeline in MLflow is downloaded first.

    If --model is empty, there are three defaults in this order: $PRITTI_HOME/models/pritti-town, the only pipeline
    under $PRITTI_HOME/models, and the released weights.

    Args:
        model: Value of --model: a directory, a name, models:/NAME/VERSION, the id of an MLflow run, or empty.

    Returns:
        Directory or URI of the pipeline.

    Raises:
        ValueError: There is no such pipeline, or --model is empty and there are several trained pipelines.
    """
    if not model:
        found = [split_name(path)[0] for path in storage.list_files(home_path("models"), INDEX_NAME)]
        if (town := home_path("models", "pritti-town")) in found:
            return town
        if len(found) > 1:
            raise ValueError(
                "--model is missing and several pipelines were trained here; "
                f"specify one of: {', '.join(sorted(found))}"
            )
        return found[0] if found else find_pipeline_path("town")
    for directory in (make_absolute(model), *([] if is_uri(model) else [home_path("zoo", model)])):
        if storage.exists(storage.join_uri(directory, INDEX_NAME)):
            return directory
    if re.fullmatch(r"models:/.+|[0-9a-f]{32}", model):
        from jobs.support.registry import download_pipeline  # imported here because it imports MLflow

        return download_pipeline(model)
    return find_pipeline_path(model)
