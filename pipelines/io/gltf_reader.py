"""Read binary glTF 2.0 files from untrusted sources as meshes, and apply the transforms of the nodes.

The reader uses only the content of the file. A buffer is the binary chunk or a base64 `data:` URI (glTF 2.0, Sec.
3.6.1.1), as Open3D writes it. The reader opens no other URI, decodes no texture and decompresses nothing. Colours are
returned as stored.
"""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
POINTS, TRIANGLES = 0, 4
HARMLESS = {"KHR_materials_unlit", "KHR_mesh_quantization"}  # Required extensions that do not affect the reader.
DATA_URI = "data:"
MOVES_VERTICES = {"KHR_draco_mesh_compression", "EXT_meshopt_compression", "EXT_mesh_gpu_instancing"}
FAR_M = 1e6
# Maximum number of vertices and of triangle corners in a scene. A small file can reference one mesh a million times.
MAX_NUMBERS = 2**25


class MeshPart(NamedTuple):
    """A mesh primitive of a node, transformed to the frame of the file.

    Attributes:
        extras: Extras of the node.
        file_from_mesh: Transform from the frame of the mesh to the frame of the file.
        vertices: Vertices in the frame of the file.
        triangles: Vertex indices; shape (0, 3) for a point cloud.
        color: Stored colours in [0, 1]: the vertex colour times the colour of the material.
    """

    extras: dict
    file_from_mesh: np.ndarray  # (4, 4)
    vertices: np.ndarray  # (v, 3) float64
    triangles: np.ndarray  # (t, 3) int64
    color: np.ndarray  # (v, 3) float64


class Glb(NamedTuple):
    """Content of a file: the extras of the default scene, and the mesh parts in the order of the node tree."""

    extras: dict
    parts: list[MeshPart]


def read_glb(data: bytes) -> Glb:
    """Read the default scene of a binary glTF 2.0 file.

    Args:
        data: Content of the file.

    Returns:
        Extras and mesh parts of the scene.

    Raises:
        ValueError: The file is invalid or uses an unsupported feature; the message names the fault.
    """
    try:
        tree, binary = _read_chunks(data)
        _refuse(tree)
        buffers = [_read_buffer(entry, index, binary) for index, entry in enumerate(tree.get("buffers", []))]
        scene = tree["scenes"][tree.get("scene", 0)]
        parts, total = [], 0
        for node, file_from_mesh in _list_placed_nodes(tree, scene.get("nodes", [])):
            for primitive in tree["meshes"][node["mesh"]]["primitives"] if "mesh" in node else ():
                read = [primitive["attributes"]["POSITION"], primitive.get("indices")]
                total += sum(tree["accessors"][index]["count"] for index in read if index is not None)
                if total > MAX_NUMBERS:
                    raise ValueError(f"the file holds more than {MAX_NUMBERS} vertices; export one scene per file")
                parts.append(_read_part(tree, buffers, node, primitive, file_from_mesh))
        return Glb(dict(scene.get("extras", {})), parts)
    except (LookupError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"the file is not well-formed glTF ({error!r}); export it again") from error


def _read_chunks(data: bytes) -> tuple[dict, bytes]:
    """Return the parsed JSON chunk and the binary chunk. An absent binary chunk is returned as empty."""
    if data[:4] != b"glTF" or len(data) < 20:
        raise ValueError(f"the file begins with {data[:4]!r} and is not a binary glTF file; export as .glb")
    version, length = np.frombuffer(data, "<u4", 2, 4).tolist()
    if version != 2 or length > len(data):
        raise ValueError(
            f"glTF version {version} with {len(data)} of {length} bytes; expected a whole file of version 2"
        )
    chunks, start = {}, 12
    while start + 8 <= length:
        size, kind = np.frombuffer(data, "<u4", 2, start).tolist()
        if start + 8 + size > length:
            raise ValueError(f"a chunk of {size} bytes exceeds the end of the file; copy or export it again")
        chunks.setdefault(kind, data[start + 8 : start + 8 + size])
        start += 8 + size
    return json.loads(chunks[JSON_CHUNK]), chunks.get(BINARY_CHUNK, b"")


def _read_buffer(entry: dict, index: int, binary: bytes) -> bytes:
    """Return the content of a buffer: its data URI, or the binary chunk if the first buffer has no URI."""
    if "uri" not in entry:
        if index:
            raise ValueError(f"buffer {index} has neither a URI nor the binary chunk; export the file again")
        return binary
    header, _, text = entry["uri"].partition(",")
    try:
        if not header.endswith(";base64"):
            raise ValueError(f"its URI begins with {header[:40]!r}")
        content = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError) as error:
        raise ValueError(f"buffer {index} is not valid base64 ({error}); export the file again") from error
    if len(content) < entry["byteLength"]:
        raise ValueError(f"buffer {index} has {len(content)} of {entry['byteLength']} bytes; export the file again")
    return content


def _refuse(tree: dict) -> None:
    for kind in ("buffers", "images"):
        if any(not entry.get("uri", DATA_URI).startswith(DATA_URI) for entry in tree.get(kind, [])):
            raise ValueError(f"{kind} lie outside the file; export as one self-contained .glb")
    unread = set(tree.get("extensionsRequired", [])) - HARMLESS | MOVES_VERTICES & set(tree.get("extensionsUsed", []))
    if unread:
        raise ValueError(f"the reader does not support {', '.join(sorted(unread))}; export without it")


def _list_placed_nodes(tree: dict, roots: list[int]) -> Iterator[tuple[dict, np.ndarray]]:
    """Yield each node with its transform file_from_node (4, 4). Parents come first."""
    seen, todo = set(), [(root, np.eye(4)) for root in reversed(roots)]
    while todo:
        index, file_from_parent = todo.pop()
        if index in seen:
            raise ValueError(f"node {index} has two parents, which glTF forbids; export it again")
        seen.add(index)
        node = tree["nodes"][index]
        file_from_node = file_from_parent @ _compute_node_transform(node)
        yield node, file_from_node
        todo += [(child, file_from_node) for child in reversed(node.get("children", []))]


def _compute_node_transform(node: dict) -> np.ndarray:
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T  # The file stores a matrix column by column.
    transform = np.eye(4)
    rotation = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix()
    transform[:3, :3] = rotation * np.array(node.get("scale", [1, 1, 1]), float)
    transform[:3, 3] = node.get("translation", [0, 0, 0])
    return transform


def _read_part(tree: dict, buffers: list[bytes], node: dict, primitive: dict, file_from_mesh: np.ndarray) -> MeshPart:
    attributes, mode = primitive["attributes"], primitive.get("mode", TRIANGLES)
    if mode not in (POINTS, TRIANGLES):
        raise ValueError(f"a mesh has the drawing mode {mode}, which is not read; export triangles")
    local = _read_accessor(tree, buffers, attributes["POSITION"])
    vertices = local @ file_from_mesh[:3, :3].T + file_from_mesh[:3, 3]
    if not (np.abs(vertices) < FAR_M).all():
        raise ValueError(f"vertices are NaN or lie beyond {FAR_M:.0f} m; export the scene in metres")
    corner = (
        _read_accessor(tree, buffers, primitive["indices"])[:, 0] if "indices" in primitive else np.arange(len(local))
    )
    triangles = corner[: len(corner) * (mode == TRIANGLES)].astype(np.int64).reshape(-1, 3)
    if len(triangles) and not 0 <= triangles.min() <= triangles.max() < len(vertices):
        raise ValueError(
            f"triangles refer to vertex {triangles.max()}, but the mesh has {len(vertices)} vertices; export it again"
        )
    material = tree["materials"][primitive["material"]] if "material" in primitive else {}
    base = material.get("pbrMetallicRoughness", {}).get("baseColorFactor", [1.0, 1.0, 1.0])[:3]
    color = np.tile(np.array(base, float), (len(vertices), 1))
    if "COLOR_0" in attributes:
        color *= _read_accessor(tree, buffers, attributes["COLOR_0"])[:, :3]
    if not ((color >= 0) & (color <= 1)).all():
        raise ValueError("colours lie outside [0, 1]; export 8-bit colours")
    return MeshPart(dict(node.get("extras", {})), file_from_mesh, vertices, triangles, color)


def _read_accessor(tree: dict, buffers: list[bytes], index: int) -> np.ndarray:
    """Return the values (count, width) of an accessor.

    Floats and normalised integers are returned as float64; other integers keep their stored type.
    """
    accessor = tree["accessors"][index]
    if "sparse" in accessor or "bufferView" not in accessor:
        raise ValueError(f"accessor {index} is sparse, which the reader does not support; export dense buffers")
    view, kind = tree["bufferViews"][accessor["bufferView"]], np.dtype(COMPONENTS[accessor["componentType"]])
    binary = buffers[view["buffer"]]
    count, width = accessor["count"], WIDTHS[accessor["type"]]
    item = kind.itemsize * width
    stride, start = view.get("byteStride", item), view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    if count < 0 or start < 0 or stride < item or start + max(count - 1, 0) * stride + item * (count > 0) > len(binary):
        raise ValueError(f"accessor {index} reads beyond its buffer of {len(binary)} bytes; copy or export it again")
    values = np.ndarray((count, width), kind, binary, start, (stride, kind.itemsize))
    if kind.kind == "f":
        return values.astype(np.float64)
    return (values / np.iinfo(kind).max).clip(-1) if accessor.get("normalized") else values
