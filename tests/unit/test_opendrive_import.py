"""Tests of the reader of OpenDRIVE: curves against formulas, a real file, our export read again, and broken files."""

import gzip
import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from scipy.special import fresnel

from models.scene import CATEGORIES, CATEGORY_INDEX, KITTI_GROUND_CLASSES, Grid, Scene
from pipelines.io.opendrive import export_opendrive
from pipelines.preprocess.sharding import plan_opendrive
from pipelines.preprocess.sources.drive import Drive, Pose
from pipelines.preprocess.sources.maps import list_map_files
from pipelines.preprocess.sources.opendrive.file import GET_FILE, SUFFIXES, Map, Road, read_map
from pipelines.preprocess.sources.opendrive.lanes import LAYERS, list_strips
from pipelines.preprocess.sources.opendrive.reader import OpenDriveOptions, read_drive, read_poses
from pipelines.preprocess.sources.opendrive.reference_line import NO_CUBICS, Cubics, Geometry, ReferenceLine
from pipelines.preprocess.sources.town.version2.town import make_large_crops

LANES = """
<lanes>{offset}<laneSection s="0">
<left><lane id="2" type="sidewalk"><width sOffset="0" a="2" b="0" c="0" d="0"/>
<height sOffset="0" inner="0.12" outer="0.12"/></lane>
<lane id="1" type="driving"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane></left>
<center><lane id="0" type="none"/></center>
<right><lane id="-1" type="driving"><width sOffset="0" a="3" b="0.01" c="0" d="0"/></lane>
<lane id="-2" type="none"><width sOffset="0" a="2" b="0" c="0" d="0"/><material surface="grass"/></lane></right>
</laneSection></lanes>"""
LINE = '<geometry s="0" x="100" y="50" hdg="0" length="80"><line/></geometry>'


def make_road(plan: str = LINE, more: str = "", offset: str = "", length: float = 80.0, rule: str = "RHT") -> str:
    lanes = LANES.format(offset=offset)
    return f'<road id="7" length="{length}" junction="-1" rule="{rule}"><planView>{plan}</planView>{lanes}{more}</road>'


def write(folder: Path, *roads: str, name: str = "map.xodr") -> str:
    path = folder / name
    path.write_text(f'<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="6"/>{"".join(roads)}</OpenDRIVE>')
    return str(path)


def read(path: str, spacing_m: float = 10.0) -> Drive:
    return read_drive(path, OpenDriveOptions(spacing_m))[0]


def rasterise(drive: Drive, x_m: float, y_m: float, grid: Grid | None = None) -> tuple[np.ndarray, np.ndarray]:
    pose = Pose(np.array([x_m, y_m, 0.0]), 0.0)
    return drive.ground.rasterise(pose, grid or Grid(), len(KITTI_GROUND_CLASSES))


# ------------------------------------------------------------------------------------------------------ curves


def test_arc_is_a_circle():
    piece = Geometry("arc", 0.0, 3.0, 4.0, 0.5, 30.0, (0.05,))
    points, direction = piece.evaluate(np.linspace(0, 30, 7))
    center = np.array([3.0 - 20 * np.sin(0.5), 4.0 + 20 * np.cos(0.5)])
    np.testing.assert_allclose(np.linalg.norm(points - center, axis=1), 20.0, atol=1e-9)
    assert direction[-1] == pytest.approx(0.5 + 30 * 0.05)


def test_spiral_is_a_clothoid():
    length, end = 60.0, 0.04
    piece = Geometry("spiral", 0.0, 0.0, 0.0, 0.0, length, (0.0, end))
    distance = np.array([0.0, 7.3, 21.0, 60.0])
    points, direction = piece.evaluate(distance)
    scale = np.sqrt(np.pi * length / end)
    s, c = fresnel(distance / scale)
    np.testing.assert_allclose(points, scale * np.stack([c, s], axis=1), atol=1e-9)
    np.testing.assert_allclose(direction, distance**2 * end / length / 2)


def test_spiral_with_equal_curvatures_is_an_arc():
    distance = np.linspace(0, 40, 9)
    spiral = Geometry("spiral", 0.0, 1.0, 2.0, 0.3, 40.0, (-0.03, -0.03)).evaluate(distance)
    arc = Geometry("arc", 0.0, 1.0, 2.0, 0.3, 40.0, (-0.03,)).evaluate(distance)
    np.testing.assert_allclose(spiral[0], arc[0], atol=1e-9)
    np.testing.assert_allclose(spiral[1], arc[1], atol=1e-12)


def test_poly3_has_the_length_of_its_curve():
    piece = Geometry("poly3", 0.0, 0.0, 0.0, 0.0, 50.0, (0.0, 0.0, 0.02, -0.0002))
    points, _ = piece.evaluate(np.linspace(0, 50, 2001))
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).sum() == pytest.approx(50.0, abs=0.01)
    u, v = points.T
    np.testing.assert_allclose(v, 0.02 * u**2 - 0.0002 * u**3, atol=1e-9)


def test_param_poly3_uses_both_ranges():
    terms = (0.0, 30.0, 0.0, 0.0, 0.0, 0.0, 6.0, 0.0)
    normalized = Geometry("paramPoly3", 0.0, 0.0, 0.0, 0.0, 31.0, (*terms, 1.0)).evaluate(np.array([15.5, 31.0]))[0]
    np.testing.assert_allclose(normalized, [[15.0, 1.5], [30.0, 6.0]])
    by_length = Geometry("paramPoly3", 0.0, 0.0, 0.0, 0.0, 31.0, (0, 1, 0, 0, 0, 0, 0.01, 0, 0.0))
    np.testing.assert_allclose(by_length.evaluate(np.array([10.0]))[0], [[10.0, 1.0]])


def test_superelevation_raises_the_left_side():
    tilt = Cubics(np.zeros(1), np.array([[0.1, 0.0, 0.0, 0.0]]))
    line = ReferenceLine(50.0, (Geometry("line", 0.0, 0.0, 0.0, 0.0, 50.0),), NO_CUBICS, tilt)
    left, right = line.place(np.array([10.0, 10.0]), np.array([4.0, -4.0]))
    np.testing.assert_allclose(left, [10.0, 4 * np.cos(0.1), 4 * np.sin(0.1)])
    np.testing.assert_allclose(right, [10.0, -4 * np.cos(0.1), -4 * np.sin(0.1)])


# ------------------------------------------------------------------------------------------------------- lanes


def test_lanes_have_widths_classes_and_heights(tmp_path):
    elevation = '<elevationProfile><elevation s="0" a="5" b="0.02" c="0" d="0"/></elevationProfile>'
    drive = read(write(tmp_path, make_road(more=elevation)))
    height, occupied = rasterise(drive, 100.0, 50.0)
    row = int((64.0 - 40.0) / 0.25)  # x = 40 m, where the right lane is 3.4 m wide.
    classes = {}
    for y in (4.8, 3.2, 2.8, 0.0, -3.3, -3.6, -5.3, -5.6):
        seen = occupied[:, row, int((32.0 - y) / 0.25)]
        classes[y] = [n for n, s in zip(KITTI_GROUND_CLASSES, seen, strict=True) if s]
    road, walk, grass = ["road"], ["sidewalk"], ["terrain"]
    assert classes == {4.8: walk, 3.2: walk, 2.8: road, 0.0: road, -3.3: road, -3.6: grass, -5.3: grass, -5.6: []}
    assert height[0, row, 128] == pytest.approx(5 + 0.02 * 40, abs=0.01)
    assert height[1, row, int((32.0 - 4.0) / 0.25)] == pytest.approx(5.8 + 0.12, abs=0.01)


def test_lane_offset_moves_all_lanes(tmp_path):
    offset = '<laneOffset s="0" a="1.5" b="0" c="0" d="0"/>'
    drive = read(write(tmp_path, make_road(offset=offset)))
    occupied = rasterise(drive, 100.0, 50.0)[1][0, 128]
    y = 32.0 - (np.flatnonzero(occupied) + 0.5) * 0.25
    assert y.max() == pytest.approx(4.5, abs=0.13)


@pytest.mark.parametrize("rule", ["RHT", "LHT"])
def test_poses_follow_the_rule_of_traffic(tmp_path, rule):
    drive = read(write(tmp_path, make_road(rule=rule)))
    side = np.sign(drive.world_from_imu[:, 1, 3] - 50.0)
    forward = drive.world_from_imu[:, 0, 0]
    np.testing.assert_allclose(forward, -side if rule == "RHT" else side, atol=1e-9)
    assert len(drive) == 16


OBJECTS = """<objects>
<object id="1" type="tree" name="tree" s="10" t="-6" zOffset="0" radius="0.2" height="10" hdg="0"/>
<object id="2" type="building" name="building" s="30" t="15" zOffset="0" hdg="0.5" height="8"><outline>
<cornerLocal u="-5" v="-4" z="0" height="8"/><cornerLocal u="5" v="-4" z="0" height="8"/>
<cornerLocal u="5" v="4" z="0" height="8"/><cornerLocal u="-5" v="4" z="0" height="8"/></outline></object>
<object id="3" type="barrier" name="fence" s="10" t="8" zOffset="0"><repeat s="10" length="25" distance="0"
 tStart="8" tEnd="8" heightStart="1.5" heightEnd="1.5" widthStart="0.1" widthEnd="0.1" zOffsetStart="0"/></object>
<object id="4" type="pole" name="streetLamp" s="20" t="5.5" zOffset="0" height="6" radius="0.1"/>
<object id="5" type="pole" name="pole" s="0" t="-6" zOffset="0" height="1"><repeat s="40" length="20" distance="10"
 tStart="-6" tEnd="-8" heightStart="1" heightEnd="1"/></object>
<object id="6" type="obstacle" name="bench" s="50" t="6" zOffset="0" length="2" width="0.5" height="0.8"/>
<object id="7" type="spaceship" name="?" s="50" t="6" zOffset="0"/>
<object id="8" type="tree" name="broken" s="nowhere" t="6"/>
</objects><signals>
<signal id="9" s="60" t="-5" zOffset="2.5" dynamic="no" type="274" width="0.6" height="0.6"/>
<signal id="10" s="60" t="-5" zOffset="0.0" dynamic="no" type="293"/></signals>"""


def test_objects_become_primitives(tmp_path):
    drive, report = read_drive(write(tmp_path, make_road(more=OBJECTS)), OpenDriveOptions())
    found = {}
    for label, kind, center, size in zip(drive.label, drive.category, drive.center_m, drive.size_m, strict=True):
        found.setdefault((label, CATEGORIES[kind]), []).append((center, size))
    ((center, size),) = found["tree", "vegetation_ellipsoid"]
    assert center[:2].tolist() == [110.0, 44.0] and center[2] + size[2] / 2 == pytest.approx(10.0)
    ((center, size),) = found["building", "construction_big"]
    np.testing.assert_allclose(center, [130.0, 65.0, 4.0], atol=1e-6)
    assert sorted(size.tolist()) == pytest.approx([8.0, 8.0, 10.0])
    pieces = found["fence", "construction_small"]
    assert len(pieces) == 3 and sum(size[0] for _, size in pieces) == pytest.approx(25.0)
    assert len(found["streetLamp", "pole"]) == len(found["streetLamp", "traffic_control"]) == 1
    np.testing.assert_allclose([c[:2] for c, _ in found["pole", "pole"]], [[140, 44], [150, 43], [160, 42]])
    assert found["bench", "object"][0][1].tolist() == [2.0, 0.5, 0.8]
    assert len(found["traffic_sign", "traffic_control"]) == len(found["traffic_sign", "pole"]) == 1
    assert report["skipped"] == {
        "object of type spaceship": 1,
        "object with s='nowhere', expected a finite number of at most 1e+08": 1,
    }
    _, occupied = rasterise(drive, 100.0, 50.0)
    assert not occupied[:, int((64 - 30) / 0.25), int((32 - 15) / 0.25)].any()


# ------------------------------------------------------------------------------------------------- a real city


def test_real_file_keeps_its_content(real_data):
    path = real_data / "opendrive" / "ingolstadt-city-hall.xodr.gz"
    drive, report = read_drive(str(path), OpenDriveOptions())
    root = ElementTree.fromstring(gzip.decompress(path.read_bytes()))
    kinds = [element.get("type") for element in root.iter("object")]
    assert report["roads"] == 71 and report["objects"]["tree"] == kinds.count("tree") == 117
    assert report["buildings"] == kinds.count("building") and report["building_iou_mean"] > 0.9
    assert (drive.category == CATEGORY_INDEX["pole"]).sum() >= kinds.count("pole")
    assert len(drive) > 200 and drive.world_from_imu[0, 1, 3] > 5.4e6
    scene = drive.at(np.array([len(drive) // 2])).scene(0)
    assert scene.occupied[0].mean() > 0.05 and scene.occupied[1].any() and len(scene) > 30
    assert scene.attribution is None


def find_lane_middle(road: Road, lane: int, at_end: bool) -> np.ndarray | None:
    """Return the middle (2,) of a lane at one end of a road."""
    section = road.sections[-1 if at_end else 0]
    for strip in list_strips(road, section):
        if strip.lane.id == lane:
            place = -1 if at_end else 0
            middle = (strip.inner_m[place] + strip.outer_m[place]) / 2
            return road.line.place(strip.s_m[[place]], np.array([middle]))[0, :2]
    return None


def measure_gaps(path: Path) -> np.ndarray:
    """Return the distances between the middles of driving lanes and of their successors (m)."""
    roads = {road.id: road for road in read_map(str(path)).roads}
    root = ElementTree.fromstring(gzip.decompress(path.read_bytes()))
    gaps = []
    for element in root.iter("road"):
        link = element.find("link/successor[@elementType='road']")
        if link is None:
            continue
        last = element.findall("lanes/laneSection")[-1]
        for lane in last.iterfind("*/lane[@type='driving']"):
            following = lane.find("link/successor")
            if following is not None:
                ends = (
                    find_lane_middle(roads[element.get("id")], int(lane.get("id")), True),
                    find_lane_middle(
                        roads[link.get("elementId")], int(following.get("id")), link.get("contactPoint") == "end"
                    ),
                )
                gaps.append(np.linalg.norm(np.subtract(*ends)))
    return np.array(gaps)


def test_real_lanes_meet_their_successors(real_data):
    gaps = measure_gaps(real_data / "opendrive" / "ingolstadt-city-hall.xodr.gz")
    assert len(gaps) > 40 and np.median(gaps) < 0.01 and np.percentile(gaps, 90) < 0.1


@pytest.mark.parametrize("town", ["Town03", "Town07", "Town10HD"])
def test_town_of_carla_keeps_its_content(carla_maps, town):
    path = carla_maps / f"{town}.xodr.gz"
    drive, report = read_drive(str(path), OpenDriveOptions())
    root = ElementTree.fromstring(gzip.decompress(path.read_bytes()))
    damaged = sum(n for reason, n in report["skipped"].items() if "finite number" in reason)  # "-1.0499979e" in Town03
    assert report["roads"] + damaged == len(list(root.iter("road"))) and damaged <= 1
    length = sum(float(road.get("length")) for road in root.iter("road") if road.get("junction") == "-1")
    assert report["length_m"] == pytest.approx(length, abs=0.06, rel=0.001 * damaged)
    gaps = measure_gaps(path)
    assert len(gaps) > 20 and np.median(gaps) < 0.01 and np.percentile(gaps, 90) < 0.1
    spaces = [element for element in root.iter("object") if element.find("parkingSpace") is not None]
    area = sum(float(one.get("width")) * float(one.get("length")) for one in spaces)
    corners = drive.ground.triangles_m[drive.ground.triangle_layer == LAYERS.index("parking"), :, :2]
    sides = corners[:, 1:] - corners[:, :1]
    triangles = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]) / 2
    assert triangles.sum() >= 0.99 * area
    assert all(drive.at(np.array([k])).scene(0).occupied[0].mean() > 0.02 for k in range(0, len(drive), 50))


@pytest.mark.slow
def test_real_lanes_agree_with_sumo(real_data, tmp_path):
    sumo = pytest.importorskip("sumo", reason="no SUMO: install pritti-on-ray[traffic]")
    path = real_data / "opendrive" / "ingolstadt-city-hall.xodr.gz"
    plain, net = tmp_path / "map.xodr", tmp_path / "map.net.xml"
    plain.write_bytes(gzip.decompress(path.read_bytes()))
    program = shutil.which("netconvert") or str(Path(sumo.SUMO_HOME, "bin", "netconvert"))
    subprocess.run([program, "--opendrive-files", plain, "-o", net], check=True, capture_output=True)
    root = ElementTree.parse(net).getroot()
    offset = np.array([float(v) for v in root.find("location").get("netOffset").split(",")])
    drive = read(str(path))
    road = drive.ground.triangles_m[drive.ground.triangle_layer == 0][:, :, :2]
    surface = shapely.union_all(shapely.buffer(shapely.polygons(road), 0.01))
    inside = []
    for edge in root.iter("edge"):
        if edge.get("function") != "internal":
            for lane in edge.iter("lane"):
                if "pedestrian" not in lane.get("allow", "") and float(lane.get("length")) > 5:
                    shape = np.array([[float(v) for v in point.split(",")[:2]] for point in lane.get("shape").split()])
                    line = shapely.LineString(shape - offset)
                    inside.append((line.intersection(surface).length, line.length))
    covered, total = np.sum(inside, axis=0)
    assert len(inside) > 20 and covered > 0.85 * total


# ------------------------------------------------------------------------------------------ our export, read again


def import_export(scene: Scene, folder: Path) -> tuple[Map, Scene]:
    """Return the roads of an exported scene, and the scene with the imported ground."""
    path = folder / "scene.xodr"
    path.write_bytes(export_opendrive(scene))
    height, occupied = rasterise(read(str(path)), 0.0, 0.0, scene.grid)
    ground = {"ground_classes": KITTI_GROUND_CLASSES, "height_m": height, "occupied": occupied}
    return read_map(str(path)), replace(scene, **ground)


def sample_roads(roads: Map) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points (n, 2), widths of all driving lanes (n,) and distances to the ends of the road (n,)."""
    points, widths, ends = [], [], []
    for road in roads.roads:
        if road.junction:
            continue
        s = np.linspace(0, road.line.length_m, max(2, int(road.line.length_m)))
        width = np.zeros(len(s))
        for section in road.sections:
            for strip in list_strips(road, section):
                if strip.lane.kind == "driving":
                    width += np.interp(s, strip.s_m, np.abs(strip.outer_m - strip.inner_m))
        points.append(road.line.evaluate(s)[0][:, :2])
        widths.append(width)
        ends.append(np.minimum(s, road.line.length_m - s))
    return np.concatenate(points), np.concatenate(widths), np.concatenate(ends)


def test_imported_export_has_the_same_roads(tmp_path):
    grid = Grid(128.0, 64.0, 0.25, 512, 512)
    (scene,) = make_large_crops(1_000_001, 1, grid)
    first, back = import_export(scene, tmp_path)
    road, again = scene.occupied[0], back.occupied[0]
    assert (road & again).sum() > 0.9 * (road | again).sum()
    assert np.abs(scene.height_m[0] - back.height_m[0])[road & again].mean() < 0.1
    second, _ = import_export(back, tmp_path)
    points, widths, ends = sample_roads(second)
    lines = shapely.MultiLineString([road.line.evaluate(np.linspace(0, road.line.length_m, 100))[0][:, :2] for road in
                                     first.roads if not road.junction])  # fmt: skip
    distance = shapely.distance(shapely.points(points), lines)
    there, wide, _ = sample_roads(first)
    nearest = shapely.STRtree(shapely.points(there)).nearest(shapely.points(points))
    inner = ends > 10.0  # Nearer to junctions, centrelines of masks depend on the kerbs.
    assert inner.sum() > 100 and (distance[inner] <= 0.2).mean() > 0.9 and np.median(distance) < 0.05
    assert (np.abs(widths - wide[nearest])[inner] <= 0.1).mean() > 0.85


# ---------------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<OpenDRIVE><road", "broken XML"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><OpenDRIVE>&b;</OpenDRIVE>', "broken XML"),
        ("<osm/>", "root element 'osm', expected 'OpenDRIVE'"),
        ("<OpenDRIVE/>", "has no road that can be read"),
        ('<OpenDRIVE><road id="1" length="10"/></OpenDRIVE>', "road without a reference line"),
        (f"<OpenDRIVE>{make_road().replace('<line/>', '<knot/>')}</OpenDRIVE>", "geometry of none of the kinds line"),
        (f"<OpenDRIVE>{make_road(length='nan')}</OpenDRIVE>", "length='nan', expected a finite number"),
    ],
)
def test_broken_map_names_file_and_fix(tmp_path, content, message):
    path = tmp_path / "broken.xodr"
    path.write_text(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_map(str(path))
    assert "broken.xodr" in str(caught.value) and "pass an OpenDRIVE file" in str(caught.value)


def test_compressed_bomb_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("PRITTI_MAX_JSON_BYTES", "100000")
    path = tmp_path / "bomb.xodr.gz"
    path.write_bytes(gzip.compress(b" " * 10_000_000))
    with pytest.raises(ValueError, match=r"bomb\.xodr\.gz, decompressed"):
        read_map(str(path))


def test_bad_road_is_skipped_and_counted(tmp_path):
    unknown = make_road(more="<hovercraftLanes/>")
    _, report = read_drive(write(tmp_path, '<road id="1" length="5"/>', unknown), OpenDriveOptions())
    assert report["roads"] == 1
    assert report["skipped"] == {"road without a reference line": 1, "element hovercraftLanes of a road": 1}


def test_map_without_driving_lanes_is_refused(tmp_path):
    path = write(tmp_path, make_road().replace('"driving"', '"sidewalk"'))
    with pytest.raises(ValueError, match="no road outside of junctions has a driving lane"):
        read_poses(path, OpenDriveOptions())


def test_notice_of_our_export_is_kept(tmp_path):
    text = Path(write(tmp_path, make_road())).read_text()
    text = text.replace('revMinor="6"/>', 'revMinor="6"><userData code="attribution" value="© Somebody"/></header>')
    (tmp_path / "map.xodr").write_text(text)
    assert read(str(tmp_path / "map.xodr")).scene(0).attribution == "© Somebody"


def test_plan_lists_files_and_poses(tmp_path):
    write(tmp_path, make_road(), name="a.xodr")
    write(tmp_path, make_road(), name="b.xodr")
    assert [Path(path).name for path in list_map_files((str(tmp_path),), SUFFIXES, GET_FILE)] == ["a.xodr", "b.xodr"]
    tasks = plan_opendrive((str(tmp_path),), OpenDriveOptions(), 0.0)
    assert [(task.split, task.parts[0].sequence, len(task.parts[0].poses)) for task in tasks] == [
        ("train", "a", 16), ("train", "b", 16)]  # fmt: skip
    with pytest.raises(ValueError, match="no such file or directory"):
        list_map_files((str(tmp_path / "c.xodr"),), SUFFIXES, GET_FILE)
