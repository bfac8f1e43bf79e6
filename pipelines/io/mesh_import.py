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
from typing import Any

import numpy as np

from models.scene import (
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
from pipelines.io.gltf_reader import Glb, read_glb
from pipelines.io.mesh_export import GLTF_FROM_SCENE
from pipelines.io.mesh_segmentation import (
    COLOR_TOLERANCE,
    convert_to_stored_linear,
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
MAX_PIXELS = 2**24  # Maximum number of pixels of an imported grid.


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
    glb_bytes = source if isinstance(source, bytes) else storage.read_bytes(name)
    try:
        glb = read_glb(glb_bytes)
        if "grid" in glb.extras and "ground_classes" in glb.extras:
            return _import_own_scene(glb, scene_id)
        return _import_foreign_scene(
            glb, scene_id or name.rsplit("/", 1)[-1].removesuffix(".glb"), orientation, grid or Grid()
        )
    except (ValueError, np.linalg.LinAlgError) as error:
        raise ValueError(f"{name}: {error}") from error


def _import_own_scene(glb: Glb, scene_id: str) -> Scene:
    nodes = [part for part in glb.parts if "category" in part.extras]
    try:
        about = _read_metadata(glb.extras)
        category = np.array([CATEGORY_INDEX[part.extras["category"]] for part in nodes], np.int8)
        size_said_m, yaw_said, heading, existence, instance_id, label = (
            np.array([part.extras[name] for part in nodes], kind)
            for name, kind in (
                ("size_m", float),
                ("yaw_rad", float),
                ("heading_rad", float),
                ("existence", float),
                ("instance_id", np.int64),
                ("label", str),
            )
        )
    except (LookupError, TypeError, OverflowError) as error:
        raise ValueError(f"the extras of this export are incomplete ({error!r}); export it again") from error
    if not ((existence >= 0) & (existence <= 1)).all() or (np.abs(heading) > 2 * np.pi).any():
        raise ValueError("existence lies outside [0, 1], or heading_rad lies outside ±2π; export it again")
    scene_from_gltf = np.linalg.inv(GLTF_FROM_SCENE)
    scene_from_unit = np.array([scene_from_gltf @ part.file_from_mesh for part in nodes]).reshape(-1, 4, 4)
    center_m = scene_from_unit[:, :3, 3]
    rotation, size_m = fit_boxes_to_edges(scene_from_unit[:, :3, :3], center_m)
    # If the fitted sizes agree with the stored sizes, keep the stored sizes. Otherwise, rounding can swap length and
    # width of a square.
    size_said_m = size_said_m.reshape(-1, 3)
    size_m = np.where(np.isclose(size_m, size_said_m, rtol=UNMOVED, atol=0), size_said_m, size_m)
    rotation, size_m = canonicalize_boxes(rotation, size_m)
    turned = ~np.isclose(compute_yaw(rotation), yaw_said, rtol=0, atol=UNMOVED)

    ground = [part for part in glb.parts if "classes" in part.extras]
    vertices_m = _join_meshes([part.vertices @ scene_from_gltf[:3, :3].T for part in ground], (0, 3))
    ids = np.array([GROUND_CLASS_ID[name] for name in about["ground_classes"]])
    class_id, off = find_nearest_class(_join_meshes([part.color for part in ground], (0, 3)), True, ids)
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
        instance_id=instance_id,
        label=label.astype(object),
        height_m=height_m,
        occupied=occupied,
    )


def _read_metadata(extras: dict) -> dict[str, Any]:
    """Read and check the scene-level fields of a Scene.

    The function raises LookupError, TypeError or ValueError for missing or invalid fields.
    """
    said, classes = extras["grid"], tuple(extras["ground_classes"])
    lengths = front_m, left_m, resolution_m = tuple(float(said[name]) for name in ("front_m", "left_m", "resolution_m"))
    grid = Grid(front_m, left_m, resolution_m, int(said["rows"]), int(said["cols"]))
    sound = np.isfinite(lengths).all() and grid.resolution_m > 0 < min(grid.rows, grid.cols)
    if not sound or grid.rows * grid.cols > MAX_PIXELS:
        raise ValueError(f"the grid {said} is invalid; export it again")
    if not set(classes) <= set(GROUND_CLASSES) or len(set(classes)) < len(classes):
        raise ValueError(f"the ground classes are {classes}, expected some of {', '.join(GROUND_CLASSES)}")
    densities = {name: extras[name] for name in ("vegetation_density", "vehicle_density")}
    if not set(densities.values()) <= {*DENSITIES, None}:
        raise ValueError(
            f"the density labels are {densities}, expected some of {', '.join(DENSITIES)}; export it again"
        )
    x, y, z = extras["world_xyz_m"]
    return densities | {
        **{name: str(extras[name]) for name in ("scene_id", "source", "sequence", "split")},
        "frame": int(extras["frame"]),
        "world_xyz_m": (float(x), float(y), float(z)),
        "world_yaw_rad": float(extras["world_yaw_rad"]),
        "grid": grid,
        "ground_classes": classes,
    }


def _import_foreign_scene(glb: Glb, scene_id: str, scene_from_file: np.ndarray, grid: Grid) -> Scene:
    if not glb.parts:
        raise ValueError("the file holds no mesh; export the scene with its meshes")
    linear = convert_to_stored_linear(np.concatenate([part.color for part in glb.parts]))
    found = [segment_mesh(part.vertices @ scene_from_file.T, part.triangles, part.color, linear) for part in glb.parts]
    ground_m, ground_id, corners_m, box_id = (np.concatenate([part[k] for part in found]) for k in range(4))
    clouds = [cloud for part in found for cloud in part.clouds]
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
