"""Tests of benchmarks/town_realism.py and benchmarks/osm_realism.py, with small inputs that are made by hand."""

import sys

import numpy as np
import pytest
import shapely
from helpers import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))
import osm_realism
import town_realism

from models.scene import CATEGORY_INDEX, Grid, Scene
from pipelines.preprocess.sources.town.generator import generate_town


def make_street_scene(setback_m: float) -> Scene:
    """Return a straight road of width 8 m along x, and two houses of 10 x 6 x 5 m at a distance from its edge."""
    grid = Grid(resolution_m=0.5, rows=128, cols=128)
    occupied = np.zeros((1, 128, 128), bool)
    occupied[0, :, 56:72] = True  # -4 m to 4 m
    center = np.array([[20.0, 4 + setback_m, 2.5], [40.0, 4 + setback_m, 2.5]], np.float32)
    return Scene(
        scene_id=f"street-{setback_m}",
        source="test",
        sequence="0",
        frame=0,
        split="test",
        category=np.full(2, CATEGORY_INDEX["construction_big"], np.int8),
        center_m=center,
        rotation=np.tile(np.eye(3, dtype=np.float32), (2, 1, 1)),
        size_m=np.tile(np.array([10, 6, 5], np.float32), (2, 1)),
        ground_classes=("road",),
        height_m=np.zeros((1, 128, 128), np.float32),
        occupied=occupied,
        grid=grid,
    )


def test_realism_measures_known_street():
    values = dict(zip(town_realism.NAMES, town_realism.measure_scenes([make_street_scene(7.0)])[0], strict=True))
    assert values["construction_big.road_edge_m"] == pytest.approx(7.0, abs=0.6)
    assert values["construction_big.square_to_edge"] == pytest.approx(1.0, abs=1e-3)
    assert values["construction_big.neighbour_log_m"] == pytest.approx(np.log10(20), abs=1e-3)
    assert values["road_width_m"] == pytest.approx(8.0, abs=0.01)
    assert values["building_height_m"] == 5.0 and values["building_width_m"] == 6.0
    assert values["unannotated_share"] == pytest.approx(1 - 16 / 128)
    assert np.isnan(values["vehicle_small.on_road"])


def test_realism_distance_is_shift_in_units_of_spread():
    reference = np.array([[0.0, 1.0], [2.0, 3.0], [4.0, np.nan]])
    spread = np.array([2.0, 0.5])
    assert town_realism.compute_distances(reference + 3, reference, spread).tolist() == [1.5, 6.0]
    assert town_realism.compute_distances(reference, reference, spread).tolist() == [0.0, 0.0]
    empty = np.full((2, 2), np.nan)
    assert np.isnan(town_realism.compute_distances(empty, reference, spread)).all()


def test_realism_halves_are_far_apart():
    along = np.stack([np.arange(0.0, 300.0, 2.0), np.zeros(150)], axis=1)
    first, second = town_realism.split_drive(along)
    assert np.linalg.norm(along[first][:, None] - along[second][None], axis=2).min() >= 64
    assert abs(len(first) - len(second)) <= 2 and len(first) > 55 and first[-1] < second[0]
    with pytest.raises(ValueError, match="no two of the 5 scenes are 64 m apart"):
        town_realism.split_drive(along[:5])


def test_realism_control_is_farther_than_town():
    drive = generate_town(1, 2)
    scenes = [drive.scene(k) for k in range(0, 200, 20)]
    values = town_realism.measure_scenes(scenes)
    damaged = town_realism.measure_scenes(town_realism.damage_scenes(scenes, "permuted"))
    spread = np.nanstd(values, axis=0)
    assert np.nanmean(town_realism.compute_distances(damaged, values, spread)) > 0.5


def test_realism_summary_counts_nearer_quantities():
    text = town_realism.compare_pair(np.array([2.0, 1.0, np.nan, 3.0]), np.array([1.0, 2.0, 5.0, 0.0]))
    assert text == "nearer in 2 of 3 quantities; mean distance 2.000 -> 1.000, 50.0 % smaller"


def test_realism_reads_published_scenes(real_data):
    (path,) = (real_data / "glb").glob("low_12.glb")
    values = town_realism.measure_scenes([town_realism.import_glb(str(path))])
    assert np.isfinite(values).mean() > 0.5


# ---------------------------------------------------------------------------------------------------- OpenStreetMap

METRES_PER_DEGREE = np.radians(osm_realism.EARTH_RADIUS_M)


def write_osm(path, ways):
    """Write ways, each as (tags, points in metres); equal points share a node."""
    refs, lines, body = {}, [], []
    for number, (tags, points) in enumerate(ways, 1):
        for point in points:
            refs.setdefault(point, len(refs) + 1)
        inner = "".join(f'<nd ref="{refs[point]}"/>' for point in points)
        inner += "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
        body.append(f'<way id="{number}" version="1">{inner}</way>')
    for (x, y), ref in refs.items():
        lines.append(
            f'<node id="{ref}" version="1" lat="{y / METRES_PER_DEGREE:.9f}" lon="{x / METRES_PER_DEGREE:.9f}"/>'
        )
    path.write_text('<?xml version="1.0"?><osm version="0.6">' + "".join(lines + body) + "</osm>")
    return str(path)


def outline(x, y, length, width):
    return [(x, y), (x + length, y), (x + length, y + width), (x, y + width), (x, y)]


@pytest.fixture
def small_map(tmp_path):
    """A T-junction of three streets, two houses that touch, and a house that stands alone."""
    road = {"highway": "residential"}
    return write_osm(
        tmp_path / "small.osm",
        [
            (road, [(-60.0, 0.0), (0.0, 0.0)]),
            (road, [(0.0, 0.0), (80.0, 0.0)]),
            (road, [(0.0, 0.0), (0.0, -50.0), (10.0, -90.0)]),
            ({"highway": "footway"}, [(-60.0, 5.0), (80.0, 5.0)]),
            ({"building": "yes"}, outline(10.0, 8.0, 12.0, 6.0)),
            ({"building": "house"}, outline(22.0, 8.0, 12.0, 6.0)),
            ({"building": "yes"}, outline(50.0, 12.0, 8.0, 8.0)),
            ({"building": "shed"}, outline(70.0, 12.0, 2.0, 2.0)),
        ],
    )


def test_osm_map_has_known_statistics(small_map):
    plan = osm_realism.read_osm(small_map)
    assert len(plan.buildings) == 3 and len(plan.streets) == 3  # the shed is too small
    values = osm_realism.measure_plan(plan)
    assert np.sort(values["distance_to_street_m"]) == pytest.approx([8.0, 8.0, 12.0], abs=0.01)
    assert values["square_to_street"] == pytest.approx([1.0] * 3, abs=1e-3)
    assert np.sort(values["touches_neighbour"]).tolist() == [0.0, 1.0, 1.0]
    assert np.sort(10 ** values["log_area_m2"]) == pytest.approx([64.0, 72.0, 72.0], rel=3e-3)
    assert np.sort(values["elongation"]) == pytest.approx([1.0, 2.0, 2.0], rel=3e-3)
    assert values["junction_degree"].tolist() == [3.0]
    assert values["junction_angle_deg"] == pytest.approx([90.0], abs=0.1)
    assert len(values["street_log_m"]) == 0  # every street has one free end


def test_osm_turned_house_is_not_square(tmp_path):
    turned = shapely.affinity.rotate(shapely.box(20, 20, 40, 30), 45)
    points = [tuple(point) for point in np.round(shapely.get_coordinates(turned), 3).tolist()]
    path = write_osm(
        tmp_path / "turned.osm",
        [({"highway": "tertiary"}, [(0.0, 0.0), (90.0, 0.0)]), ({"building": "yes"}, points)],
    )
    assert osm_realism.measure_plan(osm_realism.read_osm(path))["square_to_street"] == pytest.approx([-1.0], abs=1e-3)


def test_osm_file_without_streets_is_refused(tmp_path):
    path = write_osm(tmp_path / "bare.osm", [({"building": "yes"}, outline(0.0, 0.0, 9.0, 9.0))])
    with pytest.raises(ValueError, match=r"bare.osm: 1 buildings and 0 streets; pass an extract with both"):
        osm_realism.read_osm(path)
    with pytest.raises(ValueError, match="pass an extract of OpenStreetMap"):
        osm_realism.read_osm(str(tmp_path / "absent.osm"))


def test_osm_plan_of_town_has_junctions():
    values = osm_realism.measure_plan(osm_realism.plan_drive(generate_town(1, 2)))
    assert len(values["log_area_m2"]) > 100 and len(values["junction_degree"]) > 8
    assert set(np.unique(values["junction_degree"])) <= {3.0, 4.0, 5.0}
    assert np.median(values["square_to_street"]) > 0.5
    assert 20 < 10 ** np.median(values["street_log_m"]) < 120


def test_osm_reads_real_extract(real_data):
    plan = osm_realism.read_osm(str(real_data / "osm" / "neukolln.osm.gz"))
    values = osm_realism.measure_plan(plan)
    assert len(plan.buildings) > 80 and 0.5 < values["touches_neighbour"].mean() < 1
