"""Tests of the voxel import: axis conventions, pictures from above and invalid files."""

import io
from dataclasses import replace
from itertools import permutations, product

import numpy as np
import pytest
from helpers import random_scene, save_npz

from pipelines.geometry.voxels import VoxelGrid, voxelize
from pipelines.io.voxel_import import FULL, SHAPES, draw_voxels, read_voxels, write_voxels
from pipelines.rendering.render import render_bev
from pipelines.schema.palette import CLASS_COLORS


@pytest.fixture(scope="module")
def town_scenes(town_drive_3) -> list:
    return [town_drive_3.scene(k, "test") for k in np.linspace(0, len(town_drive_3) - 1, 6).astype(int)]


def random_voxels(shape=FULL, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (rng.integers(0, 17, shape) * (rng.random(shape) < 0.05)).astype(np.uint8)


def test_read_voxels_round_trips_own_deterministic_files(tmp_path, town_scenes):
    for k, scene in enumerate((town_scenes[0], random_scene(1, n=0))):
        path = tmp_path / "deep" / f"{k}.npz"
        write_voxels(str(path), scene)
        got, first = read_voxels(str(path)), path.read_bytes()
        assert got.dtype == np.uint8 and np.array_equal(got, voxelize(scene, VoxelGrid()))
        write_voxels(str(path), scene)
        assert path.read_bytes() == first and len(first) < 200_000
    with pytest.raises(ValueError, match="cannot be read back"):
        write_voxels(str(path), scene, VoxelGrid(levels=8))


def test_read_voxels_round_trips_empty_scene(tmp_path):
    scene = random_scene(1, n=0)
    path = str(tmp_path / "empty.npz")
    write_voxels(path, replace(scene, occupied=np.zeros_like(scene.occupied)))
    assert not read_voxels(path).any()
    assert (draw_voxels(read_voxels(path)) == 255).all()


@pytest.mark.parametrize("shape", SHAPES[1:])
def test_read_voxels_repeats_coarse_voxels(tmp_path, shape):
    coarse = random_voxels(shape)
    got, factor = read_voxels(save_npz(tmp_path / "x.npz", coarse.astype(np.int64), "any")), np.array(FULL) // shape
    assert got.shape == FULL
    for at in np.random.default_rng(0).integers(0, FULL, (500, 3)):
        assert got[tuple(at)] == coarse[tuple(at // factor)]


def test_read_voxels_undoes_every_axis_convention(tmp_path):
    """The reader puts a voxel at the correct x (forward), y (left) and z (up) for each order and direction of the
    axes."""
    ours = random_voxels((64, 64, 8))
    for letters in permutations("xyz"):
        for signs in product("+-", repeat=3):
            theirs = np.zeros([{"x": 64, "y": 64, "z": 8}[c] for c in letters], np.uint8)
            for row, col, level in np.argwhere(ours):
                along = {"x": (63 - row, row), "y": (63 - col, col), "z": (level, 7 - level)}
                theirs[tuple(along[c][s == "-"] for c, s in zip(letters, signs, strict=True))] = ours[row, col, level]
            axes = tuple(c + s for c, s in zip(letters, signs, strict=True))
            assert np.array_equal(read_voxels(save_npz(tmp_path / "x.npz", theirs), axes)[::4, ::4, ::4], ours), axes


def test_voxel_picture_shows_topmost_filled_voxel():
    voxels = random_voxels()
    picture = draw_voxels(voxels)
    for row, col in np.random.default_rng(0).integers(0, 256, (500, 2)):
        seen = [k for k in voxels[row, col] if k]
        assert np.array_equal(picture[row, col], CLASS_COLORS[seen[-1]] if seen else [255, 255, 255])
    assert picture.shape == (256, 256, 3) and picture.dtype == np.uint8


def test_voxel_picture_agrees_with_picture_of_primitives(town_scenes):
    """The pictures may differ at a primitive that covers no voxel centre."""
    tall = VoxelGrid(bottom_m=-10.0, top_m=22.0, levels=64)
    for scene in town_scenes[:3]:
        same = (draw_voxels(voxelize(scene, tall)) == render_bev(scene)).all(axis=2)
        assert same.mean() > 0.99


def compress_arrays(**arrays) -> bytes:
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    return content.getvalue()


FAULTS = {
    "text": (lambda: b"hello", r"not an \.npz archive"),
    "truncated": (lambda: compress_arrays(voxels=random_voxels())[:-200], r"not an \.npz archive"),
    "shape": (lambda: compress_arrays(voxels=np.zeros((64, 64, 16), np.uint8)), r"holds 64 x 64 x 16 of uint8"),
    "flat": (lambda: compress_arrays(voxels=np.zeros((256, 256), np.uint8)), r"array of shape \(256, 256\)"),
    "batch": (lambda: compress_arrays(voxels=np.zeros((9, *FULL), np.uint8)), r"holds 9 x 256 x 256 x 32 of uint8"),
    "floats": (lambda: compress_arrays(voxels=np.zeros(FULL, np.float32)), r"of float32"),
    "class": (lambda: compress_arrays(voxels=np.full((64, 64, 8), 18)), r"class ids \[18\]"),
    "negative": (lambda: compress_arrays(voxels=np.full((64, 64, 8), -1)), r"class ids \[-1\]"),
    "two": (lambda: compress_arrays(a=np.zeros(2), b=np.zeros(2)), r"holds a, b"),
    "none": (lambda: compress_arrays(), r"holds nothing"),
    "pickle": (lambda: compress_arrays(voxels=np.array([{}], object)), r"pickled objects"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_read_voxels_names_invalid_file_and_content(tmp_path, fault):
    make, words = FAULTS[fault]
    path = tmp_path / "theirs.npz"
    path.write_bytes(make())
    with pytest.raises(ValueError, match=rf"theirs\.npz: .*{words}.*expected"):
        read_voxels(str(path))


def test_read_voxels_names_missing_file_and_wrong_axes(tmp_path):
    with pytest.raises(ValueError, match=r"absent\.npz: no such file"):
        read_voxels(str(tmp_path / "absent.npz"))
    with pytest.raises(ValueError, match=r"axes 'x\+ y z-' are invalid; name x"):
        read_voxels(save_npz(tmp_path / "x.npz", random_voxels()), ("x+", "y", "z-"))
