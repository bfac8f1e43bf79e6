"""Tests of joining tiles: through tables, the joined tiles equal the large scene."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers import random_scene

from models.composition.block_grid import BlockGrid
from models.composition.outpaint import BlockComposer
from models.layout import LayoutSpec
from models.scene import Grid
from pipelines.evaluation.cities import read_run_record
from pipelines.generation.tiles import join_tiles
from pipelines.schema.tables import Shard

SMALL = Grid(rows=32, cols=32, resolution_m=2.0)
STEPS = (2, 1, 0, 3)  # Blocks ahead, behind, left and right.


def make_tiles(tile_m: float):
    """Return a large scene in the frame of its first block, and its tiles in their own frames."""
    composer = BlockComposer(BlockGrid(8, 6, num_blocks=STEPS), LayoutSpec(grid=SMALL), lambda scenes: None)
    grid = composer.find_grid(composer.block_grid.indices())
    city = random_scene(3, n=300, grid=grid, world_xyz_m=(1000.0, -2000.0, 30.0), world_yaw_rad=2.2)
    rng = np.random.default_rng(0)
    low, high = [grid.back_m, grid.right_m, -2], [grid.front_m, grid.left_m, 6]
    city = replace(city, center_m=rng.uniform(low, high, (300, 3)).astype(np.float32))
    tiles = [tile.to_own_frame(city.crop(tile.grid)) for tile in composer.cut_tiles(tile_m)]
    return city, [replace(tile, scene_id=f"{k:03d}", source="generated-c") for k, tile in enumerate(tiles)]


@pytest.mark.parametrize("tile_m", [64.0, 96.0, 128.0])
def test_joined_tiles_equal_the_large_scene(tmp_path, tile_m):
    city, tiles = make_tiles(tile_m)
    assert len(tiles) > 2
    record = {"overlap": 0.25, "num_blocks": STEPS, "order": "colours", "tile_m": tile_m}
    (tmp_path / "generated-c.json").write_text(json.dumps(record))
    of_run = read_run_record(str(tmp_path), "generated-c")
    assert of_run.size_m == (city.grid.rows * 2.0, city.grid.cols * 2.0)
    for number, tile in enumerate(tiles):
        Shard(str(tmp_path), "generated-c", "generated", number).write([tile])
    read = [Shard(str(tmp_path), "generated-c", "generated", number).scenes([0])[0] for number in range(len(tiles))]
    joined = join_tiles(read, *of_run.corner_m)
    assert joined.grid == city.grid and np.array_equal(joined.occupied, city.occupied)
    assert np.abs(joined.height_m - city.height_m).max() < 0.02  # Tables hold heights in steps.
    order, truth = (np.lexsort(np.round(scene.center_m, 2).T) for scene in (joined, city))
    assert np.allclose(joined.center_m[order], city.center_m[truth], atol=0.02)
    assert np.array_equal(joined.category[order], city.category[truth])


def test_tiles_of_other_scenes_are_refused():
    _, tiles = make_tiles(96.0)
    x, y, z = tiles[1].world_xyz_m
    with pytest.raises(ValueError, match="scene 001 does not lie on the pixels of scene 000"):
        join_tiles([tiles[0], replace(tiles[1], world_xyz_m=(x + 0.7, y, z))], 0.0, 0.0)
