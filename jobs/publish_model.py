#!/usr/bin/env python3
"""Publish a trained and evaluated pipeline in the model zoo and in MLflow.

    jobs/sample_scenes.py --num-scenes 1000 --run judged --sampler sde-dpm++ --num-inference-steps 20
    jobs/evaluate_scenes.py --real-split test --run judged --lvae DIR/lvae
    jobs/publish_model.py --name town --evaluation $PRITTI_HOME/evaluations/judged

The job writes weights, configuration and a model card, and registers a version in MLflow. The card describes the MLflow
runs that trained these weights, and an evaluation of scenes generated with these weights. If the training started from
published weights, the card quotes the entry of those weights. If a run or the evaluation is missing or belongs to other
weights, the job publishes nothing. Other jobs accept a published pipeline as --model NAME, as its directory, as
models:/NAME/VERSION, or as the id of the MLflow run.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import run
from jobs.support.options import IfBusyOption, LogFormatOption, ModelOption


@dataclass(frozen=True)
class Config:
    model: ModelOption = ""
    evaluation: str = ""
    """Directory that jobs/evaluate_scenes.py --lvae wrote (default: $PRITTI_HOME/evaluations/latest)."""
    name: str = "town"
    """Name of the entry in the model zoo and of the registered model."""
    output: str = ""
    """Directory to write weights and model card to (default: $PRITTI_HOME/zoo/<name>)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    register: bool = True
    """Also register the pipeline as a model version in MLflow."""


if __name__ == "__main__":
    run("publish_model")
