from pathlib import Path

import pytest

from nlos_cam.errors import OutputExistsError
from nlos_cam.files import atomic_directory, atomic_file, cache_folder


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({"NLOS_CAM_CACHE": "chosen", "XDG_CACHE_HOME": "other"}, "chosen"),
        ({"NLOS_CAM_CACHE": "", "XDG_CACHE_HOME": "other"}, "other/nlos-cam"),
        ({"XDG_CACHE_HOME": "other"}, "other/nlos-cam"),
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


def test_atomic_file_appears_when_it_is_on_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, synced = tmp_path / "out.txt", list[int]()
    out.write_text("old")
    monkeypatch.setattr("nlos_cam.files.os.fsync", synced.append)
    with atomic_file(out) as part, atomic_file(out) as other:  # two writers do not meet
        part.write_text("new")
        other.write_text("other")
        assert out.read_text() == "old"
    assert out.read_text() == "new"
    assert len(synced) == 2
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt])
def test_atomic_writes_leave_nothing_after_an_error(tmp_path: Path, error: type[BaseException]) -> None:
    def write() -> None:
        with atomic_directory(tmp_path / "folder") as folder, atomic_file(tmp_path / "file") as file:
            (folder / "a.txt").write_text("a")
            file.write_text("b")
            raise error

    with pytest.raises(error):
        write()
    assert list(tmp_path.iterdir()) == []


def test_atomic_directory_appears_when_it_is_whole(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with atomic_directory(out) as part, atomic_directory(out) as other:
        (part / "inner").mkdir()
        (part / "inner" / "a.txt").write_text("a")
        (other / "b.txt").write_text("b")
        assert not out.exists()
    assert (out / "inner" / "a.txt").read_text() == "a"
    assert (out / "b.txt").read_text() == "b"
    assert list(tmp_path.iterdir()) == [out]


def test_atomic_directory_replaces_entries_of_the_same_name(tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "old.txt").write_text("old")
    (tmp_path / "mine.txt").write_text("mine")
    with atomic_directory(tmp_path) as part:
        (part / "inner").mkdir()
        (part / "inner" / "new.txt").write_text("new")
    assert [path.name for path in (tmp_path / "inner").iterdir()] == ["new.txt"]
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_atomic_directory_refuses_to_replace_a_file(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("precious")
    with pytest.raises(OutputExistsError, match="out"), atomic_directory(tmp_path / "out"):
        pass
    assert (tmp_path / "out").read_text() == "precious"
