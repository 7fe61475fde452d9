from pathlib import Path

import numpy as np
import pytest
from nlos_calibration.errors import RecordFileError
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.reference import BareWallStatistics, save_reference
from nlos_calibration.rig import dump_toml
from nlos_calibration.wall_record import load_measured, load_wall

RECORD = Path(__file__).parent / "wall_v2.toml"


def test_a_record_without_a_reference_has_none() -> None:
    assert load_measured(RECORD).reference is None


def test_the_reference_beside_the_record_is_read(tmp_path: Path) -> None:
    blank = np.zeros((12, 16), np.float32)
    statistics = BareWallStatistics(Intrinsics(16, 12, 11.4, 11.5, 7.5, 5.5))
    cells = np.full((64, 80), 0.2, np.float32)
    statistics.add(blank + np.float32(0.2), blank.astype(np.uint8), cells, cells)
    wall = statistics.reference(blank == 0, serial="", settings={})
    named = {"reference": "wall.npz", "reference_sha256": save_reference(tmp_path / "wall.npz", wall)}
    path = tmp_path / "wall.toml"
    path.write_text(dump_toml(load_wall(RECORD).model_copy(update=named)), encoding="utf-8")
    measured = load_measured(path)
    assert measured.reference is not None
    assert measured.reference.frames == 1
    (tmp_path / "wall.npz").unlink()
    with pytest.raises(RecordFileError, match="calibrate the wall again"):
        load_measured(path)
