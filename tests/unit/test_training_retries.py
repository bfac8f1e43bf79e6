"""Tests of the rounds of retries of a training: they continue only while there is progress."""

from types import SimpleNamespace
from typing import Any

import pytest
import ray.train.torch
from ray.exceptions import RayActorError
from ray.train.v2.api.exceptions import WorkerGroupError

from jobs.support import trainer


def run_rounds(monkeypatch, tmp_path, rounds) -> tuple[object, int]:
    """Run `fit_with_retries` with one (checkpoint saved, error or result) per round; return result and round count."""
    left = list(rounds)

    class Rounds:
        def __init__(self, *_, **__) -> None:
            pass

        def fit(self) -> object:
            checkpoint, outcome = left.pop(0)
            (tmp_path / "killed" / checkpoint).mkdir(parents=True, exist_ok=True)
            if isinstance(outcome, Exception):
                raise outcome
            return outcome

    monkeypatch.setattr(ray.train.torch, "TorchTrainer", Rounds)
    run: Any = SimpleNamespace(storage_path=str(tmp_path), name="killed")
    try:
        return trainer.fit_with_retries(run, ray.train.ScalingConfig()), len(rounds) - len(left)
    except WorkerGroupError as error:
        return error, len(rounds) - len(left)


def test_training_continues_while_there_are_new_checkpoints(monkeypatch, tmp_path):
    died = WorkerGroupError("killed", {0: RuntimeError("worker died")})
    rounds = [("checkpoint_1", died), ("checkpoint_2", died), ("checkpoint_3", died), ("checkpoint_4", "done")]
    assert run_rounds(monkeypatch, tmp_path, rounds) == ("done", 4)


def test_lost_controllers_are_replaced(monkeypatch, tmp_path):
    lost = RayActorError()
    rounds = [("", lost)] * trainer.RETRIES + [("checkpoint_1", lost), ("checkpoint_1", "done")]
    assert run_rounds(monkeypatch, tmp_path, rounds) == ("done", trainer.RETRIES + 2)
    rounds = [("checkpoint_1", lost)] * (trainer.RETRIES + 2)
    with pytest.raises(RayActorError):
        run_rounds(monkeypatch, tmp_path, rounds)


@pytest.mark.parametrize(
    ("rounds", "count"),
    [
        ([("", RuntimeError("worker died")), ("checkpoint_1", None)], 1),  # no checkpoint at all
        ([("checkpoint_1", RuntimeError("worker died"))] * 2 + [("checkpoint_2", None)], 2),  # the same checkpoint
        ([("checkpoint_1", ValueError("loss is nan")), ("checkpoint_2", None)], 1),  # an error that a retry repeats
    ],
)
def test_training_without_progress_or_with_a_mistake_ends(monkeypatch, tmp_path, rounds, count):
    rounds = [(name, error and WorkerGroupError(str(error), {0: error})) for name, error in rounds]
    result, tried = run_rounds(monkeypatch, tmp_path, rounds)
    assert isinstance(result, WorkerGroupError) and tried == count
