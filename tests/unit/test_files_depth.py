"""Depth maps from files: every real type, size and layout reads, and what is wrong has one line that names it."""

import re
from pathlib import Path

import numpy as np
import pytest

from nlos_cam.errors import SceneError
from nlos_cam.objects.meshes import read_depth_map


def _refused(path: Path) -> str:
    with pytest.raises(SceneError) as caught:
        read_depth_map(path)
    told = str(caught.value)
    assert told.startswith(str(path))
    assert "\n" not in told
    return told


REAL = ["f2", "f4", "f8", "g", ">f4", "i1", "u1", "i2", ">i4", "i8", "u8"]


@pytest.mark.parametrize("dtype", REAL)
@pytest.mark.parametrize("size", [8, 64, 256])
def test_depth_maps_of_every_real_type_and_size_read(tmp_path: Path, dtype: str, size: int) -> None:
    depth = np.arange(size * size).reshape(size, size) % 4 / (1 if np.dtype(dtype).kind in "iu" else 8)
    np.save(tmp_path / "map.npy", depth.astype(dtype))
    read = read_depth_map(tmp_path / "map.npy")
    np.testing.assert_array_equal(read, depth)
    assert (read.dtype, type(read), read.flags.c_contiguous) == (np.float32, np.ndarray, True)


@pytest.mark.parametrize("layout", ["transposed", "strided", "reversed", "fortran"])
def test_the_layout_in_memory_does_not_matter(tmp_path: Path, layout: str) -> None:
    whole = np.random.default_rng(0).uniform(0.1, 0.4, (32, 32))
    whole[3:9, 4:20] = np.nan
    views = {"transposed": whole.T, "strided": whole[::2, ::2], "reversed": whole[::-1, ::-1]}
    depth = views.get(layout, np.asfortranarray(whole))
    np.save(tmp_path / "map.npy", depth)
    np.testing.assert_array_equal(read_depth_map(tmp_path / "map.npy"), depth.astype(np.float32))


def test_an_empty_object_is_a_depth_map(tmp_path: Path) -> None:
    np.save(tmp_path / "map.npy", np.full((64, 64), np.nan, np.float16))
    assert np.isnan(read_depth_map(tmp_path / "map.npy")).all()


def _map(value: complex, shape: tuple[int, ...] = (16, 16), dtype: str = "f8") -> np.ndarray:
    depth = np.full(shape, 0.3, dtype)
    depth.reshape(-1)[:1] = value
    return depth


@pytest.mark.parametrize(
    ("depth", "words"),
    [
        (_map(-0.01), r"-0\.01 m.*0 to 10 .*negative is behind the wall"),
        (_map(300), "300 m.*in metres"),
        (_map(300, dtype="u2"), "300 m.*in metres"),
        (_map(np.inf), "inf m"),
        (_map(-np.inf, dtype="f2"), "-inf m"),
        (_map(0.3, (16,)), r"shape \(16,\)"),
        (_map(0.3, (16, 16, 1)), r"shape \(16, 16, 1\)"),
        (_map(0.3, (16, 17)), r"shape \(16, 17\).*\(n, n\) with n from 8 to 256"),
        (_map(0.3, (7, 7)), r"shape \(7, 7\)"),
        (_map(0.3, (257, 257)), r"shape \(257, 257\)"),
        (_map(0.3, ()), r"shape \(\)"),
        (_map(0.3, (0, 0)), r"damaged|shape \(0, 0\)"),
        (_map(0.3, dtype="c8"), "complex64"),
        (_map(True, dtype="?"), "bool"),
        (np.full((16, 16), "a"), "U1"),
        (np.full((16, 16), None), "damaged or no depth map.*numpy.save"),
        (np.zeros((16, 16), "M8[s]"), "datetime"),
        (np.zeros((16, 16), [("depth_m", "f4")]), "depth_m"),
    ],
)
def test_what_is_no_depth_map_has_one_line(tmp_path: Path, depth: np.ndarray, words: str) -> None:
    np.save(tmp_path / "map.npy", depth, allow_pickle=True)
    assert re.search(words, _refused(tmp_path / "map.npy"))


def test_a_file_of_several_arrays_is_no_depth_map(tmp_path: Path) -> None:
    np.savez(tmp_path / "maps.npz", depth_m=_map(0.3))
    assert "damaged or no depth map" in _refused(tmp_path / "maps.npz")


def test_a_header_that_claims_too_much_costs_nothing(tmp_path: Path) -> None:
    np.save(tmp_path / "map.npy", _map(0.3))
    content = (tmp_path / "map.npy").read_bytes()
    claimed = content.replace(b"(16, 16), }            ", b"(1600000, 1600000), }  ")
    assert claimed != content
    (tmp_path / "map.npy").write_bytes(claimed)
    assert "damaged" in _refused(tmp_path / "map.npy")


@pytest.mark.parametrize("cut", [0, 5, 60, 128, 400])
@pytest.mark.parametrize("junk", [b"", b"hello"])
def test_a_damaged_depth_map_is_refused(tmp_path: Path, cut: int, junk: bytes) -> None:
    path = tmp_path / "map.npy"
    np.save(path, _map(0.3))
    path.write_bytes(path.read_bytes()[:cut] + junk)
    assert "damaged or no depth map" in _refused(path)


def test_a_missing_file_or_a_folder_is_named(tmp_path: Path) -> None:
    assert "No such file" in _refused(tmp_path / "none.npy")
    assert "directory" in _refused(tmp_path)
