"""Tests of the reader of OpenStreetMap: real extracts, small maps with known dimensions, and broken files."""

import gzip
import io
import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import osmium
import pyproj
import pytest
import shapely
import trimesh
from osm_map import HERE, LATITUDE, LONGITUDE, Map, make_street, make_town_street

from models.limits import LimitError
from models.scene import CATEGORIES, CATEGORY_INDEX, KITTI_GROUND_CLASSES, VEHICLES, Grid, Scene
from pipelines.io.geojson import export_geojson
from pipelines.io.mesh_export import export_glb, export_ply
from pipelines.io.mesh_import import import_glb
from pipelines.io.opendrive import export_opendrive
from pipelines.preprocess.sharding import plan_osm
from pipelines.preprocess.sources.drive import Drive
from pipelines.preprocess.sources.maps import list_map_files
from pipelines.preprocess.sources.osm.buildings import cover_footprint, find_direction, repair_polygons
from pipelines.preprocess.sources.osm.extract import GET_EXTRACT, SUFFIXES, Region, read_extract
from pipelines.preprocess.sources.osm.furnish import FURNISHED
from pipelines.preprocess.sources.osm.reader import OsmOptions, read_drive, read_poses
from pipelines.preprocess.sources.osm.tags import find_heights, find_profile, parse_length
from pipelines.schema.attribution import ATTRIBUTIONS, find_attribution
from pipelines.schema.conversion import make_scene_tables, parse_scenes
from pipelines.schema.splits import split_squares


def read(made: Map, folder: Path, **options) -> Drive:
    path = made.write(folder / "map.osm")
    return read_drive(path, OsmOptions(HERE, free_pose_share=0.0, **options))[0]


def find_classes(scene: Scene, y_m: float) -> list[str]:
    """Return the ground classes of the scene at x = 20 m and a distance to the left (m)."""
    row = int((scene.grid.front_m - 20.0) / scene.grid.resolution_m)
    col = int((scene.grid.left_m - y_m) / scene.grid.resolution_m)
    return [name for name, seen in zip(scene.ground_classes, scene.occupied[:, row, col], strict=True) if seen]


def find_pose(drive: Drive, x_m: float, yaw_rad: float) -> int:
    cost = [abs(drive.pose(k).xyz_m[0] - x_m) + 100 * abs(np.cos(drive.pose(k).yaw_rad - yaw_rad) - 1) for k in
            range(len(drive))]  # fmt: skip
    return int(np.argmin(cost))


# ------------------------------------------------------------------------------------------------------- tags


@pytest.mark.parametrize(
    ("text", "metres"),
    [("3.5", 3.5), ("3,5 m", 3.5), ("350 cm", 3.5), ("12'6\"", 3.81), ("10 ft", 3.048), ("wide", None), ("", None)],
)
def test_lengths_have_the_units_of_the_wiki(text, metres):
    assert parse_length(text) == (None if metres is None else pytest.approx(metres))


@pytest.mark.parametrize(
    ("tags", "width", "oneway"),
    [
        ({"highway": "residential", "width": "7.5"}, 7.5, 0),
        ({"highway": "primary", "lanes": "4"}, 14.0, 0),
        ({"highway": "secondary", "oneway": "yes", "lanes": "2"}, 6.5, 1),
        ({"highway": "residential", "oneway": "-1"}, 3.5, -1),
        ({"highway": "motorway"}, 7.5, 1),
        ({"highway": "tertiary", "width": "nonsense"}, 6.0, 0),
    ],
)
def test_road_width_follows_width_lanes_or_class(tags, width, oneway):
    profile = find_profile(tags)
    assert profile is not None
    assert (profile.left_m + profile.right_m, profile.oneway) == (pytest.approx(width), oneway)


def test_lane_parking_lies_inside_a_tagged_width():
    profile = find_profile({"highway": "residential", "width": "8", "parking:right": "lane"})
    outside = find_profile({"highway": "residential", "width": "8", "parking:right": "street_side"})
    assert profile is not None and outside is not None
    assert (profile.left_m, profile.right_m, profile.parking_m) == (4.0, pytest.approx(1.8), (0.0, 2.2))
    assert (outside.left_m, outside.right_m, outside.parking_m) == (4.0, 4.0, (0.0, 2.2))


def test_building_heights_follow_height_then_levels():
    assert find_heights({"building": "yes", "height": "17.5"}) == (0.0, 17.5, True)
    assert find_heights({"building": "yes", "building:levels": "4"}) == (0.0, 12.0, True)
    assert find_heights({"building:part": "yes", "building:levels": "5", "min_height": "6"}) == (6.0, 15.0, True)
    assert find_heights({"building": "garage"}) == (0.0, 2.8, False)


# -------------------------------------------------------------------------------------------------- buildings


def turn(polygon, degrees: float):
    return shapely.transform(polygon, lambda p: p @ np.array(
        [[np.cos(np.radians(degrees)), np.sin(np.radians(degrees))],
         [-np.sin(np.radians(degrees)), np.cos(np.radians(degrees))]]) + [400, -30])  # fmt: skip


ELL = shapely.Polygon([(0, 0), (20, 0), (20, 8), (8, 8), (8, 25), (0, 25)])
YARD = shapely.Polygon([(0, 0), (40, 0), (40, 30), (0, 30)], [[(10, 10), (30, 10), (30, 20), (10, 20)]])


@pytest.mark.parametrize("degrees", [0.0, 17.0, 44.9, 88.0])
@pytest.mark.parametrize(("shape", "boxes"), [(shapely.box(0, 0, 12, 9), 1), (ELL, 2), (YARD, 4)])
def test_rectilinear_footprints_are_covered_exactly(shape, boxes, degrees):
    footprint = turn(shape, degrees)
    cover = cover_footprint(footprint)
    assert len(cover.center_m) == boxes and cover.iou > 0.999
    assert abs(np.sin(2 * (find_direction(footprint) - np.radians(degrees)))) < 1e-6
    assert cover.size_m.prod(axis=1).sum() == pytest.approx(footprint.area, rel=1e-3)


def test_curved_footprint_reports_an_imperfect_cover():
    cover = cover_footprint(shapely.Point(0, 0).buffer(15))
    assert 0.75 < cover.iou < 0.97 and 3 <= len(cover.center_m) <= 12


def test_crossing_outline_is_repaired():
    (bow,), changed = repair_polygons([shapely.Polygon([(0, 0), (10, 10), (10, 0), (0, 10)])])
    assert changed.all() and bow.is_valid and bow.area == pytest.approx(50.0)
    assert cover_footprint(bow).size_m.min() > 0


# ------------------------------------------------------------------------------------------------------- maps


def test_ground_has_the_widths_of_the_tags(tmp_path):
    made = make_street(sidewalk="both", parking__right="street_side")
    made.way([(-200, 20), (200, 20), (200, 60), (-200, 60), (-200, 20)], landuse="grass")
    drive = read(made, tmp_path)
    scene = drive.scene(find_pose(drive, -20.0, 0.0))
    # The pose lies 1.5 m to the right of the line of the street.
    expected = {4.3: "road", 4.7: "sidewalk", 6.3: "sidewalk", -1.3: "road", -1.7: "parking", -3.5: "parking",
                -3.9: "sidewalk", -5.5: "sidewalk", 22.0: "terrain"}  # fmt: skip
    assert {y: find_classes(scene, y) for y in expected} == {y: [name] for y, name in expected.items()}
    assert find_classes(scene, 12.0) == [] and find_classes(scene, -6.0) == []
    assert np.unique(scene.height_m[scene.occupied]) == pytest.approx([-drive.pose(0).xyz_m[2]])
    assert scene.occupied.sum(axis=0).max() == 1


def test_poses_keep_right_or_left(tmp_path):
    for side, sign in (("right", 1), ("left", -1)):
        drive = read(make_street(), tmp_path, drive_on_left=side == "left")
        y = drive.world_from_imu[:, 1, 3]
        forward = drive.world_from_imu[:, 0, 0]
        np.testing.assert_allclose(y, -sign * 1.5 * np.sign(forward), atol=0.02)
    oneway = read(make_street(oneway="yes"), tmp_path)
    np.testing.assert_allclose(oneway.world_from_imu[:, :2, 0], np.tile([1.0, 0.0], (len(oneway), 1)), atol=0.02)
    np.testing.assert_allclose(oneway.world_from_imu[:, 1, 3], 0.0, atol=0.02)


def test_spacing_is_the_distance_of_poses(tmp_path):
    drive = read(make_street(oneway="yes"), tmp_path, spacing_m=16.0)
    np.testing.assert_allclose(np.diff(np.sort(drive.world_from_imu[:, 0, 3])), 16.0, atol=0.02)
    assert len(drive) == 25


def test_building_with_parts_is_replaced_by_its_parts(tmp_path):
    made = make_street()
    made.way([(0, 20), (20, 20), (20, 30), (0, 30), (0, 20)], building="yes", building__levels="2")
    made.way([(0, 20), (10, 20), (10, 30), (0, 30), (0, 20)], building__part="yes", building__levels="3")
    made.way([(10, 20), (20, 20), (20, 30), (10, 30), (10, 20)], building__part="yes", building__levels="7")
    drive = read(made, tmp_path)
    assert sorted(drive.size_m[:, 2].tolist()) == [9.0, 21.0] and drive.size_m[0, :2].max() < 10.1


def test_buildings_and_water_hide_the_ground_below(tmp_path):
    made = make_street()
    made.way([(-100, 5), (100, 5), (100, 60), (-100, 60), (-100, 5)], landuse="meadow")
    made.way([(-100, 10), (100, 10), (100, 20), (-100, 20), (-100, 10)], building="yes")
    made.way([(-100, 30), (100, 30), (100, 40), (-100, 40), (-100, 30)], natural="water")
    drive = read(made, tmp_path)
    scene = drive.scene(find_pose(drive, -20.0, 0.0))
    assert [find_classes(scene, y) for y in (9.0, 16.0, 25.0, 31.75)] == [["terrain"], [], ["terrain"], []]


def test_furniture_stands_where_the_map_says(tmp_path):
    made = make_street()
    made.node(10.0, 8.0, highway="street_lamp")
    made.node(30.0, -8.0, natural="tree", diameter_crown="6", height="9")
    made.node(0.0, 0.0, highway="traffic_signals", traffic_signals__direction="forward")
    made.way([(40, 9), (65, 9)], barrier="hedge", height="2")
    drive = read(made, tmp_path)
    boxes = SimpleNamespace(**{
        label: [(CATEGORIES[c], *np.round(p, 2), *np.round(s, 2)) for c, p, s, name in
                zip(drive.category, drive.center_m, drive.size_m, drive.label, strict=True) if name == label]
        for label in ("street_lamp", "tree", "traffic_signals", "hedge")
    })  # fmt: skip
    pole, lamp = boxes.street_lamp
    assert (pole[0], lamp[0]) == ("pole", "traffic_control") and pole[1:3] == (10.0, 8.0)
    assert lamp[2] == pytest.approx(7.65)  # The lamp hangs towards the street, and overlaps the top of the pole.
    assert lamp[3] - lamp[6] / 2 < pole[3] + pole[6] / 2
    ((kind, x, y, z, length, width, height),) = boxes.tree
    assert (kind, x, y, length, width) == ("vegetation_ellipsoid", 30.0, -8.0, 6.0, 6.0)
    assert z + height / 2 == pytest.approx(9.0, abs=0.02)
    pole, signal = boxes.traffic_signals  # Traffic along the way keeps right: the pole stands at y = -3 - 0.6.
    assert pole[1:3] == signal[1:3] == (0.0, -3.6)
    assert len(boxes.hedge) == 3 and sum(box[4] for box in boxes.hedge) == pytest.approx(25.0, abs=0.05)
    assert {(box[0], box[2], box[6]) for box in boxes.hedge} == {("vegetation_cuboid", 9.0, 2.0)}


def test_furnished_objects_are_marked_and_stand_free(tmp_path):
    made = make_town_street()
    plain, drive = read(made, tmp_path), read(made, tmp_path, furnish=True)
    is_added = np.array([label.startswith(FURNISHED) for label in drive.label])
    assert not any(label.startswith(FURNISHED) for label in plain.label)
    assert (~is_added).sum() == len(plain.label) and is_added.sum() > 100
    xy, category = drive.center_m[is_added, :2], drive.category[is_added]
    houses = shapely.union_all([shapely.box(20 * k, y, 20 * k + 14, y + 12) for k in range(-10, 10) for y in
                                (12, -24)])  # fmt: skip
    assert not shapely.contains_xy(shapely.buffer(houses, -0.05), xy).any()
    cars = np.isin(category, VEHICLES)
    assert cars.sum() > 10 and (np.abs(xy[~cars, 1]) > 3.45).all()
    heading = drive.heading_rad[is_added][cars]
    agrees = np.cos(heading) * -np.sign(xy[cars, 1]) > 0.9  # Cars on the right of the way point along it.
    assert agrees.mean() > 0.8
    again = read(made, tmp_path, furnish=True)
    np.testing.assert_array_equal(drive.center_m, again.center_m)
    other = read(made, tmp_path, furnish=True, seed=1)
    assert drive.center_m.shape != other.center_m.shape or not np.allclose(drive.center_m, other.center_m)


def test_furnishing_adds_no_plants_near_mapped_plants(tmp_path):
    made = make_town_street()
    for x in range(-200, 201, 20):
        made.node(float(x), 5.0, natural="tree")
    drive = read(made, tmp_path, furnish=True)
    plants = [label for label, kind in zip(drive.label, drive.category, strict=True) if
              CATEGORIES[kind].startswith("vegetation")]  # fmt: skip
    assert set(plants) == {"tree"}


def test_country_roads_are_not_furnished(tmp_path):
    drive = read(make_street(), tmp_path, furnish=True)
    assert len(drive.category) == 0


def test_pbf_equals_xml(tmp_path):
    made = make_town_street()
    path = made.write(tmp_path / "map.osm")
    with osmium.SimpleWriter(str(tmp_path / "map.osm.pbf")) as writer:
        for item in osmium.FileProcessor(path):
            writer.add(item)
    options = OsmOptions(HERE, furnish=True)
    (first, _), (second, _) = read_drive(path, options), read_drive(str(tmp_path / "map.osm.pbf"), options)
    np.testing.assert_allclose(first.center_m, second.center_m, atol=0.02)  # PBF stores 1e-7 degrees.
    np.testing.assert_array_equal(first.label, second.label)


# ------------------------------------------------------------------------------------------------- real extracts


def list_elements(path: Path, kind: str, key: str) -> list[dict[str, str]]:
    """Return the tags of elements that have a key, read with the standard library."""
    root = ElementTree.fromstring(gzip.decompress(path.read_bytes()))
    tags = [{tag.get("k"): tag.get("v") for tag in element.iter("tag")} for element in root.iter(kind)]
    return [found for found in tags if key in found]


@pytest.mark.parametrize(
    "name", ["neukolln", *(pytest.param(name, marks=pytest.mark.slow) for name in ("monaco", "north-bayreuth"))]
)
def test_real_extract_keeps_its_content(real_data, name):
    path = real_data / "osm" / f"{name}.osm.gz"
    drive, report = read_drive(str(path), OsmOptions())
    trees = [tags for tags in list_elements(path, "node", "natural") if tags["natural"] == "tree"]
    assert report["objects"].get("tree", 0) >= 0.95 * len(trees) > 0
    buildings = [tags for kind in ("way", "relation") for tags in list_elements(path, kind, "building")]
    assert report["buildings"] >= 0.9 * len(buildings) > 100
    assert report["building_iou_mean"] > 0.9
    assert len(drive) > 250 and len(drive.category) == len(drive.label)
    scene = drive.at(np.arange(len(drive) // 2, len(drive) // 2 + 1)).scene(0)
    assert scene.occupied[KITTI_GROUND_CLASSES.index("road")].any()


def test_real_distances_agree_with_the_ellipsoid(real_data):
    path = str(real_data / "osm" / "monaco.osm.gz")
    extract = read_extract(path)
    nodes = {item.id: (item.location.lon, item.location.lat) for item in osmium.FileProcessor(path) if item.is_node()}
    geod = pyproj.Geod(ellps="WGS84")
    for way in extract.lines[:200]:
        if "highway" in way.tags:
            longitude, latitude = np.array([nodes[ref] for ref in way.nodes]).T
            assert way.geometry.length == pytest.approx(geod.line_length(longitude, latitude), rel=1e-5)


def test_real_footprints_lie_below_their_boxes(real_data):
    path = str(real_data / "osm" / "neukolln.osm.gz")
    drive, _ = read_drive(path, OsmOptions())
    built = drive.category == CATEGORY_INDEX["construction_big"]
    extract = read_extract(path)
    outlines = [area.geometry for area in extract.areas if area.tags.get("building", "no") != "no"
                and shapely.is_valid(area.geometry)]  # fmt: skip
    footprints = shapely.union_all(outlines)
    inside = shapely.contains_xy(shapely.buffer(footprints, 1.0), drive.center_m[built, :2])
    assert inside.mean() > 0.97


# ------------------------------------------------------------------------------------------------------ notices


def test_each_format_states_the_licence(tmp_path):
    drive = read(make_town_street(), tmp_path, furnish=True)
    scene = drive.scene(find_pose(drive, -20.0, 0.0))
    notice = ATTRIBUTIONS["osm"]
    glb = export_glb(scene)
    tree = json.loads(glb[20 : 20 + int.from_bytes(glb[12:16], "little")])
    assert tree["asset"]["copyright"] == notice
    assert import_glb(glb).attribution == notice
    assert json.loads(export_geojson(scene))["attribution"] == notice
    header = ElementTree.fromstring(export_opendrive(scene)).find("header")
    assert header is not None and header.find("userData[@code='attribution']").get("value") == notice
    ply = export_ply(scene)
    assert b"\ncomment ? OpenStreetMap contributors, ODbL 1.0" in ply[:300]
    mesh = trimesh.load_mesh(io.BytesIO(ply), file_type="ply")
    assert len(mesh.vertices) > 1000


def test_notices_survive_the_tables(tmp_path):
    drive = read(make_street(), tmp_path)
    (back,) = parse_scenes(**make_scene_tables([drive.scene(0)]), source="osm", split="train")
    assert back.attribution == ATTRIBUTIONS["osm"] and find_attribution("town") is None


# ------------------------------------------------------------------------------------------------------ regions


def test_region_keeps_poses_inside_and_content_around(tmp_path):
    made = make_street()
    made.way([(100, 20), (110, 20), (110, 30), (100, 30), (100, 20)], building="yes")
    path = made.write(tmp_path / "map.osm")
    small = OsmOptions(Region(origin_deg=(LATITUDE, LONGITUDE), radius_m=50.0), free_pose_share=0.0)
    drive, _ = read_drive(path, small)
    assert np.abs(drive.world_from_imu[:, :2, 3]).max() <= 50.0 and len(drive.category) == 1
    assert read_poses(path, small)[1].xy_m.shape == (len(drive), 2)


def test_squares_split_crops_without_overlap():
    rng = np.random.default_rng(0)
    xy, yaw = rng.uniform(0, 3000, (2000, 2)), rng.uniform(-np.pi, np.pi, 2000)
    labels = split_squares(xy, yaw, 0.1)
    assert 0.05 < (labels == "test").mean() < 0.15 and (labels == "train").mean() > 0.5
    grid = Grid()
    corners = np.array([[grid.back_m, grid.left_m], [grid.front_m, grid.left_m], [grid.front_m, grid.right_m],
                        [grid.back_m, grid.right_m]])  # fmt: skip
    turned = [corners @ np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]]) + p for a, p in zip(yaw, xy,
              strict=True)]  # fmt: skip
    crops = shapely.polygons(turned)
    test = shapely.union_all(crops[labels == "test"])
    assert shapely.area(shapely.intersection(crops[labels == "train"], test)).max() < 1e-6
    assert (split_squares(xy[:1], yaw[:1], 0.5) == "train").all()


# ---------------------------------------------------------------------------------------------------- bad input

ENTITIES = '<!DOCTYPE osm [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]><osm version="0.6"><node id="1" '


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<osm version='0.6'><node id=", "XML parsing error"),
        (ENTITIES + 'lat="1" lon="1"><tag k="highway" v="&b;"/></node></osm>', "XML entities are not supported"),
        ("no map at all", "XML parsing error"),
        ('<osm version="0.6"></osm>', "has no way with the key highway"),
    ],
)
def test_broken_extract_names_file_and_fix(tmp_path, content, message):
    path = tmp_path / "broken.osm"
    path.write_text(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_extract(str(path))
    assert "broken.osm" in str(caught.value) and "pass an extract of OpenStreetMap" in str(caught.value)


def test_broken_pbf_and_gzip_are_refused(tmp_path):
    for name in ("broken.osm.pbf", "broken.osm.gz"):
        (tmp_path / name).write_bytes(b"\x00\x00\x00\x0d" + bytes(range(200)))
        with pytest.raises(ValueError, match=name):
            read_extract(str(tmp_path / name))


@pytest.mark.parametrize(
    ("region", "message"),
    [
        (Region(bbox_deg=(179.9, 10.0, -179.9, 10.1)), "antimeridian"),
        (Region(bbox_deg=(13.0, 52.0, 13.0, 52.1)), "expected WEST SOUTH EAST NORTH"),
        (Region(origin_deg=(89.0, 13.0)), "exceeds latitudes"),
        (Region(bbox_deg=(10.0, 50.0, 14.0, 53.0)), "wider than 100 km"),
        (
            Region(bbox_deg=(14.0, 52.0, 14.1, 52.1)),
            "no highway lies in the region; the highways of the file span",
        ),
    ],
)
def test_unsuitable_region_is_refused(tmp_path, region, message):
    path = make_street().write(tmp_path / "map.osm")
    with pytest.raises(ValueError, match=message):
        read_extract(path, region)


def test_extract_across_antimeridian_is_refused(tmp_path):
    text = make_street().text()
    moved = text.replace('lon="12.99', 'lon="-179.99').replace('lon="13.00', 'lon="179.99')
    path = tmp_path / "map.osm"
    path.write_text(moved)
    with pytest.raises(ValueError, match="antimeridian"):
        read_extract(str(path))


def test_unsorted_extract_is_refused_with_a_remedy(tmp_path):
    text = make_street().text().replace("</osm>", '<way id="9" version="1"/></osm>')
    (tmp_path / "map.osm").write_text(text)
    with pytest.raises(ValueError, match="sort the file with 'osmium sort'"):
        read_extract(str(tmp_path / "map.osm"))


def test_limits_name_the_remedy(tmp_path, monkeypatch):
    path = make_town_street().write(tmp_path / "map.osm")
    monkeypatch.setenv("PRITTI_MAX_MAP_FEATURES", "5")
    with pytest.raises(LimitError, match="cut out a part with --bbox"):
        read_extract(path)


def test_ways_without_nodes_are_counted(tmp_path):
    text = make_street().text().replace("</osm>", '<way id="9999" version="1"><nd ref="77"/><nd ref="78"/>'
                                                  '<tag k="highway" v="primary"/></way></osm>')  # fmt: skip
    (tmp_path / "map.osm").write_text(text)
    _, report = read_drive(str(tmp_path / "map.osm"), OsmOptions(HERE))
    assert report["skipped"] == {"way with fewer than two known nodes": 1} and report["roads"] == 1


def test_inputs_are_files_or_directories(tmp_path):
    made = make_street()
    for name in ("a.osm", "b.osm"):
        made.write(tmp_path / name)
    assert [Path(p).name for p in list_map_files((str(tmp_path),), SUFFIXES, GET_EXTRACT)] == ["a.osm", "b.osm"]
    with pytest.raises(ValueError, match="no such file"):
        list_map_files((str(tmp_path / "c.osm"),), SUFFIXES, GET_EXTRACT)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="contains no file"):
        list_map_files((str(tmp_path / "empty"),), SUFFIXES, GET_EXTRACT)
    with pytest.raises(ValueError, match="would both be named a"):
        list_map_files((str(tmp_path / "a.osm"), str(tmp_path / "a.osm")), SUFFIXES, GET_EXTRACT)


def test_test_squares_must_leave_training_scenes(tmp_path):
    path = make_town_street().write(tmp_path / "map.osm")
    with pytest.raises(ValueError, match=r"--test-share 0\.5 leaves no training scene"):
        plan_osm((path,), OsmOptions(), 0.5)
    tasks = plan_osm((path,), OsmOptions(), 0.0)
    assert {task.split for task in tasks} == {"train"} and tasks[0].parts[0].sequence == "map"


def test_street_without_poses_is_refused(tmp_path):
    made = Map()
    made.way([(-50.0, 0.0), (50.0, 0.0)], highway="footway")
    path = made.write(tmp_path / "map.osm")
    with pytest.raises(ValueError, match="no street lies in the region"):
        read_poses(path, OsmOptions(HERE))
