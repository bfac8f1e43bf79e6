"""Tests of the readers of .npz and GLB files with hostile and damaged files.

A reader returns the content of a valid file, or it raises a ValueError that names the file. It must not use up memory
or time.
"""

import io
import json
import struct
import time
import tracemalloc
import zipfile

import numpy as np
import pytest
import trimesh
from helpers import random_scene

from models.limits import LIMITS
from models.scene import ELLIPSOID, Grid
from pipelines.io.gltf_reader import place_parts, read_glb
from pipelines.io.mesh_export import export_glb
from pipelines.io.mesh_import import import_glb
from pipelines.io.voxel_import import read_voxels
from pipelines.metrics.adm_npz import iterate_pictures, read_picture_shape, read_reference_moments
from pipelines.runtime.npz import open_npz
from pipelines.schema.palette import COLOR_HEX, parse_rgb

VOXELS = np.random.default_rng(0).integers(0, 17, (32, 32, 4)).astype(np.uint8)


def compress_arrays(**arrays) -> bytes:
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    return content.getvalue()


def make_npy(header: str, numbers: bytes = b"", version: bytes = b"\1\0", length: int | None = None) -> bytes:
    """Return a .npy file with any text as its header."""
    text = header.encode("latin1") + b"\n"
    size = len(text) if length is None else length
    return b"\x93NUMPY" + version + size.to_bytes(2 if version == b"\1\0" else 4, "little") + text + numbers


def describe(shape: object, descr: object = "|u1") -> str:
    return f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape}, }}"


def zip_entries(*entries: tuple[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", method) as archive:
        for name, data in entries:
            archive.writestr(name, data)
    return content.getvalue()


def replace_field(content: bytes, local: int, central: int, form: str, value: int) -> bytes:
    """Return a zip file with another value in a field of its first entry, in both of its headers."""
    made = bytearray(content)
    struct.pack_into(form, made, local, value)
    struct.pack_into(form, made, content.index(b"PK\1\2") + central, value)
    return bytes(made)


def set_flags(content: bytes, flags: int) -> bytes:
    return replace_field(content, 6, 8, "<H", flags)


def set_method(content: bytes, method: int) -> bytes:
    return replace_field(content, 8, 10, "<H", method)


def damage_payload(content: bytes) -> bytes:
    """Return a zip file in which the compressed numbers of the first entry are replaced."""
    start = 30 + sum(struct.unpack_from("<HH", content, 26))
    return content[:start] + b"\xff" * 40 + content[start + 40 :]


def state_directory(content: bytes, size: int) -> bytes:
    """Return a zip file that states another length of its directory."""
    made = bytearray(content)
    struct.pack_into("<I", made, content.rindex(b"PK\5\6") + 12, size)
    return bytes(made)


GOOD = zip_entries(("voxels.npy", make_npy(describe((32, 32, 4)), VOXELS.tobytes())))
NESTED = "(" * 3000 + ")" * 3000

HOSTILE_VOXELS = {
    "encrypted": (set_flags(GOOD, 1), "is encrypted"),
    "strongly encrypted": (set_flags(GOOD, 0x41), "is encrypted"),
    "zlib": (damage_payload(GOOD), "'voxels' is damaged"),
    "LZMA": (set_method(GOOD, 14), "compression method 14"),
    "bzip2": (zip_entries(("voxels.npy", make_npy(describe((32, 32, 4)), VOXELS.tobytes())), method=12), "method 12"),
    "unknown method": (set_method(GOOD, 77), "compression method 77"),
    "token": (zip_entries(("voxels.npy", make_npy("{'descr': '|u1', 'shape': (32,", bytes(4096)))), "is damaged"),
    "nested": (zip_entries(("voxels.npy", make_npy(NESTED))), "is damaged"),
    "no suffix": (zip_entries(("voxels", VOXELS.tobytes())), "holds nothing"),
    "long header": (zip_entries(("voxels.npy", make_npy(" " * 20_000, version=b"\2\0"))), "header has 20,001 bytes"),
    "huge header": (zip_entries(("voxels.npy", make_npy("", version=b"\2\0", length=2**32 - 1))), "header has"),
    "huge": (zip_entries(("voxels.npy", make_npy(describe((2**20, 2**20, 2**20))))), "needs .* bytes, has 0"),
    "negative": (zip_entries(("voxels.npy", make_npy(describe((-32, -32, 4)), VOXELS.tobytes()))), "shape is"),
    "boolean": (zip_entries(("voxels.npy", make_npy(describe((True, 4096, 1)), VOXELS.tobytes()))), "shape is"),
    "fields": (
        zip_entries(("voxels.npy", make_npy(describe((32, 32, 4), [("a", "|u1")]), bytes(4096)))),
        "has the type",
    ),
    "void": (zip_entries(("voxels.npy", make_npy(describe((32, 32, 4), "|V1"), bytes(4096)))), "has the type"),
    "missing": (zip_entries(("voxels.npy", make_npy(describe((32, 32, 4)), bytes(4095)))), "4,096 bytes, has 4,095"),
    "trailing": (zip_entries(("voxels.npy", make_npy(describe((32, 32, 4)), bytes(4097)))), "4,096 bytes, has 4,097"),
    "version": (
        zip_entries(("voxels.npy", make_npy(describe((32, 32, 4)), bytes(4096), b"\7\0"))),
        "not a numpy array",
    ),
    "checksum": (replace_field(GOOD, 14, 16, "<I", 1), "CRC"),
    "two sizes": (replace_field(zip_entries(("voxels.npy", b"\x93NUMPY"), method=0), 22, 24, "<I", 99), "is damaged"),
    "directory": (state_directory(GOOD, 2**31), "not an .npz archive"),
}


@pytest.mark.parametrize("fault", HOSTILE_VOXELS)
def test_read_voxels_refuses_hostile_file_with_its_name(tmp_path, fault):
    content, words = HOSTILE_VOXELS[fault]
    path = tmp_path / "theirs.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"theirs\.npz: .*{words}.*expected one scene"):
        read_voxels(str(path))


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_npz_readers_refuse_two_arrays_of_one_name(tmp_path):
    array = make_npy(describe((32, 32, 4)), VOXELS.tobytes())
    for name, read in (("voxels", read_voxels), ("arr_0", read_picture_shape), ("mu", read_reference_moments)):
        path = tmp_path / f"{name}.npz"
        path.write_bytes(zip_entries((f"{name}.npy", array), (f"{name}.npy", array)))
        with pytest.raises(ValueError, match=rf"{name}\.npz: two arrays have the name '{name}\.npy'"):
            read(str(path))


def test_long_zip_directory_is_refused_before_it_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr("pipelines.runtime.npz.DIRECTORY_BYTES", 200)
    path = tmp_path / "x.npz"
    path.write_bytes(zip_entries(*((f"{k}.npy", b"") for k in range(9))))
    with pytest.raises(ValueError, match=r"x\.npz: .*its directory has \d+ bytes; at most 200"):
        read_voxels(str(path))


def test_npz_reader_equals_numpy():
    rng = np.random.default_rng(0)
    for dtype in ("|u1", "<i2", ">i4", "<u8", "<f2", ">f8", "<U5"):
        for shape in ((), (0, 3), (7,), (3, 4, 5)):
            array = rng.integers(0, 100, shape).astype(dtype)
            for order in (array, np.asfortranarray(array)):
                with open_npz(compress_arrays(a=order, b=array)) as archive:
                    assert archive.names == ["a", "b"]
                    got = archive.read("a")
                assert got.dtype == order.dtype and got.shape == order.shape and np.array_equal(got, order)


def test_npz_reader_raises_only_value_error_for_flipped_bytes(tmp_path):
    rng, outcomes = np.random.default_rng(0), {"same": 0, "refused": 0}
    path = tmp_path / "x.npz"
    path.write_bytes(GOOD)
    whole = read_voxels(str(path))
    for _ in range(400):
        made = bytearray(GOOD)
        made[rng.integers(len(made)) if rng.random() < 0.3 else -1 - rng.integers(120)] = rng.integers(256)
        path.write_bytes(bytes(made))
        try:
            assert np.array_equal(read_voxels(str(path)), whole)
            outcomes["same"] += 1
        except ValueError as error:
            assert "x.npz" in str(error)
            outcomes["refused"] += 1
    assert min(outcomes.values()) > 20


def write_pictures_bomb(path, shape: tuple[int, ...]) -> None:
    """Write an .npz file of black pictures that is a thousand times smaller than the pictures."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("arr_0.npy", "w") as stream:
        stream.write(make_npy(describe(shape)))
        left = int(np.prod(shape))
        while left > 0:
            left -= stream.write(bytes(min(left, 2**24)))


def test_picture_bomb_is_refused_before_it_is_decompressed(tmp_path, monkeypatch):
    monkeypatch.setenv("PRITTI_MAX_ARRAY_BYTES", str(2**24))
    path = tmp_path / "bomb.npz"
    write_pictures_bomb(path, (1, 4096, 4096, 3))
    assert path.stat().st_size < 10**5
    tracemalloc.start()
    try:
        for read in (read_picture_shape, lambda path: iterate_pictures(path, 1)):
            with pytest.raises(
                ValueError, match=r"bomb\.npz: a picture of 4096 x 4096: 50,331,648 bytes .*ARRAY_BYTES"
            ):
                read(str(path))
        write_pictures_bomb(path, (64, 512, 512, 3))
        assert read_picture_shape(str(path)) == (64, 512, 512, 3)
        with pytest.raises(ValueError, match=r"bomb\.npz: 64 pictures of 512 x 512: .*ARRAY_BYTES"):
            iterate_pictures(str(path), 64)
        assert sum(len(part) for part in iterate_pictures(str(path), 8)) == 64
        assert tracemalloc.get_traced_memory()[1] < 6e7
    finally:
        tracemalloc.stop()
    assert LIMITS["array_bytes"].value <= 2**28


@pytest.mark.parametrize("shape", [(10**18, 0, 5, 3), (2**62, 0, 0, 3)])
def test_pictures_without_pixels_are_refused(tmp_path, shape):
    path = tmp_path / "x.npz"
    path.write_bytes(zip_entries(("arr_0.npy", make_npy(describe(shape)))))
    with pytest.raises(ValueError, match=r"x\.npz: arr_0 is uint8"):
        iterate_pictures(str(path), 4)


def test_reference_moments_refuse_matrix_that_is_no_covariance(tmp_path):
    rng = np.random.default_rng(0)
    sigma = np.cov(rng.normal(size=(50, 2048)), rowvar=False).astype(np.float32)
    skewed, negative, large = sigma.copy(), sigma.copy(), sigma.copy()
    skewed[3, 700] += 0.5
    negative[7, 7] = -0.1
    large[9, 9] = 1e35
    path = tmp_path / "x.npz"
    np.savez(path, mu=np.zeros(2048), sigma=sigma)
    assert read_reference_moments(str(path)) is not None
    for wrong, words in ((skewed, "no covariance"), (negative, "no covariance"), (large, "beyond 1e")):
        np.savez(path, mu=np.zeros(2048), sigma=wrong)
        with pytest.raises(ValueError, match=rf"x\.npz: sigma .*{words}"):
            read_reference_moments(str(path))


# --------------------------------------------------------------------------------------------------------------- GLB


def join_glb(tree: object, binary: bytes = b"") -> bytes:
    """Return a GLB file with a JSON value, or with any bytes as its JSON chunk."""
    header = tree if isinstance(tree, bytes) else json.dumps(tree).encode()
    header += b" " * (-len(header) % 4)
    body = struct.pack("<I", len(header)) + b"JSON" + header
    if binary:
        body += struct.pack("<I", len(binary)) + b"BIN\0" + binary
    return b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body


def split_glb(glb: bytes) -> tuple[dict, bytes]:
    size = int.from_bytes(glb[12:16], "little")
    return json.loads(glb[20 : 20 + size]), glb[28 + size :]


def make_points_tree(component: int = 5126, dtype: str = "<f4", count: int = 6, **accessor) -> tuple[dict, bytes]:
    """Return JSON and content of a GLB with one triangle mesh whose positions have any component type."""
    positions = np.arange(3 * count).reshape(count, 3).astype(dtype)
    item = -(-3 * positions.itemsize // 4) * 4  # glTF aligns each vertex to four bytes.
    content = b"".join(row.tobytes().ljust(item, b"\0") for row in positions)
    indices = np.arange(count, dtype="<u2").tobytes()
    tree = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_mesh_quantization"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": component, "count": count, "type": "VEC3"} | accessor,
            {"bufferView": 1, "componentType": 5123, "count": count, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": len(content), "byteStride": item},
            {"buffer": 0, "byteOffset": len(content), "byteLength": len(indices)},
        ],
        "buffers": [{"byteLength": len(content) + len(indices)}],
    }
    return tree, content + indices


def refuse_glb(tree: object, binary: bytes, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        place_parts(read_glb(join_glb(tree, binary)).parts)


def set_path(path: tuple, value: object):
    """Return a function that replaces one value of a JSON tree, or deletes the value if `value` is ..."""

    def change(tree: dict) -> None:
        *parents, last = path
        for key in parents:
            tree = tree[key]
        if value is ...:
            del tree[last]
        else:
            tree[last] = value

    return change


POSITION, VIEW, NODE, PART = ("accessors", 0), ("bufferViews", 0), ("nodes", 0), ("meshes", 0, "primitives", 0)
WRONG_VALUES = [
    (("asset",), ..., "the file has no 'asset'"),
    (("asset", "version"), "1.0", "version '1.0'"),
    (("scene",), -1, "'scene' is -1, expected at least 0"),
    (("scene",), True, "'scene' is True, expected an integer"),
    (("scenes", 0, "nodes"), [-1], "the scene refers to node -1"),
    (("scenes", 0, "nodes"), [0.0], r"refers to node 0\.0"),
    (("scenes", 0, "nodes"), [True], "refers to node True"),
    (("scenes", 0, "extras"), [1], "'extras' is an array of 1 values"),
    ((*NODE, "mesh"), -1, "node 0 refers to mesh -1"),
    ((*NODE, "children"), [-1], "node 0 refers to node -1"),
    ((*NODE, "children"), "ab", "'children' is 'ab', expected an array"),
    ((*NODE, "rotation"), [0, 0, 0, 0], "node 0: 'rotation' has length 0"),
    ((*NODE, "rotation"), [0, 0, 0.1, 1], r"node 0: 'rotation' has length 1\.00499"),
    ((*NODE, "rotation"), [0, 0, 0], "node 0: 'rotation' has 3 values, expected 4"),
    ((*NODE, "scale"), [True, 1, 1], "node 0: 'scale' holds True, expected numbers"),
    ((*NODE, "scale"), [1, 1, "1"], "node 0: 'scale' holds '1', expected numbers"),
    ((*NODE, "translation"), [0, 10**400, 0], "node 0: 'translation' holds 1000"),
    ((*NODE, "translation"), [0, None, 0], "node 0: 'translation' holds null"),
    ((*NODE, "translation"), [0, 1e7, 0], "node 0: vertices are NaN or lie beyond"),
    ((*NODE, "matrix"), [1] * 16, r"node 0: the last row of 'matrix' is \[1"),
    ((*NODE, "skin"), 0, "node 0 has a skin"),
    ((*NODE, "weights"), [0.5], "node 0 has morph weights"),
    (("meshes", 0, "primitives"), [], "mesh 0 has no primitive"),
    ((*PART, "indices"), -1, "mesh 0 refers to accessor -1"),
    ((*PART, "indices"), 0, "accessor 0 has type 'VEC3', component type 5126"),
    ((*PART, "attributes", "POSITION"), 0.0, r"'POSITION' is 0\.0, expected an integer"),
    ((*PART, "attributes", "COLOR_0"), 1, "accessor 1 has type 'SCALAR'"),
    ((*PART, "mode"), 1, "drawing mode 1"),
    ((*PART, "mode"), 0, "is a point cloud with indices"),
    ((*PART, "material"), -1, "mesh 0 refers to material -1"),
    (("accessors", 1, "componentType"), 5122, "accessor 1 has type 'SCALAR', component type 5122"),
    (("accessors", 1, "componentType"), 5126, "accessor 1 has type 'SCALAR', component type 5126"),
    (("accessors", 1, "normalized"), True, "accessor 1 .* normalized True"),
    (("accessors", 1, "count"), 5, "mesh 0 has 5 triangle corners, expected a multiple of 3"),
    ((*POSITION, "count"), 3, "triangles refer to vertex 5, but the mesh has 3 vertices"),
    ((*POSITION, "count"), 0, "accessor 0: 'count' is 0, expected at least 1"),
    ((*POSITION, "count"), 6.5, r"accessor 0: 'count' is 6\.5, expected an integer"),
    ((*POSITION, "componentType"), 5124, "component type 5124"),
    ((*POSITION, "componentType"), 5125, "component type 5125"),
    ((*POSITION, "type"), "VEC2", "type 'VEC2'"),
    ((*POSITION, "normalized"), True, "normalized True"),
    ((*POSITION, "normalized"), 1, "'normalized' is 1, expected a bool"),
    ((*POSITION, "byteOffset"), -12, "accessor 0: 'byteOffset' is -12"),
    ((*POSITION, "byteOffset"), 12, "accessor 0 reads beyond its buffer view of 72 bytes"),
    ((*POSITION, "bufferView"), -1, "accessor 0 refers to bufferView -1"),
    ((*POSITION, "sparse"), {}, "accessor 0 is sparse"),
    ((*VIEW, "byteOffset"), -4, "bufferView 0: 'byteOffset' is -4"),
    ((*VIEW, "byteLength"), 71, "accessor 0 reads beyond its buffer view of 71 bytes"),
    ((*VIEW, "byteLength"), 1000, "bufferView 0 ends at byte 1000, beyond its buffer of 84 bytes"),
    ((*VIEW, "byteLength"), ..., "bufferView 0 has no 'byteLength'"),
    ((*VIEW, "buffer"), -1, "bufferView 0 refers to buffer -1"),
    (("buffers", 0, "byteLength"), 100, "buffer 0 has 84 of 100 bytes"),
    (("buffers", 0, "byteLength"), 8, "buffer 0 has 84 of 8 bytes"),
    (("buffers", 0, "uri"), 5, "'uri' is 5, expected a text"),
    (("nodes",), [0], "'nodes' holds values that are no objects"),
    (("extensionsUsed",), [5], "'extensionsUsed' holds"),
    (("extensionsUsed",), [], "component type 5121"),
]


@pytest.mark.parametrize("path, value, words", WRONG_VALUES)
def test_glb_reader_names_place_and_value(path, value, words):
    tree, binary = make_points_tree()
    if path == ("extensionsUsed",) and not value:  # Integer positions need the extension.
        tree, binary = make_points_tree(5121, "<u1")
    assert len(read_glb(join_glb(tree, binary)).parts) == 1
    set_path(path, value)(tree)
    refuse_glb(tree, binary, words)


def test_glb_reader_refuses_what_is_no_json():
    tree, binary = make_points_tree()
    text = json.dumps(tree)
    for changed, words in (
        (text.replace('"mesh": 0', '"mesh": 0, "translation": [NaN, 0, 0]'), "NaN is not a JSON number"),
        (text.replace('"mesh": 0', '"mesh": 0, "translation": [1e999, 0, 0]'), "range of 64-bit numbers"),
        (text.replace('"scene": 0', '"scene": 0, "scene": 0'), "the key 'scene' occurs twice"),
        (text.replace('"scene": 0', f'"scene": {"[" * 10**5}{"]" * 10**5}'), "nested too deeply"),
        (text[:-1], "the JSON chunk is invalid"),
        ("[]", "holds no object"),
    ):
        refuse_glb(changed.encode(), binary, words)
    refuse_glb(text.encode().replace(b"nodes", b"n\xffdes"), binary, "the JSON chunk is invalid")


def test_glb_reader_refuses_damaged_chunks():
    glb = join_glb(*make_points_tree())
    size = int.from_bytes(glb[12:16], "little")

    def state_length(content: bytes) -> bytes:
        return content[:8] + struct.pack("<I", len(content)) + content[12:]

    empty = struct.pack("<II", 0, 0x1234)
    assert len(read_glb(state_length(glb + empty)).parts) == 1
    for changed, words in (
        (glb + b"\0\0\0\0", "expected a whole file"),
        (state_length(glb + b"\0\0\0\0"), "exceeds the end of the file"),
        (state_length(glb + empty * 100_000), "more than 16 chunks"),
        (state_length(glb + glb[12 : 20 + size]), "expected JSON and then at most one binary chunk"),
        (state_length(glb[:12] + glb[20 + size :] + glb[12 : 20 + size]), "expected JSON and then"),
        (state_length(glb[:12]), "is not a binary glTF file"),
    ):
        with pytest.raises(ValueError, match=words):
            read_glb(changed)


def make_amplified_tree(num_primitives: int, num_nodes: int, count: int = 1) -> tuple[dict, bytes]:
    tree, binary = make_points_tree()
    tree["meshes"] = [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 0}] * num_primitives}]
    tree["accessors"][0]["count"] = count
    tree["nodes"] = [{"mesh": 0}] * num_nodes
    tree["scenes"][0]["nodes"] = list(range(num_nodes))
    return tree, binary


def test_glb_reader_counts_before_it_allocates(monkeypatch):
    start = time.process_time()
    refuse_glb(*make_amplified_tree(1500, 1500), "mesh primitives of a GLB file, .* at most 100,000")
    refuse_glb(*make_amplified_tree(0, 1500), "has no primitive")
    refuse_glb(*make_amplified_tree(1, 1, 2**22), "mesh 0: .* vertices and triangle corners .* at most 3,000,000")
    tree, binary = make_points_tree()
    tree["nodes"], tree["scenes"][0]["nodes"] = [{"mesh": 0}] * 100, list(range(100))
    monkeypatch.setenv("PRITTI_MAX_GLB_VERTICES", "1000")
    assert len(read_glb(join_glb(tree, binary)).parts) == 100
    refuse_glb(tree, binary, "all placements: 1,200 vertices and triangle corners .* at most 1,000")
    refuse_glb(*make_amplified_tree(1, 1, 10**400), "'count' is 1000")
    assert time.process_time() - start < 3
    monkeypatch.setenv("PRITTI_MAX_GLB_NODES", "1000")
    monkeypatch.setenv("PRITTI_MAX_JSON_VALUES", "10000")
    refuse_glb(*make_amplified_tree(1, 1001), "1,001 nodes of a GLB file; at most 1,000")
    refuse_glb(b"[" + b"[]," * 5000 + b"0]", b"", "the JSON chunk is invalid .10,001 commas, .* at most 10,000")
    monkeypatch.setenv("PRITTI_MAX_GLB_BYTES", "100")
    with pytest.raises(ValueError, match="bytes of a GLB file; at most 100"):
        import_glb(join_glb(*make_points_tree()))


# trimesh reads no vertices of type 5125, because glTF has none.
POSITION_TYPES = [(5120, "<i1"), (5121, "<u1"), (5122, "<i2"), (5123, "<u2"), (5126, "<f4")]


@pytest.mark.parametrize("component, dtype", POSITION_TYPES)
def test_glb_reader_equals_trimesh_for_component_type(component, dtype):
    tree, binary = make_points_tree(component, dtype)
    tree["nodes"] = [{"children": [1], "rotation": [0.5, 0.5, -0.5, 0.5], "translation": [1, 2, 3]}]
    tree["nodes"] += [{"mesh": 0, "scale": [2, 0.5, 3]}]
    (part,) = read_glb(join_glb(tree, binary)).parts
    theirs = trimesh.load_scene(io.BytesIO(join_glb(tree, binary)), file_type="glb", process=False)
    (mesh,) = theirs.dump()
    np.testing.assert_allclose(place_parts([part])[0], mesh.vertices, atol=1e-12)
    np.testing.assert_array_equal(part.local.triangles, mesh.faces)


@pytest.mark.parametrize("component, dtype", [(5121, "<u1"), (5123, "<u2"), (5125, "<u4")])
def test_glb_reader_equals_trimesh_for_index_type(component, dtype):
    box = trimesh.creation.icosphere(subdivisions=1)
    tree, binary = split_glb(trimesh.Scene(box).export(file_type="glb"))
    (primitive,) = tree["meshes"][0]["primitives"]
    accessor = tree["accessors"][primitive["indices"]]
    content = box.faces.astype(dtype).tobytes()
    accessor |= {"componentType": component, "bufferView": len(tree["bufferViews"]), "byteOffset": 0}
    tree["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(content)})
    tree["buffers"][0]["byteLength"] = len(binary + content)
    (part,) = read_glb(join_glb(tree, binary + content)).parts
    np.testing.assert_array_equal(part.local.triangles, box.faces)
    np.testing.assert_allclose(place_parts([part])[0], box.vertices, atol=1e-7)


@pytest.mark.parametrize("name", ["generated_low_0", "high_121", "low_12", "medium_240"])
def test_glb_reader_equals_trimesh_for_files_of_the_authors(real_data, name):
    path = real_data / "glb" / f"{name}.glb"
    (part,) = read_glb(path.read_bytes()).parts
    mesh = trimesh.load(path, process=False, force="mesh")
    np.testing.assert_array_equal(place_parts([part])[0], mesh.vertices)
    np.testing.assert_array_equal(part.local.triangles, mesh.faces)
    assert np.abs(255 * part.local.color - np.asarray(mesh.visual.vertex_colors)[:, :3]).max() < 1


SMALL_GRID = Grid(front_m=64.0, left_m=32.0, resolution_m=0.25, rows=8, cols=8)
EXTRAS, LAST = ("scenes", 0, "extras"), ("nodes", -1, "extras")
WRONG_EXTRAS = [
    ((*EXTRAS, "grid"), ..., "'grid' is missing"),
    ((*EXTRAS, "ground_classes"), [], "'ground_classes' are no list"),
    ((*EXTRAS, "ground_classes"), "road", "'ground_classes' are no list"),
    ((*EXTRAS, "ground_classes"), ["road"], "name other ground classes than the file"),
    ((*EXTRAS, "grid", "rows"), 8.0, "'rows' is no integer"),
    ((*EXTRAS, "grid", "rows"), True, "'rows' is no integer"),
    ((*EXTRAS, "grid", "cols"), -8, "'cols' is no integer from 1"),
    ((*EXTRAS, "grid", "resolution_m"), 0, "'resolution_m' is 0, expected a number"),
    ((*EXTRAS, "grid", "resolution_m"), 1e-300, "'resolution_m' is 1e-300"),
    ((*EXTRAS, "grid", "front_m"), "64", "'front_m' is 64, expected a number"),
    ((*EXTRAS, "frame"), 0.5, "'frame' is no integer"),
    ((*EXTRAS, "frame"), 2**63, "'frame' is no integer"),
    ((*EXTRAS, "scene_id"), 7, "'scene_id' is no text"),
    ((*EXTRAS, "scene_id"), "", "'scene_id' is empty"),
    ((*EXTRAS, "split"), "a\u0000b", "'split' is no text"),
    ((*EXTRAS, "source"), "x" * 1001, "1,001 characters of an id"),
    ((*EXTRAS, "vehicle_density"), "huge", "density label"),
    ((*EXTRAS, "vehicle_density"), [], "density label"),
    ((*EXTRAS, "world_xyz_m"), [0, 0], "'world_xyz_m' is no list of 3"),
    ((*EXTRAS, "world_yaw_rad"), True, "'world_yaw_rad' is bool"),
    ((*LAST, "category"), "tree", "'category' is 'tree'"),
    ((*LAST, "category"), ["pole"], "'category' is no text"),
    ((*LAST, "category"), ..., "name neither a category nor ground classes"),
    ((*LAST, "size_m"), [1, 2, -3], "'size_m' is -3, expected a number"),
    ((*LAST, "size_m"), [1, 2, 10**400], "'size_m' is 1000"),
    ((*LAST, "size_m"), [[1], [2], [3]], "'size_m' is list"),
    ((*LAST, "existence"), 1.5, "'existence' is 1.5"),
    ((*LAST, "existence"), "1", "'existence' is 1, expected a number"),
    ((*LAST, "heading_rad"), 6.0, "'heading_rad' is 6.0"),
    ((*LAST, "yaw_rad"), None, "'yaw_rad' is NoneType"),
    ((*LAST, "instance_id"), 1.5, "'instance_id' is no integer"),
    ((*LAST, "instance_id"), 2**63, "'instance_id' is no integer"),
    ((*LAST, "label"), ["a"], "'label' is no text"),
]


@pytest.mark.parametrize("path, value, words", WRONG_EXTRAS)
def test_import_refuses_wrong_extras_of_export(path, value, words):
    tree, binary = split_glb(export_glb(random_scene(6, n=2, grid=SMALL_GRID)))
    set_path(path, value)(tree)
    with pytest.raises(ValueError, match=f"^GLB: .*{words}"):
        import_glb(join_glb(tree, binary))


def test_import_refuses_changed_shapes_of_export():
    scene = random_scene(6, n=3, grid=SMALL_GRID, category=np.int8([ELLIPSOID, 3, 3]))
    tree, binary = split_glb(export_glb(scene))
    assert len(import_glb(join_glb(tree, binary))) == 3
    matrix = tree["nodes"][-1]["matrix"]
    sheared = [*matrix[:4], *(b + 0.01 * a for a, b in zip(matrix[:4], matrix[4:8], strict=True)), *matrix[8:]]
    for path, value, words in (
        (("nodes", -1, "matrix"), sheared, "axes of node . are not perpendicular"),
        (("nodes", -1, "mesh"), 0, "the mesh of node . is no cube of size 1"),
        (("nodes", -3, "extras", "category"), "pole", "the mesh of node . is no cube of size 1"),
        (("nodes", -1, "extras", "category"), "vegetation_ellipsoid", "the mesh of node . is no sphere of size 1"),
    ):
        changed, _ = split_glb(join_glb(tree, binary))
        set_path(path, value)(changed)
        with pytest.raises(ValueError, match=words):
            import_glb(join_glb(changed, binary))


def test_import_reads_export_of_many_trees():
    """The spheres of an export share one mesh, and the import does not transform its vertices."""
    scene = random_scene(6, n=700, grid=SMALL_GRID, category=np.full(700, ELLIPSOID, np.int8))
    got = import_glb(export_glb(scene))
    np.testing.assert_array_equal(got.center_m, scene.center_m)
    np.testing.assert_array_equal(got.size_m, scene.size_m)


def export_ground(positions_m: np.ndarray, names: np.ndarray) -> bytes:
    """Return a GLB with ground vertices in the authors' frame; the class "" is a colour between two classes."""
    palette = {name: parse_rgb(COLOR_HEX[name]) for name in ("road", "terrain")} | {"": (110, 150, 140)}
    color = np.array([palette[name] for name in names], np.uint8)
    cloud = trimesh.PointCloud(positions_m, colors=np.column_stack([color, np.full(len(color), 255)]))
    return trimesh.Scene(cloud).export(file_type="glb")


def test_import_of_repeated_ground_vertices_is_fast():
    count = 60_000
    positions = np.tile([30.0, 0.0, 0.0], (count, 1))
    names = np.array(["road", ""] * (count // 2))
    positions[::2, 0] = 30.25
    tree, binary = split_glb(export_ground(positions, names))
    for mesh in tree["meshes"]:  # A point cloud may not have uncoloured points, so the points become triangles.
        mesh["primitives"][0]["mode"] = 4
    start = time.process_time()
    scene = import_glb(join_glb(tree, binary))
    assert scene.occupied.sum() == 2 and time.process_time() - start < 3


def test_import_fits_a_limited_number_of_ellipsoids(monkeypatch):
    monkeypatch.setenv("PRITTI_MAX_GLB_ELLIPSOIDS", "3")
    scene = random_scene(6, n=4, grid=SMALL_GRID, category=np.full(4, ELLIPSOID, np.int8))
    tree, binary = split_glb(export_glb(scene))
    for entry in (*tree["scenes"], *tree["nodes"]):
        entry.pop("extras", None)
    with pytest.raises(ValueError, match=r"4 ellipsoids .* at most 3"):
        import_glb(join_glb(tree, binary), axes=("y+", "z+", "x+"))
