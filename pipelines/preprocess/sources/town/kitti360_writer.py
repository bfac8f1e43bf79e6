"""Write a Drive in KITTI-360's file format, including typical defects.

The reader can then be tested without the dataset.

    ROOT/data_3d_bboxes/train_full/2013_05_28_drive_0007_sync.xml
    ROOT/data_poses/2013_05_28_drive_0007_sync/poses.txt

The reader returns the same drive from these files. Mirrored boxes are equivalent to the original boxes, and duplicates
are exact copies.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from models.scene import ELLIPSOID
from pipelines.preprocess.sources.drive import STATIC, Drive, SlabGround

WINDOW_POSES = 20  # Number of poses per annotation window. With one pose every 10 m, a window covers about 200 m.
# Name of each ground class in the XML: "ground" means terrain, and "unknownGround" means ground.
XML_GROUND = {
    "road": "road",
    "sidewalk": "sidewalk",
    "parking": "driveway",
    "terrain": "ground",
    "ground": "unknownGround",
}
# Labels without a category. The writer inserts objects with these labels at random positions.
STRAY_LABELS = ("stop", "caravan", "sky", "vendingmachine", "railtrack", "train")

BOX_VERTICES = np.array(
    [
        [0.5, 0.5, 0.5],
        [0.5, 0.5, -0.5],
        [0.5, -0.5, 0.5],
        [0.5, -0.5, -0.5],
        [-0.5, 0.5, -0.5],
        [-0.5, 0.5, 0.5],
        [-0.5, -0.5, -0.5],
        [-0.5, -0.5, 0.5],
    ]
)
BOX_FACES = np.array(
    [
        *([0, 2, 1], [2, 3, 1], [4, 6, 5], [6, 7, 5], [4, 5, 1], [5, 0, 1]),
        *([7, 6, 2], [6, 3, 2], [5, 7, 0], [7, 2, 0], [1, 3, 4], [3, 6, 4]),
    ]
)


def make_sphere_mesh() -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (63, 3) and faces (80, 3) of the unit sphere.

    The mesh has 7 rows from pole to pole (y axis) and 9 columns. The first column equals the last column.
    """
    row, column = np.meshgrid(np.arange(7) * np.pi / 6, np.arange(9) * np.pi / 4, indexing="ij")
    vertices = np.stack([-np.sin(row) * np.cos(column), np.cos(row), np.sin(row) * np.sin(column)], axis=-1)
    faces = [[k + 1, 9 + k, 10 + k] for k in range(8)]
    for r in range(1, 5):
        for a in range(9 * r, 9 * r + 8):
            faces += [[a + 1, a, a + 10], [a, a + 9, a + 10]]
    faces += [[45 + k + 1, 45 + k, 54 + k] for k in range(8)]
    return vertices.reshape(-1, 3), np.array(faces)


def write_kitti360(drive: Drive, root: str | Path, defects: bool = True, seed: int = 0) -> None:
    """Write the XML file and poses.txt of one drive.

    The sequence number is int(drive.sequence) % 10000.

    Args:
        drive: Drive whose ground is a SlabGround.
        root: Directory in KITTI-360's layout.
        defects: Whether to add the defects of KITTI-360's files: mirrored and slightly sheared boxes, duplicate objects
        at borders of annotation windows, empty plane matrices, labels without a category, and random order of fields
        and objects.
        seed: Seed of the defects.

    Raises:
        ValueError: The ground of the drive is not a SlabGround.
    """
    ground = drive.ground
    if not isinstance(ground, SlabGround):
        raise ValueError(f"drive {drive.sequence} has no slab ground; KITTI-360's format supports only slabs")
    rng = np.random.default_rng([7302, seed])
    name = f"2013_05_28_drive_{int(drive.sequence) % 10_000:04d}_sync"
    boxes, poses = Path(root) / "data_3d_bboxes" / "train_full", Path(root) / "data_poses" / name
    slabs = _write_slabs(ground)
    boxes.mkdir(parents=True, exist_ok=True)
    poses.mkdir(parents=True, exist_ok=True)

    box_windows = _list_windows(drive, drive.center_m)
    slab_windows = _list_windows(drive, np.array([slab[0].mean(axis=0) for slab in slabs]))
    sphere, box = make_sphere_mesh(), (BOX_VERTICES, BOX_FACES)
    objects, twice = [], []
    for k in range(len(drive.category)):
        static = drive.timestamp[k] == STATIC
        round_ = drive.category[k] == ELLIPSOID
        fields = _write_head(drive, str(drive.label[k]), "instance", k, box_windows[k][0])
        fields["transform"] = _write_matrix(_transform(drive, k, 0.5 if round_ else 1.0, rng if defects else None))
        fields |= _write_mesh("", *(sphere if round_ else box)) | _write_mesh("_plane")
        fields["transform_plane"] = _write_matrix(None)
        objects.append((int(drive.instance_id[k]) if static else len(drive.category) + k, fields))
        if defects and static and len(box_windows[k]) > 1 and rng.random() < 0.5:
            twice.append(fields | _write_window(drive, box_windows[k][1]))
    for k, (vertices, faces) in enumerate(slabs):
        label = XML_GROUND[drive.ground_classes[ground.slab_class[k]]]
        fields = _write_head(drive, label, "stuff", None, slab_windows[k][0]) | _write_slab(vertices, faces)
        if defects and rng.random() < 0.1:
            fields |= _write_mesh("_plane") | {"transform_plane": _write_matrix(None)}
        objects.append((2 * len(drive.category) + k, fields))
        if defects and len(slab_windows[k]) > 1 and rng.random() < 0.5:
            twice.append(fields | _write_window(drive, slab_windows[k][1]))
    after = 2 * len(drive.category) + len(slabs)
    if defects:
        for label in rng.choice(STRAY_LABELS, 12):
            like = objects[rng.integers(len(drive.category))][1]
            objects.append((after, like | {"label": str(label)}))
            after += 1
        objects = [objects[k] for k in rng.permutation(len(objects))]
    objects += [(after + k, fields) for k, fields in enumerate(twice)]

    with open(boxes / f"{name}.xml", "w", encoding="ascii") as file:
        file.write('<?xml version="1.0"?>\n<opencv_storage>\n')
        for number, (index, fields) in enumerate(objects, 1):
            items = [_write_element(tag, content) for tag, content in ({"index": str(index)} | fields).items()]
            if defects and rng.random() < 0.2:
                items = [items[k] for k in rng.permutation(len(items))]
            file.write(f"<object{number}>\n" + "\n".join(items) + f"\n</object{number}>\n")
        file.write("</opencv_storage>\n")
    lines = [
        " ".join([str(int(frame)), *(f"{value:.10e}" for value in matrix.ravel())])
        for frame, matrix in zip(drive.frame, drive.world_from_imu, strict=True)
    ]
    (poses / "poses.txt").write_text("\n".join(lines) + "\n", encoding="ascii")


def _list_windows(drive: Drive, points_m: np.ndarray) -> list[list[int]]:
    """Return the annotation windows of each object.

    An object belongs to the window of its nearest pose and, near a border, also to the next window.
    """
    poses = drive.world_from_imu[:, :2, 3]
    found = []
    for point in points_m[:, :2]:
        pose = int(np.square(poses - point).sum(axis=1).argmin())
        window, within = divmod(pose, WINDOW_POSES)
        meets = within == WINDOW_POSES - 1 and pose + 1 < len(poses)
        found.append([window, window + 1] if meets else [window])
    return found


def _write_window(drive: Drive, window: int) -> dict[str, str]:
    last = min(len(drive) - 1, (window + 1) * WINDOW_POSES - 1)
    return {"start_frame": str(drive.frame[window * WINDOW_POSES]), "end_frame": str(drive.frame[last])}


def _write_head(drive: Drive, label: str, category: str, box: int | None, window: int) -> dict[str, str]:
    moving = box is not None and drive.timestamp[box] != STATIC
    return {
        "label": label,
        "category": category,
        "level_min": "0.",
        "level_max": "10.",
        "dynamic": str(int(moving)),
        "dynamicSeq": str(drive.instance_id[box]) if moving else "-1",
        "dynamicIdx": str(box) if moving else "-1",
        "timestamp": str(drive.timestamp[box]) if moving else "-1",
        **_write_window(drive, window),
    }


def _transform(drive: Drive, k: int, scale: float, rng: np.random.Generator | None) -> np.ndarray:
    """Return world_from_mesh (4, 4) of the unit mesh.

    If a random generator is given, a few transforms are mirrored, or sheared by less than 1 mm.
    """
    matrix = np.eye(4)
    matrix[:3, :3] = drive.rotation[k] * drive.size_m[k] * scale
    matrix[:3, 3] = drive.center_m[k]
    if rng is not None and rng.random() < 0.05:
        matrix[:3, int(rng.integers(1, 3))] *= -1  # The first axis is not mirrored, because it may be a heading.
    if rng is not None and rng.random() < 0.05:
        matrix[:3, :3] += rng.normal(0, 1e-4, (3, 3)) * drive.size_m[k].min() * scale
    return matrix


def _write_slabs(ground: SlabGround) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return vertices (2 n, 3) and faces (4 n - 4, 3) of each slab. The n top vertices come first."""
    first = np.searchsorted(ground.vertex_slab, np.arange(len(ground.slab_class) + 1))
    owner = ground.vertex_slab[ground.triangles[:, 0]]
    at = np.searchsorted(owner, np.arange(len(ground.slab_class) + 1))
    return [
        (ground.vertices_m[first[k] : first[k + 1]], ground.triangles[at[k] : at[k + 1]] - first[k])
        for k in range(len(ground.slab_class))
    ]


def _write_slab(vertices: np.ndarray, faces: np.ndarray) -> dict[str, str]:
    """Write a slab and its mid-plane relative to the slab's centre. The mid-plane is the real surface."""
    n = len(vertices) // 2
    matrix = np.eye(4)
    matrix[:3, 3] = vertices.mean(axis=0)
    local = vertices - matrix[:3, 3]
    fields = {"transform": _write_matrix(matrix), **_write_mesh("", local, faces)}
    return (
        fields
        | {"transform_plane": _write_matrix(matrix)}
        | _write_mesh("_plane", (local[:n] + local[n:]) / 2, faces[: n - 2])
    )


def _write_mesh(suffix: str, vertices: np.ndarray | None = None, faces: np.ndarray | None = None) -> dict[str, str]:
    return {f"vertices{suffix}": _write_matrix(vertices), f"faces{suffix}": _write_matrix(faces, "u")}


def _write_matrix(values: np.ndarray | None, kind: str = "f") -> str:
    """Return the content of an OpenCV matrix element; None gives an empty matrix."""
    rows, cols = (0, 0) if values is None else values.shape
    flat = [] if values is None else values.ravel().tolist()
    data = " ".join([f"{v:d}" if kind == "u" else f"{v:.8e}" for v in flat])
    return f"\n<rows>{rows}</rows>\n<cols>{cols}</cols>\n<dt>{kind}</dt>\n<data>\n{data} </data>"


def _write_element(tag: str, content: str) -> str:
    is_matrix = content.startswith("\n<rows>")
    return f'<{tag} type_id="opencv-matrix">{content}</{tag}>' if is_matrix else f"<{tag}>{content}</{tag}>"
