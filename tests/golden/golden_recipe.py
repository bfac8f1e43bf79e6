"""Inputs of the golden results of torch-fidelity: weights, images and features computed by formula.

They use only integers and uniform random numbers, no logarithm and no matrix product, so that every machine computes
the same bits.
"""

import hashlib
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

GOLDEN = Path(__file__).parent / "torch_fidelity.safetensors"
# Height, width (enlarged, the last one reduced), width of stripes, halvings of contrast, offset of each picture.
PICTURES = ((64, 64, 16, 0, 0), (64, 64, 70, 3, 10), (256, 256, 1500, 0, 0), (320, 400, 900, 1, 120))


def random_state_dict(shapes: Mapping[str, Sequence[int]]) -> dict[str, np.ndarray]:
    """float32 parameters of an Inception network, each by its name; activations stay of order one in all layers."""
    state = {}
    for name, shape in shapes.items():
        if name.endswith("num_batches_tracked"):  # not in converted weight files
            continue
        uniform = np.random.RandomState(zlib.crc32(name.encode())).random_sample(shape)
        if name.endswith("running_var"):
            value = 0.5 + uniform
        elif name.endswith("bn.weight"):
            value = 0.8 + 0.4 * uniform
        elif name.endswith("weight"):
            value = (2 * uniform - 1) * np.sqrt(6 / np.prod(shape[1:]))
        else:  # biases and running means
            value = 0.4 * (uniform - 0.5)
        state[name] = value.astype(np.float32)
    return state


def picture(k: int) -> np.ndarray:
    """The k-th picture, uint8 (height, width, 3): curved stripes with a different slope in each channel."""
    height, width, stripe, halvings, offset = PICTURES[k]
    row, column, channel = np.ogrid[:height, :width, :3]
    waves = (row * row * (k + 3) + row * column * (channel + 1) * 5 + column * (k + 1) * 77) // stripe % 256
    return ((waves >> halvings) + offset).astype(np.uint8)


def feature_sets() -> tuple[np.ndarray, np.ndarray]:
    """Real and generated features, float32 (300, 32): random walks along the dimensions, the generated ones tighter."""
    real, generated = (np.random.RandomState(seed).random_sample((300, 32)) - 0.5 for seed in (1, 2))
    return np.cumsum(real, axis=1).astype(np.float32), (0.85 * np.cumsum(generated, axis=1) + 0.4).astype(np.float32)


def logits() -> np.ndarray:
    """float32 (300, 40), from sure to undecided rows."""
    random = np.random.RandomState(3)
    return (20 * random.random_sample((300, 40)) * random.random_sample((300, 1))).astype(np.float32)


def recipe_sha256(state: Mapping[str, np.ndarray]) -> str:
    """Of every number above; a golden file made from others is out of date."""
    digest = hashlib.sha256()
    for name in sorted(state):
        digest.update(name.encode() + np.ascontiguousarray(state[name]).tobytes())
    for array in (*map(picture, range(len(PICTURES))), *feature_sets(), logits()):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
