"""Functions for all networks that compute features of pictures: digests of weight files, and resized pictures."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from models.local_copy import make_local_copy

INPUT_SIZE = 224  # Side of the pictures that networks trained on ImageNet read.


def hash_weights(path: str | Path, network: str, known_file: str) -> str:
    """Return the hexadecimal sha256 of a weight file.

    Args:
        path: Path or URI of the weight file.
        network: Name of the network, for the error message.
        known_file: Name of the published file, for the error message.

    Returns:
        64 hexadecimal digits.

    Raises:
        ValueError: The file is missing, or its name contains a different sha256.
    """
    path = Path(make_local_copy(path))
    if not path.is_file():
        raise ValueError(f"{path}: no such file; {network} weights must be local, such as {known_file}")
    with path.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    claimed = re.search(r"-([0-9a-f]{8})\.pth$", path.name)
    if claimed and not sha256.startswith(claimed[1]):
        raise ValueError(f"{path}: file is corrupted; its sha256 starts with {sha256[:8]}, expected {claimed[1]}")
    return sha256


@torch.inference_mode()
def compute_resized_features(
    network: nn.Module,
    pictures: np.ndarray,
    num_features: int,
    batch_size: int,
    normalise: Callable[[Tensor], Tensor],
) -> np.ndarray:
    """Compute the features of pictures in batches.

    Each picture is resized to INPUT_SIZE x INPUT_SIZE pixels, bilinearly with antialiasing. It is not cropped, because
    the border of a scene counts as much as its centre. The aspect ratio is not kept.

    Args:
        network: Network on any device. It maps normalised pictures (b, 3, 224, 224) to features.
        pictures: (n, height, width, 3) uint8 pictures.
        num_features: Number of features per picture.
        batch_size: Number of pictures per batch.
        normalise: Function that normalises pixels in 0..255, given as (b, 3, 224, 224) float32.

    Returns:
        (n, num_features) float32 features. The features of a picture do not depend on the other pictures, except for
        rounding.

    Raises:
        ValueError: The pictures have another type or shape.
    """
    if pictures.dtype != np.uint8 or pictures.ndim != 4 or pictures.shape[-1] != 3:
        raise ValueError(f"pictures must be uint8 (n, height, width, 3), got {pictures.dtype} {pictures.shape}")
    device = next(network.parameters()).device
    features = np.empty((len(pictures), num_features), np.float32)
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):  # TF32 keeps only 10 of the 23 mantissa bits.
        for start in range(0, len(pictures), batch_size):
            batch = torch.from_numpy(np.array(pictures[start : start + batch_size], order="C")).to(device)
            x = batch.permute(0, 3, 1, 2).float()
            if x.shape[2:] != (INPUT_SIZE, INPUT_SIZE):
                x = F.interpolate(x, (INPUT_SIZE, INPUT_SIZE), mode="bilinear", antialias=True)
            features[start : start + batch_size] = network(normalise(x)).cpu().numpy()
    return features
