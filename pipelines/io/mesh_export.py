"""Meshes of a Scene: layout reconstruction (paper, supplement B.2) and GLB files.

The ground is one fused surface: each occupied pixel becomes a vertex at its centre, coloured by the class
that won the pixel, and each 2 x 2 block of occupied pixels becomes two triangles along one consistent
diagonal. A primitive is a unit cuboid or a unit ellipsoid (diameter 1) under T = [R diag(l, w, h) | t].
"""

from __future__ import annotations

import os
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import NamedTuple
from uuid import uuid4

import numpy as np
import trimesh
import trimesh.exchange.gltf
import trimesh.exchange.ply
import trimesh.visual

from models.scene import CATEGORIES, ELLIPSOID, Scene
from pipelines.schema.palette import CATEGORY_IDS, CLASS_COLORS, COLOR_HEX, EMPTY, list_ground_ids

GROUND = -1  # "primitive" of a ground triangle
ABOUT = (  # what a file says of the scene as a whole
    *("scene_id", "source", "sequence", "frame", "split", "world_xyz_m", "world_yaw_rad"),
    *("vegetation_density", "vehicle_density", "ground_classes"),
)

# Cyclic, hence a proper rotation: glTF's +z is forward, +y up and +x left, ours are x, z and y.
GLTF_FROM_SCENE = np.array([[0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], float)
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963  # glTF: vertices, indices


class Triangles(NamedTuple):
    """Triangle soup in the scene frame; corners counter-clockwise seen from outside (ground: from above)."""

    corners_m: np.ndarray  # (t, 3, 3) float64
    class_id: np.ndarray  # (t,) uint8, see palette; a ground triangle has the class of its first corner
    primitive: np.ndarray  # (t,) int64, index into the scene's primitives, GROUND for the ground


@cache
def make_unit_cuboid() -> tuple[np.ndarray, np.ndarray]:
    """Vertices (8, 3) at ±0.5 and triangles (12, 3), outward."""
    mesh = trimesh.creation.box()
    return np.asarray(mesh.vertices, float), np.asarray(mesh.faces)


@cache
def make_unit_ellipsoid() -> tuple[np.ndarray, np.ndarray]:
    """Vertices (642, 3) on the sphere of diameter 1 and triangles (1280, 3), outward; volume 0.99 of pi/6."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    return np.asarray(mesh.vertices, float), np.asarray(mesh.faces)


def compute_placements(scene: Scene) -> np.ndarray:
    """(n, 4, 4) T = [R diag(l, w, h) | t] of each primitive (paper, supplement B.2)."""
    transform = np.zeros((len(scene), 4, 4))
    transform[:, :3, :3] = scene.rotation * scene.size_m[:, None, :]
    transform[:, :3, 3] = scene.center_m
    transform[:, 3, 3] = 1
    return transform


def build_ground_mesh(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The fused ground surface (paper, supplement B.2).

    Returns vertices_m (v, 3), one per occupied pixel; triangles (t, 3), facing up, two per 2 x 2 block of
    occupied pixels, cut along the diagonal (i, j + 1) - (i + 1, j); vertex_class_id (v,).
    """
    height, winner = scene.surface()
    occupied = winner >= 0
    row, col = np.nonzero(occupied)
    vertices = np.stack([scene.grid.x_m()[row], scene.grid.y_m()[col], height[row, col]], axis=1)
    vertex = np.cumsum(occupied).reshape(occupied.shape) - 1
    whole = occupied[:-1, :-1] & occupied[1:, :-1] & occupied[:-1, 1:] & occupied[1:, 1:]
    here, right, below, across = vertex[:-1, :-1], vertex[:-1, 1:], vertex[1:, :-1], vertex[1:, 1:]
    triangles = np.stack([v[whole] for v in (here, below, right, right, below, across)], axis=1).reshape(-1, 3)
    return vertices, triangles, list_ground_ids(scene)[winner[occupied]]


def triangulate_ground(scene: Scene) -> Triangles:
    """The triangles of `build_ground_mesh`."""
    vertices, triangles, class_id = build_ground_mesh(scene)
    return Triangles(vertices[triangles], class_id[triangles[:, 0]], np.full(len(triangles), GROUND))


def triangulate_cuboids(scene: Scene) -> Triangles:
    """Twelve triangles for each primitive that is a cuboid."""
    return _add_instances(scene, np.flatnonzero(scene.category != ELLIPSOID), *make_unit_cuboid())


def triangulate_ellipsoids(scene: Scene) -> Triangles:
    """1280 triangles for each primitive that is an ellipsoid."""
    return _add_instances(scene, np.flatnonzero(scene.category == ELLIPSOID), *make_unit_ellipsoid())


def triangulate_scene(scene: Scene) -> Triangles:
    """Everything in the scene as triangles: ground, cuboids, ellipsoids."""
    parts = triangulate_ground(scene), triangulate_cuboids(scene), triangulate_ellipsoids(scene)
    return Triangles(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _add_instances(scene: Scene, primitive: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> Triangles:
    transform = compute_placements(scene)[primitive]
    placed = vertices @ transform[:, :3, :3].transpose(0, 2, 1) + transform[:, None, :3, 3]  # (p, v, 3)
    class_id = np.repeat(CATEGORY_IDS[scene.category[primitive]], len(triangles))
    corners = placed.take(triangles, axis=1).reshape(-1, 3, 3)
    return Triangles(corners, class_id, np.repeat(primitive, len(triangles)))


def export_glb(scene: Scene) -> bytes:
    """Export the scene to a binary glTF 2.0 file, y up, metres.

    Node `scene` holds the rotation from z up to y up, so that its children are in the scene frame: `ground` (vertex
    colours; absent without occupied pixels) and one node per primitive, `<category>_<index>`, with category, class id,
    colour, label, instance id and the exact parameters in its extras. The extras of the file hold the grid and the
    fields of ABOUT. mesh_import.py reads the same scene from it, except that only the fused ground remains. Colours are
    in linear light, as glTF demands, so a viewer shows the palette's sRGB values.
    """
    about = {name: getattr(scene, name) for name in ABOUT} | {"grid": asdict(scene.grid)}
    world = trimesh.Scene(metadata=about)
    world.graph.update("scene", "world", matrix=GLTF_FROM_SCENE)
    vertices, triangles, class_id = build_ground_mesh(scene)
    if len(vertices):
        # A triangle without area keeps pixels that have no neighbours: files leave meshes without triangles out.
        triangles = triangles if len(triangles) else np.zeros((1, 3), int)
        world.geometry["ground"] = _paint_mesh(vertices, triangles, class_id)
        extras = {"classes": {name: f"#{COLOR_HEX[name]}" for name in scene.ground_classes}}
        world.graph.update("ground", "scene", matrix=np.eye(4), geometry="ground", metadata=extras)
    for category in np.unique(scene.category):
        world.geometry[CATEGORIES[category]] = _make_unit_mesh(category)
    for index, transform in enumerate(compute_placements(scene)):
        name = CATEGORIES[scene.category[index]]
        node = f"{name}_{index:04d}"
        world.graph.update(node, "scene", matrix=transform, geometry=name, metadata=_make_extras(scene, index))
    return trimesh.exchange.gltf.export_glb(world, tree_postprocessor=_set_buffer_targets)


def _set_buffer_targets(tree: dict) -> None:
    """glTF's hints for the GPU: which buffer views hold vertices, which indices."""
    for mesh in tree.get("meshes", ()):
        for part in mesh["primitives"]:
            targets = {index: ARRAY_BUFFER for index in part["attributes"].values()}
            for accessor, target in (targets | {part["indices"]: ELEMENT_ARRAY_BUFFER}).items():
                tree["bufferViews"][tree["accessors"][accessor]["bufferView"]]["target"] = target


def export_ply(scene: Scene) -> bytes:
    """Export the scene to one binary PLY mesh in the scene frame, z up, metres.

    Vertices have palette colours (sRGB), `class_id` and `primitive` (its number, GROUND for the ground).
    """
    ground_m, triangles, class_id = build_ground_mesh(scene)
    vertices, faces, classes, primitives = [ground_m], [triangles], [class_id], [np.full(len(ground_m), GROUND)]
    count = len(ground_m)
    for index, transform in enumerate(compute_placements(scene)):
        unit, unit_faces = make_unit_ellipsoid() if scene.category[index] == ELLIPSOID else make_unit_cuboid()
        vertices.append(unit @ transform[:3, :3].T + transform[:3, 3])
        faces.append(unit_faces + count)
        classes.append(np.full(len(unit), CATEGORY_IDS[scene.category[index]]))
        primitives.append(np.full(len(unit), index))
        count += len(unit)
    class_id = np.concatenate(classes).astype(np.uint8)
    mesh = trimesh.Trimesh(
        np.concatenate(vertices), np.concatenate(faces), vertex_colors=CLASS_COLORS[class_id], process=False
    )
    mesh.vertex_attributes = {"class_id": class_id, "primitive": np.concatenate(primitives).astype(np.int32)}
    return trimesh.exchange.ply.export_ply(mesh)


def write_glb(scene: Scene, path: str | Path) -> None:
    """Write `export_glb` to a temporary file next to `path` and move it into place."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{uuid4().hex}.tmp")
    temporary.write_bytes(export_glb(scene))
    os.replace(temporary, path)


def _make_unit_mesh(category: int) -> trimesh.Trimesh:
    visual = trimesh.visual.TextureVisuals(material=_make_material(CATEGORIES[category], CATEGORY_IDS[category]))
    if category != ELLIPSOID:
        return trimesh.Trimesh(*make_unit_cuboid(), visual=visual, process=False)
    vertices, triangles = make_unit_ellipsoid()
    # With normals viewers shade smoothly, without them each facet flatly.
    return trimesh.Trimesh(vertices, triangles, vertex_normals=2 * vertices, visual=visual, process=False)


def _paint_mesh(vertices_m: np.ndarray, triangles: np.ndarray, class_id: np.ndarray) -> trimesh.Trimesh:
    # White: a viewer multiplies the material's colour by the vertex's.
    visual = trimesh.visual.TextureVisuals(material=_make_material("ground", EMPTY))
    opaque = np.full((len(vertices_m), 1), 255, np.uint8)
    visual.vertex_attributes["color"] = np.hstack([_convert_to_linear(CLASS_COLORS)[class_id], opaque])
    return trimesh.Trimesh(vertices_m, triangles, visual=visual, process=False)


def _make_material(name: str, class_id: int) -> trimesh.visual.material.PBRMaterial:
    color = [*_convert_to_linear(CLASS_COLORS[class_id]), 255]
    return trimesh.visual.material.PBRMaterial(
        name=name, baseColorFactor=color, metallicFactor=0.0, roughnessFactor=0.9
    )


def _convert_to_linear(srgb: np.ndarray) -> np.ndarray:
    """uint8 sRGB as uint8 linear light (IEC 61966-2-1)."""
    value = np.asarray(srgb) / 255
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return np.round(255 * linear).astype(np.uint8)


def _make_extras(scene: Scene, index: int) -> dict:
    category = int(scene.category[index])
    heading = float(scene.heading_rad[index])
    return {
        "category": CATEGORIES[category],
        "class_id": int(CATEGORY_IDS[category]),
        "color": f"#{COLOR_HEX[CATEGORIES[category]]}",
        "kind": "ellipsoid" if category == ELLIPSOID else "cuboid",
        "label": str(scene.label[index]),
        "instance_id": int(scene.instance_id[index]),
        "center_m": scene.center_m[index].tolist(),
        "size_m": scene.size_m[index].tolist(),
        "yaw_rad": float(scene.yaw_rad[index]),
        "heading_rad": heading if np.isfinite(heading) else None,
        "existence": float(scene.existence[index]),
    }
