"""Tests of the table voxels: coarse voxels, packed grids, the reader of training samples, and invalid rows."""

import numpy as np
import pytest
from helpers import random_scene
from scipy.stats import mode

from models.scene import Grid
from models.voxel_grids import (
    COARSE_FACTORS,
    FINE,
    FINE_SHAPE,
    NUM_CLASSES,
    coarsen_voxels,
    repeat_voxels,
)
from pipelines.geometry.voxels import VoxelGrid, voxelize
from pipelines.io.voxel_table import make_voxel_row, make_voxel_table, pack_grid, read_grid, unpack_voxels
from pipelines.runtime import storage
from pipelines.schema.palette import CLASS_COLORS
from pipelines.schema.tables import Shard
from pipelines.training.voxel_reader import VoxelReader

SMALL = VoxelGrid(Grid(4.0, 2.0, 0.25, 16, 24), -1.0, 1.0, 8)


def random_voxels(shape: tuple[int, ...], seed: int = 0, filled: float = 0.4) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (rng.integers(0, NUM_CLASSES, shape) * (rng.random(shape) < filled)).astype(np.uint8)


def test_number_of_classes_is_that_of_the_palette():
    assert len(CLASS_COLORS) == NUM_CLASSES


@pytest.mark.parametrize("factor", COARSE_FACTORS)
@pytest.mark.parametrize("filled", [0.03, 0.5])
def test_coarse_voxels_agree_with_mode_of_scipy(factor, filled):
    """scipy's mode returns the smallest of equally frequent values, and can leave out the empty ones."""
    voxels = random_voxels((16, 24, 8), filled=filled)
    got = coarsen_voxels(voxels, factor)
    assert got.shape == tuple(np.array(voxels.shape) // factor) and got.dtype == np.uint8
    for place in np.ndindex(got.shape):
        block = voxels[tuple(slice(k * step, (k + 1) * step) for k, step in zip(place, factor, strict=True))].ravel()
        block = block[block > 0]
        assert got[place] == (mode(block).mode if len(block) else 0), place


def test_repeated_voxels_coarsen_to_themselves():
    voxels = random_voxels((4, 6, 3))
    assert np.array_equal(coarsen_voxels(repeat_voxels(voxels, (4, 4, 4)), (4, 4, 4)), voxels)
    with pytest.raises(ValueError, match="a grid of 16 x 24 x 6 voxels has no whole number of blocks of 4 x 4 x 4"):
        coarsen_voxels(random_voxels((16, 24, 6)), (4, 4, 4))


def test_packed_rows_return_grids_and_counts():
    grids = [random_voxels(SMALL.shape, seed) for seed in range(3)]
    table = make_voxel_table([make_voxel_row(f"s{k}", voxels, SMALL) for k, voxels in enumerate(grids)])
    for k, voxels in enumerate(grids):
        assert np.array_equal(unpack_voxels(table, k), voxels) and read_grid(table, k) == SMALL
        assert table["num_voxels"][k].as_py() == np.bincount(voxels.ravel(), minlength=NUM_CLASSES).tolist()
        for factor in COARSE_FACTORS:
            assert np.array_equal(unpack_voxels(table, k, factor), coarsen_voxels(voxels, factor))


def test_packed_town_scenes_have_at_most_45_kilobytes(town_drive_3):
    """The mean size of fine grids of a town of version 1, whose scenes are fuller than those of version 2."""
    scenes = [town_drive_3.scene(k, "test") for k in np.linspace(0, len(town_drive_3) - 1, 6).astype(int)]
    sizes = [len(pack_grid(voxelize(scene, VoxelGrid(scene.grid)))) for scene in scenes]
    assert 5_000 < np.mean(sizes) <= 45_000


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"voxels": b"abc"}, "row 0, column 'voxels': damaged bytes"),
        ({"voxels": pack_grid(np.zeros(100, np.uint8))}, "row 0, column 'voxels': damaged bytes"),
        ({"voxels": pack_grid(np.zeros(2**24, np.uint8))}, "row 0, column 'voxels': damaged bytes"),
        ({"voxels": pack_grid(np.full(SMALL.shape, 99, np.uint8))}, "class id 99, expected 0 to 17"),
        ({"voxels_2x2x2": None}, "row 0, column 'voxels_2x2x2': null; run jobs/voxelize_scenes.py"),
    ],
)
def test_invalid_grid_names_row_and_column(change, message):
    row = make_voxel_row("a", random_voxels(SMALL.shape), SMALL) | change
    (name,) = change
    with pytest.raises(ValueError, match=message):
        unpack_voxels(make_voxel_table([row]), 0, (2, 2, 2) if name.endswith("2x2x2") else FINE)


def test_wrong_voxels_are_not_packed():
    voxels = random_voxels(SMALL.shape)
    for wrong, message in (
        (voxels[:8], "voxels are uint8 of"),
        (voxels.astype(int), "voxels are int64"),
        (np.full(SMALL.shape, 18, np.uint8), "class id 18, expected 0 to 17"),
    ):
        with pytest.raises(ValueError, match=f"scene night-7: {message}"):
            make_voxel_row("night-7", wrong, SMALL)


def test_table_with_hostile_size_is_refused(tmp_path):
    shard = Shard(str(tmp_path), "town", "train", 0)
    row = make_voxel_row("a", random_voxels(SMALL.shape), SMALL) | {"rows": 2**30, "cols": 2**30}
    storage.write_parquet(make_voxel_table([row]), shard.path("voxels"))
    with pytest.raises(ValueError, match=r"part-00000\.parquet: row 0, columns 'rows'.* voxels of a scene; at most"):
        shard.read("voxels")


def test_reader_returns_requested_rows_and_sizes(tmp_path):
    shard = Shard(str(tmp_path), "town", "train", 0)
    grid = VoxelGrid()
    grids = [random_voxels(FINE_SHAPE, seed, 0.01) for seed in range(3)]
    rows = [make_voxel_row(f"s{k}", voxels, grid, ((8, 8, 8),)) for k, voxels in enumerate(grids)]
    storage.write_parquet(make_voxel_table(rows), shard.path("voxels"))
    got = VoxelReader(FINE_SHAPE, (FINE, (8, 8, 8)))(shard, np.array([2, 0]))
    assert sorted(got) == ["voxels", "voxels_8x8x8"]
    assert np.array_equal(got["voxels"], np.stack([grids[2], grids[0]])) and got["voxels"].dtype == np.uint8
    assert np.array_equal(got["voxels_8x8x8"][0], coarsen_voxels(grids[2], (8, 8, 8)))
    with pytest.raises(ValueError, match=r"part-00000\.parquet: row 0, column 'voxels_2x2x2': null"):
        VoxelReader(FINE_SHAPE, ((2, 2, 2),))(shard, np.array([0]))
    with pytest.raises(ValueError, match="a grid of 256 x 256 x 32 voxels, but the model reads 512 x 512 x 32"):
        VoxelReader((512, 512, 32), (FINE,))(shard, np.array([0]))


def test_row_states_the_grid_of_a_wide_scene():
    wide = VoxelGrid(Grid(96.0, 32.0, 0.25, 512, 256))
    voxels = voxelize(random_scene(0, grid=wide.columns), wide)
    table = make_voxel_table([make_voxel_row("wide", voxels, wide)])
    assert voxels.shape == (512, 256, 32) and voxels.any() and read_grid(table, 0) == wide
    assert np.array_equal(unpack_voxels(table, 0), voxels)
