"""Tests of the ablations: box encodings, the small autoencoder and the optional components of the layout VAE."""

import itertools
import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import random_scene, small_spec
from scipy.spatial.transform import Rotation

from jobs.implementation.ablate_lvae import sum_training_seconds
from models.batch import LayoutBatch
from models.geometry.encodings import ENCODINGS, compute_harmonics, find_nearest_frame
from models.layout import LayoutSpec
from models.lvae import LayoutVAE
from models.presets import LVAE_PRESETS
from models.scene import Grid, canonicalize_boxes, make_yaw_rotation
from models.studies.orientation_study import (
    BOX_DISTRIBUTIONS,
    OneObjectAutoencoder,
    StudyConfig,
    draw_boxes,
    train_autoencoder,
)
from models.tensors import decode_layout, make_layout_batch
from models.vae.config import override_options
from models.vae.losses import compute_lvae_loss
from models.vae.matching import MatchWeights
from models.vae.outputs import LayoutOutput
from pipelines.evaluation.ablation import (
    AUGMENTATION_VARIANTS,
    BRANCH_VARIANTS,
    DECODER_VARIANTS,
    DETR_VARIANTS,
    GROUND_VARIANTS,
    LOST_YAW_IOU3D,
    CenteredBoxes,
    Trial,
    compute_mean_iou3d,
    compute_square_iou,
    compute_yaw_loss,
    draw_training_boxes,
    list_trials,
    measure_accuracy,
)
from pipelines.preprocess.sources.town.generator import generate_town
from pipelines.schema.scene_subset import SceneSubset
from pipelines.schema.tables import Shard

CUBE_SYMMETRIES = [
    np.diag(signs)[:, list(order)]
    for order in itertools.permutations(range(3))
    for signs in itertools.product((-1.0, 1.0), repeat=3)
]  # 48 rotations and reflections that map a cube to itself


def compute_corners(rotation: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """Return the corners (..., 8, 3) of boxes that are centred at zero."""
    signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    return np.einsum("...ij,...kj->...ki", rotation, signs * np.asarray(size_m)[..., None, :])


def compute_box_distance(a: tuple, b: tuple) -> np.ndarray:
    """Return the Hausdorff distance (...) of the corners, which is 0 for two descriptions of the same box."""
    gaps = np.linalg.norm(compute_corners(*a)[..., :, None, :] - compute_corners(*b)[..., None, :, :], axis=-1)
    return np.maximum(gaps.min(axis=-1).max(axis=-1), gaps.min(axis=-2).max(axis=-1))


def draw_boxes_of_any_size(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return n boxes with random rotations and sizes.

    One third of the boxes have three different extents, one third have two equal extents, and one third are cubes.
    """
    rng = np.random.default_rng(seed)
    size = rng.uniform(0.3, 5.0, (n, 3))
    size[n // 3 :, 1] = size[n // 3 :, 0]
    size[2 * n // 3 :, 2] = size[2 * n // 3 :, 0]
    return Rotation.random(n, rng=rng).as_matrix(), size


# ---------------------------------------------------------------------------------------------------- encodings


@pytest.mark.parametrize("name", ENCODINGS)
def test_encoding_round_trip_keeps_corners(name):
    rotation, size = draw_boxes_of_any_size(3000)
    if name == "cholesky":  # this encoding is ambiguous for equal extents
        rotation, size = rotation[:1000], size[:1000]
    code = ENCODINGS[name].encode(rotation, size)
    assert code.shape == (len(size), ENCODINGS[name].entries)
    decoded = ENCODINGS[name].decode(code)
    assert np.allclose(np.linalg.det(decoded[0]), 1)
    assert compute_box_distance((rotation, size), decoded).max() < 1e-6
    batched = ENCODINGS[name].decode(code[:6].reshape(2, 3, -1))  # batch dimensions are arbitrary
    assert np.allclose(batched[0].reshape(6, 3, 3), decoded[0][:6])


def test_encoding_is_unique_per_box_except_quaternion():
    rotation, size = draw_boxes_of_any_size(60)
    codes = {
        name: np.stack([e.encode(rotation @ s, size @ np.abs(s)) for s in CUBE_SYMMETRIES if np.linalg.det(s) > 0])
        for name, e in ENCODINGS.items()
    }
    assert np.ptp(codes["cholesky"], axis=0).max() < 1e-12
    assert np.ptp(codes["octahedral"], axis=0).max() < 1e-12
    assert np.ptp(codes["quaternion"], axis=0).max() > 1


def test_encoding_is_bi_lipschitz_only_if_octahedral():
    """The test checks a lower and an upper bound of code change divided by corner distance, for near and far pairs."""
    rng = np.random.default_rng(1)
    rotation, size = draw_boxes_of_any_size(6000)
    step = 10 ** rng.uniform(-4, 0, (6000, 1))
    turn = Rotation.from_rotvec(step * rng.standard_normal((6000, 3))).as_matrix()
    grown = np.maximum(size + rng.integers(0, 2, (6000, 1)) * step * rng.standard_normal((6000, 3)), 0.3)
    other = canonicalize_boxes(turn @ rotation, grown)  # datasets contain canonical boxes
    distance = compute_box_distance((rotation, size), other) / size.max(axis=1)
    ratio = {
        name: np.linalg.norm(e.encode(*other) - e.encode(*canonicalize_boxes(rotation, size)), axis=1) / distance
        for name, e in ENCODINGS.items()
    }
    assert ratio["octahedral"].min() > 0.05 and ratio["octahedral"].max() < 50
    assert ratio["cholesky"].min() < 1e-6  # A rotated cube has the same code.
    assert ratio["quaternion"].max() > 1000  # Length and width are swapped, or yaw jumps between -pi/2 and pi/2.


@pytest.mark.parametrize("name", ["cholesky", "octahedral"])
def test_encoding_is_continuous_where_length_equals_width(name):
    """If a box changes in smaller steps, its encoding also changes in smaller steps, even where length equals width.

    The path turns the box by 180 degrees, tilts it and returns to the same box.
    """
    largest = []
    for count in (501, 5001):
        t = np.linspace(0, 1, count)
        rotation = (
            make_yaw_rotation(np.pi * t)
            @ Rotation.from_rotvec(np.outer(0.3 * np.sin(2 * np.pi * t), [1, 0, 0])).as_matrix()
        )
        size = np.stack([3 + np.cos(2 * np.pi * t), 3 - np.cos(2 * np.pi * t), 1.5 + 0 * t], axis=1)
        rotation, size = canonicalize_boxes(rotation, size)
        code = ENCODINGS[name].encode(rotation, size)
        assert np.allclose(code[0], code[-1])
        largest.append(np.linalg.norm(np.diff(code, axis=0), axis=1).max() * (count - 1))
    assert largest[1] < 1.05 * largest[0] < 60
    jumps = np.linalg.norm(np.diff(ENCODINGS["quaternion"].encode(rotation, size), axis=0), axis=1)
    assert jumps.max() > 0.5


def test_harmonics_are_degree_four_and_equivariant_to_yaw():
    basis = compute_harmonics()
    flat = basis.reshape(9, 81)
    assert np.allclose(flat @ flat.T, np.eye(9))
    assert np.allclose(np.einsum("kaacd->kcd", basis), 0)
    assert all(np.allclose(basis, basis.transpose(0, *(1 + np.array(p)))) for p in itertools.permutations(range(4)))
    yaw = np.linspace(-np.pi, np.pi, 50)
    code = ENCODINGS["octahedral"].encode(make_yaw_rotation(yaw), np.ones((50, 3)))[:, 6:]
    turning = np.stack([np.cos(4 * yaw), np.sin(4 * yaw)], axis=1) / np.sqrt(2)
    assert np.allclose(code[:, :2], turning) and np.allclose(code[:, 2:], code[0, 2:])
    assert np.isfinite(
        find_nearest_frame(np.zeros((1, 9)))
    ).all()  # the decoder accepts all values that a network predicts


# ----------------------------------------------------------------------------------------------------- lost yaw


def test_cholesky_error_of_square_equals_closed_form():
    turn = np.linspace(0, np.pi / 2, 2001)
    size = np.broadcast_to([2.0, 2.0, 1.5], (len(turn), 3))
    still = CenteredBoxes(np.broadcast_to(np.eye(3), (len(turn), 3, 3)), size)
    iou = compute_mean_iou3d(still, CenteredBoxes(make_yaw_rotation(turn), size))
    assert np.allclose(iou, compute_square_iou(turn), atol=1e-6)
    assert abs(np.trapezoid(iou, turn) / (np.pi / 2) - LOST_YAW_IOU3D) < 1e-6


def test_cholesky_loses_yaw_of_squares_and_octahedral_keeps_it():
    def compute_loss(encoding, share):
        return compute_yaw_loss(encoding, share, 1e-3, 400)["iou3d_lost_with_yaw"]

    assert abs(compute_loss("cholesky", 1.0) - (1 - LOST_YAW_IOU3D)) < 0.02
    assert compute_loss("cholesky", 0.9) > 4 * compute_loss("cholesky", 0.5)
    assert all(compute_loss("octahedral", share) < 1e-3 for share in (0.5, 0.9, 1.0))


# -------------------------------------------------------------------------------------------------- autoencoder


def test_autoencoder_bodies_are_equal_and_small():
    torch.manual_seed(0)
    ends = ("encoder.project_in.", "decoder.heads.0.features.4.")
    bodies = []
    for encoding in ENCODINGS.values():
        torch.manual_seed(0)
        model = OneObjectAutoencoder(encoding.entries)
        assert sum(p.numel() for p in model.parameters()) <= 500_000
        bodies.append({n: p for n, p in model.state_dict().items() if not n.startswith(ends)})
    for body in bodies[1:]:
        assert body.keys() == bodies[0].keys()
        assert all(torch.equal(body[name], bodies[0][name]) for name in body)  # the initial weights are also equal


def test_trial_training_sets_are_nested_and_differ_by_seed():
    large, small = (draw_training_boxes(Trial("vehicle", "cholesky", n, 3)) for n in (10_000, 1200))
    assert all((a[:1200] == b).all() for a, b in zip(large, small, strict=True))
    other = draw_training_boxes(Trial("vehicle", "cholesky", 1200, 4))
    assert not np.isin(other.size_m, large.size_m).any()
    low, high = BOX_DISTRIBUTIONS["vehicle"].length_m
    assert low <= large.size_m[:, 0].min() and large.size_m[:, 0].max() <= high
    assert (large.size_m[:, 1] < large.size_m[:, 0]).all()
    with pytest.raises(ValueError, match="expected sizes of at least 2"):
        list_trials("vehicle", (), 5)


@pytest.mark.parametrize("name", ENCODINGS)
def test_trial_learns_with_tiny_settings(name):
    torch.set_num_threads(1)
    boxes, truth = draw_boxes(BOX_DISTRIBUTIONS["vehicle"], 128, 0), draw_boxes(BOX_DISTRIBUTIONS["vehicle"], 200, 1)
    iou = []
    for epochs in (0, 15):
        fitted = train_autoencoder(ENCODINGS[name], boxes, StudyConfig(epochs, batch_size=8), 0, moving_only=True)
        rebuilt, _ = fitted.rebuild(truth)
        iou.append(compute_mean_iou3d(truth, rebuilt).mean())
    assert fitted.kept.sum() == {"cholesky": 4, "quaternion": 5, "octahedral": 6}[name]
    assert np.allclose(np.abs(rebuilt.rotation[:, 2]).max(axis=1), 1)  # an angle that the autoencoder omits is 0
    assert iou[1] > iou[0] + 0.05


# ----------------------------------------------------------------------------------------------------- switches


@pytest.mark.parametrize("decoder", ["detr", "cells"])
@pytest.mark.parametrize(
    ("switch", "channels"), [({"split_latent": False}, 32), ({"branches": "ground"}, 16), ({"branches": "objects"}, 16)]
)
def test_layout_vae_switches_disable_their_branch(decoder, switch, channels):
    spec, scenes = small_spec(), [random_scene(i) for i in range(6)]
    torch.manual_seed(0)
    changes = {"objects": {"decoder": decoder}, "shortcut": True, "latent_channels": 16}
    options = override_options(LVAE_PRESETS["smoke"].architecture(), changes)
    lvae, batch = LayoutVAE(layout=spec.to_dict(), **(options | switch)), make_layout_batch(scenes, spec)
    lvae.init_from_data(batch)
    assert lvae.latent_shape == (channels, 8, 8)
    output, posterior = lvae(batch, torch.randn(6, *lvae.latent_shape))
    losses = compute_lvae_loss(output, posterior, batch, spec)
    losses.total.backward()
    ground, objects = (switch.get("branches", "both") in ("both", side) for side in ("ground", "objects"))
    assert (losses.height > 0) == (losses.occupancy > 0) == ground
    assert (losses.center > 0) == (losses.existence > 0) == objects
    names = {name.split("_")[0] for name, p in lvae.named_parameters() if p.grad is not None}
    assert names == {name for name, there in (("ground", ground), ("object", objects)) if there}
    with torch.no_grad():
        rebuilt = [
            decode_layout(x, spec, s) for x, s in zip(lvae.decode(posterior.mean).layouts(), scenes, strict=True)
        ]
    assert all(scene.occupied.any() == ground for scene in rebuilt)
    if not objects:
        assert not any(len(scene) for scene in rebuilt)
    if (
        ground and objects
    ):  # both decoders read the whole latent; the linear start of the ground decoder reads only the ground half
        own, other = lvae.ground_decoder.shortcut.weight.split(16)
        assert (own != 0).any() and not other.any()
        assert (lvae.ground_decoder.shortcut.weight.grad[16:] != 0).any()
        latent = posterior.mean.detach().requires_grad_()
        lvae.decode(latent).features.sum().backward()
        assert (latent.grad[:, :16] != 0).any() and (latent.grad[:, 16:] != 0).any()


def test_layout_vae_config_without_switches_is_full_model():
    flat = {"latent_channels": 4, "channels": [8, 16, 16], "norm_groups": 4, "width": 32, "layers": 1, "heads": 2}
    old = {"layout": small_spec().to_dict()} | flat | {"hidden": 64, "head_hidden": 32, "fold": 1, "least_per_cell": 1}
    lvae = LayoutVAE.from_config(old)
    same = LayoutVAE(layout=small_spec().to_dict(), **LVAE_PRESETS["smoke"].architecture())
    assert lvae.config == same.config
    assert lvae.config.split_latent and lvae.config.branches == "both" and lvae.latent_shape == (8, 8, 8)
    with pytest.raises(ValueError, match="branches is 'sky', expected one of"):
        LayoutVAE.from_config(old | {"branches": "sky"})


def test_ground_study_shrinks_networks_at_equal_latents():
    row = LVAE_PRESETS["town-pixels"].architecture()
    models = {
        name: LayoutVAE(layout=LayoutSpec().to_dict(), **override_options(row, variant.architecture))
        for name, variant in GROUND_VARIANTS.items()
    }
    assert {model.latent_shape for model in models.values()} == {(32, 32, 32)}
    sizes = {name: model.num_parameters() for name, model in models.items()}
    paper = LVAE_PRESETS["kitti360"]
    assert GROUND_VARIANTS["the paper's networks"].architecture["ground"]["channels"] == paper.model.ground.channels
    assert min(sizes, key=sizes.get) in ("half as wide", "an eighth of the paper's widths")
    assert max(sizes, key=sizes.get) == "the paper's networks"


def test_variants_can_be_built_from_preset_town():
    row = LVAE_PRESETS["town"]
    layout = LayoutSpec().with_resolution(row.raster_px).to_dict()
    for study in (BRANCH_VARIANTS, DECODER_VARIANTS, DETR_VARIANTS, GROUND_VARIANTS, AUGMENTATION_VARIANTS):
        for variant in study.values():
            with torch.device("meta"):
                LayoutVAE(layout=layout, **override_options(row.architecture(), variant.architecture))


def test_variant_names_are_valid_for_files_and_mlflow():
    from jobs.implementation.ablate_lvae import make_slug

    studies = (BRANCH_VARIANTS, DECODER_VARIANTS, DETR_VARIANTS, GROUND_VARIANTS, AUGMENTATION_VARIANTS)
    names = [make_slug(name) for study in studies for name in study]
    assert all(re.fullmatch(r"[\w-]+", name) for name in names) and len(set(names)) == len(names) > 33


def test_study_without_trials_releases_its_directory(tmp_path):
    from jobs.implementation.ablate_lvae import guard_study

    guard_study(str(tmp_path), {"dataset": "/nowhere"})
    (tmp_path / "mlflow.json").write_text("{}")
    guard_study(str(tmp_path), {"dataset": "/somewhere"})
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "cells-seed0.json").write_text("{}")
    guard_study(str(tmp_path), {"dataset": "/somewhere"})
    with pytest.raises(ValueError, match='holds a study with dataset="/somewhere", asked for "/nowhere"'):
        guard_study(str(tmp_path), {"dataset": "/nowhere"})


def test_decoder_that_ignores_latents_errs_as_with_another(tmp_path):
    """A perfect decoder has no error but fails with wrong latents; a decoder of one fixed scene has equal errors."""
    spec = LayoutSpec()
    scenes = [generate_town(1000).scene(k, "test", Grid()) for k in (0, 9, 20, 33)]
    Shard(str(tmp_path), "town", "test", 0).write(scenes)
    selection = SceneSubset(str(tmp_path), "town", "test")
    first = make_layout_batch(scenes[:1], spec)

    def encode(batch: LayoutBatch) -> SimpleNamespace:
        return SimpleNamespace(mean=torch.cat([batch.features, batch.real[..., None].float()], dim=-1))

    def decode(latent: torch.Tensor) -> LayoutOutput:
        ground = torch.zeros(len(latent), *first.height.shape[1:])
        logit = 18 * latent[..., 9] - 9
        return LayoutOutput(ground, ground, latent[..., :9], logit, spec.slots, MatchWeights())

    perfect = SimpleNamespace(spec=spec, encode=encode, decode=decode)
    scores = measure_accuracy(perfect, selection, batch_size=3)
    assert scores["median_center_error_m"] < 0.01 and scores["recall_1m"] == 1
    assert scores["other_latent_center_error_m"] > 2
    constant = encode(first).mean
    blind = SimpleNamespace(spec=spec, encode=encode, decode=lambda z: decode(constant.expand(len(z), -1, -1)))
    scores = measure_accuracy(blind, selection)
    assert scores["median_center_error_m"] == scores["other_latent_center_error_m"] > 1


def test_training_time_covers_all_parts_of_a_resumed_run():
    rates = [(50, 10.0), (100, 20.0), (120, 5.0)]  # Batches of 4: 20 s, 10 s and 16 s.
    assert sum_training_seconds(rates, 4) == pytest.approx(46.0)
    assert sum_training_seconds([], 4) == 0.0
