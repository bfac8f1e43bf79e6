"""Read KITTI-360's original files as a Drive: the 3D boxes and ground polygons of a sequence (XML), and the poses.

    ROOT/data_3d_bboxes/train_full/2013_05_28_drive_0003_sync.xml
    ROOT/data_poses/2013_05_28_drive_0003_sync/poses.txt

The name of a sequence is its four digits. The z axis of the world frame points up. The axes of the IMU are x forward, y
right and z down. The XML file (over 100 MB for the longest drives) is streamed. The reader skips and reports defective
objects. The reader raises ValueError if the file itself is invalid.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from os import PathLike
from typing import BinaryIO

import numpy as np
from defusedxml import ElementTree
from defusedxml.common import DefusedXmlException

from models.limits import LimitError, require_within
from models.scene import CATEGORY_INDEX, KITTI_GROUND_CLASSES
from pipelines.preprocess.sources.drive import STATIC, Drive, SlabGround
from pipelines.preprocess.sources.files import read_file
from pipelines.preprocess.sources.input_paths import InputPath, find_local_file, make_input_path

SOURCE = "kitti360"

# Labels of each category, from the paper's table "object categories". `_convert_to_plain` converts labels to lower case
# and removes blanks and underscores. "trafficSign" in the XML and "traffic sign" in the development kit are therefore
# the same label.
CATEGORY_LABELS = {
    "vegetation_cuboid": ("vegetation",),  # A sphere mesh becomes vegetation_ellipsoid.
    "vehicle_big": ("truck", "bus"),
    "vehicle_small": ("car", "trailer", "unknownvehicle"),
    "two_wheelers": ("motorcycle", "bicycle"),
    "human": ("rider", "pedestrian", "person"),
    "construction_big": ("building", "garage", "unknownconstruction"),
    "construction_small": ("wall", "fence", "guardrail", "gate"),
    "pole": ("smallpole", "bigpole", "pole", "polegroup"),
    "traffic_control": ("trafficlight", "trafficsign", "lamp"),
    "object": ("trashbin", "box", "unknownobject"),
}
# The XML uses other names: "ground" means terrain, "unknownGround" means ground, and "driveway" means parking.
GROUND_LABELS = {
    "road": ("road",),
    "sidewalk": ("sidewalk",),
    "parking": ("driveway", "parking"),
    "terrain": ("ground", "terrain"),
    "ground": ("unknownground",),
}
# The paper drops the first five labels and does not mention the other four.
DROPPED_LABELS = (
    "tunnel",
    "bridge",
    "train",
    "stop",
    "caravan",
    "vendingmachine",
    "railtrack",
    "sky",
    "licenseplate",
)

CATEGORY_OF = {label: CATEGORY_INDEX[name] for name, labels in CATEGORY_LABELS.items() for label in labels}
GROUND_CLASS_OF = {
    label: KITTI_GROUND_CLASSES.index(name) for name, labels in GROUND_LABELS.items() for label in labels
}
# The local +x axis is the direction of travel for these labels.
HEADED_LABELS = {label for name in ("vehicle_big", "vehicle_small", "two_wheelers") for label in CATEGORY_LABELS[name]}
HEADED_LABELS |= {"rider"}

SPHERE_VERTICES = 63
# Some objects occur twice, in two adjacent annotation windows. The sizes of the two copies agree to a micrometre. The
# windows were registered separately. The poses of the copies therefore differ by up to 0.4 m and 0.33 degrees. If the
# shift exceeds DUPLICATE_SHIFT_M or half the size of the object, the two objects are not copies.
DUPLICATE_SIZE_M = 1e-3
DUPLICATE_SHIFT_M = 0.5
DUPLICATE_TURN_RAD = 0.01
MAX_COORDINATE_M = 1e5  # Largest valid coordinate; the real world frame spans several km.
MAX_SIZE_M = 1e3
MIN_SIZE_M = 1e-3
# Minimum singular value of the unit axes. If the angle between two axes is smaller than about 40 degrees, the box is
# invalid.
MIN_SINGULAR = 0.5

# Limits of a file. Real objects have up to about 20 elements, and their longest text has some kilobytes.
MAX_TOKEN_BYTES = 2**22  # Bytes of a tag or of a text between two tags.
MAX_OBJECT_ELEMENTS = 1_000
MAX_DEFECTS = 10_000
MAX_LABELS = 1_000  # Different labels without a category.
MAX_NEIGHBOURS = 100  # Different objects of a label and a frame with their centre in the same cubic metre.
MAX_LINE_LETTERS = 1_000  # Letters of a line of poses.txt.
LINE_ENDS = (b"\n", b"\r", b"\v", b"\f", b"\x1c", b"\x1d", b"\x1e")

SEQUENCE_NAME = re.compile(r"2013_05_28_drive_(\d{4})_sync")


@dataclass(frozen=True)
class Defect:
    """An object that cannot be read, with the reason.

    Attributes:
        index: The object's <index> in the XML, -1 if absent.
        label: Label in the XML.
        reason: Fault of the object.
    """

    index: int
    label: str
    reason: str


@dataclass(frozen=True)
class ReadReport:
    """Number of objects in one XML file that were read or dropped, by reason.

    `objects` is the sum of boxes, slabs and all dropped objects.

    Attributes:
        dropped: Number of objects for each known label without a category.
        unknown: Number of objects for each label that is in none of the tables.
        duplicates: Number of duplicate objects that were dropped.
        defects: Objects that cannot be read.
    """

    objects: int
    boxes: int
    slabs: int
    dropped: dict[str, int]
    unknown: dict[str, int]
    duplicates: int
    defects: tuple[Defect, ...]

    def summary(self) -> str:
        """Return one line for a log."""
        parts = [f"{self.objects} objects: {self.boxes} boxes, {self.slabs} ground slabs"]
        parts += [f"{self.duplicates} duplicates dropped"] if self.duplicates else []
        parts += [f"dropped labels {_count_labels(self.dropped)}"] if self.dropped else []
        parts += [f"unknown labels {_count_labels(self.unknown)}"] if self.unknown else []
        if self.defects:
            first = self.defects[0]
            parts += [f"{len(self.defects)} defective, first object {first.index} ({first.label}): {first.reason}"]
        return "; ".join(parts)


def list_sequences(root: str | PathLike) -> list[str]:
    """Return the annotated sequences.

    A sequence without poses is included; `read_poses` raises an error for it.

    Args:
        root: Directory of KITTI-360.

    Returns:
        Four digits of each sequence, in ascending order.

    Raises:
        ValueError: No sequence exists, or no sequence has poses.
    """
    folder = make_input_path(root, "data_3d_bboxes", "train_full")
    names = sorted(match[1] for path in folder.glob("*.xml") if (match := SEQUENCE_NAME.fullmatch(path.stem)))
    if not names:
        raise ValueError(
            f"{folder} holds no 2013_05_28_drive_NNNN_sync.xml; --input must name the KITTI-360 folder that"
            " holds data_3d_bboxes and data_poses"
        )
    if not any(_make_poses_path(root, name).is_file() for name in names):
        raise ValueError(
            f"{_make_poses_path(root, names[0])} is missing, but sequence {names[0]} is annotated; unpack KITTI-360's"
            " data_poses.zip here"
        )
    return names


def read_drive(root: str | PathLike, sequence: str) -> tuple[Drive, ReadReport]:
    """Read all annotations along one sequence.

    For a moving object, `instance_id` is the track number (dynamicSeq). For a static object, it is the index in the
    file. Moving and static objects are numbered separately. `timestamp` is the frame of a moving box, or STATIC.

    Args:
        root: Directory of KITTI-360.
        sequence: Four digits of the sequence.

    Returns:
        The drive in the world frame (float64), and a report on dropped objects.

    Raises:
        ValueError: The XML or poses file is missing or invalid; the message names the file.
    """
    frame, world_from_imu = read_poses(root, sequence)
    boxes, slabs, report = _read_objects(_make_boxes_path(root, sequence))
    drive = Drive(
        source=SOURCE,
        sequence=sequence,
        **_stack_boxes(boxes),
        ground_classes=KITTI_GROUND_CLASSES,
        ground=_stack_slabs(slabs),
        frame=frame,
        world_from_imu=world_from_imu,
    )
    return drive, report


def _read_objects(path: InputPath) -> tuple[list[_Box], list[_Slab], ReadReport]:
    """Return the boxes and slabs of one XML file, and a report on dropped objects.

    Boxes and slabs have the order of the file. Duplicates are dropped.
    """
    boxes: list[_Box] = []
    slabs: list[_Slab] = []
    seen: dict[tuple, list[np.ndarray]] = {}
    dropped, unknown, duplicates, defects = Counter(), Counter(), 0, []
    for number, fields in enumerate(_stream_objects(path), 1):
        require_within("table_rows", number, str(path), is_partial=True)
        if len(defects) > MAX_DEFECTS or len(unknown) > MAX_LABELS:
            raise ValueError(
                f"{path}: more than {MAX_DEFECTS:,} objects are defective, such as object {defects[0].index} "
                f"({defects[0].reason})"
                if len(defects) > MAX_DEFECTS
                else f"{path}: more than {MAX_LABELS:,} labels are unknown, such as {next(iter(unknown))!r}"
            )
        label = _read_label(fields)
        plain = _convert_to_plain(label)
        if not plain:
            defects.append(Defect(_read_index(fields), label, "no label"))
            continue
        if plain in DROPPED_LABELS:
            dropped[label] += 1
            continue
        if plain not in CATEGORY_OF and plain not in GROUND_CLASS_OF:
            unknown[label] += 1
            continue
        try:
            parsed = _parse_slab(fields, plain) if plain in GROUND_CLASS_OF else _parse_box(fields, label)
        except DefectiveObject as error:
            defects.append(Defect(_read_index(fields), label, str(error)))
            continue
        try:
            is_copy = _find_copies(seen, (plain, parsed.timestamp), parsed.vertices_m)
        except DefectiveObject as error:
            defects.append(Defect(_read_index(fields), label, str(error)))
            continue
        if is_copy:
            duplicates += 1
        elif isinstance(parsed, _Box):
            boxes.append(parsed)
        else:
            slabs.append(parsed)
    objects = len(boxes) + len(slabs) + dropped.total() + unknown.total() + duplicates + len(defects)
    report = ReadReport(objects, len(boxes), len(slabs), dict(dropped), dict(unknown), duplicates, tuple(defects))
    if objects == 0:
        raise ValueError(f"{path} holds no <objectN>; unpack data_3d_bboxes.zip of KITTI-360 again")
    return boxes, slabs, report


# ------------------------------------------------------------------------------------------------------ poses


def _make_boxes_path(root: str | PathLike, sequence: str) -> InputPath:
    return make_input_path(root, "data_3d_bboxes", "train_full") / f"2013_05_28_drive_{sequence}_sync.xml"


def _make_poses_path(root: str | PathLike, sequence: str) -> InputPath:
    return make_input_path(root, "data_poses") / f"2013_05_28_drive_{sequence}_sync" / "poses.txt"


def read_poses(root: str | PathLike, sequence: str) -> tuple[np.ndarray, np.ndarray]:
    """Read the poses of one sequence.

    The file omits frames in which the car hardly moves.

    Args:
        root: Directory of KITTI-360.
        sequence: Four digits of the sequence.

    Returns:
        frame (p,) int64, ascending; and world_from_imu (p, 3, 4) float64 (m).

    Raises:
        ValueError: The file is missing, or a line is not a valid pose; the message names file and line.
    """
    path = _make_poses_path(root, sequence)
    content = read_file(path, "unpack data_poses.zip of KITTI-360 here")
    require_within("table_rows", sum(map(content.count, LINE_ENDS)), str(path))
    text = content.decode("ascii", "replace")
    frame, rows = [], []
    for number, line in enumerate(text.splitlines(), 1):
        if len(line) > MAX_LINE_LETTERS:
            raise ValueError(f"{path}, line {number}: {len(line):,} letters, expected a frame and 12 numbers")
        words = line.split()
        if not words:
            continue
        if len(words) != 13:
            raise ValueError(
                f"{path}, line {number}: {len(words)} numbers, expected a frame and 12; the line may be truncated"
            )
        if not words[0].isdecimal() or len(words[0]) > 18:
            raise ValueError(f"{path}, line {number}: frame {words[0]!r} is not a whole number")
        row = _read_floats(words[1:])
        if row is None or np.abs(row).max() > MAX_COORDINATE_M:
            raise ValueError(f"{path}, line {number}: {line.strip()[:80]!r} is not a pose; restore the line")
        if frame and int(words[0]) <= frame[-1]:
            raise ValueError(f"{path}, line {number}: frame {words[0]} follows frame {frame[-1]}; sort the lines")
        frame.append(int(words[0]))
        rows.append(row)
    if not rows:
        raise ValueError(f"{path} holds no pose; unpack data_poses.zip of KITTI-360 again")
    world_from_imu = np.array(rows).reshape(-1, 3, 4)
    rotation = world_from_imu[:, :, :3]
    skew = np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero((skew > 1e-2) | (np.linalg.det(rotation) < 0))
    if len(bad):
        raise ValueError(f"{path}: the matrix of frame {frame[bad[0]]} is no rotation; restore the line")
    if not text.endswith(("\n", "\r")):  # If the file is cut off within its last number, the last pose is wrong.
        raise ValueError(
            f"{path}: line {number} has no line end, so the file may be truncated; unpack data_poses.zip again"
        )
    return np.array(frame, np.int64), world_from_imu


# -------------------------------------------------------------------------------------------------------- XML


class _BoundedStream:
    """Binary stream for the XML parser that refuses tags and texts of more than MAX_TOKEN_BYTES bytes."""

    def __init__(self, file: BinaryIO) -> None:
        self.file, self.since_tag = file, 0

    def read(self, count: int = -1) -> bytes:
        """Return the next bytes."""
        part = self.file.read(count)
        end = part.rfind(b">")
        self.since_tag = self.since_tag + len(part) if end < 0 else len(part) - end - 1
        if self.since_tag > MAX_TOKEN_BYTES:
            raise ValueError(f"a tag or a text has more than {MAX_TOKEN_BYTES:,} bytes")
        return part


def _stream_objects(path: InputPath) -> Iterator[dict]:
    """Yield the fields of each <objectN> as a map from tag to element, and free the previous elements.

    The function raises ValueError for a missing or malformed file. The function also rejects files with a document type
    declaration, because entity bombs need such a declaration.
    """
    again = "unpack data_3d_bboxes.zip of KITTI-360 again"
    try:
        local = find_local_file(path)
        if local.exists() and not local.is_file():  # Reading a named pipe would never end.
            raise ValueError("no regular file")
        with open(local, "rb") as file:
            require_within("json_bytes", local.stat().st_size)
            depth = elements = 0
            for event, element in ElementTree.iterparse(_BoundedStream(file), ("start", "end"), forbid_dtd=True):
                depth += 1 if event == "start" else -1
                elements += event == "start"
                if elements > MAX_OBJECT_ELEMENTS:
                    raise ValueError(f"an object has more than {MAX_OBJECT_ELEMENTS:,} elements")
                if event == "start" and depth == 1:
                    root = element
                    if root.tag != "opencv_storage":
                        raise ElementTree.ParseError(f"the root is <{root.tag[:40]}>, expected <opencv_storage>")
                elif event == "end" and depth == 1:
                    elements = 0
                    yield {child.tag: child for child in element}
                    root.clear()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror}); {again}") from error
    except LimitError as error:
        raise LimitError(f"{path}: {error}") from error
    except DefusedXmlException as error:
        raise ValueError(
            f"{path} declares a document type or entities, which files of KITTI-360 never do; {again}"
        ) from error
    # Invalid encodings raise LookupError or ValueError.
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise ValueError(f"{path}: broken XML ({error}); {again}") from error


class DefectiveObject(ValueError):
    """Error for one object that cannot be read; the message gives the reason."""


def _read_text(fields: dict, tag: str, default: str | None = None) -> str:
    text = (fields[tag].text or "").strip() if tag in fields else ""
    if text:
        return text
    if default is None:
        raise DefectiveObject(f"no {tag}")
    return default


def _read_label(fields: dict) -> str:
    """Return the label of an object as in the file, or "" if the object has no label."""
    return " ".join(_read_text(fields, "label", " ").split())[:40]


def _read_integer(fields: dict, tag: str) -> int:
    text = _read_text(fields, tag)
    if not re.fullmatch(r"-?\d{1,18}", text):
        raise DefectiveObject(f"{tag} is {text[:20]!r}, which is not a whole number")
    return int(text)


def _read_index(fields: dict) -> int:
    """Return the <index> of an object, or -1 if it has no index."""
    try:
        return _read_integer(fields, "index")
    except DefectiveObject:
        return -1


def _read_floats(words: list[str]) -> np.ndarray | None:
    """Return n words as (n,) float64, or None if a word is not a finite number."""
    try:
        values = np.array(words, np.float64)
    except ValueError:
        return None
    return values if np.isfinite(values).all() else None


def _read_matrix(fields: dict, tag: str, cols: int) -> np.ndarray:
    """Return an OpenCV matrix (rows, cols) as float64."""
    if tag not in fields:
        raise DefectiveObject(f"no {tag}")
    parts = {child.tag: child for child in fields[tag]}
    rows, stated_cols = _read_integer(parts, "rows"), _read_integer(parts, "cols")
    words = _read_text(parts, "data", " ").split()
    if stated_cols != cols or rows * cols != len(words):
        raise DefectiveObject(f"{tag} is {rows} x {stated_cols} with {len(words)} numbers, expected n x {cols}")
    values = _read_floats(words)
    if values is None:
        raise DefectiveObject(f"{tag} contains a value that is not a finite number")
    return values.reshape(rows, cols)


def _read_vertices_and_transform(fields: dict) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return local vertices (v, 3), world_from_local (4, 4) and world vertices (v, 3).

    All three arrays are float64 (m).
    """
    world_from_local = _read_matrix(fields, "transform", 4)
    if world_from_local.shape != (4, 4) or np.abs(world_from_local[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise DefectiveObject("transform is not an affine 4 x 4 matrix")
    vertices = _read_matrix(fields, "vertices", 3)
    if len(vertices) < 6:
        raise DefectiveObject(f"{len(vertices)} vertices are no solid")
    largest = max(np.abs(world_from_local).max(), np.abs(vertices).max())
    if largest > MAX_COORDINATE_M:
        raise DefectiveObject(f"transform or vertices hold {largest:.3g}")
    vertices_m = vertices @ world_from_local[:3, :3].T + world_from_local[:3, 3]
    if np.abs(vertices_m).max() > MAX_COORDINATE_M:
        raise DefectiveObject(f"lies {np.abs(vertices_m).max():.3g} m from the world's origin")
    return vertices, world_from_local, vertices_m


# ------------------------------------------------------------------------------------------------------ boxes


@dataclass(frozen=True, eq=False)
class _Box:
    category: int
    label: str
    center_m: np.ndarray
    rotation: np.ndarray
    size_m: np.ndarray
    heading_rad: float
    instance_id: int
    timestamp: int
    vertices_m: np.ndarray


def _parse_box(fields: dict, label: str) -> _Box:
    vertices, world_from_local, vertices_m = _read_vertices_and_transform(fields)
    center_m, rotation, size_m = compute_box_geometry(world_from_local, vertices)
    category = CATEGORY_OF[_convert_to_plain(label)]
    if category == CATEGORY_INDEX["vegetation_cuboid"] and len(vertices) == SPHERE_VERTICES:
        category = CATEGORY_INDEX["vegetation_ellipsoid"]
    timestamp = _read_integer(fields, "timestamp")
    if timestamp < STATIC:
        raise DefectiveObject(f"timestamp is {timestamp}, expected a frame or -1")
    instance_id = _read_integer(fields, "index" if timestamp == STATIC else "dynamicSeq")
    lies_flat = np.abs(rotation[2, 0]) < np.sqrt(0.5)
    headed = _convert_to_plain(label) in HEADED_LABELS and lies_flat
    heading_rad = float(np.arctan2(rotation[1, 0], rotation[0, 0])) if headed else np.nan
    return _Box(category, label, center_m, rotation, size_m, heading_rad, instance_id, timestamp, vertices_m)


def compute_box_geometry(
    world_from_local: np.ndarray, vertices: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute centre, rotation and size of a box or ellipsoid mesh under an affine transform.

    For a mirrored transform, the y axis of the box is flipped. The x axis is kept, because it may be the heading. If
    the transform is sheared, the rotation is the nearest rotation (polar factor of the unit axes), and the sizes are
    the lengths of the axes.

    Args:
        world_from_local: (4, 4) transform.
        vertices: (v, 3) local vertices. The function uses only the extent of the mesh: 1 for the unit cube, 2 for the
            sphere of radius 1.

    Returns:
        center_m (3,), proper rotation (3, 3) and full size_m (3,) in the world frame.

    Raises:
        DefectiveObject: The box has zero volume or an implausible size, or two axes are nearly parallel.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    axes_m = world_from_local[:3, :3] * (high - low)
    center_m = world_from_local[:3, :3] @ ((low + high) / 2) + world_from_local[:3, 3]
    size_m = np.linalg.norm(axes_m, axis=0)
    if size_m.min() < MIN_SIZE_M or size_m.max() > MAX_SIZE_M:
        raise DefectiveObject(f"size is {' x '.join(f'{s:.3g}' for s in size_m)} m")
    axes = axes_m / size_m
    if np.linalg.det(axes) < 0:
        axes[:, 1] *= -1
    left, singular, right = np.linalg.svd(axes)
    if singular.min() < MIN_SINGULAR:
        raise DefectiveObject(f"sheared flat: smallest singular value of its unit axes is {singular.min():.2g}")
    return center_m, left @ right, size_m


def _stack_boxes(boxes: list[_Box]) -> dict[str, np.ndarray]:
    """Return the per-box arrays of a Drive."""
    n = len(boxes)
    return {
        "category": np.array([box.category for box in boxes], np.int8),
        "center_m": np.array([box.center_m for box in boxes]).reshape(n, 3),
        "rotation": np.array([box.rotation for box in boxes]).reshape(n, 3, 3),
        "size_m": np.array([box.size_m for box in boxes]).reshape(n, 3),
        "heading_rad": np.array([box.heading_rad for box in boxes], np.float64),
        "instance_id": np.array([box.instance_id for box in boxes], np.int64),
        "label": np.array([box.label for box in boxes], object),
        "timestamp": np.array([box.timestamp for box in boxes], np.int64),
    }


# ----------------------------------------------------------------------------------------------------- ground


@dataclass(frozen=True, eq=False)
class _Slab:
    ground_class: int
    timestamp: int  # always STATIC
    vertices_m: np.ndarray
    triangles: np.ndarray


def _parse_slab(fields: dict, plain: str) -> _Slab:
    _, _, vertices_m = _read_vertices_and_transform(fields)
    extent_m = np.ptp(vertices_m, axis=0).max()
    if extent_m > MAX_SIZE_M:
        raise DefectiveObject(f"ground slab of {extent_m:.3g} m")
    triangles = _read_matrix(fields, "faces", 3)
    if len(triangles) == 0:
        raise DefectiveObject("no faces")
    if (triangles % 1).any() or triangles.min() < 0 or triangles.max() >= len(vertices_m):
        raise DefectiveObject(f"faces name vertices other than 0..{len(vertices_m) - 1}")
    return _Slab(GROUND_CLASS_OF[plain], STATIC, vertices_m, triangles.astype(np.int64))


def _stack_slabs(slabs: list[_Slab]) -> SlabGround:
    """Return all slabs as one SlabGround."""
    counts = np.array([len(slab.vertices_m) for slab in slabs], np.int64)
    first = np.cumsum(counts) - counts
    no_triangles = np.zeros((0, 3), np.int64)
    return SlabGround(
        slab_class=np.array([slab.ground_class for slab in slabs], np.int64),
        vertices_m=np.concatenate([np.zeros((0, 3)), *[slab.vertices_m for slab in slabs]]),
        vertex_slab=np.repeat(np.arange(len(slabs)), counts),
        triangles=np.concatenate([no_triangles, *[s.triangles + f for s, f in zip(slabs, first, strict=True)]]),
    )


# ---------------------------------------------------------------------------------------------- small helpers


def _find_copies(seen: dict[tuple, list[np.ndarray]], key: tuple, vertices_m: np.ndarray) -> bool:
    """Return whether `seen` contains a copy of this object at nearly the same position.

    If not, add the object to `seen`.
    """
    center_m = vertices_m.mean(axis=0)
    low, high = (np.floor(center_m + s).tolist() for s in (-DUPLICATE_SHIFT_M, DUPLICATE_SHIFT_M))
    for cell in product(*({a, b} for a, b in zip(low, high, strict=True))):
        if len(seen.get((key, cell), ())) > MAX_NEIGHBOURS:
            raise DefectiveObject(f"more than {MAX_NEIGHBOURS} other objects of this label lie in the same place")
        if any(_is_copy(other_m, vertices_m) for other_m in seen.get((key, cell), ())):
            return True
    seen.setdefault((key, tuple(np.floor(center_m).tolist())), []).append(vertices_m)
    return False


def _is_copy(one_m: np.ndarray, other_m: np.ndarray) -> bool:
    """Return whether two vertex lists (v, 3) are copies of one rigid shape at nearly the same position."""
    if one_m.shape != other_m.shape:
        return False
    center_m, other_center_m = one_m.mean(axis=0), other_m.mean(axis=0)
    shift_m = other_center_m - center_m
    one_m, other_m = one_m - center_m, other_m - other_center_m
    radius_m, other_radius_m = np.linalg.norm(one_m, axis=1), np.linalg.norm(other_m, axis=1)
    turn_m = np.linalg.norm(one_m - other_m, axis=1)
    return bool(
        (np.abs(radius_m - other_radius_m) <= DUPLICATE_SIZE_M).all()
        and (turn_m <= DUPLICATE_TURN_RAD * radius_m + DUPLICATE_SIZE_M).all()
        and np.linalg.norm(shift_m) <= DUPLICATE_SHIFT_M
        and shift_m @ shift_m <= np.ptp(one_m @ shift_m) / 2
    )


def _convert_to_plain(label: str) -> str:
    return label.replace(" ", "").replace("_", "").lower()


def _count_labels(counts: dict[str, int]) -> str:
    return ", ".join(f"{label} {count}" for label, count in sorted(counts.items()))
