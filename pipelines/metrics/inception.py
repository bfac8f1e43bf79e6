"""Compute features of pictures with the Inception network or with a network with random weights.

The Inception network is TensorFlow's graph of 2015-12-05 (1008 classes), written in PyTorch. FID is defined by this
network. The parameters have the same names as in the weight files of pytorch-fid and torch-fidelity. Both files can
therefore be loaded. The code downloads no weights: download the file once and pass its path.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import safetensors.torch
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from models.local_copy import make_local_copy
from pipelines.metrics.networks import hash_weights

INPUT_SIZE = 299
FEATURES, CLASSES = 2048, 1008
SPATIAL_CHANNELS, SPATIAL_FEATURES = 7, 7 * 17 * 17
KNOWN_FILE = "weights-inception-2015-12-05-6726825d.pth of torch-fidelity's release v0.2.0"
# The file of pytorch-fid has the same sha256.
KNOWN_SHA256 = "6726825d0af5f729cebd5821db510b11b1cfad8faad88a03f1befd49fb9129b2"

# A branch is a chain of convolutions (output channels, kernel height, kernel width). If a chain ends in SPLIT, its last
# step has two parallel convolutions: 1x3 and 3x1. If a chain has only one step, the step has the same name as the
# branch. The steps of longer chains are called name_1, name_2 and so on.
SPLIT = "split"
Chain = tuple[tuple[int, int, int] | str, ...]


CHAINS_5 = {
    "branch1x1": ((64, 1, 1),),
    "branch5x5": ((48, 1, 1), (64, 5, 5)),
    "branch3x3dbl": ((64, 1, 1), (96, 3, 3), (96, 3, 3)),
}


def _make_chains_6(channels: int) -> dict[str, Chain]:
    c = channels
    return {
        "branch1x1": ((192, 1, 1),),
        "branch7x7": ((c, 1, 1), (c, 1, 7), (192, 7, 1)),
        "branch7x7dbl": ((c, 1, 1), (c, 7, 1), (c, 1, 7), (c, 7, 1), (192, 1, 7)),
    }


CHAINS_6A = {"branch3x3": ((384, 3, 3),), "branch3x3dbl": ((64, 1, 1), (96, 3, 3), (96, 3, 3))}
CHAINS_7A = {
    "branch3x3": ((192, 1, 1), (320, 3, 3)),
    "branch7x7x3": ((192, 1, 1), (192, 1, 7), (192, 7, 1), (192, 3, 3)),
}
CHAINS_7 = {
    "branch1x1": ((320, 1, 1),),
    "branch3x3": ((384, 1, 1), SPLIT),
    "branch3x3dbl": ((448, 1, 1), (384, 3, 3), SPLIT),
}


class InceptionFeatures(NamedTuple):
    """Features of n pictures. The network returns tensors; `compute_inception_features` returns float32 arrays.

    Attributes:
        pool3: (n, 2048) features for FID, precision and recall.
        spatial: (n, 2023) features for ADM's sFID: the first 7 channels of mixed_6/conv, in the order row, column,
            channel.
        logits: (n, 1008) logits without bias, as in ADM's Inception score.
    """

    pool3: Tensor | np.ndarray
    spatial: Tensor | np.ndarray
    logits: Tensor | np.ndarray


class Conv(nn.Module):
    """Convolution without bias, batch norm (eps 1e-3) and ReLU.

    By default, the output has the same size as the input. With `reduce`, the convolution has stride 2 and no padding.
    Without `pad`, it has stride 1 and no padding.
    """

    def __init__(self, inputs: int, outputs: int, height: int, width: int, reduce: bool = False, pad: bool = True):
        super().__init__()
        padding = (height // 2, width // 2) if pad and not reduce else 0
        self.conv = nn.Conv2d(inputs, outputs, (height, width), 2 if reduce else 1, padding, bias=False)
        self.bn = nn.BatchNorm2d(outputs, eps=0.001)

    def forward(self, x: Tensor) -> Tensor:
        """Apply convolution, batch norm and ReLU.

        Args:
            x: (n, c, h, w) features.

        Returns:
            (n, outputs, h', w') features.
        """
        return F.relu(self.bn(self.conv(x)))


class Mixed(nn.Module):
    """Inception block: parallel chains of convolutions and a pooling branch, concatenated along the channels.

    With `pool_channels`, the pooling keeps the size and is followed by a 1x1 convolution. Without `pool_channels`, the
    last layer of each branch has stride 2. Average pooling ignores the padding, and block 7c uses maximum pooling. Both
    rules follow the TensorFlow graph.
    """

    def __init__(self, inputs: int, chains: dict[str, Chain], pool_channels: int | None, max_pool: bool = False):
        super().__init__()
        self.chains: list[list[list[str]]] = []  # Names of the parallel modules for each branch and step.
        self.reduce, self.max_pool = pool_channels is None, max_pool
        self.outputs = 0
        for branch, chain in chains.items():
            steps, channels = [], inputs
            for i, step in enumerate(chain):
                name = branch if len(chain) == 1 else f"{branch}_{i + 1}"
                if isinstance(step, str):  # SPLIT
                    self.add_module(name + "a", Conv(channels, 384, 1, 3))
                    self.add_module(name + "b", Conv(channels, 384, 3, 1))
                    steps.append([name + "a", name + "b"])
                    channels = 768
                else:
                    last = i == len(chain) - 1
                    self.add_module(name, Conv(channels, *step, reduce=self.reduce and last))
                    steps.append([name])
                    channels = step[0]
            self.chains.append(steps)
            self.outputs += channels
        if pool_channels is not None:
            self.branch_pool = Conv(inputs, pool_channels, 1, 1)
        self.outputs += inputs if pool_channels is None else pool_channels

    def forward(self, x: Tensor) -> Tensor:
        """Apply all branches and concatenate their outputs along the channels.

        Args:
            x: (n, c, h, w) features.

        Returns:
            (n, self.outputs, h', w') features.
        """
        branches = []
        for steps in self.chains:
            y = x
            for names in steps:
                y = torch.cat([self.get_submodule(name)(y) for name in names], dim=1)
            branches.append(y)
        return torch.cat([*branches, self._pool(x)], dim=1)

    def _pool(self, x: Tensor) -> Tensor:
        if self.reduce:
            return F.max_pool2d(x, 3, stride=2)
        if self.max_pool:
            return self.branch_pool(F.max_pool2d(x, 3, stride=1, padding=1))
        return self.branch_pool(F.avg_pool2d(x, 3, stride=1, padding=1, count_include_pad=False))


class Inception(nn.Module):
    """Inception network of FID, which maps uint8 pictures (n, height, width, 3) to InceptionFeatures.

    Attributes:
        weights_sha256: Hexadecimal sha256 of the weight file. None: `load_inception` has not set it.
    """

    weights_sha256: str | None = None

    def __init__(self) -> None:
        super().__init__()
        self.Conv2d_1a_3x3 = Conv(3, 32, 3, 3, reduce=True)
        self.Conv2d_2a_3x3 = Conv(32, 32, 3, 3, pad=False)
        self.Conv2d_2b_3x3 = Conv(32, 64, 3, 3)
        self.Conv2d_3b_1x1 = Conv(64, 80, 1, 1)
        self.Conv2d_4a_3x3 = Conv(80, 192, 3, 3, pad=False)
        self.Mixed_5b = Mixed(192, CHAINS_5, 32)
        self.Mixed_5c = Mixed(256, CHAINS_5, 64)
        self.Mixed_5d = Mixed(288, CHAINS_5, 64)
        self.Mixed_6a = Mixed(288, CHAINS_6A, None)
        self.Mixed_6b = Mixed(768, _make_chains_6(128), 192)
        self.Mixed_6c = Mixed(768, _make_chains_6(160), 192)
        self.Mixed_6d = Mixed(768, _make_chains_6(160), 192)
        self.Mixed_6e = Mixed(768, _make_chains_6(192), 192)
        self.Mixed_7a = Mixed(768, CHAINS_7A, None)
        self.Mixed_7b = Mixed(1280, CHAINS_7, 192)
        self.Mixed_7c = Mixed(2048, CHAINS_7, 192, max_pool=True)
        self.fc = nn.Linear(FEATURES, CLASSES)
        self.eval().requires_grad_(False)

    def forward(self, images: Tensor) -> InceptionFeatures:
        """Compute the features of pictures.

        Args:
            images: (n, height, width, 3) uint8 pictures.

        Returns:
            Features as tensors.

        Raises:
            ValueError: The pictures have another type or shape.
        """
        if images.dtype != torch.uint8 or images.ndim != 4 or images.shape[-1] != 3:
            found = f"{images.dtype} {tuple(images.shape)}"
            raise ValueError(f"Inception needs uint8 pictures (n, height, width, 3), got {found}")
        x = images.permute(0, 3, 1, 2).to(self.fc.weight.dtype)
        x = (resize_like_tensorflow1(x, INPUT_SIZE) - 128) / 128  # n 3 299 299
        x = self.Conv2d_2b_3x3(self.Conv2d_2a_3x3(self.Conv2d_1a_3x3(x)))  # n 64 147 147
        x = F.max_pool2d(x, 3, stride=2)  # n 64 73 73
        x = self.Conv2d_4a_3x3(self.Conv2d_3b_1x1(x))  # n 192 71 71
        x = F.max_pool2d(x, 3, stride=2)  # n 192 35 35
        x = self.Mixed_5d(self.Mixed_5c(self.Mixed_5b(x)))  # n 288 35 35
        x = self.Mixed_6d(self.Mixed_6c(self.Mixed_6b(self.Mixed_6a(x))))  # n 768 17 17
        # TensorFlow's mixed_6 is Mixed_6d here. The first channels are the output of branch1x1, which is TensorFlow's
        # mixed_6/conv after ReLU.
        spatial = x[:, :SPATIAL_CHANNELS].permute(0, 2, 3, 1).flatten(1)
        x = self.Mixed_7c(self.Mixed_7b(self.Mixed_7a(self.Mixed_6e(x))))  # n 2048 8 8
        pool3 = x.mean(dim=(2, 3))
        return InceptionFeatures(pool3, spatial, pool3 @ self.fc.weight.T)


def resize_like_tensorflow1(x: Tensor, size: int) -> Tensor:
    """Resize pictures bilinearly, like ResizeBilinear of TensorFlow 1.

    Corners are not aligned, and pixel centres have no half-pixel offset: output pixel i reads input position i * (in /
    out). Compared with torch's resizing, an enlarged picture is shifted by half a pixel, up and to the left. Columns
    are resized before rows to reproduce the rounding of TensorFlow.

    Args:
        x: (n, c, h, w) pictures.
        size: Height and width of the output (px).

    Returns:
        (n, c, size, size) pictures.
    """
    for dim in (3, 2):
        length = x.shape[dim]
        position = torch.arange(size, dtype=torch.float32, device=x.device) * np.float32(length / size).item()
        low = position.long()
        high = (low + 1).clamp(max=length - 1)
        share = (position - low).to(x.dtype).view(-1, *[1] * (3 - dim))
        below, above = x.index_select(dim, low), x.index_select(dim, high)
        x = below + (above - below) * share
    return x


def load_inception(path: str | Path) -> Inception:
    """Load the Inception network with the weights of a local state dict.

    A file name such as KNOWN_FILE contains the first digits of the sha256, and these digits are checked. A warning is
    given if the weights are not the published weights.

    Args:
        path: Path or URI of a file of type .pth, .pt or .safetensors.

    Returns:
        The network in evaluation mode.

    Raises:
        ValueError: The file is missing, is corrupted or holds the weights of another network. The message names the
            file.
    """
    path = Path(make_local_copy(path))
    sha256 = hash_inception_weights(path)
    try:
        if path.suffix == ".safetensors":
            state = safetensors.torch.load_file(path)
        else:
            state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # The unpickler of torch raises many types of errors for a corrupted file.
        raise ValueError(f"{path}: not a readable state dict ({error})") from error
    network = Inception()
    try:
        network.load_state_dict(state)
    except (RuntimeError, TypeError) as error:
        raise ValueError(f"{path}: not the weights of the FID Inception network ({error})") from error
    if sha256 != KNOWN_SHA256:
        warnings.warn(describe_weights(path), stacklevel=2)
    network.weights_sha256 = sha256
    return network


def hash_inception_weights(path: str | Path) -> str:
    """Return the hexadecimal sha256 of a weight file (`networks.hash_weights`).

    Args:
        path: Weight file.

    Returns:
        64 hexadecimal digits.

    Raises:
        ValueError: The file is missing, or its name contains a different sha256.
    """
    return hash_weights(path, "Inception", KNOWN_FILE)


def describe_weights(path: str | Path) -> str:
    """Describe a weight file for a report: its path, its sha256, and whether it is the published file.

    Args:
        path: Weight file.

    Returns:
        One sentence.

    Raises:
        ValueError: The file is missing, or its name contains a different sha256.
    """
    sha256 = hash_inception_weights(path)
    known = sha256 == KNOWN_SHA256
    verdict = "the published file" if known else f"not {KNOWN_FILE}; scores are not comparable with published scores"
    return f"Inception weights {path}, sha256 {sha256}: {verdict}"


@torch.inference_mode()
def compute_inception_features(network: Inception, images: np.ndarray, batch_size: int = 32) -> InceptionFeatures:
    """Compute the Inception features of pictures in batches.

    Args:
        network: Network on any device.
        images: (n, height, width, 3) uint8 pictures.
        batch_size: Pictures per batch.

    Returns:
        Features as float32 arrays: pool3 (n, 2048), spatial (n, 2023) and logits (n, 1008).
    """
    device = network.fc.weight.device
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):  # TF32 keeps only 10 of the 23 mantissa bits.
        parts = [network(batch.to(device)) for batch in _iterate_batches(images, batch_size)]
    if not parts:
        return InceptionFeatures(*(np.empty((0, size), np.float32) for size in (FEATURES, SPATIAL_FEATURES, CLASSES)))
    return InceptionFeatures(*(torch.cat(part).float().cpu().numpy() for part in zip(*parts, strict=True)))


def make_random_network(seed: int = 0, channels: tuple[int, ...] = (32, 64, 128, 256)) -> nn.Sequential:
    """Build a small convolutional network with random weights that depend only on the seed.

    The network consists of 3x3 convolutions with stride 2 (He initialisation) and ReLU. Use it in tests, and to compare
    sources if Inception weights are not available. Distances between its features have names such as `random_frechet`,
    never FID. Weights come from numpy's legacy generator, whose random stream never changes.

    Args:
        seed: Seed of the weights.
        channels: Output channels of each convolution.

    Returns:
        The network in evaluation mode.
    """
    random = np.random.RandomState(seed)
    layers, inputs = [], 3
    for outputs in channels:
        conv = nn.Conv2d(inputs, outputs, 3, stride=2, padding=1, bias=False)
        weight = random.standard_normal(conv.weight.shape) * np.sqrt(2 / (9 * inputs))
        conv.weight.data = torch.from_numpy(weight.astype(np.float32))
        layers += [conv, nn.ReLU()]
        inputs = outputs
    return nn.Sequential(*layers).eval().requires_grad_(False)


@torch.inference_mode()
def compute_random_features(images: np.ndarray, seed: int = 0, batch_size: int = 32) -> np.ndarray:
    """Compute the features of pictures under `make_random_network(seed)`.

    The features are the channel means over the picture after each convolution (32 + 64 + 128 + 256 channels). They
    describe both coarse and fine structure.

    Args:
        images: (n, height, width, 3) uint8 pictures.
        seed: Seed of the network.
        batch_size: Pictures per batch.

    Returns:
        (n, 480) float32 features.
    """
    network = make_random_network(seed)
    parts = []
    for batch in _iterate_batches(images, batch_size):
        x, means = batch.permute(0, 3, 1, 2).float() / 128 - 1, []
        for layer in network:
            x = layer(x)
            if isinstance(layer, nn.ReLU):
                means.append(x.mean(dim=(2, 3)))
        parts.append(torch.cat(means, dim=1))
    return torch.cat(parts).numpy() if parts else np.empty((0, 480), np.float32)


def _iterate_batches(images: np.ndarray, batch_size: int) -> Iterator[Tensor]:
    if images.dtype != np.uint8 or images.ndim != 4 or images.shape[-1] != 3:
        raise ValueError(f"pictures must be uint8 (n, height, width, 3), got {images.dtype} {images.shape}")
    for start in range(0, len(images), batch_size):
        yield torch.from_numpy(np.ascontiguousarray(images[start : start + batch_size]))
