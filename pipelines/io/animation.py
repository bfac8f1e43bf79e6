"""Export a Scene with its traffic as an animated GLB file (glTF 2.0)."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
import pyarrow as pa
import trimesh.exchange.gltf

from models.scene import CATEGORY_INDEX, Scene
from pipelines.geometry.parked_vehicles import find_driving_vehicles
from pipelines.io.mesh_export import build_world, complete_tree, make_unit_mesh
from pipelines.schema.tracks import RoadUser, find_time_step, list_road_users

HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
FLOAT = 5126  # glTF constant of 32-bit floats.
TYPES = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4"}


def export_animation(scene: Scene, tracks: pa.Table) -> bytes:
    """Export a scene and its traffic to a binary glTF 2.0 file with one animation.

    The file is that of `export_glb` without the vehicles in traffic, which the simulated traffic replaces. In addition,
    each road user has a node `road_user_<object_id>`, whose extras hold category, object id and size. The scale of the
    node is 0 before the first time, from one time step after the last, and in viewers without animation.

    Args:
        scene: Scene.
        tracks: Rows of the table tracks of the scene.

    Returns:
        Content of the .glb file.

    Raises:
        ValueError: The scene has no traffic.
    """
    users = list_road_users(tracks)
    if not users:
        raise ValueError(f"scene {scene.scene_id} has no traffic to export")
    world = build_world(scene, find_driving_vehicles(scene))
    for user in users:
        if user.category not in world.geometry:
            world.geometry[user.category] = make_unit_mesh(CATEGORY_INDEX[user.category])
        extras = {"category": user.category, "object_id": user.object_id, "size_m": user.size_m.tolist()}
        world.graph.update(user.name, "scene", matrix=np.eye(4), geometry=user.category, metadata=extras)
    content = trimesh.exchange.gltf.export_glb(world, tree_postprocessor=lambda t: complete_tree(scene.attribution, t))
    return _add_animation(content, users)


def _add_animation(content: bytes, users: list[RoadUser]) -> bytes:
    """Add an animation of the nodes of road users to a GLB file."""
    size, _ = CHUNK.unpack_from(content, HEADER.size)
    text_at = HEADER.size + CHUNK.size
    tree = json.loads(content[text_at : text_at + size])
    numbers = bytearray(content[text_at + size + CHUNK.size :][: tree["buffers"][0]["byteLength"]])

    def store(values: np.ndarray) -> int:
        """Append (k,), (k, 3) or (k, 4) numbers to the buffer, and return the number of their accessor."""
        data = np.ascontiguousarray(values, "<f4")
        numbers.extend(bytes(-len(numbers) % 4))
        view = {"buffer": 0, "byteOffset": len(numbers), "byteLength": data.nbytes}
        numbers.extend(data.tobytes())
        tree["bufferViews"].append(view)
        accessor: dict[str, Any] = {"bufferView": len(tree["bufferViews"]) - 1, "componentType": FLOAT}
        accessor |= {"count": len(data), "type": TYPES[data.shape[1:]]}
        if data.ndim == 1:
            accessor |= {"min": [float(data.min())], "max": [float(data.max())]}
        tree["accessors"].append(accessor)
        return len(tree["accessors"]) - 1

    nodes = {node.get("name"): number for number, node in enumerate(tree["nodes"])}
    samplers, channels = [], []
    step_s = find_time_step(users)
    for user in users:
        target = nodes[user.name]
        rotation = _make_quaternions(user.yaw_rad)
        place = {"translation": user.center_m[0], "rotation": rotation[0], "scale": np.zeros(3)}
        tree["nodes"][target].pop("matrix", None)
        tree["nodes"][target] |= {name: np.asarray(value, float).tolist() for name, value in place.items()}
        time_s = store(user.time_s)
        start_s, end_s = float(user.time_s[0]), float(user.time_s[-1]) + step_s
        shown = [(start_s, user.size_m), (end_s, np.zeros(3))]
        if start_s > 0:
            shown.insert(0, (0.0, np.zeros(3)))
        seen_s, scale = store(np.array([t for t, _ in shown])), store(np.stack([value for _, value in shown]))
        for path, times, values, mode in (
            ("translation", time_s, store(user.center_m), "LINEAR"),
            ("rotation", time_s, store(rotation), "LINEAR"),
            ("scale", seen_s, scale, "STEP"),
        ):
            channels.append({"sampler": len(samplers), "target": {"node": target, "path": path}})
            samplers.append({"input": times, "output": values, "interpolation": mode})
    tree["animations"] = [{"name": "traffic", "channels": channels, "samplers": samplers}]
    numbers.extend(bytes(-len(numbers) % 4))
    tree["buffers"][0]["byteLength"] = len(numbers)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    parts = CHUNK.pack(len(text), b"JSON"), text, CHUNK.pack(len(numbers), b"BIN\0"), bytes(numbers)
    total = HEADER.size + sum(len(part) for part in parts)
    return b"".join([HEADER.pack(b"glTF", 2, total), *parts])


def _make_quaternions(yaw_rad: np.ndarray) -> np.ndarray:
    """Return quaternions (k, 4) of rotations about z, in the order x, y, z, w. Neighbours have equal signs."""
    half_rad = np.unwrap(yaw_rad.astype(float)) / 2
    zero = np.zeros_like(half_rad)
    return np.stack([zero, zero, np.sin(half_rad), np.cos(half_rad)], axis=1)
