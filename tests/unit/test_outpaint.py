"""Worlds of blocks: given the truth for every block they equal the truth, in any order of blocks."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from helpers import QUICK, random_scene, scenes_equal, small_spec

from models.composition.infinite import City
from models.composition.outpaint import Block, Lattice, World, colour, height_near, outward
from models.layout import LayoutSpec
from models.scene import KITTI_GROUND_CLASSES, Grid
from models.tensors import new_scene

SPEC = small_spec()
SMALL = Grid(rows=32, cols=32, resolution_m=2.0)
LARGE = Grid(front_m=96.0, left_m=64.0, rows=64, cols=64, resolution_m=2.0)
TRUTH_SPEC = LayoutSpec(grid=SMALL)
EMPTY = new_scene("empty", "town", "0", 0, TRUTH_SPEC)
SIDES, CORNERS = [(1, 0), (-1, 0), (0, 1), (0, -1)], [(1, 1), (1, -1), (-1, 1), (-1, -1)]


def cell_occupancy(scenes) -> torch.Tensor:
    """A test encoder whose latent is the occupancy of 8 x 8 cells, which shows what a block knows."""
    occupied = np.stack([s.occupied for s in scenes]).astype(np.float32)
    return torch.from_numpy(occupied.reshape(len(scenes), len(KITTI_GROUND_CLASSES), 8, 4, 8, 4).mean(axis=(3, 5)))


@pytest.fixture
def truth():
    """128 x 128 m on one slope with block (0, 0) in the middle; objects of a category do not overlap."""
    scene = random_scene(3, n=300, grid=LARGE)
    rng = np.random.default_rng(0)
    center = rng.uniform([-32, -64, -2], [96, 64, 6], (300, 3)).astype(np.float32)
    return replace(scene, center_m=center, size_m=scene.size_m * 0.05)


def seen(truth, place, lattice=None):
    """The truth as a block at `place` sees it, in its own frame."""
    step = 64.0 * (lattice.step / lattice.size if lattice else 0.5)
    x, y = step * place[0], step * place[1]
    return truth.cropped(replace(SMALL, front_m=64 + x, left_m=32 + y)).moved(-x, -y)


# ---------------------------------------------------------------------------------------------------------- lattices


def lattices():
    rectangles = [(1, 1, 1, 1), (3, 0, 2, 1), (0, 4, 0, 0)]
    for last, overlap in product(rectangles, (0.125, 0.25, 0.5, 0.75)):
        yield Lattice.of(8, overlap, last=last)
    for overlap in (0.125, 0.25, 0.375):
        yield Lattice.of(8, overlap, rank=colour, last=None)


@pytest.mark.parametrize(
    "lattice", lattices(), ids=lambda lattice: f"{lattice.rank.__name__}-{lattice.step}-{lattice.last}"
)
def test_block_grid_cells_have_one_owner_known_to_later_blocks(lattice):
    places = lattice.places() if lattice.last else list(product(range(-3, 4), repeat=2))
    owners: dict[tuple[int, int], list] = {}
    for place in places:
        for row, col in np.argwhere(lattice.owned(place)).tolist():
            # World cells: rows grow backward, columns to the right.
            owners.setdefault((row - place[0] * lattice.step, col - place[1] * lattice.step), []).append(place)
    assert all(len(found) == 1 for found in owners.values())
    for place in places:
        known = np.zeros((8, 8), bool)
        for other, cells in lattice.known(place):
            assert lattice.rank(other) < lattice.rank(place) and not (known & cells).any()
            known |= cells
            for row, col in np.argwhere(cells).tolist():
                at = (row - place[0] * lattice.step, col - place[1] * lattice.step)
                assert owners.get(at, [other]) == [other]
        assert np.array_equal(known, ~lattice.owned(place))


def test_block_grid_fronts_are_independent():
    lattice = Lattice.of(8, 0.5, last=(2, 2, 2, 2))
    fronts = lattice.fronts(lattice.places())
    assert [len(front) for front in fronts] == [1, 4, 8, 8, 4]
    for front in fronts:
        assert not any({other for other, _ in lattice.known(place)} & set(front) for place in front)
    endless = Lattice.of(8, 0.25, rank=colour, last=None)
    needed, waiting = set(), [(1, 1)]
    while waiting:
        place = waiting.pop()
        needed.add(place)
        waiting += [other for other, _ in endless.known(place)]
    assert needed == set(product(range(3), repeat=2))
    with pytest.raises(ValueError, match="no list of places"):
        endless.places()


def test_block_grid_rejects_wrong_overlaps():
    with pytest.raises(ValueError, match=r"overlap 0.51 is not a whole number of the 8 latent cells"):
        Lattice.of(8, 0.51)
    with pytest.raises(ValueError, match=r"overlap 0.5: four colours need less than 0.5"):
        Lattice.of(8, 0.5, rank=colour, last=None)


# ------------------------------------------------------------------------------------------------------------ worlds


@pytest.mark.parametrize("mode", ["copy", "reencode"])
def test_world_gives_blocks_their_known_neighbors(truth, mode):
    lattice = Lattice.of(8, 0.5)
    world = World(lattice, TRUTH_SPEC, cell_occupancy)
    made = {}
    for place in [(0, 0), *SIDES, *CORNERS]:
        scene = seen(truth, place)
        task = world.task(place, made, EMPTY, mode)
        known = task.unknown == 0
        assert known.float().mean() == (0 if place == (0, 0) else 0.5 if place in SIDES else 0.75)
        assert torch.equal(task.latent[known], cell_occupancy([scene])[0][known])
        assert np.array_equal(task.known.occupied, scene.occupied & ~task.new_pixels)
        made[place] = Block(scene, cell_occupancy([scene])[0])
    with pytest.raises(KeyError):
        world.task((1, 1), {}, EMPTY, mode)


@pytest.mark.parametrize(("overlap", "rank"), [(0.5, outward), (0.25, outward), (0.25, colour)])
def test_world_of_true_blocks_equals_truth_in_one_datum(truth, overlap, rank):
    """Heights of a block are relative to its own ground; heights of the world are not."""
    last = (1, 1, 1, 1) if overlap == 0.5 else (0, 0, 0, 0)
    lattice = Lattice.of(8, overlap, rank=rank, last=last if rank is outward else None)
    world = World(lattice, TRUTH_SPEC, cell_occupancy, height_near(truth, 0.0, 0.0))
    made = {}
    wanted = lattice.places() if rank is outward else list(product((-1, 0, 1), (-1, 0, 1)))
    for place in [place for front in lattice.fronts(wanted) for place in front]:
        needed = {other for other, _ in lattice.known(place)}
        if not needed <= made.keys():
            continue  # beyond the truth
        task = world.task(place, made, EMPTY, "reencode")
        datum = task.datum_m
        assert (datum != 0) == (task.knows and height_near(task.known.moved(0, 0, datum), 0, 0) != world.level_m)
        scene = seen(truth, place, lattice).moved(0, 0, -datum)
        made[place] = world.block(task, task.latent, scene)
        assert made[place].known_ground > 0.5
    whole = world.stitched(made, EMPTY)
    want = truth.cropped(whole.grid)
    assert np.array_equal(whole.occupied, want.occupied) and np.allclose(whole.height_m, want.height_m, atol=1e-4)
    assert len(whole) == len(want) > 0
    order = [np.lexsort(np.round(s.center_m, 2).T) for s in (whole, want)]
    assert np.allclose(whole.center_m[order[0]], want.center_m[order[1]], atol=1e-4)
    part = replace(SMALL, front_m=40.0, left_m=10.0, rows=10, cols=12)
    cut = world.stitched(made, EMPTY, part)
    assert np.array_equal(cut.occupied, want.cropped(part).occupied) and len(cut) == len(want.cropped(part))


def test_world_does_not_repeat_known_object(truth):
    lattice = Lattice.of(8, 0.5)
    world = World(lattice, TRUTH_SPEC, cell_occupancy)
    middle = seen(truth, (0, 0))
    made = {(0, 0): Block(middle, cell_occupancy([middle])[0])}
    task = world.task((1, 0), made, EMPTY, "copy")
    # An object just behind the seam, generated again just ahead of the seam and once more far ahead.
    car = {"size_m": np.float32([[4, 2, 1.5]]), "rotation": np.eye(3, dtype=np.float32)[None]}
    known = replace(task.known.select([0]), center_m=np.float32([[31.9, 5, 0]]), **car)
    task = replace(task, known=known)
    again, far = (replace(known, center_m=np.float32([[x, 5, 0]])) for x in (32.1, 50.0))
    assert len(world.block(task, task.latent, again).scene) == 0
    assert np.array_equal(world.block(task, task.latent, far).scene.center_m, far.center_m)


def test_world_marks_blocks_that_know_only_empty_ground(truth):
    lattice = Lattice.of(8, 0.5)
    world = World(lattice, TRUTH_SPEC, cell_occupancy)
    bare = replace(seen(truth, (0, 0)), occupied=np.zeros_like(EMPTY.occupied), height_m=np.zeros_like(EMPTY.height_m))
    task = world.task((1, 0), {(0, 0): Block(bare, cell_occupancy([bare])[0])}, EMPTY, "reencode")
    assert world.block(task, task.latent, seen(truth, (1, 0))).known_ground == 0.0


# ---------------------------------------------------------------------------------------------------------- pipeline


def test_outpaint_keeps_given_scene_and_takes_label_per_block(pipeline):
    scene = random_scene(2, n=30, grid=SPEC.grid)
    for mode, last in (("copy", (1, 1, 1, 1)), ("reencode", (1, 0, 0, 2))):
        labels = {place: "high" if place[0] else "low" for place in product(range(-1, 2), range(-2, 2))}
        large = pipeline.outpaint(scene, labels, mode=mode, last=last, resampling=QUICK)
        steps = last[0] + last[1], last[2] + last[3]
        assert (large.grid.rows, large.grid.cols) == tuple(32 + 16 * n for n in steps)
        middle = large.cropped(scene.grid)
        assert np.array_equal(middle.occupied, scene.occupied) and np.array_equal(middle.height_m, scene.height_m)
        assert {tuple(c) for c in middle.center_m.tolist()} >= {tuple(c) for c in scene.center_m.tolist()}
        assert large.occupied.any() and large.scene_id == scene.scene_id
    one = pipeline.outpaint(scene, "low", last=(1, 0, 0, 0), resampling=QUICK)
    other = pipeline.outpaint(scene, "high", last=(1, 0, 0, 0), resampling=QUICK)
    assert not scenes_equal(one, other)
    with pytest.raises(ValueError, match="outpainting mode 'paste'"):
        pipeline.outpaint(scene, "low", mode="paste", resampling=QUICK)
    with pytest.raises(ValueError, match="the model needs"):
        pipeline.outpaint(replace(scene, grid=replace(scene.grid, front_m=9.0)), "low")


def test_city_is_independent_of_request_order(pipeline):
    places = list(product((0, 1), (-1, 0, 1)))
    cities = []
    for order in (places, places[::-1]):
        city = City(pipeline, lambda place: ("low", "high")[place[0] % 2], seed=3, resampling=QUICK)
        for place in order:
            city.block(place)
        cities.append(city)
    assert all(scenes_equal(*(city.block(place).scene for city in cities)) for place in places)
    assert len({city.block(place).datum_m for city in cities for place in places}) > 1
    one = cities[0]
    before = one.block((1, 1))
    for place in list(one.made):
        one.forget(place)
    assert scenes_equal(one.block((1, 1)).scene, before.scene) and set(one.made) <= set(product(range(3), repeat=2))
    whole = one.scene(70.0, 10.0, 20.0, 30.0)
    assert whole.grid == Grid(70.0, 20.0, 2.0, 40, 25)
    part = one.scene(40.0, -10.0, 20.0, 0.0)
    assert scenes_equal(whole.cropped(part.grid), part)
    with pytest.raises(ValueError, match="an empty rectangle"):
        one.scene(10.0, -10.0, 5.0, 5.0)
    with pytest.raises(ValueError, match="label 'dense' is unknown"):
        City(pipeline, "dense")
