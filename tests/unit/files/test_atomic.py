import multiprocessing
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from nlos_cam.errors import OutputExistsError
from nlos_cam.files import (
    FileBusyError,
    atomic_directory,
    atomic_file,
    atomic_files,
    cache_folder,
)


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({"NLOS_CAM_CACHE": "chosen", "XDG_CACHE_HOME": "other"}, "chosen"),
        ({"NLOS_CAM_CACHE": "", "XDG_CACHE_HOME": "other"}, "other/nlos-cam"),
        ({"XDG_CACHE_HOME": "other"}, "other/nlos-cam"),
        ({"XDG_CACHE_HOME": ""}, ".cache/nlos-cam"),
        ({"NLOS_CAM_CACHE": ""}, ".cache/nlos-cam"),
        ({}, ".cache/nlos-cam"),
    ],
)
def test_cache_folder_is_chosen_by_variables(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, variables: dict[str, str], expected: str
) -> None:
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    for name in ("NLOS_CAM_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value and str(tmp_path / value))

    assert cache_folder() == tmp_path / expected
    assert not cache_folder().exists()


def test_atomic_file_appears_when_it_is_on_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out.txt"
    synced = list[int]()
    out.write_text("old")
    monkeypatch.setattr("nlos_cam.files.atomic.os.fsync", synced.append)
    with atomic_file(out) as part:
        part.write_text("new")
        assert out.read_text() == "old"

    assert out.read_text() == "new"
    assert len(synced) == 2, "the file, then its folder"
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt])
def test_atomic_writes_leave_nothing_after_an_error(
    tmp_path: Path, error: type[BaseException]
) -> None:
    def write() -> None:
        with (
            atomic_directory(tmp_path / "folder") as folder,
            atomic_file(tmp_path / "file") as file,
        ):
            (folder / "a.txt").write_text("a")
            file.write_text("b")
            raise error

    with pytest.raises(error):
        write()

    assert list(tmp_path.iterdir()) == []


def test_atomic_directory_appears_when_it_is_whole(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with atomic_directory(out) as part:
        (part / "inner").mkdir()
        (part / "inner" / "a.txt").write_text("a")
        assert not out.exists()
        with pytest.raises(FileBusyError), atomic_directory(out):
            pytest.fail("two writers")

    assert (out / "inner" / "a.txt").read_text() == "a"
    assert list(tmp_path.iterdir()) == [out]


def test_atomic_directory_refuses_one_that_appeared_and_a_file(tmp_path: Path) -> None:
    def write() -> None:
        with atomic_directory(tmp_path / "out") as part:
            (part / "b.txt").write_text("b")
            (tmp_path / "out").mkdir()
            (tmp_path / "out" / "a.txt").write_text("a")

    with pytest.raises(OutputExistsError, match="appeared"):
        write()

    assert [path.name for path in (tmp_path / "out").iterdir()] == ["a.txt"]

    (file := tmp_path / "mine.txt").write_text("precious")

    with pytest.raises(OutputExistsError, match=r"mine\.txt"), atomic_directory(file):
        pass

    assert file.read_text() == "precious"


@pytest.mark.parametrize("way", ["exchange", "no exchange", "no links", "current folder"])
def test_atomic_directory_replaces_entries_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    out = tmp_path / "out"
    for folder in ("inner", "kept/deep"):
        (out / folder).mkdir(parents=True)
        (out / folder / "old.txt").write_text("old")
    (out / "past").mkdir()
    (out / "past" / "gone.txt").write_text("old")
    (out / "mine.txt").write_text("mine")
    (out / "stale-1.txt").write_text("old")
    (out / "stale-2.txt").write_text("old")
    if way == "no exchange":
        monkeypatch.setattr("nlos_cam.files.atomic._exchange", lambda *_: False)
    if way == "no links":
        monkeypatch.setattr("nlos_cam.files.atomic._link_all", lambda *_: False)
    if way == "current folder":
        monkeypatch.chdir(out)
    with atomic_directory(out, drop=["stale-*.txt", "past*/"]) as part:
        (part / "inner").mkdir()
        (part / "inner" / "new.txt").write_text("new")
        (part / "stale-2.txt").write_text("new")
        assert (out / "stale-1.txt").read_text() == "old"
    files = sorted(str(path.relative_to(out)) for path in out.rglob("*.txt"))

    assert files == ["inner/new.txt", "kept/deep/old.txt", "mine.txt", "stale-2.txt"]
    assert (out / "stale-2.txt").read_text() == "new"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("mode", [0o700, 0o2775])
def test_atomic_directory_keeps_the_permissions_of_the_old_one(tmp_path: Path, mode: int) -> None:
    out = tmp_path / "out"
    out.mkdir()
    out.chmod(mode)
    with atomic_directory(out) as part:
        (part / "new.txt").write_text("new")

    assert out.stat().st_mode & 0o7777 == mode
    assert (out / "new.txt").exists()


def test_dropped_files_are_no_folders_nor_links_to_them(tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "folder").mkdir(parents=True)
    (out / "link").symlink_to(out / "folder")
    (out / "old.txt").write_text("old")
    with atomic_directory(out, drop=["*"]) as part:
        (part / "new.txt").write_text("new")

    assert sorted(path.name for path in out.iterdir()) == ["folder", "link", "new.txt"]


def overwrite_and_die(out: Path, calls: int) -> None:
    """Write a directory over another, and die before the call of the system with this number that
    renames or links.
    """
    left = iter(range(calls))
    rename = Path.rename
    link = os.link
    replace = Path.replace

    def dying(call: Callable[..., Any]) -> Callable[..., Any]:
        def act(*arguments: Any, **options: Any) -> Any:
            if next(left, None) is None:
                os.kill(os.getpid(), signal.SIGKILL)
            return call(*arguments, **options)

        return act

    Path.rename = dying(rename)
    os.link = dying(link)
    Path.replace = dying(replace)  # type: ignore[method-assign]
    with atomic_directory(out) as part:
        for name in "abc":
            (part / name).mkdir()
            (part / name / "new").write_text("new")


def test_directory_is_old_or_new_whenever_its_writer_dies(tmp_path: Path) -> None:
    fork = multiprocessing.get_context("fork")
    states = set[str]()
    for existed in (True, False):
        for calls in range(4):
            out = tmp_path / f"{existed}{calls}"
            for name in ("a", "b", "mine1", "mine2") if existed else ():
                (out / name).mkdir(parents=True)
                (out / name / "old").write_text("old")
            process = fork.Process(target=overwrite_and_die, args=(out, calls))
            process.start()
            process.join()
            found = " ".join(
                sorted(
                    f"{path.parent.name}/{path.name}" for path in out.rglob("*") if path.is_file()
                )
            )
            states.add(found)
    old = "a/old b/old mine1/old mine2/old"
    whole = "a/new b/new c/new"

    assert states == {old, f"{whole} mine1/old mine2/old", "", whole}


def test_files_that_belong_together_appear_together(tmp_path: Path) -> None:
    paths = [tmp_path / "one", tmp_path / "two"]
    with atomic_files(*paths) as parts:
        for part, text in zip(parts, ("first", "second"), strict=True):
            part.write_text(text)

        assert not any(path.exists() for path in paths)

    assert [path.read_text() for path in paths] == ["first", "second"]

    def stop_between() -> None:
        with atomic_files(*paths) as parts:
            parts[0].write_text("third")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stop_between()

    assert [path.read_text() for path in paths] == ["first", "second"]
    assert {*tmp_path.iterdir()} == {*paths}
