"""MLflow, from the driver and from rank 0 only: one run per training run, found again when it resumes."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path

from jobs.support.cli import home
from pipelines.runtime import provenance, storage

METRICS_PER_CALL = 1000  # MLflow's limit


def tracking_uri() -> str:
    """$MLFLOW_TRACKING_URI, or an sqlite file under $PRITTI_HOME."""
    return os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{home('mlflow.db')}"


def shown(uri: str) -> str:
    """A tracking URI for messages: without the user and password that it may hold."""
    return re.sub(r"//[^/@]*@", "//", uri)


def client(uri: str):
    """An MLflow client. Quiet, and without a call home."""
    os.environ.setdefault("DO_NOT_TRACK", "true")
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    import logging

    from mlflow import MlflowClient

    for name in ("alembic", "mlflow"):  # which mlflow's import has set
        logging.getLogger(name).setLevel(logging.WARNING)
    return MlflowClient(tracking_uri=uri)


class Tracker:
    """Writes to one MLflow run. Picklable: workers open their own client."""

    def __init__(self, uri: str, run_id: str) -> None:
        self.uri, self.run_id = uri, run_id
        self._client = None

    def __getstate__(self) -> dict:
        return self.__dict__ | {"_client": None}

    @property
    def client(self):
        self._client = self._client or client(self.uri)
        return self._client

    @classmethod
    def start(cls, experiment: str, name: str, parameters: dict, record: str | None = None) -> Tracker:
        """The MLflow run that the file `record` names, so that a resumed run goes on in it, or a new one.

        Called once, in the driver: two processes creating the database at once would break it.
        """
        uri = tracking_uri()
        if record and storage.exists(record) and (known := storage.read_json(record))["tracking_uri"] == uri:
            client(uri).update_run(known["run_id"], status="RUNNING")
            return cls(uri, known["run_id"])
        if uri.startswith("sqlite:///"):
            Path(uri.removeprefix("sqlite:///")).parent.mkdir(parents=True, exist_ok=True)
        api = client(uri)
        found = api.get_experiment_by_name(experiment)
        if found is None:
            artifacts = home("mlartifacts") if uri.startswith("sqlite:") else None
            experiment_id = api.create_experiment(experiment, artifact_location=artifacts)
        else:
            experiment_id = found.experiment_id
        run_id = api.create_run(experiment_id, run_name=name).info.run_id
        for key, value in parameters.items():
            api.log_param(run_id, key, value)
        for key in ("command", "commit", "machine", "versions"):
            api.set_tag(run_id, key, getattr(provenance, key)())
        if record:
            storage.write_json({"tracking_uri": uri, "run_id": run_id}, record)
        return cls(uri, run_id)

    def metrics(self, values: dict[str, float], step: int) -> None:
        import time

        from mlflow.entities import Metric

        now = int(time.time() * 1000)
        self.client.log_batch(self.run_id, metrics=[Metric(k, float(v), now, step) for k, v in values.items()])

    def tag(self, key: str, value: str) -> None:
        self.client.set_tag(self.run_id, key, value)

    def picture(self, image, path: str) -> None:
        """A picture (H, W, 3) uint8 as an artifact."""
        from PIL import Image

        self.client.log_image(self.run_id, Image.fromarray(image), artifact_file=path)

    def artifacts(self, directory: str, path: str) -> None:
        self.client.log_artifacts(self.run_id, directory, path)

    def history(self, name: str) -> list[tuple[int, float]]:
        """(step, value) of a metric, in order; a resumed run's repeated steps once."""
        values = {m.step: m.value for m in self.client.get_metric_history(self.run_id, name)}
        return sorted(values.items())

    def finish(self, status: str) -> None:
        """FINISHED, FAILED or KILLED."""
        self.client.set_terminated(self.run_id, status)


def publish_scores(output: str, scores: Mapping, tags: Mapping[str, str], files: Sequence[str] = ()) -> dict:
    """Nested scores as metrics.json (returned) and metrics.parquet of `output`, and with tags and files to MLflow.

    One MLflow run per output directory, brought up to date. Parquet: a row per score, with the ends of its 95 % interval
    where it has one; in MLflow the ends are metrics of their own, NAME.low and NAME.high.
    """
    import pyarrow as pa

    from pipelines.evaluation.evaluate import flattened, plain
    from pipelines.metrics.intervals import Estimate

    rows, known = [], {}
    for name, value in flattened(scores).items():
        score = value if isinstance(value, Estimate) else Estimate(value, None, None)
        rows.append({"metric": name} | score._asdict())
        named = {"": score.value, ".low": score.low, ".high": score.high}
        known |= {name + end: number for end, number in named.items() if number is not None}
    nested = plain(scores)
    storage.write_json(nested, storage.join(output, "metrics.json"))
    schema = pa.schema({"metric": pa.string(), "value": pa.float64(), "low": pa.float64(), "high": pa.float64()})
    storage.write_parquet(pa.Table.from_pylist(rows, schema), storage.join(output, "metrics.parquet"))

    run_name = output.rstrip("/").rsplit("/", 1)[-1]
    tracker = Tracker.start("pritti-evaluation", run_name, {}, storage.join(output, "mlflow.json"))
    for key, value in tags.items():
        tracker.tag(key, value)
    finite = [(name, number) for name, number in known.items() if isfinite(number)]
    for start in range(0, len(finite), METRICS_PER_CALL):
        tracker.metrics(dict(finite[start : start + METRICS_PER_CALL]), step=0)
    if "://" not in output:  # MLflow takes local files only
        for file in ("metrics.json", *files):
            tracker.client.log_artifact(tracker.run_id, storage.join(output, file))
    tracker.finish("FINISHED")
    return nested
