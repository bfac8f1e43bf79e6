"""MLflow tracking from the driver and from rank 0. A training run has one MLflow run, which is reused on resumption."""

from __future__ import annotations

import json
import logging
import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import ray
from PIL import Image

from jobs.support.cli import home_path, require_tracking_uri
from models.uris import parse_s3_options, split_options
from pipelines.runtime import provenance, storage
from pipelines.runtime.machines import find_start_time, identify_machine, is_process_alive

OWNER = "owner"  # Tag with the driver of a run.


def find_tracking_uri() -> str:
    """Return $MLFLOW_TRACKING_URI, or the URI of an sqlite file under $PRITTI_HOME.

    Raises:
        ValueError: $PRITTI_HOME is a URI, and $MLFLOW_TRACKING_URI is not set.
    """
    require_tracking_uri()
    return os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{home_path('mlflow.db')}"


def hide_credentials(uri: str) -> str:
    """Return a URI without user and password, for use in messages."""
    return re.sub(r"//[^/@]*@", "//", uri)


def find_artifact_settings() -> dict[str, str]:
    """Return the variables that MLflow and boto3 need to write artifacts to the storage of $PRITTI_HOME.

    MLflow knows no options of URIs, so the options become variables. Variables that the user has set have precedence.
    Credentials are left out.
    """
    base, options = split_options(home_path("mlartifacts"))
    found = parse_s3_options(options.lstrip("?")) if base.startswith("s3://") else {}
    settings = {}
    if endpoint := found.get("endpoint_override"):
        settings["MLFLOW_S3_ENDPOINT_URL"] = f"{found.get('scheme', 'https')}://{endpoint}"
    if region := found.get("region"):
        settings["AWS_DEFAULT_REGION"] = region
    names = ("MLFLOW_S3_ENDPOINT_URL", "MLFLOW_S3_IGNORE_TLS", "AWS_ENDPOINT_URL", "AWS_DEFAULT_REGION")
    return settings | {name: os.environ[name] for name in names if os.environ.get(name)}


@contextmanager
def explain_errors(uri: str) -> Iterator[None]:
    """Convert errors of MLflow and of its storage to one line with the remedy.

    Args:
        uri: Tracking URI.

    Yields:
        None.

    Raises:
        OSError: MLflow or the storage of its artifacts cannot be used.
    """
    try:
        yield
    except (ValueError, OSError):
        raise
    except Exception as error:
        reason = str(error).split("\n", 1)[0]
        raise OSError(
            f"MLflow ({hide_credentials(uri)}) or the storage of its artifacts cannot be used ({type(error).__name__}:"
            f" {reason}); check MLFLOW_TRACKING_URI, MLFLOW_S3_ENDPOINT_URL and the keys, then run the command again"
        ) from error


def make_client(uri: str):
    """Return an MLflow client without log noise and telemetry."""
    os.environ.setdefault("DO_NOT_TRACK", "true")
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    from mlflow import MlflowClient  # mlflow reads the variables above when it is imported

    for name in ("alembic", "mlflow"):  # importing mlflow sets the levels of these loggers
        logging.getLogger(name).setLevel(logging.WARNING)
    return MlflowClient(tracking_uri=uri)


def describe_owner() -> dict[str, Any]:
    """Describe this driver: its process, and its job in a Ray cluster."""
    owner: dict[str, Any] = {
        "machine": identify_machine(),
        "process": os.getpid(),
        "start_time": find_start_time(os.getpid()),
    }
    if ray.is_initialized():
        context = ray.get_runtime_context()
        owner |= {"session": context.get_session_name(), "ray_job": context.get_job_id()}
    return owner


def is_owner_dead(owner: dict[str, Any]) -> bool:
    """Return whether the driver of a run has certainly ended; a driver of an unknown cluster may live."""
    if owner.get("machine") == identify_machine():
        return not is_process_alive(int(owner["process"]), str(owner["start_time"]))
    if not ray.is_initialized() or owner.get("session") != ray.get_runtime_context().get_session_name():
        return False
    from ray._private.state import state

    jobs = {job["JobID"]: job["IsDead"] for job in state.job_table()}
    return bool(jobs.get(owner.get("ray_job"), True))


def close_dead_runs(api: Any, experiment_id: str) -> None:
    """Set the status of runs to KILLED whose drivers ended without setting it.

    Args:
        api: MLflow client.
        experiment_id: Experiment.
    """
    for run in api.search_runs([experiment_id], "attributes.status = 'RUNNING'"):
        try:
            is_dead = is_owner_dead(json.loads(run.data.tags[OWNER]))
        except (KeyError, ValueError, TypeError):  # Runs of earlier versions do not name their owner.
            continue
        if is_dead:
            api.set_terminated(run.info.run_id, "KILLED")


class Tracker:
    """Write to one MLflow run. A tracker can be pickled, because each process opens its own client."""

    def __init__(self, uri: str, run_id: str, settings: dict[str, str] | None = None) -> None:
        self.uri, self.run_id, self.settings = uri, run_id, settings or {}
        self._client = None

    def __getstate__(self) -> dict:
        return self.__dict__ | {"_client": None}

    @property
    def client(self):
        """MLflow client of this process. Workers do not have the driver's variables, so the tracker sets them."""
        if self._client is None:
            for name, value in self.settings.items():
                os.environ.setdefault(name, value)
            self._client = make_client(self.uri)
        return self._client

    @classmethod
    def start(cls, experiment: str, name: str, parameters: dict, record: str | None = None) -> Tracker:
        """Return a tracker of the MLflow run that the file `record` names, or of a new MLflow run.

        Call this method only in the driver. Two processes that create the database concurrently would damage the
        database.

        Args:
            experiment: Name of the MLflow experiment.
            name: Name of the MLflow run.
            parameters: Parameters to log for a new run.
            record: JSON file with the id of the MLflow run; a new run writes this file (None: no file).

        Returns:
            The tracker.
        """
        uri = find_tracking_uri()
        if uri.startswith("sqlite:///"):
            Path(uri.removeprefix("sqlite:///")).parent.mkdir(parents=True, exist_ok=True)
        settings = find_artifact_settings()
        for name, value in settings.items():
            os.environ.setdefault(name, value)
        api = make_client(uri)
        if (found := api.get_experiment_by_name(experiment)) is not None:
            close_dead_runs(api, found.experiment_id)
        known = storage.read_json(record) if record and storage.exists(record) else {"tracking_uri": ""}
        if hide_credentials(known["tracking_uri"]) == hide_credentials(uri):
            api.update_run(known["run_id"], status="RUNNING")
            api.set_tag(known["run_id"], OWNER, json.dumps(describe_owner()))
            return cls(uri, known["run_id"], settings)
        if found is None:
            artifacts = split_options(home_path("mlartifacts"))[0] if uri.startswith("sqlite:") else None
            experiment_id = api.create_experiment(experiment, artifact_location=artifacts)
        else:
            experiment_id = found.experiment_id
        run_id = api.create_run(experiment_id, run_name=name).info.run_id
        for key, value in parameters.items():
            api.log_param(run_id, key, value)
        tags = {
            "command": provenance.format_command(),
            "commit": provenance.find_commit(),
            "machine": provenance.describe_machine(),
            "versions": provenance.list_versions(),
            OWNER: json.dumps(describe_owner()),
        }
        for key, value in tags.items():
            api.set_tag(run_id, key, value)
        if record:
            storage.write_json({"tracking_uri": hide_credentials(uri), "run_id": run_id}, record)
        return cls(uri, run_id, settings)

    @contextmanager
    def end_on_error(self) -> Iterator[Tracker]:
        """Set the status of the run to KILLED or FAILED if the body does not end normally.

        Yields:
            This tracker.
        """
        try:
            yield self
        except BaseException as error:
            self.finish("KILLED" if isinstance(error, KeyboardInterrupt) else "FAILED")
            raise

    def metrics(self, values: dict[str, float], step: int) -> None:
        """Log values by name for a training step."""
        from mlflow.entities import Metric  # imported after `client` has set MLflow's environment variables

        now = int(time.time() * 1000)
        with explain_errors(self.uri):
            self.client.log_batch(self.run_id, metrics=[Metric(k, float(v), now, step) for k, v in values.items()])

    def tag(self, key: str, value: str) -> None:
        """Set a tag of the run."""
        with explain_errors(self.uri):
            self.client.set_tag(self.run_id, key, value)

    def picture(self, image, path: str) -> None:
        """Log a picture (H, W, 3) uint8 as an artifact."""
        with explain_errors(self.uri):
            self.client.log_image(self.run_id, Image.fromarray(image), artifact_file=path)

    def artifacts(self, directory: str, path: str) -> None:
        """Log the files of a directory as artifacts under `path`."""
        with explain_errors(self.uri):
            self.client.log_artifacts(self.run_id, directory, path)

    def history(self, name: str) -> list[tuple[int, float]]:
        """Return (step, value) of a metric, ordered by step.

        If a resumed run repeats a step, the last value of this step is returned.
        """
        values = {m.step: m.value for m in self.client.get_metric_history(self.run_id, name)}
        return sorted(values.items())

    def finish(self, status: str) -> None:
        """Set the status of the run: FINISHED, FAILED or KILLED."""
        self.client.set_terminated(self.run_id, status)
