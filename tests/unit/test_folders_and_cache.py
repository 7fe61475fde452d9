import os
from pathlib import Path

import pytest

from nlos_cam.errors import OutputExistsError
from nlos_cam.files import atomic_directory, cache_folder


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


def test_folder_appears_when_it_is_whole(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with atomic_directory(out) as part:
        (part / "inner").mkdir()
        (part / "inner" / "a.txt").write_text("a")
        assert not out.exists()
    assert (out / "inner" / "a.txt").read_text() == "a"
    assert list(tmp_path.iterdir()) == [out]


def test_contents_of_the_same_names_are_replaced(tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "old.txt").write_text("old")
    (tmp_path / "mine.txt").write_text("mine")
    with atomic_directory(tmp_path) as part:
        (part / "inner").mkdir()
        (part / "inner" / "new.txt").write_text("new")
    assert [path.name for path in (tmp_path / "inner").iterdir()] == ["new.txt"]
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_folder_is_not_left_after_an_error(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), atomic_directory(tmp_path / "out") as part:
        _ = (part / "a.txt").write_text("a") // 0
    assert list(tmp_path.iterdir()) == []


def test_file_of_that_name_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("precious")
    with pytest.raises(OutputExistsError, match="out"), atomic_directory(tmp_path / "out"):
        pass
    assert (tmp_path / "out").read_text() == "precious"


def test_part_of_a_killed_process_is_no_obstacle(tmp_path: Path) -> None:
    """In containers every process may have the same number."""
    (tmp_path / f".out.{os.getpid()}.part").mkdir()
    with atomic_directory(tmp_path / "out") as part, atomic_directory(tmp_path / "out") as other:
        (part / "a.txt").write_text("a")
        (other / "b.txt").write_text("b")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.txt", "b.txt"]
