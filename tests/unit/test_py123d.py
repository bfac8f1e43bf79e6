"""Tests of the reader of py123d's Arrow files: a log of Argoverse 2 that py123d converted, and small files."""

import subprocess
from pathlib import Path

import msgpack
import numpy as np
import pyarrow as pa
import pytest
import shapely
from helpers import ROOT

from models.scene import CATEGORIES, CATEGORY_INDEX
from pipelines.preprocess.sharding import plan_py123d
from pipelines.preprocess.sources import argoverse2, py123d
from pipelines.schema.attribution import ATTRIBUTIONS

PYTHON = ROOT / ".venv-py123d/bin/python"
IDENTITY = [1.0, 0.0, 0.0, 0.0]


def write_arrow(path: Path, columns: dict[str, pa.Array], about: dict) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    table = pa.table(columns).replace_schema_metadata({"metadata": msgpack.packb(about)})
    with pa.ipc.new_file(str(path), table.schema) as writer:
        writer.write_table(table)


def write_log(
    root: Path, boxes: list, labels: list, classes: str, split: str = "nuplan_train", own_map: bool = True
) -> Path:
    """Write a log with two poses, boxes at the first time and a road along x with a walkway."""
    folder = root / "logs" / split / "log-1"
    place = {"dataset": "nuplan", "location": "us-ma-boston"}
    write_arrow(folder / "sync.arrow", {"row": pa.array([0])}, {"dataset": "nuplan", "map_metadata": place})
    poses = [[0.0, 0.0, 10.5, *IDENTITY], [5.0, 0.0, 10.5, *IDENTITY]]
    vehicle = {"height": 2.0, "center_to_imu_se3": [1.0, 0.0, 0.5, *IDENTITY]}  # The IMU is .5 m above the ground.
    write_arrow(
        folder / "ego_state_se3.arrow",
        {
            "ego_state_se3.timestamp_us": pa.array([1_000_000, 1_500_000]),
            "ego_state_se3.imu_se3": pa.array(poses, pa.list_(pa.float64(), 7)),
        },
        vehicle,
    )
    count = len(boxes)
    write_arrow(
        folder / "box_detections_se3.arrow",
        {
            "box_detections_se3.timestamp_us": pa.array([1_010_000]),
            "box_detections_se3.bounding_box_se3": pa.array([boxes], pa.list_(pa.list_(pa.float64(), 10))),
            "box_detections_se3.track_token": pa.array([[f"t{k}" for k in range(count)]], pa.list_(pa.string())),
            "box_detections_se3.label": pa.array([labels], pa.list_(pa.uint16())),
        },
        {"box_detection_label_class": f"py123d.parser.registry.{classes}"},
    )
    shapes = [shapely.box(-10, -4, 80, 4), shapely.box(-10, 4, 80, 6), shapely.LineString([(-10, 0, 10), (80, 0, 10)])]
    write_arrow(
        folder / "map.arrow" if own_map else root / "maps" / "nuplan" / "nuplan_us-ma-boston.arrow",
        {
            "map_layer": pa.array([0, 4, 9], pa.int8()),
            "wkb": pa.array([shapely.to_wkb(shape, output_dimension=3) for shape in shapes], pa.binary()),
        },
        {},
    )
    return folder


def make_box(x_m: float, y_m: float, size_m: tuple[float, float, float]) -> list[float]:
    return [x_m, y_m, 10.0 + size_m[2] / 2, *IDENTITY, *size_m]


# ------------------------------------------------------------------------------------------------------ Argoverse 2


@pytest.fixture(scope="module")
def converted(real_data, tmp_path_factory) -> Path:
    """Logs that py123d converted in its own environment."""
    if not PYTHON.exists():
        pytest.skip("no py123d: run 'make py123d-env'")
    output = tmp_path_factory.mktemp("py123d")
    command = [PYTHON, ROOT / "tests/data/py123d/convert_av2.py", real_data / "av2" / "train", output]
    subprocess.run(command, check=True, capture_output=True)
    return output


def test_converted_log_equals_our_own_reader(converted, real_data):
    (name,) = py123d.list_logs(converted)
    theirs, skipped = py123d.read_drive(converted, *name)
    ours = argoverse2.read_drive(real_data / "av2", "train", name.log)
    assert skipped == 0 and len(theirs) == len(ours) and len(theirs.category) == len(ours.category) > 10_000
    assert np.array_equal(theirs.frame, ours.frame // 1000)  # Microseconds and nanoseconds.
    assert np.array_equal(theirs.world_from_imu, ours.world_from_imu)
    a, b = np.lexsort([theirs.instance_id, theirs.timestamp]), np.lexsort([ours.instance_id, ours.timestamp])
    assert np.array_equal(theirs.instance_id[a], ours.instance_id[b])
    for field in ("category", "label", "size_m"):
        assert np.array_equal(getattr(theirs, field)[a], getattr(ours, field)[b]), field
    assert np.allclose(theirs.center_m[a], ours.center_m[b], atol=1e-9)
    assert np.allclose(theirs.rotation[a], ours.rotation[b], atol=1e-9)
    for pose in (0, len(ours) // 2, len(ours) - 1):
        one, other = theirs.scene(pose), ours.scene(pose)
        assert one.attribution == other.attribution == ATTRIBUTIONS["av2"]
        for name_of_class in ("road", "crossing"):
            masks = [scene.occupied[scene.ground_classes.index(name_of_class)] for scene in (one, other)]
            assert (masks[0] & masks[1]).sum() >= 0.999 * (masks[0] | masks[1]).sum()
        both = one.occupied[0] & other.occupied[0]  # Heights are those of lines of the map instead of a raster.
        assert np.abs(one.height_m[0][both] - other.height_m[0][both]).max() < 0.3


# ------------------------------------------------------------------------------------------------------ small logs


def test_labels_heights_and_ground_of_small_log(tmp_path):
    boxes = [make_box(20, -2, (4.5, 1.9, 1.6)), make_box(40, 2, (12.0, 2.5, 3.2)), make_box(30, 5, (0.6, 0.6, 1.7))]
    write_log(tmp_path, boxes, [0, 0, 2], "NuPlanBoxDetectionLabel")
    drive, skipped = py123d.read_drive(tmp_path, "nuplan_train", "log-1")
    assert skipped == 0 and drive.frame.tolist() == [1_010_000] and drive.world_from_imu[0, 0, 3] == 0.0
    names = [CATEGORIES[k] for k in drive.category]
    assert names == ["vehicle_small", "vehicle_big", "human"]  # nuPlan has one class of vehicles.
    scene = drive.scene(0)
    road, walk = (scene.occupied[scene.ground_classes.index(name)] for name in ("road", "sidewalk"))
    assert road.mean() == pytest.approx(8 / 64, abs=0.01) and walk.mean() == pytest.approx(2 / 64, abs=0.01)
    assert np.allclose(scene.height_m[scene.occupied], -0.5, atol=1e-4)
    assert np.allclose(scene.center_m[:, 2] - scene.size_m[:, 2] / 2, -0.5, atol=1e-4)


def test_map_of_a_place_and_boxes_without_category(tmp_path):
    boxes = [make_box(20, -2, (4.5, 1.9, 1.6)), make_box(25, -2, (1.0, 1.0, 1.0))]
    write_log(tmp_path, boxes, [1, 0], "WODPerceptionBoxDetectionLabel", own_map=False)
    drive, skipped = py123d.read_drive(tmp_path, "nuplan_train", "log-1")
    assert skipped == 1 and len(drive.category) == 1 and drive.scene(0).occupied.any()


def test_plan_keeps_training_logs_apart(tmp_path):
    for split in ("nuplan_train", "nuplan_val"):
        folder = write_log(tmp_path, [], [], "NuPlanBoxDetectionLabel", split)
        folder.rename(folder.with_name(f"log-{split}"))
    tasks = plan_py123d(str(tmp_path))
    assert [(task.split, task.parts[0].sequence) for task in tasks] == [
        ("train", "log-nuplan_train"), ("test", "log-nuplan_val")]  # fmt: skip
    (tmp_path / "logs/nuplan_val/log-nuplan_val").rename(tmp_path / "logs/nuplan_val/log-nuplan_train")
    with pytest.raises(ValueError, match="two splits hold a log log-nuplan_train"):
        plan_py123d(str(tmp_path))
    with pytest.raises(ValueError, match=r"--input must name the directory into which py123d-conversion wrote"):
        plan_py123d(str(tmp_path / "maps"))


def test_label_classes_name_known_categories():
    for labels in py123d.LABELS.values():
        assert set(filter(None, labels.values())) <= set(CATEGORY_INDEX)
    ours = {label: CATEGORIES[k] for label, k in argoverse2.CATEGORY_OF.items()}
    assert py123d.LABELS["AV2SensorBoxDetectionLabel"] == ours


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("box_detections_se3", lambda path: path.write_bytes(path.read_bytes()[:200]), "broken Arrow file"),
        ("ego_state_se3", lambda path: path.write_bytes(b""), "broken Arrow file"),
        ("map", lambda path: path.unlink(), r"nuplan_us-ma-boston\.arrow is missing"),
    ],
)
def test_damaged_file_of_log_is_named(tmp_path, name, damage, message):
    folder = write_log(tmp_path, [], [], "NuPlanBoxDetectionLabel")
    damage(folder / f"{name}.arrow")
    with pytest.raises(ValueError, match=message) as error:
        py123d.read_drive(tmp_path, "nuplan_train", "log-1")
    assert f"{name}.arrow" in str(error.value) or name == "map"


@pytest.mark.parametrize(
    ("boxes", "labels", "classes", "message"),
    [
        ([make_box(20, 0, (4.5, 1.9, 1.6))], [7], "NuPlanBoxDetectionLabel", "label 7 of NuPlan"),
        ([make_box(np.nan, 0, (4.5, 1.9, 1.6))], [0], "NuPlanBoxDetectionLabel", "coordinate of a box nan"),
        ([make_box(20, 0, (4.5, 0.0, 1.6))], [0], "NuPlanBoxDetectionLabel", "size of a box 0"),
        ([make_box(20, 0, (4.5, 1.9, 1.6))], [0, 0], "NuPlanBoxDetectionLabel", "another number of boxes"),
        ([make_box(20, 0, (4.5, 1.9, 1.6))], [0], "OtherLabel", "unknown label class 'OtherLabel'"),
    ],
)
def test_bad_boxes_are_refused(tmp_path, boxes, labels, classes, message):
    write_log(tmp_path, boxes, labels, classes)
    with pytest.raises(ValueError, match=message):
        py123d.read_drive(tmp_path, "nuplan_train", "log-1")


def test_boxes_without_a_pose_are_refused(tmp_path):
    folder = write_log(tmp_path, [make_box(20, 0, (4.5, 1.9, 1.6))], [0], "NuPlanBoxDetectionLabel")
    path = folder / "ego_state_se3.arrow"
    table = pa.ipc.open_file(str(path)).read_all()
    late = table.set_column(0, "ego_state_se3.timestamp_us", pa.array([9_000_000, 9_500_000]))
    with pa.ipc.new_file(str(path), late.schema) as writer:
        writer.write_table(late)
    with pytest.raises(ValueError, match="no pose within 60 ms of the boxes at 1010000"):
        py123d.read_drive(tmp_path, "nuplan_train", "log-1")
