"""Trainers of the networks of voxel methods."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.graph import saved_tensors_hooks

from models.baselines.base import Networks, Stage
from models.sampling.diffusion import make_keyed_generator
from models.training import ExecutionConfig, OptimizerConfig, Trainer, Wrap


def make_baseline_trainer(
    stage: Stage,
    architecture: dict,
    networks: Networks,
    class_counts: Sequence[int],
    settings: OptimizerConfig,
    device: torch.device,
    wrap: Wrap = lambda m: m,
    execution: ExecutionConfig | None = None,
) -> Trainer:
    """Return the trainer of a stage. Its initial weights depend on the seed only.

    Args:
        stage: Stage.
        architecture: Keyword arguments of its network.
        networks: Networks of earlier stages; they are moved to `device`.
        class_counts: Number of fine voxels of each class in the training split.
        settings: Options of the optimiser.
        device: Device of the training.
        wrap: Function that wraps the network, for example with DistributedDataParallel.
        execution: Options of the execution; None: the defaults of `ExecutionConfig`.

    Returns:
        The trainer.
    """
    torch.manual_seed(settings.seed)
    model = stage.model(**architecture).to(device)
    earlier = {name: network.to(device).eval().requires_grad_(False) for name, network in networks.items()}
    loss = stage.make_loss(model, earlier, class_counts)
    return Trainer(model, loss, settings, device, wrap(model), execution)


def measure_sample_bytes(trainer: Trainer, arrays: dict[str, Tensor]) -> int:
    """Measure the memory that the backward pass needs per sample: the tensors that the forward pass keeps.

    Args:
        trainer: Trainer.
        arrays: One training sample.

    Returns:
        Bytes, without parameters and inputs.
    """
    kept: dict[int, int] = {}
    parameters = {p.untyped_storage().data_ptr() for p in trainer.model.parameters()}

    def count(tensor: Any) -> Any:
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in parameters:
            kept[storage.data_ptr()] = storage.nbytes()
        return tensor

    arrays = {name: value.to(trainer.device) for name, value in arrays.items()}
    network: nn.Module = trainer.model
    with saved_tensors_hooks(count, lambda tensor: tensor):
        losses = trainer.loss(network, arrays, [make_keyed_generator(0)])  # The graph keeps the counted tensors.
    del losses
    return sum(kept.values())
