"""Tests of the comparison of large scenes with data: seams of block grids, labels, levels, scores by ring and maps."""

import json

import numpy as np
import pytest
from helpers import random_scene

from models.composition.block_grid import RANKS, BlockGrid, label_blocks
from models.scene import VEGETATION, VEHICLES
from pipelines.evaluation.cities import (
    CityResult,
    choose_rings_per_group,
    compute_label_scores,
    compute_quantity_scores,
    compute_street_distances,
    compute_whole_scores,
    find_origin_level_m,
    find_seams_m,
    name_group,
    name_source,
    parse_label,
    read_run_record,
)
from pipelines.evaluation.traffic import Traffic
from pipelines.metrics.cities import QUANTITIES, SEAM_RECORD_SHAPE
from pipelines.metrics.validity import judge_densities
from pipelines.reporting.city_report import CELL_PX, build_label_table, draw_map, draw_ring_charts
from pipelines.schema.density_labels import DensityThresholds


def test_seams_lie_where_new_blocks_meet_known_content():
    outward = BlockGrid.from_overlap(32, 0.5, rank=RANKS["outward"], num_blocks=(2, 1, 0, 1))
    x_m, y_m = find_seams_m(outward, 2.0)
    # Block 1 spans x from 32 to 96 m and meets known content at 64 m; block 2 at 96 m; block -1 at 0 m.
    assert x_m == (0.0, 64.0, 96.0) and y_m == (-32.0,)
    colours = BlockGrid.from_overlap(32, 0.25, rank=RANKS["colours"], num_blocks=(2, 0, 0, 0))
    # Blocks 0 and 2 (x from 96 to 160 m) come first; block 1 (48 to 112 m) fills the gap between 64 and 96 m.
    assert find_seams_m(colours, 2.0) == ((64.0, 96.0), ())
    inner = BlockGrid.from_overlap(32, 0.25, 0.0625, rank=RANKS["colours"], num_blocks=(2, 0, 0, 0))
    assert find_seams_m(inner, 2.0) == ((64.0, 100.0), ())  # Block 2 does not own its first 4 m; block 0 owns all.
    assert find_seams_m(BlockGrid(32, 16, num_blocks=(0, 0, 0, 0)), 2.0) == ((), ())


def test_seams_are_read_from_the_record_of_a_run(tmp_path):
    assert read_run_record(str(tmp_path), "generated-city").seams_m == ((), ())
    path = tmp_path / "generated-city.json"
    path.write_text(json.dumps({"overlap": 0.5, "num_blocks": [1, 1, 1, 1], "order": "outward"}))
    assert read_run_record(str(tmp_path), "generated-city").seams_m == ((0.0, 64.0), (-32.0, 32.0))
    path.write_text(json.dumps({"seed": 0}))
    assert read_run_record(str(tmp_path), "generated-city").seams_m == ((), ())


def test_label_is_read_from_the_record_of_a_run(tmp_path):
    assert read_run_record(str(tmp_path), "generated-city").label is None
    for text, label in {"low": ("low", None), "any-high-free": (None, "high"), None: None}.items():
        (tmp_path / "generated-city.json").write_text(json.dumps({"label": text}))
        assert read_run_record(str(tmp_path), "generated-city").label == label
    with pytest.raises(ValueError, match="density 'lots' is unknown, expected one of low, medium, high, any"):
        parse_label("lots-any")


def test_windows_have_the_label_of_the_nearest_block(tmp_path):
    rows = [["low-low", "low-medium", "low-high"], ["high-low", "any-medium-free", "high-high"]]
    options = {"overlap": 0.25, "num_blocks": [1, 0, 1, 1], "order": "colours", "labels_map": rows, "label": None}
    (tmp_path / "generated-city.json").write_text(json.dumps(options))
    record = read_run_record(str(tmp_path), "generated-city")
    assert record.label == (None, None) and record.block_labels is not None
    by_block = label_blocks("partial", rows, (1, 0, 1, 1))
    assert {index: parse_label(name) for index, name in by_block.items()} == record.block_labels.labels
    find = record.block_labels.find_label
    # Blocks are 48 m apart; the nearest block of a point beyond the border is the last one.
    assert find(0, 0) == find(23, -23) == (None, "medium") and find(25, 0) == ("low", "medium")
    assert find(64, 64) == find(500, 500) == ("low", "low") and find(-64, -64) == ("high", "high")


def test_rings_form_groups_of_equal_width():
    assert [name_group(ring) for ring in range(4)] == ["0-1", "0-1", "2", "3"]
    assert [name_group(ring, 3) for ring in range(8)] == ["0-3"] * 4 + ["4-6"] * 3 + ["7-9"]
    # 192 m: ring 1; 704 m: five rings; 768 m: still five whole rings; 832 m: six rings; 2,080 m: fifteen rings.
    assert [choose_rings_per_group(m) for m in (192.0, 704.0, 768.0, 832.0, 2080.0)] == [1, 1, 1, 2, 3]
    assert name_source("generated", "4-6") == "generated-ring-4-6"
    assert name_source("ceiling", "4-6") == "ceiling"


def test_label_follows_thresholds_of_dataset():
    scene = random_scene(0, n=40)
    volume_m3 = scene.size_m.prod(axis=1)
    plants = np.isin(scene.category, VEGETATION)
    cars = np.isin(scene.category, VEHICLES)
    assert plants.any() and cars.any()
    above = DensityThresholds(*2 * (plants.sum() + 1.0,), *2 * (volume_m3[plants].sum() + 1,))
    below = DensityThresholds(*2 * (cars.sum() - 1.0,), *2 * (volume_m3[cars].sum() - 0.01,))
    assert judge_densities(scene, above, below) == ("low", "high")


def test_level_is_that_of_the_ground_next_to_the_origin():
    scene = random_scene(1)
    bare = np.zeros_like(scene.occupied)
    level = scene.height_m * 0 + 7
    level[:, -3, scene.grid.cols // 2 - 1 : scene.grid.cols // 2 + 1] = -2.5  # 2.5 pixels ahead of the origin.
    occupied = bare.copy()
    occupied[0, :-2] = True
    changed = type(scene)(**{**vars(scene), "height_m": level, "occupied": occupied})
    assert find_origin_level_m(changed) == -2.5
    assert np.isnan(find_origin_level_m(type(scene)(**{**vars(scene), "occupied": bare})))


def test_quantities_are_averaged_by_ring_over_kept_windows():
    def row(ring, cars, kept=True):
        values = {"ring": ring, "group": name_group(ring), "kept": kept, "vehicle_small_per_ha": cars}
        return {name: 0.0 for name in QUANTITIES} | values

    scores = compute_quantity_scores([row(2, 6.0), row(0, 1.0), row(1, 3.0), row(1, np.nan), row(2, 90.0, kept=False)])
    means = {group: found["vehicle_small_per_ha"].value for group, found in scores.items()}
    assert means == {"0-1": 2.0, "2": 6.0, "all": pytest.approx(10 / 3)}


def test_charts_show_groups_at_their_middle_ring():
    groups = {group: {name: {"value": 1.0} for name in QUANTITIES} for group in ("0-1", "2", "3-6", "all")}
    sides = {"generated": groups, "reference": {"all": groups["all"]}, "ceiling": {"all": groups["all"]}}
    chart = draw_ring_charts({"quantities": sides}).charts[0]
    assert chart.series["generated"] == ([0.5, 2.0, 4.5], [1.0] * 3) and chart.series["ceiling"][0] == [0, 4.5]


def test_quantities_are_averaged_by_label():
    def row(label, cars, kept=True):
        return {name: 0.0 for name in QUANTITIES} | {"label": label, "kept": kept, "vehicle_small_per_ha": cars}

    rows = {
        "generated": [row("low-low", 1.0), row("low-low", 3.0), row("high-any", 9.0)],
        "reference": [row("low-low", 5.0), row("low-high", 7.0)],
        "ceiling": [row("low-low", 80.0, kept=False), row("low-low", 4.0), row("high-high", 6.0)],
        "control": [row("high-any", 50.0)],
    }
    scores = compute_label_scores(rows, ("generated", "reference"))
    assert list(scores) == ["low-low"] and set(scores["low-low"]) == {"generated", "reference", "ceiling"}
    written = {
        label: {
            side: {name: found and found._asdict() for name, found in estimates.items()}
            for side, estimates in sides.items()
        }
        for label, sides in scores.items()
    }
    table = build_label_table({"labels": written})
    assert table.columns == ("quantity", "low-low", "mean of labels")
    cells = {name: values for name, *values in table.rows}
    assert cells["vehicle small per ha"] == ["2 (5, 4)"] * 2 and cells["road share"] == ["0 (0, 0)"] * 2
    more = {
        "generated": {"vehicle_small_per_ha": {"value": 4.0}},
        "reference": {"vehicle_small_per_ha": {"value": 9.0}},
    }
    cells = {name: values for name, *values in build_label_table({"labels": written | {"high-any": more}}).rows}
    assert cells["vehicle small per ha"] == ["2 (5, 4)", "4 (9, –)", "3 (7, –)"]


def test_whole_cities_are_scored_by_blocks_traffic_and_seams():
    def make(city, angles_m, traffic=None, seams=None):
        rows = [{"ring": 2, "group": "2"}, {"ring": 0, "group": "0-1"}]
        blocks_m2 = np.array([2000.0, 3000.0, 7000.0])
        overview = np.zeros((2, 2, 3), np.uint8)
        return CityResult("side", city, rows, angles_m, blocks_m2, 0.9, 20_000.0, seams or {}, overview, traffic)

    along, across = np.zeros((2, 2, 18))
    along[:, 0] = across[:, 9] = 50.0
    record = np.zeros(SEAM_RECORD_SHAPE)
    record[..., 1] = 10.0
    record[0, :, 0] = 6.0, 3.0  # Twice as many class changes at the seam.
    one = make("one", along, Traffic(100, 80, 60), {"2": record})
    other = make("other", across, Traffic(100, 100, 100), {"2": record})
    scores = compute_whole_scores([one, other], [one, other])
    assert scores["city_blocks_per_ha"] == pytest.approx(1.5) and scores["median_city_block_m2"] == 3000.0
    assert scores["vehicles_routed"].value == pytest.approx(0.9)
    assert scores["vehicles_arrived"].value == pytest.approx((0.75 + 1) / 2)
    assert list(scores["street_distance"]) == ["0-1", "2", "all"]
    assert scores["street_distance"]["2"].value == pytest.approx(1)  # A town is not compared with itself.
    assert set(scores["seams"]) == {"2", "all"}
    assert scores["seams"]["2"]["class_changes"].value == pytest.approx(2)


def test_street_distance_ranges_from_equal_to_disjoint():
    along, across = np.zeros((2, 18))
    along[0], across[9] = 5.0, 2.0
    found = compute_street_distances(np.array([along, 3 * along, across * 0]), np.array([along, across]))
    assert found[:2] == pytest.approx(np.array([[0, 1], [0, 1]]), abs=1e-6) and np.isnan(found[2]).all()


def test_map_shows_ratio_to_expected_value():
    picture = draw_map({(0, 0): 10.0, (1, 0): 40.0, (-1, 1): 1.0, (0, -1): float("nan")}, 10.0)
    assert picture.shape == (3 * CELL_PX, 3 * CELL_PX, 3)
    middle, ahead, behind_left, right = (
        picture[row * CELL_PX + 3, col * CELL_PX + 3].astype(int) for row, col in ((1, 1), (0, 1), (2, 0), (1, 2))
    )
    assert (middle == 255).all() and ahead[0] > ahead[2] and behind_left[2] > behind_left[0]
    assert len(set(right.tolist())) == 1 and right[0] < 255  # Grey: no value.
    assert draw_map({(0, 0): 0.3}, 0.0)[3, 3].argmax() == 0  # Red: nothing is expected.
    assert draw_map({(0, 0): -4.0}, -1.0, difference=5.0)[3, 3].argmax() == 2
