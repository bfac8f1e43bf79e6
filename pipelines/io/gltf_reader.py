"""Read binary glTF 2.0 files from untrusted sources as meshes, and apply the transforms of the nodes.

The reader uses only the content of the file. A buffer is the binary chunk or a base64 `data:` URI (glTF 2.0, Sec.
3.6.1.1), as Open3D writes it. The reader opens no other URI, decodes no texture and decompresses nothing. Colours are
returned as stored.

A file is valid in full, or an error names the place and the fault. The reader counts nodes, placements and vertices
before it computes with them, because a small file can place one mesh many times (models/limits.py).
"""

from __future__ import annotations

import base64
import binascii
import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from models.limits import find_limit, require_within
from models.strict_json import parse_json

JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
MAX_CHUNKS = 16
PADDING = 3  # Maximum number of bytes after the content of a buffer.
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
FLOAT, UNSIGNED_INT = 5126, 5125
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
POINTS, TRIANGLES = 0, 4
QUANTIZED = "KHR_mesh_quantization"  # The extension that allows positions with integers of up to 16 bits.
HARMLESS = {"KHR_materials_unlit", QUANTIZED}  # Required extensions that do not affect the reader.
DATA_URI = "data:"
MOVES_VERTICES = {"KHR_draco_mesh_compression", "EXT_meshopt_compression", "EXT_mesh_gpu_instancing"}
FAR_M = 1e6
HUGE = 1e15  # Largest accepted number in JSON.
LARGEST_COUNT = 2**53  # Largest accepted count or offset; JSON can state integers that exceed any float.
ROUNDING = 1e-3  # Largest accepted deviation of a quaternion from length 1.
SHOWN = 40  # Maximum number of characters of a value in an error message.
LISTS = ("accessors", "bufferViews", "buffers", "images", "materials", "meshes", "nodes", "scenes")
REQUIRED: Any = object()  # Marks a value that has no default.
LAST_ROW = [0.0, 0.0, 0.0, 1.0]


class LocalMesh(NamedTuple):
    """A mesh primitive in its own frame; all placements share it.

    Attributes:
        vertices: Vertices.
        triangles: Vertex indices; shape (0, 3) for a point cloud.
        color: Stored colours in [0, 1]: the vertex colour times the colour of the material.
    """

    vertices: np.ndarray  # (v, 3) float64
    triangles: np.ndarray  # (t, 3) int64
    color: np.ndarray  # (v, 3) float64


class MeshPart(NamedTuple):
    """A mesh primitive of a node. `place_parts` transforms its vertices to the frame of the file.

    Attributes:
        node: Index of the node.
        extras: Extras of the node.
        file_from_mesh: Transform from the frame of the mesh to the frame of the file.
        local: The mesh primitive in its own frame.
    """

    node: int
    extras: dict
    file_from_mesh: np.ndarray  # (4, 4)
    local: LocalMesh


class Glb(NamedTuple):
    """Content of a file.

    Attributes:
        extras: Extras of the default scene.
        parts: Mesh parts in the order of the node tree.
        bare: Index and extras of each placed node without a mesh.
    """

    extras: dict
    parts: list[MeshPart]
    bare: list[tuple[int, dict]]


def read_glb(data: bytes) -> Glb:
    """Read the default scene of a binary glTF 2.0 file.

    Args:
        data: Content of the file.

    Returns:
        Extras and mesh parts of the scene.

    Raises:
        ValueError: The file is invalid, exceeds a limit or uses an unsupported feature; the message names the place and
            the fault.
    """
    require_within("glb_bytes", len(data))
    content, binary = _read_chunks(data)
    return _Reader(_parse_tree(content), binary).read_scene()


def place_parts(parts: list[MeshPart]) -> list[np.ndarray]:
    """Transform the vertices of mesh parts to the frame of the file.

    Args:
        parts: Mesh parts.

    Returns:
        Vertices (v, 3) float64 of each part.

    Raises:
        ValueError: The parts together exceed the limit glb_vertices, or vertices are NaN or beyond FAR_M.
    """
    count = sum(len(part.local.vertices) + part.local.triangles.size for part in parts)
    require_within("glb_vertices", count, "all placements")
    placed = []
    for part in parts:
        with np.errstate(over="ignore", invalid="ignore"):
            vertices = part.local.vertices @ part.file_from_mesh[:3, :3].T + part.file_from_mesh[:3, 3]
        if not np.abs(vertices).max() < FAR_M:
            raise ValueError(
                f"node {part.node}: vertices are NaN or lie beyond {FAR_M:.0f} m; export the scene in metres"
            )
        placed.append(vertices)
    return placed


# -------------------------------------------------------------------------------------------------------- container


def _read_chunks(data: bytes) -> tuple[bytes, memoryview]:
    """Return the JSON chunk and the binary chunk. An absent binary chunk is returned as empty."""
    if not data:
        raise ValueError("the file is empty; export it again as .glb")
    if data[:4] != b"glTF" or len(data) < 20:
        raise ValueError(f"the file begins with {data[:4]!r} and is not a binary glTF file; export as .glb")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2 or length != len(data):
        raise ValueError(
            f"the file has {len(data)} bytes and states {length} bytes of glTF version {version}; expected a whole file"
            " of version 2: copy or export it again"
        )
    chunks, start, whole = [], 12, memoryview(data)
    while start < length:
        size, kind = struct.unpack_from("<II", data, start) if start + 8 <= length else (length, 0)
        if start + 8 + size > length:
            raise ValueError(f"a chunk of {size} bytes exceeds the end of the file; copy or export it again")
        if len(chunks) == MAX_CHUNKS:
            raise ValueError(f"the file has more than {MAX_CHUNKS} chunks; export it again")
        chunks.append((kind, whole[start + 8 : start + 8 + size]))
        start += 8 + size
    kinds = [kind for kind, _ in chunks]
    if kinds[0] != JSON_CHUNK or JSON_CHUNK in kinds[1:] or BINARY_CHUNK in kinds[2:]:
        raise ValueError(
            f"the chunks have the types {', '.join(map(hex, kinds))}; expected JSON and then at most one binary chunk"
        )
    return bytes(chunks[0][1]), chunks[1][1] if BINARY_CHUNK in kinds else whole[:0]


def _parse_tree(content: bytes) -> dict[str, Any]:
    try:
        tree = parse_json(content)
    except ValueError as error:
        raise ValueError(f"the JSON chunk is invalid ({error}); export it again") from error
    if type(tree) is not dict:
        raise ValueError("the JSON chunk holds no object; export it again")
    return tree


# ------------------------------------------------------------------------------------------------------ JSON values


def _show(value: Any) -> str:
    if type(value) in (dict, list):
        return f"an {'object' if type(value) is dict else 'array'} of {len(value)} values"
    shown = "null" if value is None else f"'{value[:SHOWN]}'" if type(value) is str else str(value)[:SHOWN]
    return shown


KIND_NAMES = {int: "an integer", float: "a number", str: "a text", list: "an array", dict: "an object", bool: "a bool"}


def _get(entry: dict, key: str, kind: type, place: str, default: Any = REQUIRED) -> Any:
    """Return a value of exactly one type; true is no integer, and 1.0 is no integer either."""
    if key not in entry and default is not REQUIRED:
        return default
    if key not in entry:
        raise ValueError(f"{place} has no {key!r}; export it again")
    value = entry[key]
    if type(value) is not kind:
        raise ValueError(f"{place}: {key!r} is {_show(value)}, expected {KIND_NAMES[kind]}; export it again")
    return value


def _get_count(entry: dict, key: str, place: str, default: Any = REQUIRED, low: int = 0) -> int:
    value = _get(entry, key, int, place, default)
    if not low <= value <= LARGEST_COUNT:
        raise ValueError(f"{place}: {key!r} is {_show(value)}, expected at least {low}; export it again")
    return value


def _get_numbers(entry: dict, key: str, count: int, place: str) -> list[float]:
    values = _get(entry, key, list, place)
    if len(values) != count:
        raise ValueError(f"{place}: {key!r} has {len(values)} values, expected {count}; export it again")
    for value in values:
        if type(value) not in (int, float) or not -HUGE <= value <= HUGE:
            raise ValueError(
                f"{place}: {key!r} holds {_show(value)}, expected numbers within {HUGE:g}; export it again"
            )
    return [float(value) for value in values]


def _pick(entries: list, index: Any, place: str, kind: str) -> Any:
    """Return the entry with an index, which may not be negative, as negative indices count from the end in Python."""
    if type(index) is not int or not 0 <= index < len(entries):
        raise ValueError(f"{place} refers to {kind} {_show(index)}, but the file has {len(entries)}; export it again")
    return entries[index]


def _list_names(tree: dict, key: str) -> set[str]:
    names = _get(tree, key, list, "the file", [])
    if any(type(name) is not str for name in names):
        raise ValueError(f"{key!r} holds {_show(names)}, expected texts; export it again")
    return set(names)


# ------------------------------------------------------------------------------------------------------------ scene


def _get_extras(node: dict) -> dict:
    """Return the extras of a node; glTF also allows values that are no objects."""
    extras = node.get("extras")
    return extras if type(extras) is dict else {}


class _Reader:
    """Reads a parsed file. A mesh is read once, regardless of how many nodes place it."""

    def __init__(self, tree: dict[str, Any], binary: memoryview) -> None:
        asset = _get(tree, "asset", dict, "the file")
        if not _get(asset, "version", str, "the asset").startswith("2."):
            raise ValueError(f"the asset has version {_show(asset['version'])}, expected 2.0; export it again")
        self.lists: dict[str, list[dict]] = {key: _get(tree, key, list, "the file", []) for key in LISTS}
        require_within("glb_nodes", len(self.lists["nodes"]))
        for key, entries in self.lists.items():
            if any(type(entry) is not dict for entry in entries):
                raise ValueError(f"{key!r} holds values that are no objects; export it again")
        for key in ("buffers", "images"):
            uris = [_get(entry, "uri", str, key, DATA_URI) for entry in self.lists[key]]
            if not all(uri.startswith(DATA_URI) for uri in uris):
                raise ValueError(f"{key} lie outside the file; export as one self-contained .glb")
        required, used = _list_names(tree, "extensionsRequired"), _list_names(tree, "extensionsUsed")
        if unread := required - HARMLESS | MOVES_VERTICES & used:
            names = ", ".join(sorted(name[:SHOWN] for name in unread)[:5])
            raise ValueError(f"the reader does not support {names}; export without it")
        self.is_quantized = QUANTIZED in required | used
        self.default_scene = _get_count(tree, "scene", "the file", 0)
        self.buffers = [_read_buffer(entry, index, binary) for index, entry in enumerate(self.lists["buffers"])]
        self.meshes: dict[int, list[LocalMesh]] = {}
        self.sizes: dict[int, int] = {}

    def read_scene(self) -> Glb:
        scene = _pick(self.lists["scenes"], self.default_scene, "the file", "scene")
        roots = _get(scene, "nodes", list, f"scene {self.default_scene}", [])
        placed, bare, placements, total = [], [], 0, 0
        most_placements = find_limit("glb_placements")
        for index, node, file_from_mesh in self._list_placed_nodes(roots):
            if "mesh" not in node:
                bare.append((index, _get_extras(node)))
                continue
            mesh = node["mesh"]
            primitives = self._list_primitives(mesh, f"node {index}")
            placements += len(primitives)
            if placements > most_placements:
                require_within("glb_placements", placements, f"node {index}", is_partial=True)
            if mesh not in self.sizes:
                self.sizes[mesh] = sum(self._count_numbers(entry, f"mesh {mesh}") for entry in primitives)
                total += self.sizes[mesh]
                require_within("glb_vertices", total, f"mesh {mesh}", is_partial=True)
            if "skin" in node:
                raise ValueError(f"node {index} has a skin, which is not read; export it without an armature")
            _refuse_morphs(node, f"node {index}")
            placed.append((index, node, mesh, file_from_mesh))
        parts = []
        for index, node, mesh, file_from_mesh in placed:
            extras = _get_extras(node)
            parts += [MeshPart(index, extras, file_from_mesh, local) for local in self._read_mesh(mesh)]
        return Glb(_get(scene, "extras", dict, "the scene", {}), parts, bare)

    def _list_placed_nodes(self, roots: list) -> Iterator[tuple[int, dict, np.ndarray]]:
        """Yield the index of each node, the node and its transform file_from_node (4, 4). Parents come first."""
        nodes, seen = self.lists["nodes"], set()
        todo: list[tuple[Any, np.ndarray, str]] = [(root, np.eye(4), "the scene") for root in reversed(roots)]
        while todo:
            index, file_from_parent, parent = todo.pop()
            node = _pick(nodes, index, parent, "node")
            if index in seen:
                raise ValueError(f"node {index} has two parents, which glTF forbids; export it again")
            seen.add(index)
            place = f"node {index}"
            with np.errstate(over="ignore", invalid="ignore"):
                file_from_node = file_from_parent @ _compute_node_transform(node, place)
            yield index, node, file_from_node
            children = _get(node, "children", list, place, [])
            if len(todo) + len(children) > len(nodes):
                raise ValueError(f"node {index} has more children than the file has nodes; export it again")
            todo += [(child, file_from_node, place) for child in reversed(children)]

    # -------------------------------------------------------------------------------------------------- meshes

    def _list_primitives(self, mesh: Any, place: str) -> list:
        primitives = _get(_pick(self.lists["meshes"], mesh, place, "mesh"), "primitives", list, f"mesh {mesh}")
        if not primitives:
            raise ValueError(f"mesh {mesh} has no primitive; export it again")
        return primitives

    def _count_numbers(self, primitive: Any, place: str) -> int:
        """Return the number of vertices and of triangle corners of a primitive."""
        if type(primitive) is not dict:
            raise ValueError(f"{place} has the primitive {_show(primitive)}, expected an object; export it again")
        indices = [_get(_get(primitive, "attributes", dict, place), "POSITION", int, place)]
        if "indices" in primitive:
            indices.append(primitive["indices"])
        accessors = [(_pick(self.lists["accessors"], index, place, "accessor"), index) for index in indices]
        return sum(_get_count(accessor, "count", f"accessor {index}", low=1) for accessor, index in accessors)

    def _read_mesh(self, mesh: int) -> list[LocalMesh]:
        if mesh not in self.meshes:
            entry, place = self.lists["meshes"][mesh], f"mesh {mesh}"
            _refuse_morphs(entry, place)
            self.meshes[mesh] = [self._read_primitive(primitive, place) for primitive in entry["primitives"]]
        return self.meshes[mesh]

    def _read_primitive(self, primitive: dict, place: str) -> LocalMesh:
        attributes, mode = primitive["attributes"], _get(primitive, "mode", int, place, TRIANGLES)
        if mode not in (POINTS, TRIANGLES):
            raise ValueError(f"{place} has the drawing mode {_show(mode)}, which is not read; export triangles")
        kinds = COMPONENTS.keys() - {UNSIGNED_INT} if self.is_quantized else {FLOAT}
        vertices = self._read_accessor(attributes["POSITION"], ("VEC3",), kinds, place).astype(np.float64)
        return LocalMesh(
            vertices,
            self._read_triangles(primitive, mode, len(vertices), place),
            self._read_color(primitive, len(vertices), place),
        )

    def _read_triangles(self, primitive: dict, mode: int, num_vertices: int, place: str) -> np.ndarray:
        if "indices" not in primitive:
            corner = np.arange(num_vertices if mode == TRIANGLES else 0)
        elif mode == POINTS:
            raise ValueError(f"{place} is a point cloud with indices, which are not read; export it without indices")
        else:
            kinds = {kind for kind, dtype in COMPONENTS.items() if "u" in dtype}
            corner = self._read_accessor(primitive["indices"], ("SCALAR",), kinds, place, False)[:, 0]
        if len(corner) % 3:
            raise ValueError(f"{place} has {len(corner)} triangle corners, expected a multiple of 3; export it again")
        if len(corner) and corner.max() >= num_vertices:
            raise ValueError(
                f"{place}: triangles refer to vertex {corner.max()}, but the mesh has {num_vertices} vertices; export"
                " it again"
            )
        return corner.astype(np.int64).reshape(-1, 3)

    def _read_color(self, primitive: dict, num_vertices: int, place: str) -> np.ndarray:
        base = [1.0, 1.0, 1.0]
        if "material" in primitive:
            material = _pick(self.lists["materials"], primitive["material"], place, "material")
            where = f"material {primitive['material']}"
            pbr = _get(material, "pbrMetallicRoughness", dict, where, {})
            if "baseColorFactor" in pbr:
                base = _get_numbers(pbr, "baseColorFactor", 4, where)[:3]
        color = np.tile(np.array(base, float), (num_vertices, 1))
        if "COLOR_0" in primitive["attributes"]:
            index = primitive["attributes"]["COLOR_0"]
            kinds = {kind for kind, dtype in COMPONENTS.items() if dtype in ("<u1", "<u2", "<f4")}
            stored = self._read_accessor(index, ("VEC3", "VEC4"), kinds, place)
            if len(stored) != num_vertices or stored.dtype.kind != "f":
                raise ValueError(
                    f"accessor {index} has {len(stored)} colours of type {stored.dtype} for {num_vertices} vertices;"
                    " export one normalised colour per vertex"
                )
            color *= stored[:, :3]
        if not (color.min(initial=0) >= 0 and color.max(initial=0) <= 1):
            raise ValueError(f"{place}: colours lie outside [0, 1]; export 8-bit colours")
        return color

    def _read_accessor(
        self, index: Any, types: tuple[str, ...], kinds: set[int], user: str, may_normalise: bool = True
    ) -> np.ndarray:
        """Return the values (count, width) of an accessor.

        Floats and normalised integers are returned as float64; other integers keep their stored type.
        """
        accessor, place = _pick(self.lists["accessors"], index, user, "accessor"), f"accessor {index}"
        if "sparse" in accessor or "bufferView" not in accessor:
            raise ValueError(f"{place} is sparse, which the reader does not support; export dense buffers")
        kind, shape = _get(accessor, "componentType", int, place), _get(accessor, "type", str, place)
        normalized = _get(accessor, "normalized", bool, place, False)
        if (
            kind not in kinds
            or shape not in types
            or (normalized and (kind in (FLOAT, UNSIGNED_INT) or not may_normalise))
        ):
            expected = f"type {' or '.join(types)} and component type {' or '.join(map(str, sorted(kinds)))}"
            raise ValueError(
                f"{place} has type {_show(shape)}, component type {_show(kind)} and normalized {normalized}, but {user}"
                f" needs {expected}; export it again"
            )
        view_index = accessor["bufferView"]
        view = _pick(self.lists["bufferViews"], view_index, place, "bufferView")
        where = f"bufferView {view_index}"
        binary = _pick(self.buffers, view.get("buffer"), where, "buffer")
        first, size = _get_count(view, "byteOffset", where, 0), _get_count(view, "byteLength", where, low=1)
        if first + size > len(binary):
            raise ValueError(
                f"{where} ends at byte {first + size}, beyond its buffer of {len(binary)} bytes; export it again"
            )
        dtype, count = np.dtype(COMPONENTS[kind]), _get_count(accessor, "count", place, low=1)
        item = dtype.itemsize * WIDTHS[shape]
        stride, start = _get_count(view, "byteStride", where, item), _get_count(accessor, "byteOffset", place, 0)
        if stride < item or start + (count - 1) * stride + item > size:
            raise ValueError(f"{place} reads beyond its buffer view of {size} bytes; copy or export it again")
        values = np.ndarray((count, WIDTHS[shape]), dtype, binary, first + start, (stride, dtype.itemsize))
        if dtype.kind == "f":
            return values.astype(np.float64)
        return (values / np.iinfo(dtype).max).clip(-1) if normalized else values


def _refuse_morphs(entry: dict, place: str) -> None:
    if any(weight != 0 for weight in _get(entry, "weights", list, place, [])):
        raise ValueError(f"{place} has morph weights, which are not read; export it without shape keys")


def _read_buffer(entry: dict, index: int, binary: memoryview) -> memoryview:
    """Return the content of a buffer: its data URI, or the binary chunk if the first buffer has no URI."""
    place = f"buffer {index}"
    size = _get_count(entry, "byteLength", place, low=1)
    content = binary
    if "uri" in entry:
        header, _, text = entry["uri"].partition(",")
        try:
            if not header.endswith(";base64"):
                raise ValueError(f"its URI begins with {header[:SHOWN]!r}")
            content = memoryview(base64.b64decode(text, validate=True))
        except (binascii.Error, ValueError) as error:
            raise ValueError(f"{place} is not valid base64 ({error}); export the file again") from error
    elif index:
        raise ValueError(f"{place} has neither a URI nor the binary chunk; export the file again")
    if not size <= len(content) <= size + PADDING:
        raise ValueError(f"{place} has {len(content)} of {size} bytes; export the file again")
    return content[:size]


def _compute_node_transform(node: dict, place: str) -> np.ndarray:
    transform = np.eye(4)
    if "matrix" in node:
        if "rotation" in node or "scale" in node or "translation" in node:
            raise ValueError(f"{place} has a matrix and a rotation, scale or translation; export it again")
        # The file stores a matrix column by column.
        transform = np.array(_get_numbers(node, "matrix", 16, place)).reshape(4, 4).T
        if transform[3].tolist() != LAST_ROW:
            raise ValueError(f"{place}: the last row of 'matrix' is {transform[3]}, expected 0, 0, 0, 1; export again")
        return transform
    if "rotation" in node:
        x, y, z, w = _get_numbers(node, "rotation", 4, place)
        length = (x * x + y * y + z * z + w * w) ** 0.5
        if not abs(length - 1) <= ROUNDING:
            raise ValueError(
                f"{place}: 'rotation' has length {length:.6g}, expected a unit quaternion; export it again"
            )
        x, y, z, w = x / length, y / length, z / length, w / length
        transform[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    if "scale" in node:
        transform[:3, :3] *= _get_numbers(node, "scale", 3, place)
    if "translation" in node:
        transform[:3, 3] = _get_numbers(node, "translation", 3, place)
    return transform
