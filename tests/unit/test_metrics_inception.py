"""Tests that compare the Inception network with published parameter names, plain torch layers and torch-fidelity."""

import hashlib
import warnings

import numpy as np
import pytest
import safetensors.numpy
import safetensors.torch
import torch
import torch.nn.functional as F
from golden import golden_recipe
from safetensors import safe_open

from pipelines.metrics import inception
from pipelines.metrics.inception import (
    Inception,
    compute_inception_features,
    compute_random_features,
    describe_weights,
    load_inception,
    resize_like_tensorflow1,
)


@pytest.fixture(scope="module")
def network() -> Inception:
    """An Inception network with random weights and batch norm statistics, in which no layer has only zero
    activations."""
    torch.manual_seed(0)
    network = Inception()
    for module in network.modules():
        if isinstance(module, torch.nn.Conv2d):
            torch.nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
        elif isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.1)
            module.running_var.uniform_(0.5, 1.5)
            torch.nn.init.uniform_(module.weight, 0.8, 1.2)
            torch.nn.init.normal_(module.bias, 0, 0.1)
    network.fc.bias.normal_(0, 10)
    return network


def make_pictures(n=2, height=64, width=64, seed=0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (n, height, width, 3), dtype=np.uint8)


# ------------------------------------------------------------------------------------------ architecture

# Shapes (output, input, kernel) of the convolutions in converted weight files (pytorch-fid, torch-fidelity).
# The value 0 for the input means the number of input channels of the block.
A = {
    "branch1x1": (64, 0, 1, 1), "branch5x5_1": (48, 0, 1, 1), "branch5x5_2": (64, 48, 5, 5),
    "branch3x3dbl_1": (64, 0, 1, 1), "branch3x3dbl_2": (96, 64, 3, 3), "branch3x3dbl_3": (96, 96, 3, 3),
}  # fmt: skip
E = {
    "branch1x1": (320, 0, 1, 1), "branch3x3_1": (384, 0, 1, 1),
    "branch3x3_2a": (384, 384, 1, 3), "branch3x3_2b": (384, 384, 3, 1),
    "branch3x3dbl_1": (448, 0, 1, 1), "branch3x3dbl_2": (384, 448, 3, 3),
    "branch3x3dbl_3a": (384, 384, 1, 3), "branch3x3dbl_3b": (384, 384, 3, 1), "branch_pool": (192, 0, 1, 1),
}  # fmt: skip


def list_branches_c(channels):
    return {
        "branch1x1": (192, 0, 1, 1), "branch7x7_1": (channels, 0, 1, 1), "branch7x7_2": (channels, channels, 1, 7),
        "branch7x7_3": (192, channels, 7, 1), "branch7x7dbl_1": (channels, 0, 1, 1),
        "branch7x7dbl_2": (channels, channels, 7, 1), "branch7x7dbl_3": (channels, channels, 1, 7),
        "branch7x7dbl_4": (channels, channels, 7, 1), "branch7x7dbl_5": (192, channels, 1, 7),
        "branch_pool": (192, 0, 1, 1),
    }  # fmt: skip


BLOCKS = {
    "Mixed_5b": (192, A | {"branch_pool": (32, 0, 1, 1)}),
    "Mixed_5c": (256, A | {"branch_pool": (64, 0, 1, 1)}),
    "Mixed_5d": (288, A | {"branch_pool": (64, 0, 1, 1)}),
    "Mixed_6a": (288, {
        "branch3x3": (384, 0, 3, 3), "branch3x3dbl_1": (64, 0, 1, 1), "branch3x3dbl_2": (96, 64, 3, 3),
        "branch3x3dbl_3": (96, 96, 3, 3),
    }),
    "Mixed_6b": (768, list_branches_c(128)), "Mixed_6c": (768, list_branches_c(160)),
    "Mixed_6d": (768, list_branches_c(160)), "Mixed_6e": (768, list_branches_c(192)),
    "Mixed_7a": (768, {
        "branch3x3_1": (192, 0, 1, 1), "branch3x3_2": (320, 192, 3, 3), "branch7x7x3_1": (192, 0, 1, 1),
        "branch7x7x3_2": (192, 192, 1, 7), "branch7x7x3_3": (192, 192, 7, 1), "branch7x7x3_4": (192, 192, 3, 3),
    }),
    "Mixed_7b": (1280, E), "Mixed_7c": (2048, E),
}  # fmt: skip
STEM = {
    "Conv2d_1a_3x3": (32, 3, 3, 3), "Conv2d_2a_3x3": (32, 32, 3, 3), "Conv2d_2b_3x3": (64, 32, 3, 3),
    "Conv2d_3b_1x1": (80, 64, 1, 1), "Conv2d_4a_3x3": (192, 80, 3, 3),
}  # fmt: skip


def list_published_shapes() -> dict[str, tuple[int, ...]]:
    convs = dict(STEM)
    for block, (inputs, branches) in BLOCKS.items():
        for branch, (outputs, own_inputs, height, width) in branches.items():
            convs[f"{block}.{branch}"] = (outputs, own_inputs or inputs, height, width)
    shapes = {"fc.weight": (1008, 2048), "fc.bias": (1008,)}
    for name, shape in convs.items():
        shapes[f"{name}.conv.weight"] = shape
        for part in ("weight", "bias", "running_mean", "running_var"):
            shapes[f"{name}.bn.{part}"] = shape[:1]
    return shapes


def test_inception_parameters_match_published_names_and_shapes(network):
    ours = {name: tuple(value.shape) for name, value in network.state_dict().items() if "num_batches" not in name}
    assert ours == list_published_shapes()
    # Inception v3 with 1000 classes and no auxiliary head has 23,834,568 parameters. The FID network has 1008 classes.
    assert sum(p.numel() for p in network.parameters()) == 23_834_568 + 8 * 2049


def test_inception_features_equal_literal_forward_pass(network):
    """The reference applies the weights with plain functions, block by block, as the TensorFlow graph does."""
    images = make_pictures(1, 80, 100)
    state = network.state_dict()

    def conv(name, x, stride=1, padding=0):
        x = F.conv2d(x, state[f"{name}.conv.weight"], stride=stride, padding=padding)
        mean, variance, scale, shift = (
            state[f"{name}.bn.{part}"][:, None, None] for part in ("running_mean", "running_var", "weight", "bias")
        )
        return torch.clamp((x - mean) / torch.sqrt(variance + 0.001) * scale + shift, min=0)

    def average(x):
        ones = torch.ones_like(x[:, :1])
        kernel = torch.ones(1, 1, 3, 3)
        sums = F.conv2d(x.flatten(0, 1)[:, None], kernel, padding=1).view_as(x)
        return sums / F.conv2d(ones, kernel, padding=1)

    def block_a(n, x):
        five = conv(f"{n}.branch5x5_2", conv(f"{n}.branch5x5_1", x), padding=2)
        double = conv(f"{n}.branch3x3dbl_2", conv(f"{n}.branch3x3dbl_1", x), padding=1)
        double = conv(f"{n}.branch3x3dbl_3", double, padding=1)
        return torch.cat([conv(f"{n}.branch1x1", x), five, double, conv(f"{n}.branch_pool", average(x))], 1)

    def block_c(n, x):
        wide, tall = (0, 3), (3, 0)
        seven = conv(f"{n}.branch7x7_2", conv(f"{n}.branch7x7_1", x), padding=wide)
        seven = conv(f"{n}.branch7x7_3", seven, padding=tall)
        double = conv(f"{n}.branch7x7dbl_1", x)
        for i, padding in zip((2, 3, 4, 5), (tall, wide, tall, wide), strict=True):
            double = conv(f"{n}.branch7x7dbl_{i}", double, padding=padding)
        return torch.cat([conv(f"{n}.branch1x1", x), seven, double, conv(f"{n}.branch_pool", average(x))], 1)

    def block_e(n, x, pooled):
        three = conv(f"{n}.branch3x3_1", x)
        double = conv(f"{n}.branch3x3dbl_2", conv(f"{n}.branch3x3dbl_1", x), padding=1)
        return torch.cat(
            [
                conv(f"{n}.branch1x1", x),
                conv(f"{n}.branch3x3_2a", three, padding=(0, 1)),
                conv(f"{n}.branch3x3_2b", three, padding=(1, 0)),
                conv(f"{n}.branch3x3dbl_3a", double, padding=(0, 1)),
                conv(f"{n}.branch3x3dbl_3b", double, padding=(1, 0)),
                conv(f"{n}.branch_pool", pooled),
            ],
            1,
        )

    x = torch.from_numpy(resize_literally(images[0].astype(np.float64), 299)).permute(2, 0, 1)[None].float()
    x = (x - 128) / 128
    x = conv("Conv2d_2b_3x3", conv("Conv2d_2a_3x3", conv("Conv2d_1a_3x3", x, stride=2)), padding=1)
    x = conv("Conv2d_4a_3x3", conv("Conv2d_3b_1x1", F.max_pool2d(x, 3, 2)))
    x = F.max_pool2d(x, 3, 2)
    for name in ("Mixed_5b", "Mixed_5c", "Mixed_5d"):
        x = block_a(name, x)
    double = conv("Mixed_6a.branch3x3dbl_2", conv("Mixed_6a.branch3x3dbl_1", x), padding=1)
    double = conv("Mixed_6a.branch3x3dbl_3", double, stride=2)
    x = torch.cat([conv("Mixed_6a.branch3x3", x, stride=2), double, F.max_pool2d(x, 3, 2)], 1)
    for name in ("Mixed_6b", "Mixed_6c", "Mixed_6d", "Mixed_6e"):
        x = block_c(name, x)
    three = conv("Mixed_7a.branch3x3_2", conv("Mixed_7a.branch3x3_1", x), stride=2)
    seven = conv("Mixed_7a.branch7x7x3_2", conv("Mixed_7a.branch7x7x3_1", x), padding=(0, 3))
    seven = conv("Mixed_7a.branch7x7x3_4", conv("Mixed_7a.branch7x7x3_3", seven, padding=(3, 0)), stride=2)
    x = torch.cat([three, seven, F.max_pool2d(x, 3, 2)], 1)
    x = block_e("Mixed_7b", x, average(x))
    x = block_e("Mixed_7c", x, F.max_pool2d(x, 3, 1, 1))
    assert x.shape == (1, 2048, 8, 8)
    expected = x.mean((2, 3))

    pool3, _, logits = compute_inception_features(network, images)
    scale = expected.abs().max().item()
    assert expected.std().item() > 0.01 * scale  # the activations are not 0
    np.testing.assert_allclose(pool3, expected, atol=1e-4 * scale)
    np.testing.assert_allclose(logits, expected @ state["fc.weight"].T, atol=1e-3 * scale)


def resize_literally(picture: np.ndarray, size: int) -> np.ndarray:
    """Resize (height, width, 3) to (size, size, 3) pixel by pixel, as ResizeBilinear of TensorFlow 1 does."""
    height, width, _ = picture.shape
    out = np.empty((size, size, 3))
    for row in range(size):
        y = row * height / size
        y0 = int(y)
        y1 = min(y0 + 1, height - 1)
        for col in range(size):
            x = col * width / size
            x0 = int(x)
            x1 = min(x0 + 1, width - 1)
            top = picture[y0, x0] + (picture[y0, x1] - picture[y0, x0]) * (x - x0)
            bottom = picture[y1, x0] + (picture[y1, x1] - picture[y1, x0]) * (x - x0)
            out[row, col] = top + (bottom - top) * (y - y0)
    return out


@pytest.mark.parametrize(("height", "width", "size"), [(5, 7, 13), (16, 9, 6), (12, 12, 12)])
def test_inception_resize_equals_tensorflow(height, width, size):
    picture = make_pictures(1, height, width)[0].astype(np.float64)
    got = resize_like_tensorflow1(torch.from_numpy(picture).permute(2, 0, 1)[None], size)[0].permute(1, 2, 0)
    np.testing.assert_allclose(got, resize_literally(picture, size), atol=1e-3)


def test_inception_features_are_independent_of_batch(network):
    images = make_pictures(3)
    together = compute_inception_features(network, images, batch_size=3)
    alone = compute_inception_features(network, images, batch_size=1)
    for got, expected in zip(together, alone, strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-4)
    assert [part.shape for part in compute_inception_features(network, images[:0])] == [(0, 2048), (0, 2023), (0, 1008)]


def test_inception_spatial_features_are_mixed_6_channels_last(network):
    """Features have TensorFlow's order (row, column, channel), like the moments in ADM's reference batches."""
    maps = []
    hook = network.Mixed_6d.branch1x1.register_forward_hook(lambda module, inputs, output: maps.append(output))
    spatial = compute_inception_features(network, make_pictures()).spatial
    hook.remove()
    assert maps[0].shape == (2, 192, 17, 17) and maps[0].min() == 0  # the features are outputs of a ReLU
    for row, column, channel in ((0, 0, 0), (0, 0, 6), (0, 1, 0), (3, 5, 2), (16, 16, 6)):
        np.testing.assert_array_equal(spatial[:, (row * 17 + column) * 7 + channel], maps[0][:, channel, row, column])


# ------------------------------------------------------------------------------------------ torch-fidelity


@pytest.fixture(scope="module")
def golden_network() -> Inception:
    network = Inception()
    state = golden_recipe.random_state_dict({name: value.shape for name, value in network.state_dict().items()})
    with safe_open(golden_recipe.GOLDEN, "numpy") as golden:
        made_from = golden.metadata()["recipe_sha256"]
    assert golden_recipe.recipe_sha256(state) == made_from, "run tests/golden/make_inception_golden.py again"
    network.load_state_dict({name: torch.from_numpy(value) for name, value in state.items()})
    return network


def compute_golden_difference(network: Inception) -> dict[str, float]:
    """Return the largest difference to torch-fidelity per layer, divided by the largest feature of the layer."""
    layers: dict[str, list[torch.Tensor]] = {"64": [], "192": [], "768": []}
    hooks = [
        getattr(network, module).register_forward_hook(lambda m, i, x, layer=layer: layers[layer].append(x))
        for layer, module in (("64", "Conv2d_2b_3x3"), ("192", "Conv2d_4a_3x3"), ("768", "Mixed_6e"))
    ]
    features = [
        compute_inception_features(network, golden_recipe.picture(k)[None]) for k in range(len(golden_recipe.PICTURES))
    ]
    for hook in hooks:
        hook.remove()
    got = {"2048": "pool3", "spatial": "spatial", "logits_unbiased": "logits"}
    got = {layer: np.concatenate([getattr(part, name) for part in features]) for layer, name in got.items()}
    for layer, maps in layers.items():
        pooled = maps if layer == "768" else [F.max_pool2d(x, 3, stride=2) for x in maps]
        got[layer] = torch.cat([x.mean((2, 3)) for x in pooled]).numpy()
    expected = safetensors.numpy.load_file(golden_recipe.GOLDEN)
    assert got.keys() == expected.keys()
    return {layer: np.abs(got[layer] - expected[layer]).max() / np.abs(expected[layer]).max() for layer in expected}


def test_inception_features_equal_torch_fidelity(golden_network):
    """In each layer, the difference to torch-fidelity is at most 1e-5 of the largest feature, for enlarged and reduced
    images."""
    difference = compute_golden_difference(golden_network)
    assert max(difference.values()) < 1e-5, difference


def test_inception_layers_distinguish_golden_pictures():
    for layer, features in safetensors.numpy.load_file(golden_recipe.GOLDEN).items():
        assert 0.1 < np.abs(features).max() < 100, layer
        gaps = np.abs(features[:, None] - features[None]).max(axis=-1) / features.std()
        assert gaps[~np.eye(len(features), dtype=bool)].min() > 0.1, layer


def test_inception_parity_detects_half_pixel_shift(golden_network, monkeypatch):
    def resize_like_torch(x, size):
        return F.interpolate(x, (size, size), mode="bilinear", align_corners=False)

    monkeypatch.setattr(inception, "resize_like_tensorflow1", resize_like_torch)
    assert min(compute_golden_difference(golden_network).values()) > 1e-3


@pytest.mark.parametrize("mistake", ["7c averages", "padding counts", "epsilon"])
def test_inception_parity_detects_layer_variants(golden_network, monkeypatch, mistake):
    if mistake == "7c averages":
        monkeypatch.setattr(golden_network.Mixed_7c, "max_pool", False)
    elif mistake == "padding counts":
        average = F.avg_pool2d
        monkeypatch.setattr(F, "avg_pool2d", lambda x, *a, count_include_pad, **k: average(x, *a, **k))
    else:
        for module in golden_network.modules():
            if isinstance(module, torch.nn.BatchNorm2d):
                monkeypatch.setattr(module, "eps", 1e-5)
    assert compute_golden_difference(golden_network)["2048"] > 1e-3


# ------------------------------------------------------------------------------------------ weight files


def test_inception_loads_pth_and_safetensors(network, tmp_path):
    # Converted weight files do not contain num_batches_tracked, because the files are older than this buffer.
    state = {name: value for name, value in network.state_dict().items() if "num_batches" not in name}
    torch.save(state, tmp_path / "weights.pth")
    safetensors.torch.save_file(state, tmp_path / "weights.safetensors")
    images = make_pictures(1)
    expected = compute_inception_features(network, images)
    for name in ("weights.pth", "weights.safetensors"):
        with pytest.warns(UserWarning, match="scores are not comparable with published scores"):
            loaded = load_inception(tmp_path / name)
        assert loaded.weights_sha256 == hashlib.sha256((tmp_path / name).read_bytes()).hexdigest()
        for got, want in zip(compute_inception_features(loaded, images), expected, strict=True):
            np.testing.assert_array_equal(got, want)


def test_inception_rejects_missing_corrupted_or_foreign_file(tmp_path):
    with pytest.raises(ValueError, match="no such file"):
        load_inception(tmp_path / "absent.pth")
    known = tmp_path / "weights-inception-2015-12-05-6726825d.pth"
    known.write_bytes(b"half a download")
    with pytest.raises(ValueError, match=r"6726825d\.pth: file is corrupted; its sha256 starts with"):
        load_inception(known)
    for name in ("broken.pth", "broken.safetensors"):
        (tmp_path / name).write_bytes(b"half a download")
        with pytest.raises(ValueError, match=f"{name}: not a readable state dict"):
            load_inception(tmp_path / name)
    torch.save({"fc.weight": torch.zeros(1000, 2048)}, tmp_path / "other.pth")
    with pytest.raises(ValueError, match="not the weights of the FID Inception network"):
        load_inception(tmp_path / "other.pth")
    torch.save([torch.zeros(3)], tmp_path / "list.pth")
    with pytest.raises(ValueError, match=r"list\.pth"):
        load_inception(tmp_path / "list.pth")


def test_inception_recognizes_published_weights_by_sha(network, tmp_path, monkeypatch):
    path = tmp_path / "mine.pth"
    torch.save(network.state_dict(), path)
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    assert f"{path}, sha256 {sha256}: not weights-inception-2015-12-05-6726825d.pth" in describe_weights(path)
    monkeypatch.setattr(inception, "KNOWN_SHA256", sha256)
    assert describe_weights(path) == f"Inception weights {path}, sha256 {sha256}: the published file"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_inception(path).weights_sha256 == sha256


def test_inception_gpu_convolutions_use_full_precision(network):
    allowed = []
    hook = network.Mixed_7c.register_forward_hook(lambda *_: allowed.append(torch.backends.cudnn.allow_tf32))
    before = torch.backends.cudnn.allow_tf32, torch.backends.cudnn.enabled
    compute_inception_features(network, make_pictures(1))
    hook.remove()
    assert allowed == [False]
    assert (torch.backends.cudnn.allow_tf32, torch.backends.cudnn.enabled) == before


def test_inception_rejects_images_of_another_kind(network):
    with pytest.raises(ValueError, match="uint8"):
        compute_inception_features(network, make_pictures().astype(np.float32))
    with pytest.raises(ValueError, match="uint8"):
        network(torch.zeros(1, 3, 8, 8, dtype=torch.uint8))


# ------------------------------------------------------------------------------------------ without weights


def test_random_features_are_fixed_finite_and_discriminative():
    images = make_pictures(5)
    features = compute_random_features(images)
    assert features.shape == (5, 480) and np.isfinite(features).all()
    np.testing.assert_array_equal(features, compute_random_features(images))
    np.testing.assert_allclose(features, compute_random_features(images, batch_size=2), atol=1e-5)
    assert np.abs(features - compute_random_features(images, seed=1)).max() > 0.01
    black, white = np.zeros_like(images), np.full_like(images, 255)
    assert np.abs(compute_random_features(black) - compute_random_features(white)).max() > 0.1
    # Results are comparable with older reports only if the features do not change.
    np.testing.assert_allclose(
        compute_random_features(white[:1])[0, [0, 100, 300, 479]], [2.72897, 0.675502, 0.103905, 1.17206], rtol=1e-4
    )
    assert compute_random_features(images[:0]).shape == (0, 480)
