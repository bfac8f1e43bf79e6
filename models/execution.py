"""How the denoising network runs during sampling: precision, CUDA graphs and compiled blocks.

The paper does not state a precision. By default, the network runs in float32, and all options are off. They change
results by rounding only.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from models.dit import DiT
from models.sampling.diffusion import Denoiser

WARM_UP_RUNS = 3  # Runs before the capture, in which libraries allocate workspaces and choose kernels.


@dataclass(frozen=True)
class SamplingExecution:
    """Options of how sampling runs.

    Attributes:
        precision: "fp32" or "bf16": precision of the transformer's blocks, as in training with the same option. Input
            and output layers and the sampler stay in float32.
        cuda_graphs: Whether each shape of the input is captured as a CUDA graph, which replays all kernels of a step
            with one launch. Ignored without a GPU.
        compile: Whether the block of the transformer is compiled. All blocks share the compiled code.
        decode_batch_size: Number of latents that are decoded together. 1: each scene is bit-identical for any batch.
            With more, scenes are equal up to rounding.

    Raises:
        ValueError: An option is out of range, or the GPU has no bf16.
    """

    precision: str = "fp32"
    cuda_graphs: bool = False
    compile: bool = False
    decode_batch_size: int = 1

    def __post_init__(self) -> None:
        if self.precision not in ("fp32", "bf16") or self.decode_batch_size < 1:
            raise ValueError(
                f"precision is {self.precision!r}, decode_batch_size {self.decode_batch_size}; expected fp32 or bf16,"
                " and 1 or more"
            )

    def prepare(self, dit: DiT) -> None:
        """Convert and compile the blocks of a network in place.

        Args:
            dit: Network on its device.

        Raises:
            ValueError: The GPU has no bf16.
        """
        if self.precision == "bf16":
            require_bf16(dit.device)
            dit.blocks.to(torch.bfloat16)
        if self.compile:
            for block in dit.blocks:
                block.compile(fullgraph=True, dynamic=False)

    def autocast(self, device: torch.device) -> torch.autocast:
        """Return the context in which the network runs.

        Args:
            device: Device of the network.

        Returns:
            Autocast context, which has no effect for fp32.
        """
        # A cache of converted weights would end with the context, so a captured graph would read freed memory.
        return torch.autocast(device.type, torch.bfloat16, enabled=self.precision == "bf16", cache_enabled=False)

    def wrap(self, model: Denoiser, device: torch.device) -> Denoiser:
        """Return a denoiser that runs with these options.

        Args:
            model: Denoiser whose network is on `device`.
            device: Device of the network.

        Returns:
            Denoiser with the same inputs and outputs.
        """
        if self.precision == "bf16":
            model = self._run_in_autocast(model, device)
        if self.cuda_graphs and device.type == "cuda":
            return FixedShapeDenoiser(model, capture_cuda_graph)
        return model

    def _run_in_autocast(self, model: Denoiser, device: torch.device) -> Denoiser:
        def denoise(latent: Tensor, timestep: Tensor, label: Tensor) -> Tensor:
            with self.autocast(device):
                return model(latent, timestep, label).to(latent.dtype)

        return denoise


def require_bf16(device: torch.device) -> None:
    """Raise an error if a GPU computes bfloat16 by emulation only.

    Args:
        device: Device; CPUs are accepted.

    Raises:
        ValueError: The GPU has no bfloat16.
    """
    if device.type == "cuda" and not torch.cuda.is_bf16_supported(including_emulation=False):
        name, (major, minor) = torch.cuda.get_device_name(device), torch.cuda.get_device_capability(device)
        raise ValueError(
            f"{name} (compute capability {major}.{minor}) has no bfloat16, which needs 8.0; use --precision fp32"
        )


class FixedShapeDenoiser:
    """Capture a denoiser once per shape of its inputs, and replay it.

    If a capture fails, a warning is issued and the denoiser runs as it is. Inputs that need gradients (pseudo-inverse
    guidance) are never replayed.

    Args:
        model: Denoiser.
        capture: Function that captures a denoiser for given inputs (`capture_cuda_graph`).
    """

    def __init__(self, model: Denoiser, capture: Callable[..., Denoiser]) -> None:
        self.model, self.capture = model, capture
        self.captured: dict[tuple, Denoiser] = {}

    def __call__(self, latent: Tensor, timestep: Tensor, label: Tensor) -> Tensor:
        """Predict the noise.

        Args:
            latent: (b, c, h, w) latents.
            timestep: (b,) timesteps.
            label: (b,) class indices.

        Returns:
            (b, c, h, w) noise, in memory that later calls do not change.
        """
        inputs = latent, timestep, label
        if torch.is_grad_enabled() and latent.requires_grad:
            return self.model(*inputs)
        key = tuple((tuple(x.shape), x.dtype, x.device) for x in inputs)
        if key not in self.captured:
            try:
                self.captured[key] = self.capture(self.model, *inputs)
            except RuntimeError as error:
                warnings.warn(f"no CUDA graph ({error}); sampling continues without it", stacklevel=2)
                self.captured[key] = self.model
        return self.captured[key](*inputs)


@torch.no_grad()
def capture_cuda_graph(model: Denoiser, latent: Tensor, timestep: Tensor, label: Tensor) -> Denoiser:
    """Capture a denoiser as a CUDA graph.

    Args:
        model: Denoiser whose kernels depend only on the shapes of the inputs.
        latent: (b, c, h, w) latents.
        timestep: (b,) timesteps.
        label: (b,) class indices.

    Returns:
        Denoiser for inputs of the same shapes.

    Raises:
        RuntimeError: The denoiser cannot be captured.
    """
    inputs = [x.clone() for x in (latent, timestep, label)]
    stream, current = torch.cuda.Stream(latent.device), torch.cuda.current_stream(latent.device)
    stream.wait_stream(current)
    with torch.cuda.stream(stream):
        for _ in range(WARM_UP_RUNS):
            model(*inputs)
    current.wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        output = model(*inputs)

    def replay(*values: Tensor) -> Tensor:
        for static, value in zip(inputs, values, strict=True):
            static.copy_(value)
        graph.replay()
        return output.clone()

    return replay
