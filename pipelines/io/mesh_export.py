"""Convert a Scene to meshes: layout reconstruction (paper, supplement B.2), GLB files and PLY files.

The ground is one fused surface. In files, the classes have smooth borders (geometry/ground_polygons.py). In the layout
reconstruction, each occupied pixel becomes a vertex at the pixel centre, with the colour of the pixel's class. Each
2 x 2 block of occupied pixels becomes two triangles. The diagonal has the same direction in all blocks.

A primitive is a unit cuboid or a unit ellipsoid (diameter 1), transformed by T = [R diag(l, w, h) | t].
"""

from __future__ import annotations

import os
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple
from uuid import uuid4

import numpy as np
import trimesh
import trimesh.exchange.gltf
import trimesh.exchange.ply
import trimesh.visual

from models.scene import CATEGORIES, ELLIPSOID, Scene
from pipelines.geometry.ground_polygons import build_smooth_ground
from pipelines.schema.palette import CATEGORY_IDS, CLASS_COLORS, COLOR_HEX, EMPTY, list_ground_ids

GROUND = -1  # Value of `primitive` for a ground triangle.
ABOUT = (  # Fields of the scene in the `extras` of a glTF file.
    *("scene_id", "source", "sequence", "frame", "split", "world_xyz_m", "world_yaw_rad"),
    *("vegetation_density", "vehicle_density", "ground_classes"),
)

# In glTF, +z points forward, +y points up and +x points left. These are the x, z and y axes of the scene frame. The
# permutation is cyclic and therefore a proper rotation.
GLTF_FROM_SCENE = np.array([[0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], float)
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963  # glTF constants for buffers of vertices and of indices.


class Triangles(NamedTuple):
    """A triangle soup in the scene frame.

    Attributes:
        corners_m: Corners (m), counter-clockwise seen from outside. Ground triangles are counter-clockwise seen from
            above.
        class_id: Class id of the palette; a ground triangle has the class of its first corner.
        primitive: Index of the primitive in the scene; GROUND for ground.
    """

    corners_m: np.ndarray  # (t, 3, 3) float64
    class_id: np.ndarray  # (t,) uint8
    primitive: np.ndarray  # (t,) int64


@cache
def make_unit_cuboid() -> tuple[np.ndarray, np.ndarray]:
    """Return the unit cuboid: vertices (8, 3) at ±0.5, and triangles (12, 3) that face outwards."""
    mesh = trimesh.creation.box()
    return np.asarray(mesh.vertices, float), np.asarray(mesh.faces)


@cache
def make_unit_ellipsoid() -> tuple[np.ndarray, np.ndarray]:
    """Return the sphere of diameter 1: vertices (642, 3) and triangles (1280, 3) that face outwards.

    The volume of the mesh is 0.99 times the volume pi/6 of the sphere.
    """
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    return np.asarray(mesh.vertices, float), np.asarray(mesh.faces)


def compute_placements(scene: Scene) -> np.ndarray:
    """Compute the transform of each primitive (paper, supplement B.2).

    Args:
        scene: Scene with n primitives.

    Returns:
        (n, 4, 4) T = [R diag(l, w, h) | t], from the unit shape to the scene frame (m).
    """
    transform = np.zeros((len(scene), 4, 4))
    transform[:, :3, :3] = scene.rotation * scene.size_m[:, None, :]
    transform[:, :3, 3] = scene.center_m
    transform[:, 3, 3] = 1
    return transform


def build_ground_mesh(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Build the mesh of the fused ground surface (paper, supplement B.2).

    Each 2 x 2 block of occupied pixels gives two triangles. The diagonal (i, j + 1) - (i + 1, j) separates the two
    triangles.

    Args:
        scene: Scene.

    Returns:
        vertices_m (v, 3) in the scene frame, one per occupied pixel; triangles (t, 3), which face up; and
        vertex_class_id (v,).
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


def build_painted_ground(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Build the mesh of the fused ground surface with smooth borders and one class per vertex.

    At a border, each class has its own vertices at the same place. Colours therefore change without a blend.

    Args:
        scene: Scene.

    Returns:
        vertices_m (v, 3) in the scene frame; triangles (t, 3), which face up; and vertex_class_id (v,).
    """
    mesh = build_smooth_ground(scene)
    num_classes = len(scene.ground_classes)
    key = mesh.triangles * num_classes + mesh.class_index[:, None]
    used = np.zeros(len(mesh.vertices_m) * num_classes, bool)
    used[key] = True
    place = np.flatnonzero(used)
    class_id = list_ground_ids(scene)[place % num_classes]
    return mesh.vertices_m[place // num_classes], (np.cumsum(used) - 1)[key], class_id


def triangulate_ground(scene: Scene) -> Triangles:
    """Return the triangles of `build_ground_mesh`.

    Args:
        scene: Scene.

    Returns:
        Triangles of the ground.
    """
    vertices, triangles, class_id = build_ground_mesh(scene)
    return Triangles(vertices[triangles], class_id[triangles[:, 0]], np.full(len(triangles), GROUND))


def triangulate_cuboids(scene: Scene) -> Triangles:
    """Return twelve triangles for each cuboid.

    Args:
        scene: Scene.

    Returns:
        Triangles of all cuboids.
    """
    return _add_instances(scene, np.flatnonzero(scene.category != ELLIPSOID), *make_unit_cuboid())


def triangulate_ellipsoids(scene: Scene) -> Triangles:
    """Return 1280 triangles for each ellipsoid.

    Args:
        scene: Scene.

    Returns:
        Triangles of all ellipsoids.
    """
    return _add_instances(scene, np.flatnonzero(scene.category == ELLIPSOID), *make_unit_ellipsoid())


def triangulate_scene(scene: Scene) -> Triangles:
    """Return the triangles of the ground, the cuboids and the ellipsoids of a scene.

    Args:
        scene: Scene.

    Returns:
        All triangles.
    """
    parts = triangulate_ground(scene), triangulate_cuboids(scene), triangulate_ellipsoids(scene)
    return Triangles(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _add_instances(scene: Scene, primitive: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> Triangles:
    transform = compute_placements(scene)[primitive]
    placed = vertices @ transform[:, :3, :3].transpose(0, 2, 1) + transform[:, None, :3, 3]  # (p, v, 3)
    class_id = np.repeat(CATEGORY_IDS[scene.category[primitive]], len(triangles))
    corners = placed.take(triangles, axis=1).reshape(-1, 3, 3)
    return Triangles(corners, class_id, np.repeat(primitive, len(triangles)))


def export_glb(scene: Scene) -> bytes:
    """Export a scene to a binary glTF 2.0 file (y up, metres).

    The node `scene` holds the rotation from z up to y up. The children of this node are therefore in the scene frame:

    * `ground` has vertex colours, and smooth borders between its classes. This node is absent if no pixel is occupied.
    * `<category>_<index>` is the node of a primitive. The extras of the node hold category, class id, colour, label,
      instance id and the exact parameters.

    The extras of the file hold the grid and the fields of ABOUT. mesh_import.py reads the same scene from this file,
    except that the ground is replaced by the fused ground. Colours are in linear light, as glTF requires. A viewer then
    shows the sRGB values of the palette.

    Args:
        scene: Scene.

    Returns:
        Content of the .glb file.
    """
    world = build_world(scene)
    return trimesh.exchange.gltf.export_glb(world, tree_postprocessor=partial(complete_tree, scene.attribution))


def build_world(scene: Scene, hidden: np.ndarray | None = None) -> trimesh.Scene:
    """Build the nodes and meshes that `export_glb` writes.

    Args:
        scene: Scene.
        hidden: (n,) bool mask of primitives to leave out (default: none).

    Returns:
        Graph with the node `scene`, and a geometry for the ground and for each category.
    """
    about = {name: getattr(scene, name) for name in ABOUT} | {"grid": asdict(scene.grid)}
    if scene.attribution:
        about["attribution"] = scene.attribution
    world = trimesh.Scene(metadata=about)
    world.graph.update("scene", "world", matrix=GLTF_FROM_SCENE)
    vertices, triangles, class_id = build_painted_ground(scene)
    if len(vertices):
        world.geometry["ground"] = _paint_mesh(vertices, triangles, class_id)
        extras = {"classes": {name: f"#{COLOR_HEX[name]}" for name in scene.ground_classes}}
        world.graph.update("ground", "scene", matrix=np.eye(4), geometry="ground", metadata=extras)
    shown = np.arange(len(scene)) if hidden is None else np.flatnonzero(~hidden)
    for category in np.unique(scene.category[shown]):
        world.geometry[CATEGORIES[category]] = make_unit_mesh(category)
    for index, transform in zip(shown.tolist(), compute_placements(scene)[shown], strict=True):
        name = CATEGORIES[scene.category[index]]
        node = f"{name}_{index:04d}"
        world.graph.update(node, "scene", matrix=transform, geometry=name, metadata=_make_extras(scene, index))
    return world


def complete_tree(attribution: str | None, tree: dict) -> None:
    """Set the licence notice, and hints that tell the GPU whether a buffer view holds vertices or indices.

    Args:
        attribution: Licence notice, or None.
        tree: JSON of a glTF file, which is changed.
    """
    if attribution:
        tree["asset"]["copyright"] = attribution
    for mesh in tree.get("meshes", ()):
        for part in mesh["primitives"]:
            targets = {index: ARRAY_BUFFER for index in part["attributes"].values()}
            for accessor, target in (targets | {part["indices"]: ELEMENT_ARRAY_BUFFER}).items():
                tree["bufferViews"][tree["accessors"][accessor]["bufferView"]]["target"] = target


def export_ply(scene: Scene) -> bytes:
    """Export a scene to one binary PLY mesh in the scene frame (z up, metres).

    Vertices have palette colours (sRGB), `class_id` and `primitive` (index of the primitive, or GROUND).

    Args:
        scene: Scene.

    Returns:
        Content of the .ply file.
    """
    ground_m, triangles, class_id = build_painted_ground(scene)
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
    content = trimesh.exchange.ply.export_ply(mesh)
    if not scene.attribution:
        return content
    first, rest = content.split(b"\n", 1)
    form, rest = rest.split(b"\n", 1)
    notice = scene.attribution.encode("ascii", "replace").replace(b"\n", b" ")
    return b"\n".join([first, form, b"comment " + notice, rest])


def write_glb(scene: Scene, path: str | Path) -> None:
    """Write a scene to a .glb file.

    The function writes a temporary file next to `path` and then renames the file. An interruption therefore leaves no
    partial file.

    Args:
        scene: Scene.
        path: Local path of the .glb file.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{uuid4().hex}.tmp")
    temporary.write_bytes(export_glb(scene))
    os.replace(temporary, path)


def make_unit_mesh(category: int) -> trimesh.Trimesh:
    """Make the mesh of size 1 that the nodes of a category share.

    Args:
        category: Index of the category.

    Returns:
        Cuboid or ellipsoid in the colour of the category.
    """
    visual = trimesh.visual.TextureVisuals(material=_make_material(CATEGORIES[category], CATEGORY_IDS[category]))
    if category != ELLIPSOID:
        return trimesh.Trimesh(*make_unit_cuboid(), visual=visual, process=False)
    vertices, triangles = make_unit_ellipsoid()
    # Viewers shade a mesh smoothly if it has normals. Without normals, viewers shade each facet separately.
    return trimesh.Trimesh(vertices, triangles, vertex_normals=2 * vertices, visual=visual, process=False)


def _paint_mesh(vertices_m: np.ndarray, triangles: np.ndarray, class_id: np.ndarray) -> trimesh.Trimesh:
    # The material is white, because a viewer multiplies the material's colour by the vertex colour.
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
    """Convert uint8 sRGB to uint8 linear light (IEC 61966-2-1)."""
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
