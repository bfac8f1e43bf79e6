"""The ablations: encodings of a box, the small autoencoder, the switches of the layout VAE, the job."""

import itertools
import json
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import duckdb
import numpy as np
import pytest
import torch
from scenes import random_scene, small_spec
from scipy.spatial.transform import Rotation

from models.geometry.encodings import ENCODINGS, harmonics, nearest_frame
from models.layout import LayoutSpec
from models.lvae import LayoutVAE
from models.presets import LVAE_PRESETS
from models.scene import canonical_boxes, yaw_rotation
from models.studies.orientation_study import THINGS, OneObjectAutoencoder, Settings, draw_boxes, fit
from models.tensors import layout_batch, scene_from_layout
from models.vae.losses import lvae_loss
from pipelines.evaluation.ablation import (
    AUGMENTATIONS,
    BRANCHES,
    DECODERS,
    GROUND,
    LOST_YAW_IOU3D,
    CentredBoxes,
    Trial,
    iou3d,
    measured,
    square_iou,
    training_boxes,
    trials,
    yaw_loss,
)

CUBE_SYMMETRIES = [
    np.diag(signs)[:, list(order)]
    for order in itertools.permutations(range(3))
    for signs in itertools.product((-1.0, 1.0), repeat=3)
]  # 48 with the mirror images: a box is its own


def corners(rotation: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """(..., 8, 3) corners of boxes centred at zero."""
    signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    return np.einsum("...ij,...kj->...ki", rotation, signs * np.asarray(size_m)[..., None, :])


def box_distance(a: tuple, b: tuple) -> np.ndarray:
    """(...) Hausdorff distance of the corner sets: 0 exactly for two descriptions of one box."""
    gaps = np.linalg.norm(corners(*a)[..., :, None, :] - corners(*b)[..., None, :, :], axis=-1)
    return np.maximum(gaps.min(axis=-1).max(axis=-1), gaps.min(axis=-2).max(axis=-1))


def any_boxes(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Boxes turned any way: a third with three extents, a third with two equal, a third cubes."""
    rng = np.random.default_rng(seed)
    size = rng.uniform(0.3, 5.0, (n, 3))
    size[n // 3 :, 1] = size[n // 3 :, 0]
    size[2 * n // 3 :, 2] = size[2 * n // 3 :, 0]
    return Rotation.random(n, rng=rng).as_matrix(), size


# ---------------------------------------------------------------------------------------------------- encodings


@pytest.mark.parametrize("name", ENCODINGS)
def test_decoding_gives_the_same_corners(name):
    rotation, size = any_boxes(3000)
    if name == "cholesky":  # cannot where extents are equal
        rotation, size = rotation[:1000], size[:1000]
    code = ENCODINGS[name].encode(rotation, size)
    assert code.shape == (len(size), ENCODINGS[name].entries)
    decoded = ENCODINGS[name].decode(code)
    assert np.allclose(np.linalg.det(decoded[0]), 1)
    assert box_distance((rotation, size), decoded).max() < 1e-6
    batched = ENCODINGS[name].decode(code[:6].reshape(2, 3, -1))  # any leading shape
    assert np.allclose(batched[0].reshape(6, 3, 3), decoded[0][:6])


def test_any_description_of_a_box_has_one_code_but_for_quaternions():
    rotation, size = any_boxes(60)
    codes = {
        name: np.stack([e.encode(rotation @ s, size @ np.abs(s)) for s in CUBE_SYMMETRIES if np.linalg.det(s) > 0])
        for name, e in ENCODINGS.items()
    }
    assert np.ptp(codes["cholesky"], axis=0).max() < 1e-12
    assert np.ptp(codes["octahedral"], axis=0).max() < 1e-12
    assert np.ptp(codes["quaternion"], axis=0).max() > 1


def test_only_octahedral_codes_tell_all_boxes_apart_and_change_as_boxes_do():
    """Lipschitz both ways: metres that corners move by, against the change of the code, for pairs near and far."""
    rng = np.random.default_rng(1)
    rotation, size = any_boxes(6000)
    step = 10 ** rng.uniform(-4, 0, (6000, 1))
    turn = Rotation.from_rotvec(step * rng.standard_normal((6000, 3))).as_matrix()
    grown = np.maximum(size + rng.integers(0, 2, (6000, 1)) * step * rng.standard_normal((6000, 3)), 0.3)
    other = canonical_boxes(turn @ rotation, grown)  # described as a dataset would
    distance = box_distance((rotation, size), other) / size.max(axis=1)
    ratio = {
        name: np.linalg.norm(e.encode(*other) - e.encode(*canonical_boxes(rotation, size)), axis=1) / distance
        for name, e in ENCODINGS.items()
    }
    assert ratio["octahedral"].min() > 0.05 and ratio["octahedral"].max() < 50
    assert ratio["cholesky"].min() < 1e-6  # a cube that turned
    assert ratio["quaternion"].max() > 1000  # length and width, or -pi/2 and pi/2, changed places


@pytest.mark.parametrize("name", ["cholesky", "octahedral"])
def test_codes_are_smooth_where_length_and_width_change_places(name):
    """A path that turns by 180 degrees, tilts and passes through l = w: it closes, and finer steps are smaller steps."""
    largest = []
    for count in (501, 5001):
        t = np.linspace(0, 1, count)
        rotation = (
            yaw_rotation(np.pi * t) @ Rotation.from_rotvec(np.outer(0.3 * np.sin(2 * np.pi * t), [1, 0, 0])).as_matrix()
        )
        size = np.stack([3 + np.cos(2 * np.pi * t), 3 - np.cos(2 * np.pi * t), 1.5 + 0 * t], axis=1)
        rotation, size = canonical_boxes(rotation, size)
        code = ENCODINGS[name].encode(rotation, size)
        assert np.allclose(code[0], code[-1])
        largest.append(np.linalg.norm(np.diff(code, axis=0), axis=1).max() * (count - 1))
    assert largest[1] < 1.05 * largest[0] < 60
    jumps = np.linalg.norm(np.diff(ENCODINGS["quaternion"].encode(rotation, size), axis=0), axis=1)
    assert jumps.max() > 0.5


def test_harmonics_are_degree_four_and_turn_with_yaw():
    basis = harmonics()
    flat = basis.reshape(9, 81)
    assert np.allclose(flat @ flat.T, np.eye(9))
    assert np.allclose(np.einsum("kaacd->kcd", basis), 0)
    assert all(np.allclose(basis, basis.transpose(0, *(1 + np.array(p)))) for p in itertools.permutations(range(4)))
    yaw = np.linspace(-np.pi, np.pi, 50)
    code = ENCODINGS["octahedral"].encode(yaw_rotation(yaw), np.ones((50, 3)))[:, 6:]
    turning = np.stack([np.cos(4 * yaw), np.sin(4 * yaw)], axis=1) / np.sqrt(2)
    assert np.allclose(code[:, :2], turning) and np.allclose(code[:, 2:], code[0, 2:])
    assert np.isfinite(nearest_frame(np.zeros((1, 9)))).all()  # a network may say anything


# ----------------------------------------------------------------------------------------------------- lost yaw


def test_a_square_of_arbitrary_yaw_keeps_what_the_closed_form_says():
    turn = np.linspace(0, np.pi / 2, 2001)
    size = np.broadcast_to([2.0, 2.0, 1.5], (len(turn), 3))
    still = CentredBoxes(np.broadcast_to(np.eye(3), (len(turn), 3, 3)), size)
    iou = iou3d(still, CentredBoxes(yaw_rotation(turn), size))
    assert np.allclose(iou, square_iou(turn), atol=1e-6)
    assert abs(np.trapezoid(iou, turn) / (np.pi / 2) - LOST_YAW_IOU3D) < 1e-6


def test_cholesky_loses_the_yaw_of_squares_and_octahedral_keeps_it():
    def lost(encoding, share):
        return yaw_loss({"encoding": encoding, "width_share": share, "noise": 1e-3}, 400)["iou3d_lost_with_yaw"]

    assert abs(lost("cholesky", 1.0) - (1 - LOST_YAW_IOU3D)) < 0.02
    assert lost("cholesky", 0.9) > 4 * lost("cholesky", 0.5)
    assert all(lost("octahedral", share) < 1e-3 for share in (0.5, 0.9, 1.0))


# -------------------------------------------------------------------------------------------------- autoencoder


def test_bodies_are_equal_and_small():
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
        assert all(torch.equal(body[name], bodies[0][name]) for name in body)  # from the same start, too


def test_training_sets_are_nested_and_seeds_differ():
    large, small = (training_boxes(Trial("vehicle", "cholesky", n, 3)) for n in (10_000, 1200))
    assert all((a[:1200] == b).all() for a, b in zip(large, small, strict=True))
    other = training_boxes(Trial("vehicle", "cholesky", 1200, 4))
    assert not np.isin(other.size_m, large.size_m).any()
    low, high = THINGS["vehicle"].length_m
    assert low <= large.size_m[:, 0].min() and large.size_m[:, 0].max() <= high
    assert (large.size_m[:, 1] < large.size_m[:, 0]).all()
    with pytest.raises(ValueError, match="expected sizes of 2 or more"):
        trials("vehicle", (), 5)


@pytest.mark.parametrize("name", ENCODINGS)
def test_a_tiny_trial_learns(name):
    torch.set_num_threads(1)
    boxes, truth = draw_boxes(THINGS["vehicle"], 128, 0), draw_boxes(THINGS["vehicle"], 200, 1)
    iou = []
    for epochs in (0, 15):
        fitted = fit(ENCODINGS[name], boxes, Settings(epochs, batch_size=8), 0, moving_only=True)
        rebuilt, _ = fitted.rebuild(truth)
        iou.append(iou3d(truth, rebuilt).mean())
    assert fitted.kept.sum() == {"cholesky": 4, "quaternion": 5, "octahedral": 6}[name]
    assert np.allclose(np.abs(rebuilt.rotation[:, 2]).max(axis=1), 1)  # what was left out stays upright
    assert iou[1] > iou[0] + 0.05


# ----------------------------------------------------------------------------------------------------- switches


@pytest.mark.parametrize("decoder", ["detr", "cells"])
@pytest.mark.parametrize(
    ("switch", "channels"), [({"split_latent": False}, 32), ({"branches": "ground"}, 16), ({"branches": "objects"}, 16)]
)
def test_switches_of_the_layout_vae(decoder, switch, channels):
    spec, scenes = small_spec(), [random_scene(i) for i in range(6)]
    torch.manual_seed(0)
    options = LVAE_PRESETS["smoke"].architecture() | {"decoder": decoder, "shortcut": True, "latent_channels": 16}
    lvae, batch = LayoutVAE(layout=spec.to_dict(), **(options | switch)), layout_batch(scenes, spec)
    lvae.start_at(batch)
    assert lvae.latent_shape == (channels, 8, 8)
    output, posterior = lvae(batch, torch.randn(6, *lvae.latent_shape))
    losses = lvae_loss(output, posterior, batch, spec)
    losses.total.backward()
    ground, objects = (switch.get("branches", "both") in ("both", side) for side in ("ground", "objects"))
    assert (losses.height > 0) == (losses.occupancy > 0) == ground
    assert (losses.center > 0) == (losses.existence > 0) == objects
    names = {name.split("_")[0] for name, p in lvae.named_parameters() if p.grad is not None}
    assert names == {name for name, there in (("ground", ground), ("object", objects)) if there}
    with torch.no_grad():
        rebuilt = [
            scene_from_layout(x, spec, s) for x, s in zip(lvae.decode(posterior.mean).layouts(), scenes, strict=True)
        ]
    assert all(scene.occupied.any() == ground for scene in rebuilt)
    if not objects:
        assert not any(len(scene) for scene in rebuilt)
    if ground and objects:  # both decoders read both halves; only the ground's half of the linear start is not zero
        own, other = lvae.ground_decoder.shortcut.weight.split(16)
        assert (own != 0).any() and not other.any()
        assert (lvae.ground_decoder.shortcut.weight.grad[16:] != 0).any()
        latent = posterior.mean.detach().requires_grad_()
        lvae.decode(latent).features.sum().backward()
        assert (latent.grad[:, :16] != 0).any() and (latent.grad[:, 16:] != 0).any()


def test_a_config_from_before_the_switches_is_the_full_model():
    old = {"layout": small_spec().to_dict()} | LVAE_PRESETS["smoke"].architecture()
    lvae = LayoutVAE.from_config(old)
    assert lvae.config.split_latent and lvae.config.branches == "both" and lvae.latent_shape == (8, 8, 8)
    with pytest.raises(ValueError, match="branches is 'sky', expected one of"):
        LayoutVAE.from_config(old | {"branches": "sky"})


# ---------------------------------------------------------------------------------------------------------- job


@pytest.fixture(scope="module")
def empty_home(cluster, tmp_path_factory):
    """A $PRITTI_HOME with nothing in it: the encoding study needs no data, the smoke preset makes its own."""
    with pytest.MonkeyPatch.context() as patch:
        path = tmp_path_factory.mktemp("ablation")
        patch.setenv("PRITTI_HOME", str(path))
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        yield path


def test_the_encoding_study_writes_its_table_and_figure_and_resumes(empty_home, capsys):
    from jobs.ablate_lvae import Encoding
    from jobs.implementation.ablate_lvae import compare_encodings

    config = Encoding(
        (64, 128),
        any_footprint_train_sizes=(64,),
        yaw_only_train_sizes=(32,),
        num_seeds=1,
        epochs=1,
        num_test_boxes=300,
        num_noisy_boxes=20,
    )
    output = empty_home / "ablations/encoding"
    assert compare_encodings(config) == str(output)
    assert "mean IoU3D" in capsys.readouterr().out and "octahedral" in (output / "encodings.txt").read_text()
    rows = duckdb.sql(f"select * from '{output}/encodings.parquet' where numbers = 'all'").fetchall()
    assert len(rows) == 9 and len(json.loads((output / "encodings.json").read_text())["rows"]) == 12
    lost = duckdb.sql(f"select count(*), count(distinct noise) from '{output}/yaw_loss.parquet'").fetchall()
    assert lost == [(120, 4)]
    for name in ("encodings", "yaw_loss"):
        assert ElementTree.parse(output / f"{name}.svg").getroot().tag == "{http://www.w3.org/2000/svg}svg"
    page = (output / "report.html").read_text()
    assert page.count("<svg") == 4 and "[drawings" not in page and page.count("<table") == 3

    kept = {path: path.stat().st_mtime_ns for path in sorted((output / "trials").iterdir())}
    redone = next(iter(kept))
    before = json.loads(redone.read_text())
    redone.unlink()
    compare_encodings(config)
    assert [p for p, time in kept.items() if p.stat().st_mtime_ns != time] == [redone]
    assert json.loads(redone.read_text())["iou"] == before["iou"]
    with pytest.raises(ValueError, match="holds a study with epochs=1, asked for 2"):
        compare_encodings(Encoding(train_sizes=(64,), num_seeds=1, epochs=2, num_test_boxes=300))


def test_variants_train_as_the_preset_does_but_for_their_switch(empty_home):
    from jobs.ablate_lvae import Augmentation, Branches, Decoders
    from jobs.implementation.ablate_lvae import prepare_variant
    from jobs.support.trainer import as_tensors
    from pipelines.training.data_loader import read_samples

    for config, variant, switch in (
        *((Branches(preset="smoke"), *item) for item in BRANCHES.items()),
        *((Decoders(preset="smoke"), *item) for item in DECODERS.items()),
        *((Augmentation(preset="smoke"), *item) for item in AUGMENTATIONS.items()),
    ):
        run = prepare_variant(config, variant, f"test-{variant}", seed=1, steps=3)
        trainer = run.build(torch.device("cpu"), lambda model: model)
        row = LVAE_PRESETS["smoke"]
        assert trainer.settings.steps == 3 and trainer.settings.seed == 1 == run.stream.seed
        assert trainer.settings.learning_rate == switch.options.get("learning_rate", row.learning_rate)
        mirrored = run.reader.augment is not None and run.reader.augment.flip
        assert mirrored == switch.options.get("flip", False)
        assert run.stream.batch_size == row.batch_size
        wanted = row.architecture() | switch.architecture
        assert {name: trainer.model.config[name] for name in wanted} == wanted
        batch = as_tensors(read_samples(run.stream, run.reader, 0, 1, row.batch_size, 0, 1))
        assert torch.isfinite(trainer.step(batch, range(row.batch_size))["loss"])


def test_the_ground_study_goes_from_the_papers_networks_down_with_equal_latents():
    row = LVAE_PRESETS["town"].architecture()
    models = {name: LayoutVAE(layout=LayoutSpec().to_dict(), **row | v.architecture) for name, v in GROUND.items()}
    assert {model.latent_shape for model in models.values()} == {(32, 32, 32)}
    sizes = {name: model.num_parameters() for name, model in models.items()}
    paper = LVAE_PRESETS["kitti360"]
    assert GROUND["the paper's networks"].architecture["channels"] == paper.channels
    assert min(sizes, key=sizes.get) in ("half as wide", "an eighth of the paper's widths")
    assert max(sizes, key=sizes.get) == "the paper's networks"


def test_variants_have_names_that_files_and_mlflow_take():
    from jobs.implementation.ablate_lvae import slug

    names = [slug(name) for study in (BRANCHES, DECODERS, GROUND, AUGMENTATIONS) for name in study]
    assert all(re.fullmatch(r"[\w-]+", name) for name in names) and len(set(names)) == len(names) > 12


def test_branches_are_trained_seed_by_seed_and_none_twice(empty_home, monkeypatch, capsys):
    import jobs.implementation.ablate_lvae as job

    trained = []

    def train_variant(config, variant, seed, output):
        trained.append((seed, variant))
        scores = {"ground_iou": 0.9 + 0.01 * seed, "height_mse_normalised": 1e-4, "height_rmse_m": 0.1}
        described = {"variant": variant, "seed": seed, "steps": config.steps, "dataset": "DIR", "parameters": 1}
        described |= {"gflops": 0.5}
        reconstruction = scores | {"ap3d": 0.5, "ap3d_50": 0.25}
        described |= {"training_seconds": 1.0, "curve": [(2, 0.1), (7, 0.5)]}
        return described | measured(BRANCHES[variant], reconstruction)

    monkeypatch.setattr(job, "train_variant", train_variant)
    output = job.compare_variants(job.Branches(preset="smoke", steps=7, num_seeds=2))
    assert trained == [(seed, variant) for seed in (0, 1) for variant in BRANCHES]
    job.compare_variants(job.Branches(preset="smoke", steps=7, num_seeds=3))
    assert trained[8:] == [(2, variant) for variant in BRANCHES]
    job.compare_variants(job.Branches(preset="smoke", steps=7, num_seeds=4, only_variants=("without ground",)))
    assert trained[12:] == [(3, "without ground")]
    job.compare_variants(job.Branches(preset="smoke", steps=7, num_seeds=3))
    rows = {row["variant"]: row for row in json.loads((Path(output) / "branches.json").read_text())["rows"]}
    full, bare = rows["full model"], rows["without ground"]
    assert (full["seeds"], full["steps"]) == (3, 7) and abs(full["ground_iou_mean"] - 0.91) < 1e-9
    assert (full["ground_iou_min"], full["ground_iou_max"]) == (0.9, 0.92) and bare["ap3d_mean"] == 0.5
    assert bare["ground_iou_mean"] is None and rows["without objects"]["ap3d_mean"] is None
    assert "without latent split" in capsys.readouterr().out
    with pytest.raises(ValueError, match="holds a study with steps=7, asked for 8"):
        job.compare_variants(job.Branches(preset="smoke", steps=8, num_seeds=2))
    with pytest.raises(ValueError, match=r"--only-variants \['without sky'\]: expected some of \['full model'"):
        job.compare_variants(job.Branches(preset="smoke", steps=7, only_variants=("without sky",)))
    with pytest.raises(ValueError, match="unknown preset 'smokes'"):
        job.compare_variants(job.Branches(preset="smokes", name="another"))
    assert not (Path(output).parent / "another").exists()


def test_a_study_without_trials_gives_its_directory_up(tmp_path):
    from jobs.implementation.ablate_lvae import guard_study as claim

    claim(str(tmp_path), {"dataset": "/nowhere"})
    (tmp_path / "mlflow.json").write_text("{}")
    claim(str(tmp_path), {"dataset": "/somewhere"})
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "cells-seed0.json").write_text("{}")
    claim(str(tmp_path), {"dataset": "/somewhere"})
    with pytest.raises(ValueError, match="holds a study with dataset=/somewhere, asked for /nowhere"):
        claim(str(tmp_path), {"dataset": "/nowhere"})
