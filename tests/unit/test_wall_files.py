from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.reference import BareWall, BareWallStatistics
from nlos_calibration.wall_record import load_measured, load_wall

from nlos_cam.calibrate.files import WallFiles, written
from nlos_cam.calibrate.report import report
from nlos_cam.errors import OutputExistsError

RECORD = Path(__file__).parent / "wall_v2.toml"


@pytest.fixture
def wall() -> BareWall:
    statistics = BareWallStatistics(Intrinsics(16, 12, 11.4, 11.5, 7.5, 5.5))
    blank, cells = np.full((12, 16), 0.2, np.float32), np.full((64, 80), 0.2, np.float32)
    for _ in range(3):
        statistics.add(blank, blank.astype(np.uint8), cells, cells)
    return statistics.reference(blank > 0, serial="", settings={})


def test_what_is_written_belongs_together(tmp_path: Path, wall: BareWall) -> None:
    files = WallFiles.beside(tmp_path / "wall.toml", overwrite=False)
    record = written(files, load_wall(RECORD), wall)
    measured = load_measured(files.record)
    assert measured.record == record
    assert measured.reference is not None
    np.testing.assert_array_equal(measured.reference.depth_m, wall.depth_m)
    assert files.report.read_text(encoding="utf-8") == report(measured, "wall.toml")
    assert {path.name for path in tmp_path.iterdir()} == {"wall.toml", "wall.npz", "wall.html"}


def test_what_ends_the_writing_leaves_the_earlier_files(
    tmp_path: Path, wall: BareWall, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = WallFiles.beside(tmp_path / "wall.toml", overwrite=False)
    written(files, load_wall(RECORD), wall)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("nlos_cam.calibrate.files.report", interrupted)
    with pytest.raises(KeyboardInterrupt):
        written(files, load_wall(RECORD), replace(wall, depth_m=wall.depth_m + np.float32(0.1)))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_without_a_reference_none_is_named(tmp_path: Path) -> None:
    files = WallFiles.beside(tmp_path / "wall.toml", overwrite=False)
    assert written(files, load_wall(RECORD), None).reference == ""
    assert not files.reference.exists()
    assert load_measured(files.record).reference is None


@pytest.mark.parametrize("name", ["wall.npz", "wall.html"])
def test_nothing_beside_is_replaced_unasked(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    with pytest.raises(OutputExistsError, match=name):
        WallFiles.beside(tmp_path / "wall.toml", overwrite=False)
    assert WallFiles.beside(tmp_path / "wall.toml", overwrite=True).record == tmp_path / "wall.toml"


@pytest.mark.parametrize("name", ["wall.npz", "wall.html"])
def test_a_record_may_not_have_the_name_of_what_lies_beside_it(tmp_path: Path, name: str) -> None:
    with pytest.raises(OutputExistsError, match=r"name it wall\.toml"):
        WallFiles.beside(tmp_path / name, overwrite=True)
