"""Tests of the VGG16 features against a functional formula, and tests of wrong weight files."""

import numpy as np
import pytest
import safetensors.torch
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from pipelines.metrics import vgg16
from pipelines.metrics.vgg16 import VGG16, compute_vgg16_features, describe_vgg16, load_vgg16

# Table 1 of Simonyan and Zisserman (2015), column D: channels of the convolutions between the pooling layers.
BLOCKS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))


@pytest.fixture(scope="module")
def state() -> dict[str, Tensor]:
    """Random weights whose features neither vanish nor explode, with torchvision's names."""
    generator, state, number, inputs = torch.Generator().manual_seed(0), {}, 0, 3
    for block in BLOCKS:
        for outputs in block:
            weight = torch.empty(outputs, inputs, 3, 3).normal_(generator=generator) * (2 / (9 * inputs)) ** 0.5
            state[f"features.{number}.weight"] = weight
            state[f"features.{number}.bias"] = torch.empty(outputs).normal_(generator=generator) * 0.1
            number, inputs = number + 2, outputs  # each convolution is followed by a ReLU
        number += 1  # a pooling layer
    for name, inputs, outputs in (("0", 25088, 4096), ("3", 4096, 4096)):
        scale = 2 * (3 / inputs) ** 0.5  # uniform numbers need a fifth of the time of normal numbers
        weight = (torch.empty(outputs, inputs).uniform_(generator=generator) - 0.5) * scale
        state[f"classifier.{name}.weight"] = weight
        state[f"classifier.{name}.bias"] = torch.full((outputs,), 0.01)
    return state


@pytest.fixture(scope="module")
def network(state) -> VGG16:
    with torch.device("meta"):
        network = VGG16()
    network.load_state_dict(state, assign=True)
    return network


def compute_reference(state: dict[str, Tensor], picture: np.ndarray) -> Tensor:
    """VGG16 of one picture (224, 224, 3) as the published list of layers, in functional form."""
    scaled = torch.from_numpy(picture).double() / 255
    x = ((scaled - torch.tensor([0.485, 0.456, 0.406])) / torch.tensor([0.229, 0.224, 0.225])).float()
    x, number = x.movedim(-1, 0)[None], 0
    for block in BLOCKS:
        for _ in block:
            x = F.relu(F.conv2d(x, state[f"features.{number}.weight"], state[f"features.{number}.bias"], padding=1))
            number += 2
        x, number = F.max_pool2d(x, kernel_size=2, stride=2), number + 1
    x = F.adaptive_avg_pool2d(x, (7, 7)).reshape(1, -1)
    for layer in ("classifier.0", "classifier.3"):
        x = F.relu(x @ state[f"{layer}.weight"].T + state[f"{layer}.bias"])
    return x[0]


def make_pictures(n: int, size: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (n, size, size, 3), dtype=np.uint8)


def test_vgg16_equals_the_published_layers(network, state):
    pictures = make_pictures(2, 224)
    found = compute_vgg16_features(network, pictures)
    for row, picture in zip(found, pictures, strict=True):
        expected = compute_reference(state, picture).numpy()
        assert expected.std() > 0.05  # the test would otherwise compare zeros
        assert np.allclose(row, expected, rtol=1e-3, atol=1e-4 * expected.max())


def test_vgg16_equals_torchvision(network, state):
    torchvision = pytest.importorskip("torchvision")
    theirs = torchvision.models.vgg16(weights=None).eval()
    classes = {"classifier.6.weight": torch.zeros(1000, 4096), "classifier.6.bias": torch.zeros(1000)}
    theirs.load_state_dict(state | classes)
    x = torch.randn(1, 3, 224, 224, generator=torch.Generator().manual_seed(1))
    pooled = theirs.avgpool(theirs.features(x)).flatten(1)
    assert torch.allclose(network(x), theirs.classifier[:5](pooled), rtol=1e-3, atol=1e-4)


def test_vgg16_resizes_whole_pictures_like_pillow(network):
    picture = make_pictures(1, 256)
    picture[:] = np.asarray(Image.fromarray(picture[0]).resize((256, 256)).convert("L"))[..., None]
    resized = np.asarray(Image.fromarray(picture[0]).resize((224, 224), Image.Resampling.BILINEAR))[None]
    found, expected = (compute_vgg16_features(network, part) for part in (picture, resized))
    assert np.abs(found - expected).max() < 0.02 * expected.max()  # Pillow rounds to 8 bits


def test_load_vgg16_keeps_weights_and_drops_the_classifier(state, tmp_path, monkeypatch):
    path = tmp_path / "vgg16.safetensors"
    safetensors.torch.save_file(state | {"classifier.6.bias": torch.zeros(1000)}, path)
    loaded = load_vgg16(path).state_dict()
    assert loaded.keys() == state.keys() and all(torch.equal(loaded[name], state[name]) for name in state)
    assert "another file" in describe_vgg16(path)
    monkeypatch.setattr(vgg16, "KNOWN_SHA256", vgg16.hash_vgg16_weights(path))
    assert describe_vgg16(path).endswith("torchvision's file")


def test_load_vgg16_rejects_wrong_files(state, tmp_path):
    small = {name: value for name, value in state.items() if value.ndim == 1}
    torch.save(small, tmp_path / "partial.pth")
    torch.save(small | {"features.0.weight": torch.zeros(64, 3, 5, 5)}, tmp_path / "wrong.pth")
    torch.save([1, 2], tmp_path / "list.pth")
    (tmp_path / "text.pth").write_text("no weights")
    (tmp_path / "vgg16-397923af.pth").write_text("cut off")
    for name, message in {
        "partial.pth": r"partial\.pth: not the weights of VGG16 \(tensor features\.0\.weight is missing\)",
        "wrong.pth": r"features\.0\.weight is \(64, 3, 5, 5\), expected \(64, 3, 3, 3\)",
        "list.pth": "a list, not a state dict",
        "text.pth": r"text\.pth: not a readable state dict",
        "vgg16-397923af.pth": "file is corrupted; its sha256 starts with .*, expected 397923af",
        "absent.pth": r"absent\.pth: no such file; VGG16 weights must be local",
    }.items():
        with pytest.raises(ValueError, match=message):
            load_vgg16(tmp_path / name)
    with pytest.raises(ValueError, match="pictures must be uint8"):
        compute_vgg16_features(VGG16.__new__(VGG16), np.zeros((1, 8, 8, 3)))
