"""Write the scores of an evaluation to files and to MLflow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite

import pyarrow as pa

from jobs.support.tracking import Tracker
from models.local_copy import make_local_copy
from models.uris import split_name
from pipelines.evaluation.evaluate import convert_estimates, flatten_scores
from pipelines.metrics.intervals import Estimate
from pipelines.runtime import storage

METRICS_PER_CALL = 1000  # MLflow's limit


def publish_scores(output: str, scores: Mapping, tags: Mapping[str, str], files: Sequence[str] = ()) -> dict:
    """Write scores to metrics.json and metrics.parquet, and log them with tags and files to MLflow.

    Each output directory has one MLflow run, which a repeated evaluation updates. The file metrics.parquet has one row
    per score. If the score has a 95 % interval, the row contains the bounds of the interval. In MLflow, the bounds are
    separate metrics, NAME.low and NAME.high.

    Args:
        output: Directory or URI of the files.
        scores: Nested scores.
        tags: Tags of the MLflow run.
        files: Names of files in `output` to log.

    Returns:
        The content of metrics.json.
    """
    rows, known = [], {}
    for name, value in flatten_scores(scores).items():
        score = value._asdict() if isinstance(value, Estimate) else {"value": value, "low": None, "high": None}
        rows.append({"metric": name} | score)
        named = {"": score["value"], ".low": score["low"], ".high": score["high"]}
        known |= {name + end: number for end, number in named.items() if number is not None}
    nested = convert_estimates(scores)
    storage.write_json(nested, storage.join_uri(output, "metrics.json"))
    schema = pa.schema({"metric": pa.string(), "value": pa.float64(), "low": pa.float64(), "high": pa.float64()})
    storage.write_parquet(pa.Table.from_pylist(rows, schema), storage.join_uri(output, "metrics.parquet"))

    run_name = split_name(output)[1]
    tracker = Tracker.start("pritti-evaluation", run_name, {}, storage.join_uri(output, "mlflow.json"))
    for key, value in tags.items():
        tracker.tag(key, value)
    finite = [(name, number) for name, number in known.items() if isfinite(number)]
    for start in range(0, len(finite), METRICS_PER_CALL):
        tracker.metrics(dict(finite[start : start + METRICS_PER_CALL]), step=0)
    for file in ("metrics.json", *files):
        tracker.client.log_artifact(tracker.run_id, make_local_copy(storage.join_uri(output, file)))
    tracker.finish("FINISHED")
    return nested
