"""Tests of ADM's .npz batches: exchange with numpy, memory use, and errors for damaged files."""

import tracemalloc
import zipfile

import numpy as np
import pytest

from pipelines.metrics.adm_npz import iterate_pictures, read_picture_shape, read_reference_moments, write_npz
from pipelines.metrics.frechet import StoredGaussian, compute_frechet_distance, compute_moments


def make_pictures(n=7, height=5, width=6) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (n, height, width, 3), dtype=np.uint8)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize("batch", [1, 3, 7, 100])
def test_npz_images_are_read_whole_in_order(tmp_path, save, batch):
    path = str(tmp_path / "samples.npz")
    save(path, make_pictures(), np.arange(7))  # ADM stores images as arr_0 and labels as arr_1
    assert read_picture_shape(path) == (7, 5, 6, 3)
    parts = list(iterate_pictures(path, batch))
    assert [len(part) for part in parts[:-1]] == [batch] * (len(parts) - 1) and 0 < len(parts[-1]) <= batch
    assert all(part.flags.writeable for part in parts)
    np.testing.assert_array_equal(np.concatenate(parts), make_pictures())


def test_npz_without_images_has_no_batches(tmp_path):
    np.savez(tmp_path / "none.npz", make_pictures(0))
    assert list(iterate_pictures(str(tmp_path / "none.npz"), 4)) == []


@pytest.mark.parametrize("grouping", [[7], [3, 4], [1] * 7])
def test_npz_writer_is_readable_by_numpy(tmp_path, grouping):
    path = str(tmp_path / "new" / "samples.npz")
    write_npz(path, iter(np.split(make_pictures(), np.cumsum(grouping)[:-1])), 7)
    with np.load(path, allow_pickle=False) as written:
        assert written.files == ["arr_0"]
        np.testing.assert_array_equal(written["arr_0"], make_pictures())
    np.testing.assert_array_equal(np.concatenate(list(iterate_pictures(path, 2))), make_pictures())


def test_npz_memory_is_bounded_by_batch(tmp_path):
    """The functions read and write 67 MB of images with less than 8 MB of memory."""
    path = str(tmp_path / "many.npz")
    tracemalloc.start()
    try:
        write_npz(path, (np.full((16, 128, 128, 3), i, np.uint8) for i in range(85)), 85 * 16)
        total = sum(int(part[0, 0, 0, 0]) for part in iterate_pictures(path, 16))
        assert tracemalloc.get_traced_memory()[1] < 8e6
    finally:
        tracemalloc.stop()
    assert total == sum(range(85))


# ------------------------------------------------------------------------------------------------------ bad files


def assert_refused(path, match):
    with pytest.raises(ValueError, match=match) as raised:
        iterate_pictures(str(path), 4)  # the call fails before it reads the first image
    assert str(path) in str(raised.value)


def test_npz_reader_rejects_files_without_images(tmp_path):
    path = tmp_path / "x.npz"
    assert_refused(path, "no such file")
    path.write_bytes(b"not an archive")
    assert_refused(path, "begins with b'not ' and is not an .npz archive")
    np.savez(path, images=make_pictures())
    assert_refused(path, r"no array 'arr_0', only 'images'")
    np.savez(path, make_pictures().astype(np.float32))
    assert_refused(path, "arr_0 is float32")
    np.savez(path, make_pictures().transpose(0, 3, 1, 2).copy())
    assert_refused(path, r"uint8 \(7, 3, 5, 6\); pictures are uint8 \(N, height, width, 3\)")
    np.savez(path, np.asfortranarray(make_pictures()))
    assert_refused(path, "Fortran order")
    np.savez(path, make_pictures())
    with pytest.raises(ValueError, match="at least 1 picture, got 0"):
        iterate_pictures(str(path), 0)


def test_npz_reader_rejects_pickle_without_reading(tmp_path):
    class Trap:
        def __reduce__(self):
            return open, (str(tmp_path / "sprung"), "w")

    path = tmp_path / "x.npz"
    np.savez(path, np.array([Trap()], dtype=object))
    assert_refused(path, "pickled")
    np.savez(path, mu=np.array([Trap()], dtype=object), sigma=np.zeros((2, 2)))
    with pytest.raises(ValueError, match="pickled"):
        read_reference_moments(str(path))
    assert not (tmp_path / "sprung").exists()


def test_npz_reader_names_truncated_and_damaged_files(tmp_path):
    path = tmp_path / "x.npz"
    np.savez(path, make_pictures())
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])  # an incomplete copy
    assert_refused(path, "damaged or not an .npz archive")

    at = whole.index(make_pictures().tobytes()) + 300
    path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])  # one wrong bit in the fourth image
    with pytest.raises(ValueError, match=r"x\.npz: array 'arr_0' is damaged .*CRC"):
        list(iterate_pictures(str(path), 2))

    with zipfile.ZipFile(path, "w") as archive, archive.open("arr_0.npy", "w") as stream:  # the writer stopped early
        header = {"descr": "|u1", "fortran_order": False, "shape": (7, 5, 6, 3)}
        np.lib.format.write_array_header_1_0(stream, header)
        stream.write(make_pictures()[:6].tobytes())
    assert_refused(path, r"array 'arr_0' of shape \(7, 5, 6, 3\) needs 630 bytes, has 540")


def test_npz_writer_rejects_bad_images_and_leaves_no_file(tmp_path):
    path = str(tmp_path / "x.npz")
    for batches, count, match in (
        ([make_pictures()], 8, "got 7 pictures, expected 8"),
        ([make_pictures(), make_pictures()], 7, "got 14 pictures, expected 7"),
        ([make_pictures(), make_pictures(1, 4, 6)], 8, r"equal size, got uint8 \(1, 4, 6, 3\); the 7 "),
        ([make_pictures().astype(np.float32)], 7, "got float32"),
        ([make_pictures()[..., :1]], 7, r"got uint8 \(7, 5, 6, 1\)"),
        ([], 0, "no pictures to write"),
    ):
        with pytest.raises(ValueError, match=match):
            write_npz(path, iter(batches), count)
    assert list(tmp_path.iterdir()) == []


# ----------------------------------------------------------------------------------------------- reference batches


def test_npz_reference_moments_equal_those_of_features(tmp_path):
    rng = np.random.default_rng(1)
    pool3, spatial = rng.normal(size=(30, 2048)).astype(np.float32), rng.normal(size=(30, 2023)).astype(np.float32)
    path = str(tmp_path / "reference.npz")
    arrays = {"mu": pool3.mean(0), "sigma": np.cov(pool3, rowvar=False)}
    np.savez(path, make_pictures(), **arrays, mu_s=spatial.mean(0), sigma_s=np.cov(spatial, rowvar=False))
    found = read_reference_moments(path)
    np.testing.assert_allclose(found.spatial.covariance, compute_moments(spatial).covariance, atol=1e-12)
    assert found.spatial.mean.shape == (2023,)
    assert found.pool3.mean.dtype == found.pool3.covariance.dtype == np.float64
    np.testing.assert_allclose(found.pool3.covariance, compute_moments(pool3).covariance, atol=1e-12)
    np.testing.assert_array_equal(np.concatenate(list(iterate_pictures(path, 4))), make_pictures())

    np.savez(path, **arrays)  # TTUR and pytorch-fid use these names
    assert read_reference_moments(path).spatial is None
    np.savez(path, make_pictures())
    assert read_reference_moments(path) is None


def test_npz_reference_moments_give_frechet_distance():
    deviation = np.array([0.0, 1.0, 2.0])
    reference = StoredGaussian(np.zeros(3), np.diag(deviation**2))
    assert compute_frechet_distance(compute_moments(np.ones((3, 3))), reference) == pytest.approx(3 + 5)
    assert compute_frechet_distance(reference, compute_moments(np.ones((3, 3)))) == pytest.approx(3 + 5)


def test_npz_reader_rejects_incomplete_or_foreign_moments(tmp_path):
    path = str(tmp_path / "x.npz")
    mu, sigma = np.zeros(2048), np.eye(2048, dtype=np.float32)
    broken = mu.copy()
    broken[5] = np.nan
    for arrays, match in (
        ({"mu": mu}, r"holds \['mu'\] only"),
        ({"mu": mu, "sigma": sigma, "mu_s": mu}, r"only; a mean \(mu\) and its covariance"),
        (
            {"mu": mu[:768], "sigma": sigma},
            r"mu has type float64 and shape \(768,\), expected floats of shape \(2048,\)",
        ),
        ({"mu": mu, "sigma": sigma[:5]}, "sigma has type float32"),
        ({"mu": broken, "sigma": sigma}, "mu holds NaN"),
    ):
        np.savez(path, **arrays)
        with pytest.raises(ValueError, match=match):
            read_reference_moments(path)
    with pytest.raises(ValueError, match="no such file"):
        read_reference_moments(str(tmp_path / "absent.npz"))
