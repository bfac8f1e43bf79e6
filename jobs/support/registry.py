"""Published models in MLflow: a run with the files of a pipeline, and a registered model version for the run."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

from mlflow.exceptions import MlflowException

from jobs.support.cli import home_path
from jobs.support.model_files import publish_directory
from jobs.support.tracking import find_tracking_uri, hide_credentials, make_client
from models.base import MAX_CONFIG_BYTES
from models.options import show_value
from models.pretrained import CHECKSUMS_NAME, INDEX_NAME, compute_checksums
from models.strict_json import parse_json
from pipelines.runtime import storage

EXPERIMENT = "pritti-zoo"
PIPELINE = "pipeline"  # artifact directory of a publishing run
RUN_ID = re.compile(r"[0-9a-f]{32}")
REFERENCE = re.compile(r"models:/([^/:%\\]{1,200})/([0-9]{1,9})")


def register_version(name: str, run_id: str) -> str:
    """Register the pipeline of a publishing run as the next version of a model.

    Args:
        name: Name of the registered model.
        run_id: Id of the MLflow run that holds the files of the pipeline.

    Returns:
        Reference models:/NAME/VERSION.
    """
    api = make_client(find_tracking_uri())
    try:
        api.get_registered_model(name)
    except MlflowException:
        api.create_registered_model(name, description="PrITTI on Ray: layout VAE and diffusion transformer")
    source = f"{api.get_run(run_id).info.artifact_uri}/{PIPELINE}"
    version = api.create_model_version(name, source, run_id, await_creation_for=0)
    return f"models:/{name}/{version.version}"


def download_pipeline(reference: str) -> str:
    """Copy a published pipeline to $PRITTI_HOME/registry if it is not there, and return its directory.

    All nodes of a cluster read this directory, so it is not in the local cache.

    Args:
        reference: models:/NAME/VERSION or the id of a publishing run.

    Returns:
        Directory or URI.

    Raises:
        ValueError: MLflow does not know the reference, or the files do not match the published checksums.
    """
    api = make_client(find_tracking_uri())
    try:
        run_id = reference
        if reference.startswith("models:/"):
            if not (match := REFERENCE.fullmatch(reference)):
                raise ValueError(f"{show_value(reference)}: expected models:/NAME/VERSION with a whole number")
            run_id = api.get_model_version(match[1], match[2]).run_id
        if not isinstance(run_id, str) or not RUN_ID.fullmatch(run_id):  # The id becomes the name of a folder.
            raise ValueError(
                f"{reference}: {show_value(run_id)} is no id of an MLflow run, expected 32 digits 0-9, a-f"
            )
        directory = home_path("registry", run_id)
        if storage.exists(storage.join_uri(directory, INDEX_NAME)):
            return directory
        with tempfile.TemporaryDirectory() as staging:
            whole = api.download_artifacts(run_id, PIPELINE, staging)
            require_plain_files(whole, staging)
            if compute_checksums(whole) != read_checksums(Path(whole, CHECKSUMS_NAME)):
                raise ValueError(f"{reference}: its files do not match its {CHECKSUMS_NAME}; publish it again")
            publish_directory(whole, directory)
    except (MlflowException, OSError) as error:
        raise ValueError(
            f"{reference}: no published pipeline in {hide_credentials(find_tracking_uri())} "
            f"({hide_credentials(str(error))}); publish one with jobs/publish_model.py"
        ) from error
    return directory


def require_plain_files(directory: str, parent: str) -> None:
    """Raise an error if a downloaded directory lies outside its parent or contains links or special files.

    Args:
        directory: Downloaded directory.
        parent: Directory that must contain it.

    Raises:
        ValueError: A path leads out of the directory, or is neither a regular file nor a directory.
    """
    if not Path(directory).resolve().is_relative_to(Path(parent).resolve()):
        raise ValueError(f"{directory}: the download lies outside {parent}")
    for path in Path(directory).rglob("*"):
        if path.is_symlink() or not (path.is_file() or path.is_dir()):
            raise ValueError(f"{path}: a published pipeline holds only regular files; publish it again")


def read_checksums(path: Path) -> dict[str, str]:
    """Read published checksums.

    Args:
        path: JSON file with one SHA-256 digest per file.

    Returns:
        Mapping from relative path to hexadecimal digest.

    Raises:
        ValueError: The file is missing, is too large, or does not map names to digests.
    """
    try:
        if path.stat().st_size > MAX_CONFIG_BYTES:
            raise ValueError(f"larger than {MAX_CONFIG_BYTES:,} bytes")
        content = parse_json(path.read_bytes())
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: no checksums ({error}); publish the pipeline again") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: holds {show_value(content)}, expected an object of SHA-256 digests")
    for name, digest in content.items():
        if not isinstance(digest, str) or not re.fullmatch(r"[0-9a-f]{64}", digest):
            raise ValueError(f"{path}: {show_value(name)} is {show_value(digest)}, expected a SHA-256 digest")
    return content
