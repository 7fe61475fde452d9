"""Laws of atomic writes, claims, cache entries and checked files, also with processes killed or
racing.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from tomllib import TOMLDecodeError
from typing import Any
from unittest.mock import Mock
from zipfile import ZipFile

import numpy as np
import pytest

from nlos_cam import files
from nlos_cam.files import (
    FileBusyError,
    OutputExistsError,
    atomic_file,
    claim,
    claims,
    load_cached,
    read_arrays,
    read_bounded,
    read_checked,
)

FORK = multiprocessing.get_context("fork")


def test_exclusive_write_refuses_a_file_that_appeared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.txt"
    for link in (os.link, Mock(side_effect=OSError(95, "no links"))):
        monkeypatch.setattr(os, "link", link)
        with atomic_file(path, exclusive=True) as part:
            part.write_text("first", encoding="utf-8")
        with (
            pytest.raises(OutputExistsError, match=r"a\.txt exists"),
            atomic_file(path, exclusive=True) as part,
        ):
            part.write_text("second", encoding="utf-8")
        assert path.read_text(encoding="utf-8") == "first"
        path.unlink()
    assert not list(tmp_path.iterdir())


def test_claim_refuses_a_second_writer_and_names_the_first(tmp_path: Path) -> None:
    with (
        claim(tmp_path / "a"),
        pytest.raises(FileBusyError, match=f"process {os.getpid()} on "),
        claim(tmp_path / "a"),
    ):
        pytest.fail("two writers")
    with claim(tmp_path / "a") as folder:
        assert folder.is_dir()
    assert not list(tmp_path.iterdir())


def test_reserved_path_is_written_by_its_process_alone(tmp_path: Path) -> None:
    with files.reservations() as reserve:
        reserve(tmp_path / "a")
        process = FORK.Process(
            target=race, args=(tmp_path / "a", *(parts := (FORK.Barrier(1), FORK.SimpleQueue())), 1)
        )
        claims._reserved, held = set(), claims._reserved
        process.start()
        process.join()
        claims._reserved = held
        assert parts[1].get() is None
        for content in ("one", "two"):
            with atomic_file(tmp_path / "a") as part:
                with pytest.raises(FileBusyError), claim(tmp_path / "a"):
                    pytest.fail("two writers in one process")
                part.write_text(content, encoding="utf-8")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def hold(path: Path, ready: Any) -> None:
    with claim(path) as folder:
        (folder / "part").write_text("half", encoding="utf-8")
        ready.set()
        threading.Event().wait(60)


def test_next_claim_removes_parts_of_the_killed_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ready = FORK.Event()
    process = FORK.Process(target=hold, args=(tmp_path / "a", ready))
    process.start()
    assert ready.wait(20)
    os.kill(process.pid or 0, signal.SIGKILL)
    process.join()
    (tmp_path / ".mine.part").mkdir()  # somebody else's, without our lock
    assert (tmp_path / ".a.part" / "part").exists()
    with claim(tmp_path / "living") as folder:
        (folder / "part").write_bytes(b"1")
        monkeypatch.setattr("nlos_cam.files.claims._swept", set())
        with claim(tmp_path / "b"):
            assert not (tmp_path / ".a.part").exists()
            assert (folder / "part").exists()
    assert [path.name for path in tmp_path.iterdir()] == [".mine.part"]


def race(path: Path, start: Any, results: Any, number: int) -> None:
    start.wait()
    try:
        with atomic_file(path, exclusive=True) as part:
            part.write_text(str(number), encoding="utf-8")
        results.put(number)
    except (FileBusyError, OutputExistsError):
        results.put(None)
    except BaseException:
        results.put(-1)  # so that nobody waits for it
        raise


def test_one_of_many_racing_writers_wins(tmp_path: Path) -> None:
    for turn in range(10):
        path = tmp_path / f"{turn}.txt"
        start = FORK.Barrier(4)
        results = FORK.SimpleQueue()
        racers = [
            FORK.Process(target=race, args=(path, start, results, number)) for number in range(4)
        ]
        for racer in racers:
            racer.start()
        for racer in racers:
            racer.join()
        winners = [number for number in (results.get() for _ in racers) if number is not None]
        assert winners == [int(path.read_text(encoding="utf-8"))]
    assert len(list(tmp_path.iterdir())) == 10


def test_claim_is_tried_again_where_its_folder_goes_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The holder before may end between the two looks of mkdir(exist_ok=True): by the claim, or by
    its lock.
    """
    make = Path.mkdir
    removed = iter([True, False, True, False, False])

    def mkdir(folder: Path, *arguments: Any, **options: Any) -> None:
        if next(removed):
            raise FileExistsError(folder)
        make(folder, *arguments, **options)

    with monkeypatch.context() as patch, claim(tmp_path / "a") as folder:
        assert folder.is_dir()
        patch.setattr(Path, "mkdir", mkdir)
        with claim(tmp_path / "b") as other:
            assert other.is_dir()
    (tmp_path / ".c.part").write_bytes(b"")
    with pytest.raises(FileExistsError), claim(tmp_path / "c"):
        pass


def upper(content: bytes) -> str:
    return content.decode("ascii").upper()


@pytest.mark.parametrize("damage", [b"", b"cont", b"cOntent", b"\xff\xfe", None])
def test_damaged_or_foreign_cache_entry_counts_as_absent(
    tmp_path: Path, damage: bytes | None
) -> None:
    entry = tmp_path / "cache" / "world.npz"
    make = Mock(return_value=b"content")
    assert [load_cached(entry, upper, make) for _ in range(3)] == ["CONTENT"] * 3
    make.assert_called_once()
    (file,) = entry.parent.iterdir()
    if damage is None:
        load_cached(entry.with_name("other.npz"), upper, lambda: b"other")
        (other,) = entry.parent.glob("other.*")
        other.replace(file)
    else:
        file.write_bytes(damage)
    assert [load_cached(entry, upper, make) for _ in range(2)] == ["CONTENT"] * 2
    assert make.call_count == 2
    assert len(list(entry.parent.glob("world.*"))) == 1


@pytest.mark.parametrize("place", ["file/below", "/proc/none"])
def test_unusable_cache_or_entry_is_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, place: str
) -> None:
    (tmp_path / "file").write_bytes(b"")
    assert load_cached(tmp_path / place / "a.npz", upper, lambda: b"made") == "MADE"
    assert "NLOS_CAM_CACHE" in caplog.text
    load_cached(tmp_path / "a.npz", bytes, lambda: b"\xff")
    assert load_cached(tmp_path / "a.npz", upper, lambda: b"new") == "NEW"
    assert "making it again" in caplog.text


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


@pytest.mark.parametrize("read", [files.read_toml])
@pytest.mark.parametrize("part", ["a.", "a . ", '{"a":', "{a = ", "[", "a ", '"a.'])
def test_deep_toml_is_refused_without_much_work(
    tmp_path: Path, read: Callable[[Path], object], part: str
) -> None:
    path = tmp_path / "a.toml"
    path.write_text(f"x = 1\n{part * 100_000}a = 1\n")  # minutes, where work grows as the square
    with pytest.raises(TOMLDecodeError):
        read(path)
