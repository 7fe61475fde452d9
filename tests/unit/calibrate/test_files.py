from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_wall import bare_wall
from nlos_calibration.wall_record import MeasuredWall, load_measured

from nlos_cam.calibrate.files import WallFiles, write_record
from nlos_cam.calibrate.report import report_html
from nlos_cam.errors import OutputExistsError


@pytest.fixture
def files(tmp_path: Path) -> WallFiles:
    return WallFiles.beside(tmp_path / "wall.toml", overwrite=False)


@pytest.mark.slow
def test_written_wall_files_belong_together(
    files: WallFiles, measured: Callable[..., MeasuredWall], monkeypatch: pytest.MonkeyPatch
) -> None:
    wall = bare_wall()
    record = write_record(files, measured().record, wall)
    loaded = load_measured(files.record)
    assert loaded.record == record
    np.testing.assert_array_equal(loaded.reference.depth_m, wall.depth_m)
    assert files.report.read_text(encoding="utf-8") == report_html(loaded, "wall.toml")
    before = {path.name: path.read_bytes() for path in files.record.parent.iterdir()}
    assert set(before) == {"wall.toml", "wall.npz", "wall.html"}

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("nlos_cam.calibrate.files.report_html", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_record(files, record, replace(wall, depth_m=wall.depth_m + np.float32(0.1)))
    assert {path.name: path.read_bytes() for path in files.record.parent.iterdir()} == before


def test_written_wall_without_a_reference_names_none(files: WallFiles, measured: Callable[..., MeasuredWall]) -> None:
    assert write_record(files, measured().record, None).reference == ""
    assert not files.reference.exists()
    assert load_measured(files.record).reference is None


@pytest.mark.parametrize("name", ["wall.npz", "wall.html"])
def test_wall_files_do_not_replace_what_lies_beside(tmp_path: Path, name: str) -> None:
    with pytest.raises(OutputExistsError, match=r"wall\.toml"):
        WallFiles.beside(tmp_path / name, overwrite=True)
    (tmp_path / name).touch()
    with pytest.raises(OutputExistsError, match=name):
        WallFiles.beside(tmp_path / "wall.toml", overwrite=False)
    assert WallFiles.beside(tmp_path / "wall.toml", overwrite=True).record == tmp_path / "wall.toml"
