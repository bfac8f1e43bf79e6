"""Compute features of pictures with VGG16 for the paper's analysis of memorisation (supplement).

The paper names a pretrained VGG16, and no layer. This module uses the second fully connected layer after its ReLU
(fc7, 4096 numbers), the last layer before the classifier. The network is configuration D of Simonyan and Zisserman,
"Very Deep Convolutional Networks for Large-Scale Image Recognition" (2015), with the parameter names of torchvision.
The code downloads no weights: download torchvision's file once and pass its path.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from torch import Tensor, nn

from models.local_copy import make_local_copy
from pipelines.metrics.networks import INPUT_SIZE, compute_resized_features, hash_weights

FEATURES = 4096
BATCH_SIZE = 16
KNOWN_FILE = "vgg16-397923af.pth of torchvision (https://download.pytorch.org/models/vgg16-397923af.pth)"
KNOWN_SHA256 = "397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0"
# Output channels of the 3x3 convolutions (configuration D). POOL is a 2x2 maximum pooling with stride 2.
POOL = 0
LAYERS = (64, 64, POOL, 128, 128, POOL, 256, 256, 256, POOL, 512, 512, 512, POOL, 512, 512, 512, POOL)
CLASSIFIER = ("classifier.6.weight", "classifier.6.bias")  # The 1000 ImageNet classes; the features do not need them.
# ImageNet's mean and deviation of pixels in 0..1, as in torchvision.
PIXEL_MEAN, PIXEL_DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class VGG16(nn.Module):
    """VGG16 without its last layer, which maps normalised pictures (n, 3, 224, 224) to features (n, 4096)."""

    def __init__(self) -> None:
        super().__init__()
        layers, channels = [], 3
        for outputs in LAYERS:
            if outputs == POOL:
                layers.append(nn.MaxPool2d(2))
            else:
                layers += [nn.Conv2d(channels, outputs, 3, padding=1), nn.ReLU(inplace=True)]
                channels = outputs
        self.features = nn.Sequential(*layers)
        # Dropout does nothing in evaluation. It keeps torchvision's numbers of the layers.
        self.classifier = nn.Sequential(
            nn.Linear(channels * 7 * 7, FEATURES), nn.ReLU(), nn.Dropout(), nn.Linear(FEATURES, FEATURES), nn.ReLU()
        )
        self.eval().requires_grad_(False)

    def forward(self, pictures: Tensor) -> Tensor:
        """Compute the features after fc7 and ReLU.

        Args:
            pictures: (n, 3, 224, 224) normalised pictures; see PIXEL_MEAN and PIXEL_DEVIATION.

        Returns:
            (n, 4096) features, at least 0.

        Raises:
            ValueError: The pictures have another shape.
        """
        if pictures.shape[1:] != (3, INPUT_SIZE, INPUT_SIZE):
            raise ValueError(f"VGG16 needs pictures (n, 3, {INPUT_SIZE}, {INPUT_SIZE}), got {tuple(pictures.shape)}")
        return self.classifier(self.features(pictures).flatten(1))


def load_vgg16(path: str | Path) -> VGG16:
    """Load VGG16 with the weights of a local state dict.

    Args:
        path: Path or URI of a file of type .pth, .pt or .safetensors, with torchvision's names of the parameters.

    Returns:
        The network in evaluation mode.

    Raises:
        ValueError: The file is missing, is corrupted or holds the weights of another network. The message names the
            file and the first wrong tensor.
    """
    path = make_local_copy(path)
    hash_vgg16_weights(path)
    try:
        if Path(path).suffix == ".safetensors":
            state = safetensors.torch.load_file(path)
        else:
            state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # The unpickler of torch raises many types of errors for a corrupted file.
        raise ValueError(f"{path}: not a readable state dict ({error})") from error
    with torch.device("meta"):
        network = VGG16()
    if not isinstance(state, dict):
        raise ValueError(f"{path}: not the weights of VGG16 (a {type(state).__name__}, not a state dict)")
    state = {name: value for name, value in state.items() if name not in CLASSIFIER}
    for name, parameter in network.state_dict().items():
        if name not in state:
            raise ValueError(f"{path}: not the weights of VGG16 (tensor {name} is missing); use {KNOWN_FILE}")
        if state[name].shape != parameter.shape:
            sizes = f"{tuple(state[name].shape)}, expected {tuple(parameter.shape)}"
            raise ValueError(f"{path}: not the weights of VGG16 (tensor {name} is {sizes}); use {KNOWN_FILE}")
    if unknown := sorted(state.keys() - network.state_dict().keys()):
        raise ValueError(f"{path}: not the weights of VGG16 (tensor {unknown[0]} is unknown); use {KNOWN_FILE}")
    network.load_state_dict({name: value.float() for name, value in state.items()}, assign=True)
    return network.requires_grad_(False)


def hash_vgg16_weights(path: str | Path) -> str:
    """Return the hexadecimal sha256 of a weight file (`networks.hash_weights`).

    Args:
        path: Weight file.

    Returns:
        64 hexadecimal digits.

    Raises:
        ValueError: The file is missing, or its name contains a different sha256.
    """
    return hash_weights(path, "VGG16", KNOWN_FILE)


def describe_vgg16(path: str | Path) -> str:
    """Describe a weight file for a report: its path, its sha256, and whether it is torchvision's file.

    Args:
        path: Weight file.

    Returns:
        One sentence.

    Raises:
        ValueError: The file is missing, or its name contains a different sha256.
    """
    sha256 = hash_vgg16_weights(path)
    known = sha256 == KNOWN_SHA256
    verdict = "torchvision's file" if known else f"another file, not {KNOWN_FILE}; distances are not comparable"
    return f"VGG16 weights {path}, sha256 {sha256}: {verdict}"


def compute_vgg16_features(network: VGG16, pictures: np.ndarray) -> np.ndarray:
    """Compute the VGG16 features of pictures in batches of 16 (`compute_resized_features`).

    Pixels are divided by 255 and normalised with ImageNet's statistics.

    Args:
        network: Network on any device.
        pictures: (n, height, width, 3) uint8 pictures.

    Returns:
        (n, 4096) float32 features.

    Raises:
        ValueError: The pictures have another type or shape.
    """
    return compute_resized_features(network, pictures, FEATURES, BATCH_SIZE, _normalise)


def _normalise(x: Tensor) -> Tensor:
    mean, deviation = (x.new_tensor(part).view(3, 1, 1) for part in (PIXEL_MEAN, PIXEL_DEVIATION))
    return (x / 255 - mean) / deviation
