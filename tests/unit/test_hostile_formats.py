"""Tests of the readers of .npz and GLB files with hostile and damaged files.

A reader returns the content of a valid file, or it raises a ValueError that names the file. It must not use up memory
or time.
"""

import io
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest

from models.limits import LIMITS
from pipelines.io.voxel_import import read_voxels
from pipelines.metrics.adm_npz import iterate_pictures, read_picture_shape, read_reference_moments
from pipelines.runtime.npz import open_npz

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
    "fields": (zip_entries(("voxels.npy", make_npy(describe((32, 32, 4), [("a", "|u1")]), bytes(4096)))), "its type"),
    "void": (zip_entries(("voxels.npy", make_npy(describe((32, 32, 4), "|V1"), bytes(4096)))), "its type is"),
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
def test_read_voxels_refuses_hostile_file_with_its_name_and_fault(tmp_path, fault):
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
