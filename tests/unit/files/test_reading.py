"""Bounded and checked reading of files that may be damaged or hostile."""

import os
from collections.abc import Callable
from pathlib import Path
from tomllib import TOMLDecodeError
from zipfile import ZipFile

import numpy as np
import pytest

from nlos_cam import files
from nlos_cam.files import read_arrays, read_bounded, read_checked


def test_checked_files_are_refused_when_any_byte_differs(tmp_path: Path) -> None:
    files.write_checked(tmp_path, {"a.bin": b"one", "b.bin": b"two"})
    files.write_checked(tmp_path, {"b.bin": b"three"})

    assert [read_checked(tmp_path / name, 10) for name in ("a.bin", "b.bin")] == [b"one", b"three"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [files.CHECKSUMS, "a.bin", "b.bin"]

    (tmp_path / "a.bin").write_bytes(b"onf")

    with pytest.raises(ValueError, match="checksum"):
        read_checked(tmp_path / "a.bin", 10)

    (tmp_path / files.CHECKSUMS).unlink()

    assert read_checked(tmp_path / "a.bin", 10) == b"onf"  # weights from before checksums


def test_bounded_read_refuses_long_files_and_pipes(tmp_path: Path) -> None:
    (tmp_path / "long").write_bytes(bytes(files.TEXT_LIMIT + 1))
    os.mkfifo(tmp_path / "pipe")
    for name, problem in (("long", "longer than the 1 MiB"), ("pipe", "not a regular file")):
        with pytest.raises(OSError, match=problem):
            read_bounded(tmp_path / name, files.TEXT_LIMIT)


def test_describe_gives_one_line() -> None:
    errors = [
        RecursionError(),
        MemoryError(),
        OSError(28, "No space left on device"),
        ValueError("a\n b"),
        KeyError(),
    ]

    assert [files.describe(error) for error in errors] == [
        "it is nested too deeply",
        "it needs more memory than there is",
        "No space left on device",
        "a b",
        "its parts contradict each other",
    ]


def _lying(folder: Path, edit: Callable[[bytes], bytes]) -> Path:
    np.savez(folder / "whole.npz", depth_m=np.ones((4, 4), np.float32), other=np.ones(2))
    with ZipFile(folder / "whole.npz") as whole, ZipFile(folder / "bad.npz", "w") as bad:
        bad.writestr("depth_m.npy", edit(whole.read("depth_m.npy")))
    return folder / "bad.npz"


@pytest.mark.parametrize(
    "edit",
    [
        lambda content: content.replace(b"(4, 4)", b"(9999999999, 4)"),
        lambda content: content.replace(b"<f4", b"|O "),
        lambda content: content.replace(b"{'descr'", b"((((((((("),
        lambda content: content[:-1],
        lambda _: b"",
    ],
)
def test_read_arrays_refuses_a_header_that_lies(
    tmp_path: Path, edit: Callable[[bytes], bytes]
) -> None:
    with pytest.raises(ValueError, match=r"^.+$"):
        read_arrays(_lying(tmp_path, edit), ["depth_m"])


def test_read_arrays_returns_what_was_saved_within_its_limit(tmp_path: Path) -> None:
    path = _lying(tmp_path, bytes)

    assert read_arrays(path)["depth_m"].tolist() == np.ones((4, 4)).tolist()

    with pytest.raises(ValueError, match="more than 0 MiB"):
        read_arrays(path, limit=100)
    with pytest.raises(ValueError, match="other"):
        read_arrays(path, ["other"])

    path.write_bytes(b"no archive")

    with pytest.raises(ValueError, match="zip"):
        read_arrays(path)


@pytest.mark.parametrize("part", ["a.", "a . ", '{"a":', "{a = ", "[", "a ", '"a.'])
def test_deep_toml_is_refused_without_much_work(tmp_path: Path, part: str) -> None:
    path = tmp_path / "a.toml"
    path.write_text(f"x = 1\n{part * 100_000}a = 1\n")  # minutes, where work grows as the square
    with pytest.raises(TOMLDecodeError):
        files.read_toml(path)
