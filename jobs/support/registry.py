"""Published models in MLflow: a run with the files of a pipeline, and a registered model version for the run."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path

from mlflow.exceptions import MlflowException

from jobs.support.cli import home_path
from jobs.support.tracking import find_tracking_uri, hide_credentials, make_client
from models.pretrained import CHECKSUMS_NAME, INDEX_NAME, compute_checksums

EXPERIMENT = "pritti-zoo"
PIPELINE = "pipeline"  # artifact directory of a publishing run


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

    Args:
        reference: models:/NAME/VERSION or the id of a publishing run.

    Raises:
        ValueError: MLflow does not know the reference, or the files do not match the published checksums.
    """
    api = make_client(find_tracking_uri())
    try:
        run_id = reference
        if reference.startswith("models:/"):
            name, _, version = reference.removeprefix("models:/").rpartition("/")
            run_id = str(api.get_model_version(name, version).run_id)
        directory = os.path.join(home_path("registry"), run_id)
        if os.path.exists(os.path.join(directory, INDEX_NAME)):
            return directory
        os.makedirs(home_path("registry"), exist_ok=True)
        with tempfile.TemporaryDirectory(dir=home_path("registry")) as staging:
            whole = api.download_artifacts(run_id, PIPELINE, staging)
            if compute_checksums(whole) != json.loads(Path(whole, CHECKSUMS_NAME).read_text()):
                raise ValueError(f"{reference}: its files do not match its {CHECKSUMS_NAME}; publish it again")
            if not os.path.exists(directory):  # another process may have finished the same download first
                os.rename(whole, directory)
    except (MlflowException, OSError) as error:
        raise ValueError(
            f"{reference}: no published pipeline in {hide_credentials(find_tracking_uri())} "
            f"({hide_credentials(str(error))}); publish one with jobs/publish_model.py"
        ) from error
    return directory
