"""Tests of the KITTI-360 reader: comparison with the vertices in files, defective objects and broken files."""

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from models.limits import LimitError
from models.scene import CATEGORIES, KITTI_GROUND_CLASSES
from pipelines.preprocess.sources.drive import STATIC
from pipelines.preprocess.sources.kitti360 import list_sequences, read_drive, read_poses

NAME = "2013_05_28_drive_0003_sync"
CUBE = np.array(
    [[1, 1, 1], [1, 1, -1], [1, -1, 1], [1, -1, -1], [-1, 1, -1], [-1, 1, 1], [-1, -1, -1], [-1, -1, 1]]
) / 2  # fmt: skip
CUBE_FACES = "0 2 1 2 3 1 4 6 5 6 7 5 4 5 1 5 0 1 7 6 2 6 3 2 5 7 0 7 2 0 1 3 4 3 6 4"
# A prism with an L-shaped outline of 64 m2; the top has the first 6 corners and the bottom has the last 6 corners.
L_OUTLINE = np.array([[0, 0], [10, 0], [10, 4], [4, 4], [4, 10], [0, 10]], float)
L_SLAB = np.concatenate([np.column_stack([L_OUTLINE, np.full(6, z)]) for z in (0.3, -0.3)])
L_FACES = "0 1 2 0 2 3 0 3 4 0 4 5 8 7 6 9 8 6 10 9 6 11 10 6 " + " ".join(
    f"{i} {i + 6} {j} {j} {i + 6} {j + 6}" for i, j in zip(range(6), [1, 2, 3, 4, 5, 0], strict=True)
)
IDENTITY_POSE = "1 0 0 100 0 -1 0 200 0 0 -1 117"  # the pose faces east, with y to the right and z down


def make_sphere() -> np.ndarray:
    """Return the vertices (63, 3) of a unit sphere: 9 columns x 7 rows with poles on the local y axis."""
    polar, around = np.meshgrid(np.linspace(0, np.pi, 7), np.linspace(0, 2 * np.pi, 9))
    x, y, z = np.sin(polar) * np.cos(around), np.cos(polar), np.sin(polar) * np.sin(around)
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)


def format_matrix(tag: str, values: np.ndarray | str, cols: int, kind: str = "f") -> str:
    words = values.split() if isinstance(values, str) else [f"{v:.9e}" for v in np.ravel(values)]
    return (
        f'<{tag} type_id="opencv-matrix">\n<rows>{len(words) // cols}</rows>\n<cols>{cols}</cols>\n'
        f"<dt>{kind}</dt>\n<data>\n{' '.join(words)} </data></{tag}>\n"
    )


def make_affine(linear: np.ndarray, at: tuple[float, float, float] = (130, 205, 117)) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = linear, at
    return out


def format_object(label="car", transform=None, vertices=CUBE, faces=CUBE_FACES, index=1, **fields) -> str:
    """Return one <objectN> element without the fields that are None."""
    transform = make_affine(np.diag([4.4, 2.0, 1.5])) if transform is None else transform
    texts = {
        "index": index, "label": label, "category": "instance", "level_min": "0.", "level_max": "10.",
        "dynamic": 0, "dynamicSeq": -1, "dynamicIdx": -1, "timestamp": -1, "start_frame": 0, "end_frame": 99,
    } | fields  # fmt: skip
    matrices = [
        format_matrix("transform", transform, 4),
        format_matrix("vertices", vertices, 3),
        format_matrix("faces", faces, 3, "u"),
    ]
    empty = [
        format_matrix(f"{tag}_plane", "", 3).replace("<cols>3", "<cols>0") for tag in ("transform", "vertices", "faces")
    ]
    parts = [f"<{tag}>{text}</{tag}>\n" for tag, text in texts.items() if text is not None]
    return f"<object{index}>\n{''.join(parts + matrices + empty)}</object{index}>\n"


def format_slab(label="road", at=(100.0, 190.0, 116.0), index=9, vertices=L_SLAB, faces=L_FACES) -> str:
    return format_object(label, make_affine(np.eye(3), at), vertices, faces, index, category="stuff")


def format_document(*objects: str) -> str:
    return '<?xml version="1.0"?>\n<opencv_storage>\n' + "".join(objects) + "</opencv_storage>\n"


def write_drive(root: Path, xml: str | bytes, poses: str | bytes | None = None) -> Path:
    if poses is None:
        poses = "".join(f"{k} {IDENTITY_POSE.replace('100', str(100 + k), 1)}\n" for k in (0, 1, 2, 5))
    for path, content in (
        (root / "data_3d_bboxes" / "train_full" / f"{NAME}.xml", xml),
        (root / "data_poses" / NAME / "poses.txt", poses),
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return root


def read_objects(root: Path, *objects: str):
    return read_drive(write_drive(root, format_document(*objects)), "0003")


def compute_corners(center: np.ndarray, rotation: np.ndarray, size: np.ndarray) -> np.ndarray:
    return center + (CUBE * size) @ rotation.T


def compute_set_distance(a: np.ndarray, b: np.ndarray) -> float:
    """Return the Hausdorff distance of two point sets."""
    distance = np.linalg.norm(a[:, None] - b[None], axis=2)
    return max(distance.min(axis=0).max(), distance.min(axis=1).max())


# ------------------------------------------------------------------------------------------- real excerpt


@pytest.fixture(scope="module")
def real_drive(real_data):
    root = real_data / "kitti360"
    (sequence,) = list_sequences(root)
    drive, report = read_drive(root, sequence)
    path = next((root / "data_3d_bboxes" / "train_full").glob("*.xml"))
    return drive, report, ElementTree.parse(path).getroot()


def parse_numbers(element: ElementTree.Element, cols: int) -> np.ndarray:
    return np.array(element.findtext("data").split(), float).reshape(-1, cols)


def test_kitti360_real_boxes_have_corners_of_file(real_drive):
    drive, _, xml = real_drive
    row_of = {index: row for row, index in enumerate(drive.instance_id)}
    cuboids = ellipsoids = 0
    for element in xml:
        row = row_of.get(int(element.findtext("index")))
        if row is None or element.findtext("category") == "stuff":
            continue
        transform, vertices = parse_numbers(element.find("transform"), 4), parse_numbers(element.find("vertices"), 3)
        world = vertices @ transform[:3, :3].T + transform[:3, 3]
        center, rotation, size = drive.center_m[row], drive.rotation[row], drive.size_m[row]
        assert np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-9) and np.linalg.det(rotation) > 0
        axes = transform[:3, :3] / np.linalg.norm(transform[:3, :3], axis=0)
        shear = np.abs(axes.T @ axes - np.eye(3)).max()
        if len(vertices) == 63:
            assert drive.category[row] == CATEGORIES.index("vegetation_ellipsoid")
            radius = np.linalg.norm((world - center) @ rotation / (size / 2), axis=1)
            assert np.abs(radius - 1).max() < (1e-3 if shear < 1e-3 else 0.05)
            ellipsoids += 1
        else:
            limit_m = 1e-3 if shear < 1e-3 else 0.05 * size.max()
            assert compute_set_distance(compute_corners(center, rotation, size), world) < limit_m
            cuboids += 1
    assert (cuboids, ellipsoids) == (np.sum(drive.category != 1), np.sum(drive.category == 1))


def test_kitti360_real_duplicates_are_nearly_identical(real_drive):
    drive, report, xml = real_drive
    written = [tuple(e.findtext(t) for t in ("label", "transform/data", "vertices/data")) for e in xml]
    assert report.objects == len(written) == 977
    boxes = [(label, t) for label, t, vertices in set(written) if len(vertices.split()) in (3 * 8, 3 * 63)]
    label = np.array([label for label, _ in boxes])
    matrix = np.array([t.split() for _, t in boxes], float).reshape(-1, 4, 4)
    size, center = np.linalg.norm(matrix[:, :3, :3], axis=1), matrix[:, :3, 3]
    near = (np.linalg.norm(center[:, None] - center, axis=2) < 0.5) & (label == "vegetation")
    alike = near & (np.abs(size[:, None] - size).max(axis=2) < 1e-4) & (label[:, None] == label)
    copies = np.triu(alike, 1).sum()
    assert copies == 33
    assert report.duplicates == len(written) - len(set(written)) + copies
    assert report.boxes + report.slabs + report.duplicates == report.objects
    assert (report.dropped, report.unknown, report.defects) == ({}, {}, ())
    assert (len(drive.category), len(drive.ground.slab_class)) == (report.boxes, report.slabs)


def test_kitti360_real_cars_stand_half_a_slab_below_raster(real_drive):
    drive, _, _ = real_drive
    depth, road_below = [], []
    for k in range(0, len(drive), 25):
        scene = drive.scene(k)
        height, ground_class = scene.surface()
        row, col = scene.grid.pixel(scene.center_m[:, 0], scene.center_m[:, 1])
        row, col = row.clip(0, 255), col.clip(0, 255)
        on_ground = np.isin(scene.category, [2, 3]) & (ground_class[row, col] >= 0)
        depth += list((height[row, col] - scene.center_m[:, 2] + scene.size_m[:, 2] / 2)[on_ground])
        near = ground_class[248:, 124:132] == KITTI_GROUND_CLASSES.index("road")
        road_below += list(height[248:, 124:132][near])
    assert abs(np.median(depth) - 0.3) < 0.1
    # the IMU is 0.93 m and the raster is 0.3 m above the road
    assert abs(np.median(road_below) + 0.63) < 0.1


def test_kitti360_real_road_lies_ahead(real_drive):
    drive, _, _ = real_drive
    ahead = np.mean([drive.scene(k).occupied[0][:, 118:138].mean() for k in range(50, 450, 50)])
    aside = np.mean([drive.scene(k).occupied[0][:, :20].mean() for k in range(50, 450, 50)])
    assert ahead > 2 * aside


def test_kitti360_real_parked_cars_point_along_road(real_drive):
    drive, _, _ = real_drive
    headed = np.flatnonzero(np.isfinite(drive.heading_rad))
    assert set(drive.label[headed]) == {"car", "truck"}
    path = drive.world_from_imu[:, :2, 3]
    nearest = np.array([np.linalg.norm(path - drive.center_m[row, :2], axis=1).argmin() for row in headed])
    turn = drive.heading_rad[headed] - np.array([drive.pose(k).yaw_rad for k in nearest])
    assert np.median(np.abs(np.sin(turn))) < 0.2


# ------------------------------------------------------------------------------------------ special cases


LABELS = {
    "vegetation_cuboid": ["vegetation"],
    "vehicle_big": ["truck", "bus"],
    "vehicle_small": ["car", "trailer", "unknownVehicle", "unknown vehicle"],
    "two_wheelers": ["motorcycle", "bicycle"],
    "human": ["rider", "pedestrian", "person"],
    "construction_big": ["building", "garage", "unknownConstruction", "unknown construction"],
    "construction_small": ["wall", "fence", "guardrail", "guard rail", "gate"],
    "pole": ["smallPole", "bigPole", "smallpole"],
    "traffic_control": ["trafficLight", "trafficSign", "traffic sign", "lamp"],
    "object": ["trashbin", "trash bin", "box", "unknownObject"],
}


@pytest.mark.parametrize(
    ("label", "category"), [(label, category) for category, labels in LABELS.items() for label in labels]
)
def test_kitti360_maps_every_object_label_to_category(tmp_path, label, category):
    drive, report = read_objects(tmp_path, format_object(label))
    assert [CATEGORIES[c] for c in drive.category] == [category]
    assert drive.label.tolist() == [label]
    headed = category in ("vehicle_big", "vehicle_small", "two_wheelers") or label == "rider"
    assert np.isfinite(drive.heading_rad[0]) == headed
    assert report.boxes == 1


@pytest.mark.parametrize(
    ("label", "ground_class"),
    [("road", "road"), ("sidewalk", "sidewalk"), ("driveway", "parking"), ("parking", "parking"),
     ("ground", "terrain"), ("unknownGround", "ground")],
)  # fmt: skip
def test_kitti360_recognizes_ground_by_label_not_shape(tmp_path, label, ground_class):
    flat = format_object(label, make_affine(np.diag([20.0, 10.0, 0.6])), category="stuff", index=2)
    drive, report = read_objects(tmp_path, format_slab(label), flat)
    assert (report.slabs, report.boxes) == (2, 0)
    assert [KITTI_GROUND_CLASSES[c] for c in drive.ground.slab_class] == [ground_class] * 2
    assert drive.scene(0).ground_area_m2()[KITTI_GROUND_CLASSES.index(ground_class)] > 100


@pytest.mark.parametrize(
    "label", ["tunnel", "bridge", "train", "stop", "caravan", "vendingmachine", "railtrack", "sky"]
)
def test_kitti360_counts_dropped_labels_without_category(tmp_path, label):
    drive, report = read_objects(
        tmp_path, format_object(label), format_object("spaceship", index=2), format_object(index=3)
    )
    assert (report.dropped, report.unknown, report.boxes) == ({label: 1}, {"spaceship": 1}, 1)
    assert len(drive.category) == 1
    assert "spaceship 1" in report.summary()


def test_kitti360_sphere_mesh_becomes_ellipsoid(tmp_path):
    turn = Rotation.from_euler("zyx", [0.5, 0.2, -0.1]).as_matrix()
    drive, _ = read_objects(
        tmp_path, format_object("vegetation", make_affine(turn @ np.diag([1.0, 2.0, 3.0])), make_sphere(), "0 1 2")
    )
    assert CATEGORIES[drive.category[0]] == "vegetation_ellipsoid"
    assert np.allclose(drive.size_m, [[2, 4, 6]], atol=1e-6)
    assert np.allclose(drive.rotation[0], turn, atol=1e-6)


def test_kitti360_slab_keeps_non_convex_outline_and_height(tmp_path):
    drive, _ = read_objects(tmp_path, format_slab(at=(110.0, 195.0, 116.0)))
    scene = drive.scene(0)  # the ego vehicle at (100, 200, 117) faces east
    assert abs(scene.ground_area_m2()[0] - 64) < 1
    assert np.allclose(scene.height_m[0][scene.occupied[0]], 116.3 - 117)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_kitti360_mirrored_box_equals_box(tmp_path, axis):
    turn = Rotation.from_euler("z", 0.7).as_matrix()
    mirror = np.ones(3)
    mirror[axis] = -1
    transform = make_affine(turn @ np.diag(mirror * [4.0, 2.0, 1.5]))
    drive, _ = read_objects(tmp_path, format_object("car", transform))
    assert np.linalg.det(drive.rotation[0]) > 0
    world = CUBE @ transform[:3, :3].T + transform[:3, 3]
    assert compute_set_distance(compute_corners(drive.center_m[0], drive.rotation[0], drive.size_m[0]), world) < 1e-6
    assert abs(np.cos(drive.heading_rad[0] - 0.7) - (1 if axis else -1)) < 1e-6


def test_kitti360_sheared_box_gets_nearest_rotation(tmp_path):
    turn = Rotation.from_euler("zyx", [1.0, 0.2, 0.1]).as_matrix()
    shear = np.array([[1, 0.04, 0], [0, 1, 0.02], [0, 0, 1]])
    drive, report = read_objects(
        tmp_path, format_object("building", make_affine(turn @ shear @ np.diag([8.0, 5.0, 3.0])))
    )
    assert report.defects == ()
    assert np.allclose(drive.rotation[0].T @ drive.rotation[0], np.eye(3), atol=1e-12)
    assert Rotation.from_matrix(drive.rotation[0] @ turn.T).magnitude() < 0.03
    assert np.allclose(drive.size_m[0], [8, 5, 3], rtol=0.01)


def test_kitti360_tilted_box_keeps_tilt(tmp_path):
    turn = Rotation.from_euler("zyx", np.radians([30, 20, -15])).as_matrix()
    drive, _ = read_objects(tmp_path, format_object("wall", make_affine(turn @ np.diag([3.0, 0.5, 1.5]))))
    assert np.allclose(drive.rotation[0], turn, atol=1e-6)


def test_kitti360_uses_vertices_of_non_unit_cube(tmp_path):
    drive, _ = read_objects(
        tmp_path, format_object("box", make_affine(np.eye(3), (120, 200, 117)), (CUBE + 0.5) * [2, 4, 6])
    )
    assert np.allclose(drive.size_m[0], [2, 4, 6])
    assert np.allclose(drive.center_m[0], [121, 202, 120])


def test_kitti360_removes_duplicate_objects(tmp_path):
    shifted = make_affine(np.diag([4.4, 2.0, 1.5]), (130.0004, 204.9997, 117))
    drive, report = read_objects(
        tmp_path,
        format_object(index=1, start_frame=0, end_frame=99),
        format_slab(index=2),
        format_object(index=3, start_frame=90, end_frame=199),
        format_object(index=4, transform=shifted),
        format_slab(index=5),
        format_object("truck", index=6),  # a second object at the same position
        format_object(
            index=7, transform=make_affine(np.diag([4.4, 2.0, 1.5]), (130.3, 205.1, 117))
        ),  # A copy from another annotation window.
        format_object(index=8, transform=make_affine(np.diag([4.4, 2.0, 1.5]), (130.9, 205, 117))),  # A different car.
        format_object(index=9, transform=make_affine(np.diag([4.4, 2.01, 1.5]), (130, 205, 117))),  # A different size.
        format_object("smallPole", index=10, transform=make_affine(np.diag([0.3, 0.3, 4]), (140, 205, 117))),
        format_object(
            "smallPole", index=11, transform=make_affine(np.diag([0.3, 0.3, 4]), (140.2, 205, 117))
        ),  # A neighbouring pole.
    )
    assert drive.instance_id.tolist() == [1, 6, 8, 9, 10, 11]
    assert (report.duplicates, report.slabs) == (4, 1)


def test_kitti360_places_moving_objects_by_frame(tmp_path):
    moving = [
        format_object(
            transform=make_affine(np.eye(3), (120 + k, 200, 117)),
            index=k + 1,
            dynamic=1,
            dynamicSeq=7,
            timestamp=k,
        )
        for k in range(3)
    ]
    drive, report = read_objects(tmp_path, *moving, moving[1], format_object(index=12))
    assert report.duplicates == 1
    assert drive.timestamp.tolist() == [0, 1, 2, STATIC]
    assert drive.instance_id.tolist() == [7, 7, 7, 12]
    assert [len(drive.scene(k)) for k in range(4)] == [2, 2, 2, 1]
    assert np.allclose(drive.scene(2).center_m[0], [120 + 2 - 102, 0, 0])


def test_kitti360_is_independent_of_element_order(tmp_path):
    element = ElementTree.fromstring(format_object())
    element[:] = reversed(element[:])
    drive, _ = read_objects(tmp_path, ElementTree.tostring(element, "unicode"))
    assert drive.size_m.tolist() == [[4.4, 2.0, 1.5]]


def test_kitti360_scene_axes_point_ahead_and_left(tmp_path):
    """The car faces east, so north is to its left.

    World coordinates of many kilometres keep a precision of one millimetre.
    """
    far_pose = IDENTITY_POSE.replace("100", "41100").replace("200", "98200")
    far_box = format_object(transform=make_affine(np.eye(3), (41110.001, 98203.002, 118)))
    drive, _ = read_drive(write_drive(tmp_path, format_document(far_box), f"0 {far_pose}\n"), "0003")
    scene = drive.scene(0)
    assert np.allclose(scene.center_m, [[10.001, 3.002, 1]], atol=1e-5)


def test_kitti360_reads_drive_without_boxes_or_ground(tmp_path):
    drive, _ = read_objects(tmp_path, format_slab())
    assert len(drive.scene(0)) == 0
    drive, _ = read_objects(tmp_path, format_object())
    assert drive.scene(0).occupied.sum() == 0


# ------------------------------------------------------------------------------- defective objects

BROKEN_OBJECTS = {
    "no transform": (lambda x: re.sub(r"<transform .*?</transform>", "", x, flags=re.S), "no transform"),
    "no vertices": (lambda x: re.sub(r"<vertices .*?</vertices>", "", x, flags=re.S), "no vertices"),
    "no label": (lambda x: x.replace("<label>car</label>", ""), "no label"),
    "no timestamp": (lambda x: x.replace("<timestamp>-1</timestamp>", ""), "no timestamp"),
    "no rows": (lambda x: x.replace("<rows>4</rows>", "", 1), "no rows"),
    "rows lie": (lambda x: x.replace("<rows>4</rows>", "<rows>5</rows>", 1), "5 x 4 with 16 numbers"),
    "huge rows": (lambda x: x.replace("<rows>8<", "<rows>999999999999999999<"), "with 24 numbers"),
    "huger rows": (lambda x: x.replace("<rows>8<", "<rows>" + "9" * 5000 + "<"), "not a whole number"),
    "negative rows": (lambda x: x.replace("<rows>8<", "<rows>-8<"), "-8 x 3"),
    "wrong count": (lambda x: x.replace("1.500000000e+00", "", 1), "4 x 4 with 15 numbers"),
    "nan": (lambda x: x.replace("4.400000000e+00", "nan", 1), "not a finite number"),
    "inf": (lambda x: x.replace("1.170000000e+02", "-inf", 1), "not a finite number"),
    "word": (lambda x: x.replace("4.400000000e+00", "four", 1), "not a finite number"),
    "huge size": (lambda x: x.replace("4.400000000e+00", "4.4e+05", 1), "transform or vertices hold"),
    "big size": (lambda x: x.replace("4.400000000e+00", "4.4e+03", 1), "size is"),
    "overflow": (lambda x: x.replace("4.400000000e+00", "1e308", 1), "transform or vertices hold"),
    "far away": (lambda x: x.replace("1.300000000e+02", "1.3e+30", 1), "transform or vertices hold"),
    "too far": (lambda x: x.replace("1.300000000e+02", "0.99999e+05").replace("5.0", "9.0"), "origin"),
    "flat": (lambda x: x.replace("1.500000000e+00", "0", 1), "size is"),
    "timestamp word": (lambda x: x.replace("<timestamp>-1", "<timestamp>soon"), "timestamp is 'soon'"),
    "timestamp -2": (lambda x: x.replace("<timestamp>-1", "<timestamp>-2"), "timestamp is -2"),
    "moving, no track": (
        lambda x: x.replace("<timestamp>-1", "<timestamp>4").replace("<dynamicSeq>-1</dynamicSeq>", ""),
        "no dynamicSeq",
    ),
    "projective": (lambda x: x.replace("0.000000000e+00 1.000000000e+00 <", "1.0 1.0 <", 1), "not an affine"),
    "not an object": (lambda x: "<object77/>", "no label"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN_OBJECTS)
def test_kitti360_drops_defective_object_with_reason(tmp_path, name):
    breaks, reason = BROKEN_OBJECTS[name]
    broken = breaks(format_object(index=77, transform=make_affine(np.diag([4.4, 2.0, 1.5]), (130, 205, 117))))
    assert broken != format_object(index=77)
    drive, report = read_objects(tmp_path, broken, format_object("truck", index=2), format_slab(index=3))
    assert drive.instance_id.tolist() == [2] and report.slabs == 1
    (defect,) = report.defects
    assert reason in defect.reason and defect.index in (77, -1)
    assert reason in report.summary()


@pytest.mark.parametrize(
    ("faces", "reason"),
    [
        ("0 1 99", "vertices other than 0..11"),
        ("0 1 -1", "vertices other"),
        ("0 1 1.5", "vertices other"),
        ("0 1 1e30", "vertices other"),
        ("0 1 nan", "not a finite"),
        ("", "no faces"),
    ],
)
def test_kitti360_drops_defective_slab_with_reason(tmp_path, faces, reason):
    drive, report = read_objects(tmp_path, format_slab(faces=faces, index=5), format_object(index=2))
    assert reason in report.defects[0].reason and report.defects[0].index == 5
    assert len(drive.ground.slab_class) == 0 and len(drive.category) == 1


def test_kitti360_sheared_flat_box_is_defective(tmp_path):
    transform = make_affine(np.array([[4, 2, 0], [0, 0.5, 0], [0, 0, 1.5]]))
    _, report = read_objects(tmp_path, format_object(transform=transform))
    assert "sheared flat" in report.defects[0].reason


# ----------------------------------------------------------------------------------- broken files

BOMB = '<!DOCTYPE b [<!ENTITY a "ha"><!ENTITY c "&a;&a;&a;&a;&a;&a;&a;">]>'
GOOD = format_document(format_object(index=1), format_slab(index=2))
BROKEN_FILES = {
    "empty": "",
    "blank": "  \n",
    "no objects": format_document(),
    "truncated": GOOD[: len(GOOD) // 2],
    "truncated by a byte": GOOD.rstrip()[:-1],
    "other root": GOOD.replace("opencv_storage", "kml"),
    "mismatched tags": GOOD.replace("</label>", "</lable>"),
    "binary": bytes(range(256)),
    "png": b"\x89PNG\r\n\x1a\n" + bytes(100),
    "entity bomb": GOOD.replace("<opencv_storage>", BOMB + "<opencv_storage>").replace(">car<", ">&c;<"),
    "external entity": GOOD.replace(
        "<opencv_storage>", '<!DOCTYPE b [<!ENTITY x SYSTEM "file:///etc/hostname">]><opencv_storage>'
    ).replace(">car<", ">&x;<"),
    "undefined entity": GOOD.replace(">car<", ">&car;<"),
    "unknown encoding": GOOD.replace('version="1.0"', 'version="1.0" encoding="klingon"'),
    "wrong encoding": GOOD.replace("car", "cär").encode("latin-1"),
    "utf-16 promised": GOOD.replace('version="1.0"', 'version="1.0" encoding="utf-16"'),
}


@pytest.mark.parametrize("name", BROKEN_FILES)
def test_kitti360_names_broken_xml(tmp_path, name):
    write_drive(tmp_path, BROKEN_FILES[name])
    with pytest.raises(ValueError) as error:
        read_drive(tmp_path, "0003")
    assert type(error.value) is ValueError
    assert f"{NAME}.xml" in str(error.value) and "again" in str(error.value)
    assert "\n" not in str(error.value)


POSE = f"7 {IDENTITY_POSE}"
BROKEN_POSES = {
    "empty": ("", "holds no pose"),
    "short line": (f"0 {IDENTITY_POSE}\n1 0 0", "line 2: 3 numbers"),
    "long line": (f"0 {IDENTITY_POSE} 1", "line 1: 14 numbers"),
    "word": (POSE.replace("117", "up"), "line 1"),
    "nan": (POSE.replace("117", "nan"), "line 1"),
    "huge": (POSE.replace("117", "1e300"), "line 1"),
    "frame": (POSE.replace("7 ", "7.5 ", 1), "frame '7.5'"),
    "huge frame": ("9" * 30 + POSE[1:], "is not a whole number"),
    "order": (f"{POSE}\n{POSE}", "line 2: frame 7 follows frame 7"),
    "scaled": (POSE.replace("-1", "-2"), "frame 7 is no rotation"),
    "mirrored": (POSE.replace("-1", "1", 1), "frame 7 is no rotation"),
    "binary": (bytes(range(256)), "line 1"),
}


@pytest.mark.parametrize("name", BROKEN_POSES)
def test_kitti360_names_broken_poses(tmp_path, name):
    poses, reason = BROKEN_POSES[name]
    write_drive(tmp_path, GOOD, poses)
    with pytest.raises(ValueError) as error:
        read_drive(tmp_path, "0003")
    assert type(error.value) is ValueError
    assert reason in str(error.value) and "poses.txt" in str(error.value)


def test_kitti360_names_missing_file(tmp_path):
    with pytest.raises(ValueError, match="data_3d_bboxes"):
        list_sequences(tmp_path)
    write_drive(tmp_path, GOOD)
    assert list_sequences(tmp_path) == ["0003"]
    poses = tmp_path / "data_poses" / NAME / "poses.txt"
    poses.unlink()
    for call in (
        lambda: list_sequences(tmp_path),
        lambda: read_poses(tmp_path, "0003"),
        lambda: read_drive(tmp_path, "0003"),
    ):
        with pytest.raises(ValueError, match=r"poses\.txt"):
            call()
    poses.mkdir()
    with pytest.raises(ValueError, match=r"poses\.txt"):
        read_poses(tmp_path, "0003")
    write_drive(tmp_path / "two", GOOD)
    with pytest.raises(ValueError, match=r"0002_sync"):
        read_drive(tmp_path / "two", "0002")


def test_kitti360_poses_are_in_world_coordinates(tmp_path):
    write_drive(tmp_path, GOOD)
    frame, world_from_imu = read_poses(tmp_path, "0003")
    assert frame.tolist() == [0, 1, 2, 5]
    assert world_from_imu.shape == (4, 3, 4) and world_from_imu.dtype == np.float64
    assert world_from_imu[3, :, 3].tolist() == [105, 200, 117]


def test_kitti360_raises_only_named_errors_for_mutated_files(tmp_path):
    rng = np.random.default_rng(0)
    good = format_document(format_object(index=1), format_slab(index=2), format_object("truck", index=3)).encode()
    refused = 0
    for _ in range(200):
        bad = bytearray(good)
        for at in rng.integers(0, len(bad), rng.integers(1, 4)):
            bad[at] = rng.choice(np.frombuffer(b"0123456789.-+enaif <>/&;!\x00\xff", np.uint8))
        if rng.random() < 0.1:
            del bad[rng.integers(len(bad)) :]
        try:
            drive, report = read_drive(write_drive(tmp_path, bytes(bad)), "0003")
        except ValueError as error:
            refused += 1
            assert type(error) in (ValueError, LimitError) and f"{NAME}.xml" in str(error)
            continue
        assert report.objects == report.boxes + report.slabs + len(report.defects) + sum(report.unknown.values())
        assert np.isfinite(drive.center_m).all() and (drive.size_m > 0).all()
        drive.scene(0)
    assert 20 < refused < 180
