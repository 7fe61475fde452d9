from datetime import date
from pathlib import Path

import numpy as np
import pytest
from nlos_calibration.errors import RecordFileError
from nlos_calibration.geometry import normal_from_angles, wall_from_plane
from nlos_calibration.projection import Intrinsics
from nlos_calibration.rig import ObjectBox, Occluder, dump_toml, load_rig
from nlos_calibration.wall import fit_wall, wall_depth
from nlos_calibration.wall_record import WallRecord, load_wall, wall_record

PINHOLE = Intrinsics(160, 120, 114.0, 115.0, 80.5, 59.0)
EXAMPLE = Path(__file__).parents[2] / "calibration/records/wall.toml"


@pytest.fixture
def record() -> WallRecord:
    pose = wall_from_plane(normal_from_angles(np.radians(40.0), np.radians(3.0)), 0.21)
    fit = fit_wall(wall_depth(pose, PINHOLE), PINHOLE, np.random.default_rng(0))
    return wall_record(fit, PINHOLE, camera="l515:f0246262", frames=60, created=date(2026, 1, 31))


def test_a_record_survives_a_file(tmp_path: Path, record: WallRecord) -> None:
    path = tmp_path / "wall.toml"
    path.write_text(dump_toml(record), encoding="utf-8")
    assert load_wall(path) == record


def test_the_rig_is_the_papers_as_measured(record: WallRecord) -> None:
    paper = load_rig("paper-rig")
    assert record.rig.pinhole == PINHOLE
    np.testing.assert_allclose(record.rig.wall_from_lidar, record.wall_from_lidar, atol=1e-9)
    assert (record.rig.occluder, record.rig.object_box) == (paper.occluder, paper.object_box)
    assert record.rig.checksum != paper.checksum


def test_occluder_and_object_box_may_be_edited(tmp_path: Path, record: WallRecord) -> None:
    box = ObjectBox(x_min_m=0.3, x_max_m=0.5, y_min_m=-0.1, y_max_m=0.1, z_near_m=0.15, z_far_m=0.3)
    rig = record.rig.model_copy(update={"occluder": Occluder(x_m=0.25, z_min_m=0.08), "object_box": box})
    path = tmp_path / "wall.toml"
    path.write_text(dump_toml(record.model_copy(update={"rig": rig})), encoding="utf-8")
    assert load_wall(path).rig == rig


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("schema_version = 1", "schema_version = 2", "schema_version: .*got 2"),
        ("frames = 60", "frames = 0", "frames: .*got 0"),
        ("frames = 60", "frames = 60\nmood = 1", "mood: .*got 1"),
        ('verdict = "good"', 'verdict = "fine"', "verdict: .*got 'fine'"),
        ("pitch_deg = ", "pitch_deg = 1", r"rig\.lidar differs"),
        ("\ndistance_m = 0.2", "\ndistance_m = 0.3", r"rig\.lidar differs"),
        (
            "0.0,\n        0.0,\n        0.0,\n        1.0",
            "0.0,\n        0.0,\n        0.0,\n        2.0",
            "pose of rig",
        ),
    ],
)
def test_the_first_problem_is_told(tmp_path: Path, record: WallRecord, old: str, new: str, problem: str) -> None:
    text = dump_toml(record)
    assert old in text
    path = tmp_path / "wall.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(RecordFileError, match=problem) as caught:
        load_wall(path)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 4


@pytest.mark.parametrize("content", [b"", b"frames = ", b"\x00\xff", b"distance_m = 0.2"])
def test_a_file_of_something_else_is_told(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "wall.toml"
    path.write_bytes(content)
    with pytest.raises(RecordFileError, match=r"wall\.toml"):
        load_wall(path)


def test_a_missing_file_and_a_folder_are_told(tmp_path: Path) -> None:
    with pytest.raises(RecordFileError, match="calibrate --wall"):
        load_wall(tmp_path / "none.toml")
    with pytest.raises(RecordFileError, match="cannot be read"):
        load_wall(tmp_path)


def test_the_worked_example_is_a_record() -> None:
    example = load_wall(EXAMPLE)
    assert example.verdict == "good"
    assert example.distance_m == pytest.approx(0.2, abs=1e-3)
    assert example.facing_deg == pytest.approx(45.0, abs=0.2)
