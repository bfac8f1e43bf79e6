"""Tests of training on several datasets: shares, one layout, reference surfaces and labels."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers import SHARD_SIZES, random_scene, small_spec

from models.augment import Augmentation
from models.labels import LABELS
from models.layout import SLAB_OFFSET_M, Bounds, LayoutSpec
from models.scene import CATEGORIES
from models.tensors import encode_layout
from pipelines.reporting.model_card import ModelCard, TrainingRecord
from pipelines.runtime import storage
from pipelines.schema.attribution import ATTRIBUTIONS
from pipelines.schema.columns import SCENES
from pipelines.schema.dataset import DENSITY_COLUMNS, Dataset, label_scenes
from pipelines.schema.density_labels import DensityThresholds
from pipelines.schema.ground_surface import to_model_surface
from pipelines.schema.mixture import Mixture
from pipelines.schema.tables import Shard
from pipelines.training.data_loader import LayoutReader, Stream, read_label_indices, read_samples
from pipelines.training.mixed_stream import CYCLE, MixedStream, mix_streams


@pytest.fixture(scope="module")
def map_shards(tmp_path_factory) -> tuple[Shard, ...]:
    """Two shards of scenes of maps, whose objects stand on the ground heights."""
    root = str(tmp_path_factory.mktemp("maps"))
    shards = tuple(Shard(root, "osm", "train", k) for k in range(2))
    for k, shard in enumerate(shards):
        shard.write([random_scene(50 + 3 * k + i, n=30, source="osm") for i in range(3)])
    return shards


# --------------------------------------------------------------------------------------------------- samples


def test_each_cycle_has_the_shares_of_the_datasets(layout_shards, map_shards):
    streams = Stream(layout_shards, SHARD_SIZES, 4, seed=0), Stream(map_shards, (3, 3), 4, seed=0)
    mixed = mix_streams(list(streams), (2.0, 1.0))
    assert isinstance(mixed, MixedStream) and mixed.quotas == (667, 333)
    shard, row = mixed.positions(0, 3 * CYCLE)
    assert mixed.shards == layout_shards + map_shards and mixed.counts == (*SHARD_SIZES, 3, 3)
    for cycle in range(3):
        assert (shard[cycle * CYCLE : (cycle + 1) * CYCLE] < len(SHARD_SIZES)).sum() == 667
    for k, stream in enumerate(streams):  # Each dataset is read in the order of its own stream.
        mine = (shard < len(SHARD_SIZES)) == (k == 0)
        shards, rows = stream.positions(0, int(mine.sum()))
        assert np.array_equal(shard[mine] - (0, len(SHARD_SIZES))[k], shards) and np.array_equal(row[mine], rows)
    runs = np.diff(np.flatnonzero(np.diff(shard < len(SHARD_SIZES)))).max()
    assert runs < 30  # The datasets alternate within a batch of usual size.


def test_mixed_stream_is_the_same_from_any_step(layout_shards, map_shards):
    streams = Stream(layout_shards, SHARD_SIZES, 4, seed=3), Stream(map_shards, (3, 3), 4, seed=3)
    mixed = MixedStream(streams, (1.0, 1.0))
    whole = np.stack(mixed.positions(0, 2500))
    for first, count in ((0, 7), (993, 20), (1999, 2), (2100, 400)):
        assert np.array_equal(np.stack(mixed.positions(first, count)), whole[:, first : first + count])
    other = MixedStream(tuple(replace(stream, seed=4) for stream in streams), (1.0, 1.0))
    assert not np.array_equal(np.stack(other.positions(0, 2500)), whole)


def test_dataset_of_weight_zero_is_not_sampled(layout_shards, map_shards):
    streams = [Stream(layout_shards, SHARD_SIZES, 4, seed=0), Stream(map_shards, (3, 3), 4, seed=0)]
    assert mix_streams(streams, (1.0, 0.0)) is streams[0]
    assert mix_streams(streams, (0.0, 0.5)) is streams[1]
    with pytest.raises(ValueError, match="gets less than one of 1000 samples; use more even --dataset-weights"):
        mix_streams(streams, (1.0, 1e-6))


@pytest.mark.parametrize("augment", [None, Augmentation(flip=True, move_m=1.0, turn_rad=0.05, seed=1)])
def test_samples_have_the_reference_surface_of_the_model(layout_shards, map_shards, augment):
    """In scenes of maps, objects stand on the ground heights; in the town, 0.3 m below. A model has one surface."""
    spec = small_spec(32)
    assert spec.surface == "top"
    mixed = MixedStream(
        (Stream(layout_shards, SHARD_SIZES, 4, seed=0), Stream(map_shards, (3, 3), 4, seed=0)), (1.0, 1.0)
    )
    got = read_samples(mixed, LayoutReader(spec, augment), first=1, count=4, batch=4, rank=0, world=1)
    seen = set()
    for k, (shard, row) in enumerate(zip(*mixed.positions(4, 16), strict=True)):
        scene = mixed.shards[shard].scenes([int(row)])[0]
        seen.add(scene.source)
        raised = replace(scene, height_m=scene.height_m + SLAB_OFFSET_M * scene.occupied)
        expected = raised if scene.source == "osm" else scene
        want = encode_layout(augment(expected, 4 + k) if augment else expected, spec)
        assert np.array_equal(got["occupied"][k], want["occupied"])
        assert np.abs(got["height"][k].astype(int) - want["height"]).max() <= 1  # Steps of 1/65535 of the bounds.
    assert seen == {"town", "osm"}


# ---------------------------------------------------------------------------------------------------- layout


def make_spec(**fields) -> LayoutSpec:
    return replace(small_spec(64), **fields)


def test_layout_covers_all_datasets():
    town = make_spec(
        categories=CATEGORIES[1:],
        slots=(6,) * 10,
        ground_classes=("road", "terrain"),
        height_bounds_m=Bounds((-2,), (1,)),
    )
    maps = make_spec(
        categories=CATEGORIES[:3],
        slots=(9, 2, 8),
        ground_classes=("road", "crossing"),
        height_bounds_m=Bounds((-3,), (0.5,)),
        center_bounds_m=Bounds((0, -32, -1), (64, 32, 40)),
        surface="surface",
    )
    both = LayoutSpec.merge([town, maps])
    assert both.categories == CATEGORIES and both.slots == (9, 6, 8, *(6,) * 8)
    assert both.ground_classes == ("road", "terrain", "crossing") and both.surface == "top"
    assert both.height_bounds_m == Bounds((-2.7,), (1,))  # Heights of the map move up by 0.3 m.
    assert both.center_bounds_m.low[2] == -8 and both.center_bounds_m.high[2] == 40
    assert both.require_cover(town, "town") == [] == both.require_cover(maps, "maps")
    assert LayoutSpec.merge([town]) == town


def test_layout_of_a_model_names_what_it_lacks():
    model = make_spec(ground_classes=("road", "terrain"), height_bounds_m=Bounds((-2,), (1,)))
    with pytest.raises(ValueError, match="/maps has the ground_classes crossing, which the layout of the model lacks"):
        model.require_cover(make_spec(ground_classes=("road", "crossing")), "/maps")
    with pytest.raises(ValueError, match="/maps has the categories vegetation_cuboid, which"):
        replace(model, categories=CATEGORIES[1:], slots=(6,) * 10).require_cover(model, "/maps")
    wide = replace(model, grid=replace(model.grid, resolution_m=2.0))
    with pytest.raises(ValueError, match=r"/maps covers x from -64 to 64 m and y from .* expected 0 to 64 m"):
        model.require_cover(wide, "/maps")
    with pytest.raises(ValueError, match="dataset 2 covers"):
        LayoutSpec.merge([model, wide])
    large = replace(model, cholesky_bounds=Bounds(model.cholesky_bounds.low, (17.0, *model.cholesky_bounds.high[1:])))
    assert model.require_cover(large, "/maps") == [
        "/maps has larger or smaller objects than the bounds of the layout: sizes are clipped"
    ]
    assert (
        model.require_cover(replace(model, surface="surface", height_bounds_m=Bounds((-2.3,), (0.7,))), "/maps") == []
    )
    (low,) = model.require_cover(replace(model, surface="surface"), "/maps")
    assert low == "/maps has ground heights from -1.7 to 1.3 m, but the bounds of the layout are -2 to 1 m"
    hills = replace(model, slots=(9, *model.slots[1:]), height_bounds_m=Bounds((-7,), (0.5,)))
    assert model.covers_heights(model) and not model.covers_heights(hills)
    few, high = model.require_cover(hills, "/hills")
    assert few == "/hills has slots for more objects of vegetation_cuboid: the farthest ones are left out"
    assert high == "/hills has ground heights from -7 to 0.5 m, but the bounds of the layout are -2 to 1 m"


# ---------------------------------------------------------------------------------------------------- labels


def test_labels_of_all_datasets_have_the_same_thresholds(town_dataset):
    shard = Shard(town_dataset, "town", "train", 0)
    low, high = DensityThresholds(1e6, 2e6, 1e6, 2e6), DensityThresholds(-2, -1, -2, -1)
    kind = "joint"
    names = LABELS[kind]
    for thresholds, expected in (((low, high), "low-high"), ((high, low), "high-low")):
        found = read_label_indices(shard, kind, thresholds)
        assert [names[k] for k in found] == [expected] * 5
    table = shard.read("scenes")
    labelled = label_scenes(table, low, high).cast(SCENES)
    assert labelled["vehicle_density"].to_pylist() == ["high"] * 5
    assert set(DENSITY_COLUMNS) <= set(table.column_names)
    stored = read_label_indices(shard, kind)
    columns = table["vegetation_density"].to_pylist(), table["vehicle_density"].to_pylist()
    assert [names[k] for k in stored] == [f"{a}-{b}" for a, b in zip(*columns, strict=True)]


# --------------------------------------------------------------------------------------------------- options


def test_mixture_names_wrong_options(tmp_path):
    town = str(tmp_path)
    thresholds = dict.fromkeys(("count_p25", "count_p75", "volume_p25_m3", "volume_p75_m3"), 1.0)
    about = {"source": "town", "scenes": {}, "layout": small_spec().to_dict()}
    about |= {"vegetation_thresholds": thresholds, "vehicle_thresholds": thresholds}
    (tmp_path / "dataset.json").write_text(json.dumps(about))
    with pytest.raises(ValueError, match="is given twice; use --dataset-weights"):
        Mixture.open([town, town])
    with pytest.raises(ValueError, match=r"--dataset-weights has 2 numbers, expected 1: one for --dataset and one for"):
        Mixture.open([town], (1.0, 2.0))
    link = tmp_path / "link"
    link.symlink_to(tmp_path)
    with pytest.raises(ValueError, match="is given twice"):
        Mixture.open([town, str(link)])
    for weights in ((0.0,), (-1.0,), (float("nan"),), (float("inf"),)):
        with pytest.raises(ValueError, match="expected numbers of 0 or more, not all 0"):
            Mixture.open([town], weights)
    with pytest.raises(ValueError, match=r"holds no dataset\.json"):
        Mixture.open([town, "/nowhere"])
    assert Mixture.open([town]).identity() == {}
    assert Mixture.open([f"{town}/"]).datasets[0].root == town


def test_identity_names_what_is_sampled(map_shards, tmp_path):
    """Weights for a layout only, as of a reference model, are no training data."""
    spec, thresholds = small_spec(), DensityThresholds(1, 1, 1, 1)
    scene = replace(random_scene(1, source="osm"), attribution="someone")
    Shard(str(tmp_path), "osm", "train", 0).write([scene])
    town, maps, other = (
        Dataset(root, source, {}, spec, thresholds, thresholds)
        for root, source in (("/town", "town"), (map_shards[0].root, "osm"), (str(tmp_path), "osm"))
    )
    found = Mixture((town, maps, other), (2.0, 0.0, 1.0)).identity()
    assert found == {
        "added_datasets": [maps.root, other.root],
        "added_sources": "osm",
        "added_notices": "someone",
        "dataset_weights": [2.0, 0.0, 1.0],
    }
    assert Mixture((town, maps), (1.0, 0.0)).identity()["added_sources"] == ""
    assert Mixture((town, maps), (1.0, 1.0)).identity()["added_notices"] == ""


@pytest.mark.parametrize("augment", [None, Augmentation(flip=True, move_m=1.0, turn_rad=0.05, seed=1)])
def test_heights_outside_the_bounds_are_clipped_on_request(layout_shards, augment):
    spec = replace(small_spec(32), height_bounds_m=Bounds((-0.7,), (-0.4,)))
    scene = layout_shards[0].scenes([2])[0]
    rows, places = np.array([2]), np.array([7])
    clipped, whole = (LayoutReader(spec, augment, clip)(layout_shards[0], rows, places) for clip in (True, False))
    expected = encode_layout(augment(scene, 7) if augment else scene, spec, clip_heights=False)
    assert np.abs(whole["height"][0] - expected["height"]).max() <= 1
    occupied = whole["occupied"]
    assert clipped["height"][occupied].min() == 0 and clipped["height"][occupied].max() == 65535
    assert whole["height"][occupied].min() < -1000 and whole["height"][occupied].max() > 66535


def test_model_card_names_the_licences_of_all_data():
    run = TrainingRecord("lvae", "lvae", "", None, 1, 0.0, {"dataset": "/a", "added_datasets": "['/b']"}, {}, {}, {})
    notices = f"{ATTRIBUTIONS['kitti360']}; {ATTRIBUTIONS['osm']}"
    added = {"added_sources": "osm, kitti360", "added_notices": notices, "dataset_weights": "[2.0, 1.0, 1.0]"}
    mixed = replace(run, options={**run.options, **added})
    cards = [
        ModelCard("x", "1", "none", ["any"], [one, run], {}, {"seed": 0, "sampler": "ddim"}, "test", {}, {})
        for one in (run, mixed)
    ]
    assert [card._list_notices() for card in cards] == [[], [ATTRIBUTIONS["kitti360"], ATTRIBUTIONS["osm"]]]
    assert cards[0]._describe_data() == "The model is trained only on the dataset above."
    assert "mixed with scenes of the sources osm, kitti360" in cards[1]._describe_data()
    assert next(cards[0]._head()).startswith("---\nlicense: apache-2.0")
    assert next(cards[1]._head()).startswith("---\nlicense: other")
    shown = dict(mixed.rows({}))["options"]
    assert shown == "added_sources osm, kitti360, dataset_weights [2.0, 1.0, 1.0]"
    assert not {"dataset", "added_datasets", "added_notices"} & set(mixed.record({})["options"])


def test_scenes_of_maps_keep_their_ground_in_a_map_model(map_shards):
    spec = replace(small_spec(32), surface="surface")
    (scene,) = map_shards[0].scenes([0])
    assert to_model_surface(scene, spec) is scene
    got = LayoutReader(spec)(map_shards[0], np.array([0]))
    assert np.array_equal(got["height"][0], encode_layout(scene, spec)["height"])
    assert storage.exists(map_shards[0].path("scenes"))
