#!/usr/bin/env python3
"""Publish a trained and evaluated pipeline in the model zoo and in MLflow.

    jobs/sample_scenes.py --num-scenes 1000 --run judged --sampler dpm++ --num-inference-steps 20
    jobs/evaluate_scenes.py --real-split test --run judged --lvae DIR/lvae
    jobs/publish_model.py --name town --evaluation $PRITTI_HOME/evaluations/judged

Writes weights, configuration and a model card, and registers a version in MLflow. The card describes the MLflow runs
that trained these weights and the evaluation of scenes that they generated; for published weights that a training
started from, it quotes their entry. If a run or the evaluation is missing or belongs to other weights, nothing is
published. Other jobs then take the pipeline as --model NAME, its directory, models:/NAME/VERSION, or the id of its
MLflow run.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import run
from jobs.support.options import ModelOption


@dataclass(frozen=True)
class Config:
    model: ModelOption = ""
    evaluation: str = ""
    """Directory that jobs/evaluate_scenes.py --lvae wrote (default: $PRITTI_HOME/evaluations/latest)."""
    name: str = "town"
    """Name of the entry and of the registered model."""
    output: str = ""
    """Directory to write the entry to (default: $PRITTI_HOME/zoo/<name>)."""
    register: bool = True
    """Also register the entry as a model version in MLflow."""


if __name__ == "__main__":
    run("publish_model")
