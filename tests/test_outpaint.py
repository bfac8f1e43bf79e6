"""The outpainting canvas: handed the truth for every block, it ends as the truth."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import random_scene

from models.layout import LayoutSpec
from models.outpaint import CORNERS, SIDES, OutpaintCanvas
from models.scene import KITTI_GROUND_CLASSES, Grid

SMALL = Grid(rows=32, cols=32, resolution_m=2.0)
LARGE = Grid(front_m=96.0, left_m=64.0, rows=64, cols=64, resolution_m=2.0)
SPEC = LayoutSpec(grid=SMALL)


def cell_occupancy(scenes) -> torch.Tensor:
    """A stand-in encoder whose latent is the occupancy of 8 x 8 cells: what a block knows can be read off it."""
    occupied = np.stack([s.occupied for s in scenes]).astype(np.float32)
    return torch.from_numpy(occupied.reshape(len(scenes), len(KITTI_GROUND_CLASSES), 8, 4, 8, 4).mean(axis=(3, 5)))


@pytest.fixture
def world():
    scene = random_scene(3, n=300, grid=LARGE)
    rng = np.random.default_rng(0)
    return replace(scene, center_m=rng.uniform([-32, -64, -2], [96, 64, 6], (300, 3)).astype(np.float32))


def block_truth(world, offset):
    """The world as a block at `offset` (steps of 32 m) sees it, in its own frame."""
    x, y = 32.0 * offset[0], 32.0 * offset[1]
    there = Grid(front_m=64 + x, left_m=32 + y, rows=32, cols=32, resolution_m=2.0)
    return world.cropped(there).moved(-x, -y)


def test_blocks_know_their_neighbours_where_they_lie(world):
    canvas = OutpaintCanvas.around(world.cropped(SMALL), SPEC, cell_occupancy, 0.5)
    for offset in SIDES + CORNERS:
        for mode in ("copy", "reencode"):
            block, truth = canvas.block(offset, mode), cell_occupancy([block_truth(world, offset)])[0]
            known = block.unknown == 0
            assert known.float().mean() == (0.5 if offset in SIDES else 0.25)
            assert torch.equal(block.latent[known], truth[known]), (offset, mode)


def test_pasting_the_truth_everywhere_gives_the_truth(world):
    canvas = OutpaintCanvas.around(world.cropped(SMALL), SPEC, cell_occupancy, 0.5)
    for offset in SIDES + CORNERS:
        truth = block_truth(world, offset)
        canvas.paste(offset, cell_occupancy([truth])[0], truth, 0.0)
    assert canvas.owned.all()
    assert np.array_equal(canvas.scene.occupied, world.occupied)
    assert np.allclose(canvas.scene.height_m, world.height_m, atol=1e-5)
    assert len(canvas.scene) == len(world)
    order = [np.lexsort(s.center_m.T) for s in (canvas.scene, world)]
    assert np.allclose(canvas.scene.center_m[order[0]], world.center_m[order[1]], atol=1e-4)
    assert torch.equal(
        canvas.latent, torch.from_numpy(world.occupied.reshape(5, 16, 4, 16, 4).mean(axis=(2, 4))).float()
    )


def test_the_height_datum_follows_the_ground(world):
    canvas = OutpaintCanvas.around(world.cropped(SMALL), SPEC, cell_occupancy, 0.5)
    block = canvas.block((1, 0), "reencode")
    at = [canvas.height_near(x, 0.0) for x in (0.0, 32.0)]
    assert np.isclose(block.datum_m, at[1] - at[0]) and block.datum_m != 0


def test_an_overlap_between_cells_is_refused(world):
    with pytest.raises(ValueError, match=r"overlap 0.51 is not a whole number of the 8 latent cells"):
        OutpaintCanvas.around(world.cropped(SMALL), SPEC, cell_occupancy, 0.51)
    with pytest.raises(ValueError, match="the model needs"):
        OutpaintCanvas.around(world, SPEC, cell_occupancy, 0.5)
