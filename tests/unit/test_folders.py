import os
from pathlib import Path

import pytest

from nlos_cam.errors import OutputExistsError
from nlos_cam.files import atomic_directory


def test_what_was_written_is_there_at_the_end_and_not_before(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with atomic_directory(out) as part:
        (part / "inner").mkdir()
        (part / "inner" / "a.txt").write_text("a")
        assert not out.exists()
    assert (out / "inner" / "a.txt").read_text() == "a"
    assert list(tmp_path.iterdir()) == [out]


def test_contents_of_the_same_names_are_replaced_and_others_stay(tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "old.txt").write_text("old")
    (tmp_path / "mine.txt").write_text("mine")
    with atomic_directory(tmp_path) as part:
        (part / "inner").mkdir()
        (part / "inner" / "new.txt").write_text("new")
    assert [path.name for path in (tmp_path / "inner").iterdir()] == ["new.txt"]
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_nothing_is_left_after_an_error(tmp_path: Path) -> None:
    def fail() -> None:
        with atomic_directory(tmp_path / "out") as part:
            (part / "a.txt").write_text("a")
            _ = 1 // 0

    with pytest.raises(ZeroDivisionError):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_a_file_of_that_name_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("precious")
    with pytest.raises(OutputExistsError, match="is a file"), atomic_directory(tmp_path / "out"):
        pass
    assert (tmp_path / "out").read_text() == "precious"


def test_what_a_killed_process_of_our_number_left_is_no_obstacle(tmp_path: Path) -> None:
    """In containers every process may have the same number."""
    (tmp_path / f".out.{os.getpid()}.part").mkdir()
    with atomic_directory(tmp_path / "out") as part, atomic_directory(tmp_path / "out") as other:
        (part / "a.txt").write_text("a")
        (other / "b.txt").write_text("b")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.txt", "b.txt"]
