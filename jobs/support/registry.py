"""Published models in MLflow: a run with the pipeline's files, and a version of a registered model that points to it."""

from __future__ import annotations

import os

from jobs.support.cli import home
from jobs.support.tracking import client, shown, tracking_uri

EXPERIMENT = "pritti-zoo"
PIPELINE = "pipeline"  # artifact directory of a publishing run


def registered(name: str, run_id: str) -> str:
    """Register a publishing run's pipeline as the next version of a model; models:/NAME/VERSION."""
    from mlflow.exceptions import MlflowException

    api = client(tracking_uri())
    try:
        api.get_registered_model(name)
    except MlflowException:
        api.create_registered_model(name, description="PrITTI on Ray: layout VAE and diffusion transformer")
    source = f"{api.get_run(run_id).info.artifact_uri}/{PIPELINE}"
    version = api.create_model_version(name, source, run_id, await_creation_for=None)
    return f"models:/{name}/{version.version}"


def downloaded(reference: str) -> str:
    """The directory with the pipeline that models:/NAME/VERSION or the id of a publishing run means.

    Copied to $PRITTI_HOME/registry once, whole or not at all. Raises ValueError for what MLflow does not know, or for
    files that are not those that were published.
    """
    import json
    import tempfile
    from pathlib import Path

    from mlflow.exceptions import MlflowException

    from models.pretrained import CHECKSUMS, INDEX, checksums

    api = client(tracking_uri())
    try:
        run_id = reference
        if reference.startswith("models:/"):
            name, _, version = reference.removeprefix("models:/").rpartition("/")
            run_id = api.get_model_version(name, version).run_id
        directory = os.path.join(home("registry"), run_id)
        if os.path.exists(os.path.join(directory, INDEX)):
            return directory
        os.makedirs(home("registry"), exist_ok=True)
        with tempfile.TemporaryDirectory(dir=home("registry")) as staging:
            whole = api.download_artifacts(run_id, PIPELINE, staging)
            if checksums(whole) != json.loads(Path(whole, CHECKSUMS).read_text()):
                raise ValueError(f"{reference}: its files are not those of its {CHECKSUMS}; publish it again")
            if not os.path.exists(directory):  # or another process was quicker
                os.rename(whole, directory)
    except (MlflowException, OSError) as error:
        raise ValueError(
            f"{reference}: no published pipeline in {shown(tracking_uri())} ({shown(str(error))}); jobs/publish_model.py makes them"
        ) from error
    return directory
