"""Tests of outpainting: block grids, composition of blocks from true scenes, and the pipeline."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from helpers import QUICK, random_scene, scenes_equal, small_spec

from jobs.implementation.outpaint_scenes import arrange_blocks
from jobs.outpaint_scenes import Config
from models.composition.block_grid import BlockGrid, label_blocks, rank_four_colors, rank_outward
from models.composition.infinite import InfiniteScene
from models.composition.outpaint import BlockComposer, SceneBlock, find_ground_height
from models.composition.seam_blending import extract_new_part
from models.layout import LayoutSpec
from models.scene import KITTI_GROUND_CLASSES, Grid, make_yaw_rotation
from models.tensors import make_empty_scene

SPEC = small_spec()
SMALL = Grid(rows=32, cols=32, resolution_m=2.0)
LARGE = Grid(front_m=96.0, left_m=64.0, rows=64, cols=64, resolution_m=2.0)
TRUTH_SPEC = LayoutSpec(grid=SMALL)
EMPTY = make_empty_scene("empty", "town", "0", 0, TRUTH_SPEC)
SIDES, CORNERS = [(1, 0), (-1, 0), (0, 1), (0, -1)], [(1, 1), (1, -1), (-1, 1), (-1, -1)]


def encode_occupancy(scenes) -> torch.Tensor:
    """Encode a scene as the occupancy of 8 x 8 cells; this latent shows the known region of a block."""
    occupied = np.stack([s.occupied for s in scenes]).astype(np.float32)
    return torch.from_numpy(occupied.reshape(len(scenes), len(KITTI_GROUND_CLASSES), 8, 4, 8, 4).mean(axis=(3, 5)))


@pytest.fixture
def truth():
    """A scene of 128 x 128 m on a constant slope, with block (0, 0) in the middle.

    Objects of the same category do not overlap.
    """
    scene = random_scene(3, n=300, grid=LARGE)
    rng = np.random.default_rng(0)
    center = rng.uniform([-32, -64, -2], [96, 64, 6], (300, 3)).astype(np.float32)
    return replace(scene, center_m=center, size_m=scene.size_m * 0.05)


def crop_truth(truth, index, block_grid=None):
    """Return the crop of the truth for the block at `index`, in the frame of the block."""
    step = 64.0 * (block_grid.step / block_grid.size if block_grid else 0.5)
    x, y = step * index[0], step * index[1]
    return truth.crop(replace(SMALL, front_m=64 + x, left_m=32 + y)).translate(-x, -y)


# ------------------------------------------------------------------------------------------------------ block grids


def iterate_block_grids():
    rectangles = [(1, 1, 1, 1), (3, 0, 2, 1), (0, 4, 0, 0)]
    for last, overlap in product(rectangles, (0.125, 0.25, 0.5, 0.75)):
        yield BlockGrid.from_overlap(8, overlap, num_blocks=last)
        if overlap > 0.25:
            yield BlockGrid.from_overlap(8, overlap, 0.125, num_blocks=last)
    for overlap in (0.125, 0.25, 0.375):
        yield BlockGrid.from_overlap(8, overlap, rank=rank_four_colors, num_blocks=None)
    yield BlockGrid.from_overlap(8, 0.375, 0.125, rank=rank_four_colors, num_blocks=None)
    yield BlockGrid.from_overlap(8, 0.375, 0.125, rank=rank_four_colors, num_blocks=(2, 1, 1, 2))


@pytest.mark.parametrize(
    "block_grid",
    iterate_block_grids(),
    ids=lambda block_grid: f"{block_grid.rank.__name__}-{block_grid.step}-{block_grid.num_blocks}-{block_grid.margin}",
)
def test_block_grid_cells_have_one_owner_known_to_later_blocks(block_grid):
    indices = block_grid.indices() if block_grid.num_blocks else list(product(range(-3, 4), repeat=2))
    owners: dict[tuple[int, int], list] = {}
    for index in indices:
        for row, col in np.argwhere(block_grid.owned_cells(index)).tolist():
            # World cells: rows increase backward, columns increase to the right.
            owners.setdefault((row - index[0] * block_grid.step, col - index[1] * block_grid.step), []).append(index)
    assert all(len(found) == 1 for found in owners.values())
    if block_grid.num_blocks:  # The blocks together own each cell that they cover.
        ahead, behind, left, right = block_grid.num_blocks
        sides = 8 + (ahead + behind) * block_grid.step, 8 + (left + right) * block_grid.step
        assert len(owners) == sides[0] * sides[1]
    assert block_grid.owned_cells((0, 0)).all()
    for index in indices:
        known = np.zeros((8, 8), bool)
        for other, cells in block_grid.known_cells(index):
            assert block_grid.rank(other) < block_grid.rank(index) and not (known & cells).any()
            known |= cells
            for row, col in np.argwhere(cells).tolist():
                at = (row - index[0] * block_grid.step, col - index[1] * block_grid.step)
                assert owners.get(at, [other]) == [other]
        assert np.array_equal(known, ~block_grid.new_cells(index))
        assert not (block_grid.owned_cells(index) & known).any()


def test_block_grid_fronts_are_independent():
    block_grid = BlockGrid.from_overlap(8, 0.5, num_blocks=(2, 2, 2, 2))
    fronts = block_grid.group_by_rank(block_grid.indices())
    assert [len(front) for front in fronts] == [1, 4, 8, 8, 4]
    for front in fronts:
        assert not any({other for other, _ in block_grid.known_cells(index)} & set(front) for index in front)
    endless = BlockGrid.from_overlap(8, 0.25, rank=rank_four_colors, num_blocks=None)
    needed, waiting = set(), [(1, 1)]
    while waiting:
        index = waiting.pop()
        needed.add(index)
        waiting += [other for other, _ in endless.known_cells(index)]
    assert needed == set(product(range(3), repeat=2))
    with pytest.raises(ValueError, match="cannot list the blocks"):
        endless.indices()


def test_paper_outpainting_does_not_blend_or_remove_copies(truth):
    scene = crop_truth(truth, (0, 0))
    new = np.zeros(scene.occupied.shape[1:], bool)
    new[: len(new) // 2] = True
    raised = scene.translate(0, 0, 0.5)
    generated = replace(scene, height_m=raised.height_m, center_m=scene.center_m, occupied=scene.occupied)
    plain = extract_new_part(generated, scene, new, blend=False)
    assert np.array_equal(plain.height_m[:, new], generated.height_m[:, new])  # the step of 0.5 m stays
    inside = new[scene.grid.pixel(scene.center_m[:, 0], scene.center_m[:, 1])]
    assert len(plain) == inside.sum()
    blended = extract_new_part(generated, scene, new)
    assert len(blended) == 0 or len(blended) < len(plain)  # all objects are copies of known objects
    assert scene.occupied[:, new].any() and not np.array_equal(blended.height_m[:, new], generated.height_m[:, new])


def test_block_grid_rejects_wrong_overlaps():
    with pytest.raises(ValueError, match=r"overlap 0.51 must lie between 0 and 1 and be a multiple of 1 / 8"):
        BlockGrid.from_overlap(8, 0.51)
    with pytest.raises(ValueError, match=r"overlap is 0.5, expected less than 0.5"):
        BlockGrid.from_overlap(8, 0.5, rank=rank_four_colors, num_blocks=None)


# ------------------------------------------------------------------------------------------------------ composition


@pytest.mark.parametrize("mode", ["copy", "reencode"])
def test_block_composer_gives_blocks_their_known_neighbors(truth, mode):
    block_grid = BlockGrid.from_overlap(8, 0.5)
    composer = BlockComposer(block_grid, TRUTH_SPEC, encode_occupancy)
    blocks = {}
    for index in [(0, 0), *SIDES, *CORNERS]:
        scene = crop_truth(truth, index)
        condition = composer.condition_block(index, blocks, EMPTY, mode)
        known = condition.mask == 0
        assert known.float().mean() == (0 if index == (0, 0) else 0.5 if index in SIDES else 0.75)
        assert torch.equal(condition.latent[known], encode_occupancy([scene])[0][known])
        assert np.array_equal(condition.known.occupied, scene.occupied & ~condition.new_pixels)
        blocks[index] = SceneBlock(scene, encode_occupancy([scene])[0])
    with pytest.raises(KeyError):
        composer.condition_block((1, 1), {}, EMPTY, mode)


@pytest.mark.parametrize(("overlap", "rank"), [(0.5, rank_outward), (0.25, rank_outward), (0.25, rank_four_colors)])
def test_block_composer_of_true_blocks_equals_truth_in_one_datum(truth, overlap, rank):
    """Heights of a block are relative to the ground of the block. Heights of the composed scene have one datum."""
    last = (1, 1, 1, 1) if overlap == 0.5 else (0, 0, 0, 0)
    block_grid = BlockGrid.from_overlap(8, overlap, rank=rank, num_blocks=last if rank is rank_outward else None)
    composer = BlockComposer(block_grid, TRUTH_SPEC, encode_occupancy, find_ground_height(truth, 0.0, 0.0))
    blocks = {}
    wanted = block_grid.indices() if rank is rank_outward else list(product((-1, 0, 1), (-1, 0, 1)))
    for index in [index for front in block_grid.group_by_rank(wanted) for index in front]:
        needed = {other for other, _ in block_grid.known_cells(index)}
        if not needed <= blocks.keys():
            continue  # the block needs a neighbour outside the truth
        condition = composer.condition_block(index, blocks, EMPTY, "reencode")
        datum = condition.datum_m
        assert (datum != 0) == (
            not condition.is_empty
            and find_ground_height(condition.known.translate(0, 0, datum), 0, 0) != composer.level_m
        )
        scene = crop_truth(truth, index, block_grid).translate(0, 0, -datum)
        blocks[index] = composer.finish_block(condition, condition.latent, scene)
        assert blocks[index].known_ground > 0.5
    whole = composer.stitch(blocks, EMPTY)
    want = truth.crop(whole.grid)
    assert np.array_equal(whole.occupied, want.occupied) and np.allclose(whole.height_m, want.height_m, atol=1e-4)
    assert len(whole) == len(want) > 0
    order = [np.lexsort(np.round(s.center_m, 2).T) for s in (whole, want)]
    assert np.allclose(whole.center_m[order[0]], want.center_m[order[1]], atol=1e-4)
    part = replace(SMALL, front_m=40.0, left_m=10.0, rows=10, cols=12)
    cut = composer.stitch(blocks, EMPTY, part)
    assert np.array_equal(cut.occupied, want.crop(part).occupied) and len(cut) == len(want.crop(part))


def test_block_composer_does_not_repeat_known_object(truth):
    block_grid = BlockGrid.from_overlap(8, 0.5)
    composer = BlockComposer(block_grid, TRUTH_SPEC, encode_occupancy)
    middle = crop_truth(truth, (0, 0))
    blocks = {(0, 0): SceneBlock(middle, encode_occupancy([middle])[0])}
    condition = composer.condition_block((1, 0), blocks, EMPTY, "copy")
    # A known object is directly behind the seam. A copy directly ahead of the seam is a duplicate. An object far ahead
    # is no duplicate.
    car = {"size_m": np.float32([[4, 2, 1.5]]), "rotation": np.eye(3, dtype=np.float32)[None]}
    known = replace(condition.known.select([0]), center_m=np.float32([[31.9, 5, 0]]), **car)
    condition = replace(condition, known=known)
    again, far = (replace(known, center_m=np.float32([[x, 5, 0]])) for x in (32.1, 50.0))
    assert len(composer.finish_block(condition, condition.latent, again).scene) == 0
    assert np.array_equal(composer.finish_block(condition, condition.latent, far).scene.center_m, far.center_m)


def test_block_composer_marks_blocks_that_know_only_empty_ground(truth):
    block_grid = BlockGrid.from_overlap(8, 0.5)
    composer = BlockComposer(block_grid, TRUTH_SPEC, encode_occupancy)
    bare = replace(
        crop_truth(truth, (0, 0)), occupied=np.zeros_like(EMPTY.occupied), height_m=np.zeros_like(EMPTY.height_m)
    )
    condition = composer.condition_block(
        (1, 0), {(0, 0): SceneBlock(bare, encode_occupancy([bare])[0])}, EMPTY, "reencode"
    )
    assert composer.finish_block(condition, condition.latent, crop_truth(truth, (1, 0))).known_ground == 0.0


# ---------------------------------------------------------------------------------------------------------- pipeline


@pytest.mark.parametrize(("tile_m", "shape"), [(None, (1, 1)), (64.0, (3, 2)), (96.0, (2, 2)), (100.0, (2, 2))])
def test_tiles_together_equal_the_whole_scene(truth, tile_m, shape):
    block_grid = BlockGrid.from_overlap(8, 0.25, rank=rank_four_colors, num_blocks=(1, 1, 0, 1))
    composer = BlockComposer(block_grid, TRUTH_SPEC, encode_occupancy)
    blocks = {
        index: SceneBlock(crop_truth(truth, index, block_grid), torch.zeros(5, 8, 8)) for index in block_grid.indices()
    }
    whole = replace(composer.stitch(blocks, EMPTY), world_xyz_m=(5.0, 7.0, 1.0), world_yaw_rad=0.5)
    tiles = composer.cut_tiles(tile_m)
    assert composer.find_grid(blocks) == whole.grid and (tiles[-1].row + 1, tiles[-1].col + 1) == shape
    assert sum(tile.grid.rows * tile.grid.cols for tile in tiles) == whole.grid.rows * whole.grid.cols
    count = 0
    for tile in tiles:
        part = composer.stitch({index: blocks[index] for index in tile.blocks}, whole, tile.grid)
        count += len(part)
        rows, cols = whole.grid.intersect(tile.grid)[0]
        assert np.array_equal(part.height_m, whole.height_m[:, rows, cols]) and part.occupied.any()
        assert np.array_equal(part.occupied, whole.occupied[:, rows, cols])
        own = tile.to_own_frame(part)
        assert np.isclose(own.grid.back_m, 0) and np.isclose(own.grid.left_m, -own.grid.right_m)
        turn = make_yaw_rotation(0.5)  # Both frames give the same places in the world.
        for scene in (part, own):
            placed = scene.center_m @ turn.T + scene.world_xyz_m
            assert np.allclose(placed, part.center_m @ turn.T + whole.world_xyz_m, atol=1e-4)
    assert count == len(whole)


def test_tiles_below_a_block_or_between_pixels_are_refused():
    composer = BlockComposer(BlockGrid.from_overlap(8, 0.25), TRUTH_SPEC, encode_occupancy)
    for tile_m in (0.0, 62.0, 65.0):
        with pytest.raises(ValueError, match=rf"the side of a tile is {tile_m:g} m, expected at least 64 m and a mult"):
            composer.cut_tiles(tile_m)


def test_label_map_rows_start_far_ahead_and_left():
    rows = [["low-low", "low-medium", "low-high"], ["high-low", "high-medium", "high-high"]]
    labels = label_blocks("partial", rows, (1, 0, 1, 1))
    assert [labels[1, j] for j in (1, 0, -1)] == rows[0] and [labels[0, j] for j in (1, 0, -1)] == rows[1]
    with pytest.raises(ValueError, match="the number of rows is 2, with 3 labels per row; the city has 3 rows with 3"):
        label_blocks("partial", rows, (1, 1, 1, 1))
    with pytest.raises(
        ValueError, match="rows is 2, with 2 and 3 labels per row; the city has 2 rows with 3 blocks each"
    ):
        label_blocks("partial", [rows[0], rows[1][:2]], (1, 0, 1, 1))
    with pytest.raises(ValueError, match="label 'lots' is unknown"):
        label_blocks("partial", [["lots"]], (0, 0, 0, 0))


def test_free_blocks_are_crops_and_the_others_views():
    assert set(label_blocks("partial", "low-high", (1, 1, 1, 1)).values()) == {"low-high"}
    off_street = label_blocks("partial", "low-high", (1, 1, 1, 1), "off-street")
    assert {index for index, label in off_street.items() if label == "low-high-free"} == set(CORNERS) | {
        (0, 1),
        (0, -1),
    }
    everywhere = label_blocks("partial", "low-high", (1, 1, 1, 1), "all")
    assert [index for index, label in everywhere.items() if label == "low-high"] == [(0, 0)]
    assert set(label_blocks("joint", "low-high", (1, 1, 1, 1), "all").values()) == {"low-high"}  # joint has no crops
    with pytest.raises(ValueError, match="free_blocks is 'some', expected one of: none, off-street, all"):
        label_blocks("partial", "low-high", (1, 1, 1, 1), "some")


def test_blocks_with_empty_surroundings_are_new_scenes(pipeline, monkeypatch):
    empty = make_empty_scene("empty", "town", "0", 0, pipeline.spec)
    given = pipeline.generate(["low"], seed=1, num_inference_steps=5)[0]
    calls = []
    sample_latents = pipeline.sample_latents
    pipeline.use_sampler("dpm++")
    pipeline.register_to_config(num_inference_steps=5)
    monkeypatch.setattr(pipeline, "sample_latents", lambda *a, **o: calls.append(a[2]) or sample_latents(*a, **o))
    options = {"seed": 3, "num_blocks": (1, 0, 0, 0), "repaint": QUICK}
    for scene, mode, expected in ((empty, "reencode", [[(0, 1, 0)]]), (empty, "paper", []), (given, "reencode", [])):
        calls.clear()
        larger = pipeline.outpaint(scene, "low", mode=mode, **options)
        assert calls == expected and larger.grid.rows == 1.5 * scene.grid.rows
    pipeline.use_sampler("ddpm")  # DDPM needs many steps, so it uses those of the options.
    calls.clear()
    larger = pipeline.outpaint(empty, "low", mode="reencode", **options)
    assert not calls and pipeline.config.num_inference_steps == 250


def test_outpaint_keeps_given_scene_and_takes_label_per_block(pipeline):
    scene = random_scene(2, n=30, grid=SPEC.grid)
    for mode, last in (("copy", (1, 1, 1, 1)), ("reencode", (1, 0, 0, 2))):
        labels = {index: "high" if index[0] else "low" for index in product(range(-1, 2), range(-2, 2))}
        large = pipeline.outpaint(scene, labels, mode=mode, num_blocks=last, repaint=QUICK, order="outward")
        steps = last[0] + last[1], last[2] + last[3]
        assert (large.grid.rows, large.grid.cols) == tuple(32 + 16 * n for n in steps)
        middle = large.crop(scene.grid)
        assert np.array_equal(middle.occupied, scene.occupied) and np.array_equal(middle.height_m, scene.height_m)
        assert {tuple(c) for c in middle.center_m.tolist()} >= {tuple(c) for c in scene.center_m.tolist()}
        assert large.occupied.any() and large.scene_id == scene.scene_id
    one = pipeline.outpaint(scene, "low", num_blocks=(1, 0, 0, 0), repaint=QUICK)
    other = pipeline.outpaint(scene, "high", num_blocks=(1, 0, 0, 0), repaint=QUICK)
    assert not scenes_equal(one, other)
    with pytest.raises(ValueError, match="outpainting mode is 'paste'"):
        pipeline.outpaint(scene, "low", mode="paste", repaint=QUICK)
    with pytest.raises(ValueError, match="the model needs"):
        pipeline.outpaint(replace(scene, grid=replace(scene.grid, front_m=9.0)), "low")


def test_infinite_scene_is_independent_of_request_order(pipeline):
    indices = list(product((0, 1), (-1, 0, 1)))
    infinites = []
    for order in (indices, indices[::-1]):
        infinite = InfiniteScene(pipeline, lambda index: ("low", "high")[index[0] % 2], seed=3, repaint=QUICK)
        for index in order:
            infinite.get_block(index)
        infinites.append(infinite)
    assert all(scenes_equal(*(infinite.get_block(index).scene for infinite in infinites)) for index in indices)
    assert len({infinite.get_block(index).datum_m for infinite in infinites for index in indices}) > 1
    one = infinites[0]
    before = one.get_block((1, 1))
    for index in list(one.blocks):
        one.drop_block(index)
    assert scenes_equal(one.get_block((1, 1)).scene, before.scene) and set(one.blocks) <= set(
        product(range(3), repeat=2)
    )
    whole = one.get_scene(70.0, 10.0, 20.0, 30.0)
    assert whole.grid == Grid(70.0, 20.0, 2.0, 40, 25)
    part = one.get_scene(40.0, -10.0, 20.0, 0.0)
    assert scenes_equal(whole.crop(part.grid), part)
    with pytest.raises(ValueError, match="the rectangle is empty"):
        one.get_scene(10.0, -10.0, 5.0, 5.0)
    with pytest.raises(ValueError, match="label 'dense' is unknown"):
        InfiniteScene(pipeline, "dense")


def test_extent_is_rounded_up_to_whole_blocks():
    for extent_m, counts, arrangement in (
        ((128.0, 65.0), (1, 1, 1, 1), ("outward", 0.5, "none", 0.0)),
        ((160.0, 160.0), (1, 1, 1, 1), ("colours", 0.25, "all", 0.0)),
        ((512.0, 128.0), (5, 5, 1, 1), ("colours", 0.25, "all", 0.0)),
    ):
        assert arrange_blocks(Config(extent_m=extent_m)) == (counts, arrangement)
        step_m = 64 * (1 - arrangement[1])
        assert all(64 + 2 * count * step_m >= side for count, side in zip(counts[1:3], extent_m, strict=True))
    far = arrange_blocks(Config(extent_m=(512.0, 128.0), order="outward", free_blocks="off-street", margin=0.0625))
    assert far == ((7, 7, 1, 1), ("outward", 0.5, "off-street", 0.0625))
    for wrong in (
        Config(extent_m=(32.0, 64.0)),
        Config(blocks_ahead=0, blocks_behind=0, blocks_left=0, blocks_right=0),
        Config(blocks_ahead=-1),
    ):
        with pytest.raises(ValueError, match="expected"):
            arrange_blocks(wrong)
