"""Tests of the messages for batches that do not fit into the memory of a GPU."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from jobs.support.trainer import describe_fitting_batch
from models.dit import DiT
from models.training import ExecutionConfig, OptimizerConfig, Trainer
from pipelines.generation.sample import Sampler
from pipelines.runtime.resources import explain_missing_cuda

BATCH = {"height": np.zeros((30, 2), np.float32)}


def make_trainer(fitting: int) -> Any:
    """Return a trainer whose step runs out of memory with parts of more than `fitting` samples."""

    def step(arrays: dict, positions: range) -> None:
        if -(-len(positions) // trainer.execution.accumulate) > fitting:
            raise torch.OutOfMemoryError("CUDA out of memory")

    trainer = SimpleNamespace(execution=ExecutionConfig(), device=torch.device("cuda", 0), step=step)
    return trainer


@pytest.mark.parametrize(
    ("fitting", "world", "message"),
    [
        (8, 1, "30 samples do not fit into the memory of cuda:0, 8 fit; use --gradient-accumulation-steps 4"),
        (8, 2, "30 samples do not fit into the memory of cuda:0; use --gradient-accumulation-steps 2"),
        (0, 1, "30 samples do not fit into the memory of cuda:0; use a smaller preset or a GPU with more memory"),
    ],
)
def test_training_names_the_batch_that_fits(monkeypatch, fitting, world, message):
    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: None)
    assert describe_fitting_batch(make_trainer(fitting), BATCH, range(30), world) == message


def test_sampling_names_a_smaller_batch():
    def generate(**_: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    names = ("labels", "seed", "num_inference_steps", "guidance_scale", "noise_scaling", "existence_threshold", "run")
    sampler = object.__new__(Sampler)
    sampler.request = SimpleNamespace(**dict.fromkeys(names, ("low",)))  # type: ignore[assignment]
    sampler.pipeline = SimpleNamespace(generate=generate, device="cuda:0")  # type: ignore[assignment]
    with pytest.raises(ValueError, match="16 scenes do not fit into the memory of cuda:0; use a --batch-size below 16"):
        sampler.generate(range(16))


def test_training_in_bf16_is_refused_without_bf16(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: False)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "Tesla V100")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda _: (7, 0))
    settings, device = OptimizerConfig(steps=1, learning_rate=1e-3, weight_decay=0.0), torch.device("cuda")
    execution = ExecutionConfig(precision="bf16")
    with pytest.raises(ValueError, match=r"Tesla V100 .* has no bfloat16, .* --precision fp32"):
        Trainer(DiT(patch=2, depth=1, width=32, heads=2), lambda *_: {}, settings, device, None, execution)


def test_old_driver_is_named(monkeypatch):
    def fail() -> None:
        raise RuntimeError("The NVIDIA driver on your system is too old (found version 11040). Please update it.")

    monkeypatch.setattr(torch.cuda, "current_device", fail)
    assert explain_missing_cuda() == "The NVIDIA driver on your system is too old (found version 11040)"
