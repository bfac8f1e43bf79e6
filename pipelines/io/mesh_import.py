"""Import binary glTF meshes as Scenes: exports of this project, and meshes with class colours as in the authors' files.

The extras of a file show whether the file is an export of this project (`mesh_export.export_glb`). In an export, each
node is a primitive. The transform of the node gives centre, rotation and size; the extras give the other fields.
Changes that a user makes in a mesh editor are therefore imported.

Any other mesh is read in the authors' format (docs/how_to/import_scenes.md), with these assumptions:

* x is forward, y right and z down, in metres, unless `axes` gives other directions. The frame includes the pitch and
  roll of the authors' IMU.
* The vertex or material colour determines the class of a vertex. The colour must match a palette colour within
  COLOR_TOLERANCE (mesh_segmentation.py). Colours are sRGB or linear light (the glTF standard); the reader chooses the
  interpretation that matches the palette better. It ignores textures.
* Ground has one vertex per occupied pixel, with or without triangles. In the authors' grid, the vertex of pixel (i, j)
  lies at the pixel corner x = 64 - .25 i, y = -32 + .25 j (y right). In exports of this project, the vertex lies at the
  pixel centre. On the border of two classes, a vertex may have an averaged colour. A vertex with an averaged colour
  gets the class of the nearest vertex with a class colour.
* Primitives are connected pieces of one class. A mesh may hold any number of primitives. The reader first merges
  vertices that are repeated along edges. A piece with eight vertices is a box; the fit uses its edges. A piece with
  more than eight vertices is an ellipsoid; the fit of a quadric works for any triangulation. Boxes of vegetation become
  vegetation_cuboid.

An imported box has the same corners as the mesh. An imported ellipsoid has the same shape as the mesh. If the shape
does not determine the yaw, the yaw is lost. The reader raises an error for a piece that fits neither shape within FIT_M
(shape_fitting.py).
"""

from __future__ import annotations

import os
from typing import Any, NamedTuple

import numpy as np

from models.limits import find_limit, require_within
from models.scene import (
    CATEGORIES,
    CATEGORY_INDEX,
    DENSITIES,
    ELLIPSOID,
    GROUND_CLASSES,
    KITTI_GROUND_CLASSES,
    Grid,
    Scene,
    canonicalize_boxes,
    compute_yaw,
)
from pipelines.geometry.shape_fitting import fit_boxes_to_corners, fit_boxes_to_edges, fit_ellipsoids
from pipelines.io.gltf_reader import FAR_M, Glb, MeshPart, place_parts, read_glb
from pipelines.io.mesh_export import GLTF_FROM_SCENE
from pipelines.io.mesh_segmentation import (
    COLOR_TOLERANCE,
    Mesh,
    find_nearest_class,
    rasterize_ground,
    segment_mesh,
)
from pipelines.runtime import storage
from pipelines.schema.axis_convention import Axes, compute_scene_from_axes
from pipelines.schema.palette import CATEGORY_IDS, GROUND_CLASS_ID

AUTHORS_AXES: Axes = ("x+", "y-", "z-")
# Changes below UNMOVED are rounding errors, not edits. For a size, the change is relative. For a yaw, the change is in
# rad.
UNMOVED = 1e-4
ORTHOGONAL = 1e-3  # Largest accepted cosine between two edges of a primitive in an export.
UNIT_M = 1e-3  # Largest accepted distance of a vertex from the unit shape in an export (m).
LEAST_M = 5e-324  # Smallest positive size (m).
ANGLE_RAD = 3.1416  # Largest accepted angle.
TEXTS = ("scene_id", "source", "sequence", "split")
OWN_EXTRAS = {"grid", "ground_classes", "world_xyz_m", "world_yaw_rad", "vegetation_density", "vehicle_density"}


def import_glb(
    source: bytes | str | os.PathLike, scene_id: str = "", axes: Axes = AUTHORS_AXES, grid: Grid | None = None
) -> Scene:
    """Import a .glb file as a Scene.

    If this project exported the file, ids, grid, ground classes and the fused ground are restored. The fused ground has
    one class per pixel. Any other mesh gets source "imported" and split "generated".

    Args:
        source: Content of the file as bytes, or its path or URI.
        scene_id: Id of the scene (default: the id in an export, or the file name without ".glb").
        axes: Directions of the file's axes. Used only for meshes that are not exports of this project.
        grid: Raster grid (default: the paper's). Used only for meshes that are not exports of this project.

    Returns:
        The scene.

    Raises:
        ValueError: The file is invalid. The message names the file, the fault and the remedy.
    """
    name = "GLB" if isinstance(source, bytes) else os.fspath(source)
    orientation = compute_scene_from_axes(axes)
    glb_bytes = source if isinstance(source, bytes) else storage.read_bytes(name, "glb_bytes")
    try:
        glb = read_glb(glb_bytes)
        if OWN_EXTRAS & glb.extras.keys():
            return _import_own_scene(glb, scene_id)
        return _import_foreign_scene(
            glb, scene_id or name.rsplit("/", 1)[-1].removesuffix(".glb"), orientation, grid or Grid()
        )
    except (ValueError, np.linalg.LinAlgError) as error:
        raise ValueError(f"{name}: {error}") from error


def _import_own_scene(glb: Glb, scene_id: str) -> Scene:
    about = _read_metadata(glb.extras)
    parts = [part for part in glb.parts if "object_id" not in part.extras]  # Road users are not part of the scene.
    _check_parts(parts, about["ground_classes"])
    for node, extras in glb.bare:
        if named := {"category", "classes"} & extras.keys():
            raise ValueError(
                f"node {node} has no mesh, but its extras name {min(named)!r}; delete the node or its extras"
            )
    nodes = [part for part in parts if "category" in part.extras]
    require_within("scene_primitives", len(nodes))
    letters = find_limit("text_characters")
    fields = [_read_primitive(part.extras, f"the extras of node {part.node}") for part in nodes]
    for text in (
        *(field.label for field in fields),
        about["scene_id"],
        about["source"],
        about["sequence"],
        about["split"],
        about.get("attribution", ""),
    ):
        if len(text) > letters:
            require_within("text_characters", len(text), "a label or an id")
    category = np.array([field.category for field in fields], np.int8)
    size_said_m = np.array([field.size_m for field in fields], float).reshape(-1, 3)
    yaw_said, heading, existence = (
        np.array([getattr(field, name) for field in fields], float) for name in ("yaw_rad", "heading_rad", "existence")
    )
    scene_from_gltf = np.linalg.inv(GLTF_FROM_SCENE)
    scene_from_unit = np.array([scene_from_gltf @ part.file_from_mesh for part in nodes]).reshape(-1, 4, 4)
    center_m, edges_m = scene_from_unit[:, :3, 3], scene_from_unit[:, :3, :3]
    if not (np.abs(center_m) < FAR_M).all():
        raise ValueError(f"primitives are NaN or lie beyond {FAR_M:.0f} m; export the scene in metres")
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        unit = edges_m / np.linalg.norm(edges_m, axis=1, keepdims=True)
        skewed = ~(np.abs(np.swapaxes(unit, 1, 2) @ unit - np.eye(3)).max(axis=(1, 2), initial=0) <= ORTHOGONAL)
    if skewed.any():
        raise ValueError(
            f"the axes of node {nodes[int(skewed.argmax())].node} are not perpendicular; export it without shear"
        )
    rotation, size_m = fit_boxes_to_edges(edges_m, center_m)
    # If the fitted sizes agree with the stored sizes, keep the stored sizes. Otherwise, rounding can swap length and
    # width of a square.
    size_m = np.where(np.isclose(size_m, size_said_m, rtol=UNMOVED, atol=0), size_said_m, size_m)
    rotation, size_m = canonicalize_boxes(rotation, size_m)
    turned = ~np.isclose(compute_yaw(rotation), yaw_said, rtol=0, atol=UNMOVED)

    ground = [part for part in parts if "classes" in part.extras]
    vertices_m = _join_meshes(place_parts(ground), (0, 3)) @ scene_from_gltf[:3, :3].T
    ids = np.array([GROUND_CLASS_ID[name] for name in about["ground_classes"]])
    class_id, off = find_nearest_class(_join_meshes([part.local.color for part in ground], (0, 3)), True, ids)
    if (off > COLOR_TOLERANCE).any():
        raise ValueError(
            f"{(off > COLOR_TOLERANCE).sum()} ground vertices match the colour of no ground class; export it again"
        )
    height_m, occupied = rasterize_ground(vertices_m, class_id, about["ground_classes"], about["grid"])
    if scene_id:
        about["scene_id"] = scene_id
    return Scene(
        **about,
        category=category,
        center_m=center_m.astype(np.float32),
        rotation=rotation.astype(np.float32),
        size_m=size_m.astype(np.float32),
        existence=existence.astype(np.float32),
        heading_rad=np.where(turned, np.nan, heading).astype(np.float32),
        instance_id=np.array([field.instance_id for field in fields], np.int64),
        label=np.array([field.label for field in fields], object),
        height_m=height_m,
        occupied=occupied,
    )


class _Primitive(NamedTuple):
    """Extras of a primitive in an export, with the types and units of `Scene`."""

    category: int
    size_m: list[float]
    yaw_rad: float
    heading_rad: float
    existence: float
    instance_id: int
    label: str


def _read_primitive(extras: dict, place: str) -> _Primitive:
    category = _read_text(extras, "category", place)
    if category not in CATEGORY_INDEX:
        raise ValueError(f"{place}: 'category' is {category[:80]!r}, expected one of {', '.join(CATEGORY_INDEX)}")
    heading = _require(extras, "heading_rad", place)
    return _Primitive(
        CATEGORY_INDEX[category],
        _read_numbers(extras, "size_m", 3, place, LEAST_M, FAR_M),
        _read_number(extras, "yaw_rad", place, -ANGLE_RAD, ANGLE_RAD),
        np.nan if heading is None else _read_number(extras, "heading_rad", place, -ANGLE_RAD, ANGLE_RAD),
        _read_number(extras, "existence", place, 0, 1),
        _read_integer(extras, "instance_id", place),
        _read_text(extras, "label", place),
    )


def _check_parts(parts: list[MeshPart], ground_classes: tuple[str, ...]) -> None:
    """Check that each mesh of an export is a unit shape with the extras of a primitive, or ground."""
    seen, checked = set(), {}
    for part in parts:
        place = f"node {part.node}"
        if ("category" in part.extras) == ("classes" in part.extras):
            raise ValueError(f"the extras of {place} name neither a category nor ground classes; export it again")
        if "classes" in part.extras:
            classes = part.extras["classes"]
            if type(classes) is not dict or set(classes) != set(ground_classes):
                raise ValueError(f"the extras of {place} name other ground classes than the file; export it again")
            continue
        if part.node in seen:
            raise ValueError(f"{place} has several mesh primitives, expected one; export it again")
        seen.add(part.node)
        is_round = part.extras["category"] == CATEGORIES[ELLIPSOID]
        key = id(part.local), is_round
        if key not in checked:
            size_m = np.linalg.norm(part.local.vertices, axis=1) if is_round else np.abs(part.local.vertices)
            checked[key] = np.abs(size_m - 0.5).max() <= UNIT_M
        if not checked[key]:
            shape = "sphere" if is_round else "cube"
            raise ValueError(
                f"the mesh of {place} is no {shape} of size 1; move, turn and scale the object, not its vertices"
            )


def _read_metadata(extras: dict) -> dict[str, Any]:
    """Read and check the scene-level fields of a Scene."""
    place = "the extras of the scene"
    said = _require(extras, "grid", place)
    if type(said) is not dict:
        raise ValueError(f"{place}: the grid is no object; export it again")
    where = "the grid in the extras"
    front_m, left_m = (_read_number(said, name, where, -FAR_M, FAR_M) for name in ("front_m", "left_m"))
    resolution_m = _read_number(said, "resolution_m", where, 1 / FAR_M, FAR_M)
    rows, cols = (_read_integer(said, name, where, 1, 2**31 - 1) for name in ("rows", "cols"))
    classes = _require(extras, "ground_classes", place)
    if type(classes) is not list or not classes or not all(name in GROUND_CLASSES for name in classes):
        raise ValueError(f"{place}: 'ground_classes' are no list of {', '.join(GROUND_CLASSES)}; export it again")
    if len(set(classes)) < len(classes):
        raise ValueError(f"{place}: 'ground_classes' names a class twice; export it again")
    require_within("raster_pixels", rows * cols * len(classes), where)
    if not extras.get("scene_id"):
        raise ValueError(f"{place}: 'scene_id' is empty; export it again")
    densities = {name: _require(extras, name, place) for name in ("vegetation_density", "vehicle_density")}
    if not all(label is None or label in DENSITIES for label in densities.values()):
        raise ValueError(f"{place}: a density label is none of {', '.join(DENSITIES)}; export it again")
    x, y, z = _read_numbers(extras, "world_xyz_m", 3, place, -1e9, 1e9)
    notice = {"attribution": _read_text(extras, "attribution", place)} if extras.get("attribution") else {}
    return (
        densities
        | notice
        | {
            **{name: _read_text(extras, name, place) for name in TEXTS},
            "frame": _read_integer(extras, "frame", place),
            "world_xyz_m": (x, y, z),
            "world_yaw_rad": _read_number(extras, "world_yaw_rad", place, -1e6, 1e6),
            "grid": Grid(front_m, left_m, resolution_m, rows, cols),
            "ground_classes": tuple(classes),
        }
    )


def _require(extras: dict, name: str, place: str) -> Any:
    if name not in extras:
        raise ValueError(f"{place} are incomplete, because {name!r} is missing; export it again")
    return extras[name]


def _check_number(value: Any, name: str, place: str, low: float, high: float) -> float:
    if type(value) not in (int, float) or not low <= value <= high:
        shown = str(value)[:80] if type(value) in (int, float, str) else type(value).__name__
        raise ValueError(
            f"{place}: {name!r} is {shown}, expected a number from {low:.5g} to {high:.5g}; export it again"
        )
    return float(value)


def _read_number(extras: dict, name: str, place: str, low: float, high: float) -> float:
    return _check_number(_require(extras, name, place), name, place, low, high)


def _read_numbers(extras: dict, name: str, count: int, place: str, low: float, high: float) -> list[float]:
    values = _require(extras, name, place)
    if type(values) is not list or len(values) != count:
        raise ValueError(f"{place}: {name!r} is no list of {count} numbers; export it again")
    return [_check_number(value, name, place, low, high) for value in values]


def _read_integer(extras: dict, name: str, place: str, low: int = -(2**63), high: int = 2**63 - 1) -> int:
    value = _require(extras, name, place)
    if type(value) is not int or not low <= value <= high:
        raise ValueError(f"{place}: {name!r} is no integer from {low} to {high}; export it again")
    return value


def _read_text(extras: dict, name: str, place: str) -> str:
    value = _require(extras, name, place)
    if type(value) is not str or not value.isprintable():
        raise ValueError(f"{place}: {name!r} is no text of printable characters; export it again")
    return value


def _import_foreign_scene(glb: Glb, scene_id: str, scene_from_file: np.ndarray, grid: Grid) -> Scene:
    if not glb.parts:
        raise ValueError("the file holds no mesh; export the scene with its meshes")
    placed = place_parts(glb.parts)
    counts = [len(vertices) for vertices in placed]
    starts = np.cumsum(counts) - counts
    mesh = Mesh(
        np.concatenate(placed) @ scene_from_file.T,
        np.concatenate([part.local.triangles + start for part, start in zip(glb.parts, starts, strict=True)]),
        np.concatenate([part.local.color for part in glb.parts]),
        np.repeat(np.arange(len(counts)), counts),
    )
    ground_m, ground_id, corners_m, box_id, clouds = segment_mesh(mesh, grid)
    require_within("scene_primitives", len(box_id) + len(clouds))
    classes = tuple(n for n in GROUND_CLASSES if n in KITTI_GROUND_CLASSES or (ground_id == GROUND_CLASS_ID[n]).any())
    height_m, occupied = rasterize_ground(ground_m, ground_id, classes, grid)
    shapes = zip(fit_boxes_to_corners(corners_m), fit_ellipsoids(clouds), strict=True)
    center_m, rotation, size_m = (np.concatenate(pair) for pair in shapes)
    rotation, size_m = canonicalize_boxes(rotation, size_m)
    category = np.append(np.searchsorted(CATEGORY_IDS, box_id), np.full(len(clouds), ELLIPSOID))
    return Scene(
        scene_id=scene_id,
        source="imported",
        sequence="imported",
        frame=0,
        split="generated",
        category=category.astype(np.int8),
        center_m=center_m.astype(np.float32),
        rotation=rotation.astype(np.float32),
        size_m=size_m.astype(np.float32),
        ground_classes=classes,
        height_m=height_m,
        occupied=occupied,
        grid=grid,
    )


def _join_meshes(arrays: list[np.ndarray], empty: tuple[int, ...]) -> np.ndarray:
    return np.concatenate(arrays) if arrays else np.zeros(empty)
