"""Laws of atomic writes, claims, cache entries and checked files, also with processes killed or
racing.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from nlos_cam import files
from nlos_cam.files import (
    FileBusyError,
    OutputExistsError,
    atomic_file,
    claim,
    claims,
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
        held = claims._reserved
        claims._reserved = set()  # as another process has it
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


def kill_within(work: Callable[[Path, Any], None], path: Path) -> None:
    """Kill a process that has done its work on a path and holds the claim."""
    ready = FORK.Event()
    process = FORK.Process(target=work, args=(path, ready))
    process.start()

    assert ready.wait(20)

    os.kill(process.pid or 0, signal.SIGKILL)
    process.join()


def test_next_claim_removes_parts_of_the_killed_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kill_within(hold, tmp_path / "a")
    (tmp_path / ".mine.part").mkdir()  # somebody else's, without our lock

    assert (tmp_path / ".a.part" / "part").exists()

    with claim(tmp_path / "living") as folder:
        (folder / "part").write_bytes(b"1")
        monkeypatch.setattr("nlos_cam.files.claims._swept", set())
        with claim(tmp_path / "b"):
            assert not (tmp_path / ".a.part").exists()
            assert (folder / "part").exists()

    assert [path.name for path in tmp_path.iterdir()] == [".mine.part"]


def replace_and_hang(path: Path, ready: Any) -> None:
    with claim(path) as folder:
        path.replace(files.replaced_folder(folder) / path.name)
        path.write_text("begun", encoding="utf-8")
        ready.set()
        threading.Event().wait(60)


@pytest.mark.parametrize("next_name", ["a", "b"])
def test_next_claim_puts_back_what_the_killed_had_taken_away(
    tmp_path: Path, next_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a").write_text("old", encoding="utf-8")
    kill_within(replace_and_hang, tmp_path / "a")
    monkeypatch.setattr("nlos_cam.files.claims._swept", set())
    with claim(tmp_path / next_name):
        assert (tmp_path / "a").read_text(encoding="utf-8") == "old"

    assert [path.name for path in tmp_path.iterdir()] == ["a"]


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
