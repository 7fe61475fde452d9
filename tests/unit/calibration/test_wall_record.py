from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from fake_wall import bare_wall
from nlos_calibration.errors import RecordFileError
from nlos_calibration.geometry import Intrinsics, normal_from_angles, wall_from_plane
from nlos_calibration.occluder import OccluderFit
from nlos_calibration.reference import save_reference
from nlos_calibration.rig import ObjectBox, Occluder, dump_toml, load_rig
from nlos_calibration.wall import fit_wall, wall_depth
from nlos_calibration.wall_record import VERSION, WallRecord, load_measured, load_wall, new_wall_record, with_occluder

PINHOLE = Intrinsics(160, 120, 114.0, 115.0, 80.5, 59.0)
EXAMPLE = Path(__file__).parents[3] / "calibration/records/wall.toml"
VERSION_1, VERSION_2 = Path(__file__).parent / "wall_v1.toml", Path(__file__).parent / "wall_v2.toml"


@pytest.fixture
def record() -> WallRecord:
    pose = wall_from_plane(normal_from_angles(np.radians(40.0), np.radians(3.0)), 0.21)
    fit = fit_wall(wall_depth(pose, PINHOLE), PINHOLE, np.random.default_rng(0))
    return new_wall_record(fit, PINHOLE, camera="l515:f0246262", frames=60, created=date(2026, 1, 31))


def written(folder: Path, record: WallRecord) -> Path:
    path = folder / "wall.toml"
    path.write_text(dump_toml(record), encoding="utf-8")
    return path


def test_wall_record_survives_a_file(tmp_path: Path, record: WallRecord) -> None:
    others = {
        "serial": "f0246262",
        "firmware": "1.5.8.1",
        "settings": {"laser_power": 80.0},
        "reference": "wall.npz",
        "reference_sha256": "0" * 64,
        "range_offset_m": -0.0045,
        "range_offset_std_m": 0.0005,
    }
    box = ObjectBox(x_min_m=0.3, x_max_m=0.5, y_min_m=-0.1, y_max_m=0.1, z_near_m=0.15, z_far_m=0.3)
    rig = record.rig.model_copy(update={"occluder": Occluder(x_m=0.25, z_min_m=0.08), "object_box": box})
    for one in (record, record.model_copy(update=others), record.model_copy(update={"rig": rig})):
        assert load_wall(written(tmp_path, one)) == one


def test_wall_record_rig_is_the_papers_as_measured(record: WallRecord) -> None:
    paper = load_rig("paper-rig")
    assert record.rig.pinhole == PINHOLE
    np.testing.assert_allclose(record.rig.wall_from_lidar, record.wall_from_lidar, atol=1e-9)
    assert (record.rig.occluder, record.rig.object_box) == (paper.occluder, paper.object_box)
    assert record.rig.checksum != paper.checksum


def test_with_occluder_replaces_the_assumed_one(record: WallRecord) -> None:
    """A wall in doubt, and a sheet first too near to it."""
    doubt = {"verdict": "doubtful", "advice": "average more frames"}
    fit = OccluderFit(0.2, 1e-4, 0.03, 1e-3, 0.0, 0.1, 0.0, 0.0, 1e-4, np.zeros((2, 2), np.bool_), ("a stray",))
    first = with_occluder(record.model_copy(update=doubt), fit)
    assert first.verdict == "doubtful"
    assert first.advice.startswith("average more frames; ")
    assert "0.030 m" in first.advice
    again = with_occluder(first, replace(fit, gap_m=0.1))
    assert (again.advice, again.warnings) == ("average more frames", ("a stray",))


def test_with_occluder_beside_a_hidden_object_is_not_good(record: WallRecord) -> None:
    fit = OccluderFit(0.2, 1e-4, 0.1, 1e-3, 0.0, 0.1, 0.0, 0.0, 1e-4, np.zeros((2, 2), np.bool_), ())
    polluted = with_occluder(record, replace(fit, doubt="an object seems to be hidden"))
    assert polluted.verdict == "doubtful"
    assert "do not use" in polluted.advice
    assert with_occluder(polluted, fit).verdict == with_occluder(record, fit).verdict == "good"


def test_load_wall_reads_version_1() -> None:
    old = load_wall(VERSION_1)
    assert (old.distance_m, old.frames, old.verdict) == (0.19999943926475988, 60, "good")
    assert old.distance_std_m is old.range_offset_std_m is None
    assert (old.serial, old.settings, old.reference, old.range_offset_m) == ("", {}, "", 0.0)


def test_load_wall_reads_version_2() -> None:
    old = load_wall(VERSION_2)
    assert (old.noise_scale, old.verdict) == (1.0023135540076475, "good")
    assert (old.temperatures_c, old.footprint_share, old.occluder) == ({}, None, None)


@pytest.mark.parametrize("old", [VERSION_1, VERSION_2])
def test_load_wall_makes_an_old_version_the_newest(tmp_path: Path, old: Path) -> None:
    assert load_wall(old).schema_version == VERSION
    path = written(tmp_path, load_wall(old))
    assert f"schema_version = {VERSION}" in path.read_text(encoding="utf-8")
    assert load_wall(path) == load_wall(old)


MATRIX_END = "0.0,\n        0.0,\n        0.0,\n        "


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("schema_version = 3", "schema_version = 4", "3.*got 4"),
        ("schema_version = 3", "schema_version = 0", "schema_version: .*got 0"),
        ('reference_sha256 = ""', 'reference_sha256 = "abc"', "reference_sha256: .*got 'abc'"),
        ("frames = 60", "frames = 60\nmood = 1", "mood: .*got 1"),
        ("pitch_deg = ", "pitch_deg = 1", r"rig\.lidar"),
        ("\ndistance_m = 0.2", "\ndistance_m = 0.3", r"rig\.lidar"),
        (f"{MATRIX_END}1.0", f"{MATRIX_END}2.0", "pose"),
    ],
)
def test_load_wall_error_names_field_and_value(
    tmp_path: Path, record: WallRecord, old: str, new: str, problem: str
) -> None:
    path = written(tmp_path, record)
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(RecordFileError, match=problem) as caught:
        load_wall(path)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 4


@pytest.mark.parametrize("content", [b"", b"frames = ", b"\x00\xff", b"distance_m = 0.2"])
def test_load_wall_of_another_kind_of_file_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "wall.toml"
    path.write_bytes(content)
    with pytest.raises(RecordFileError, match=r"wall\.toml"):
        load_wall(path)


def test_load_wall_of_a_missing_file_or_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordFileError, match="calibrate --wall"):
        load_wall(tmp_path / "none.toml")
    with pytest.raises(RecordFileError, match=tmp_path.name):
        load_wall(tmp_path)


def test_load_wall_reads_the_worked_example() -> None:
    example = load_wall(EXAMPLE)
    assert example.verdict == "good"
    assert example.distance_m == pytest.approx(0.2, abs=1e-3)
    assert example.facing_deg == pytest.approx(45.0, abs=0.2)


def test_load_measured_reads_the_reference_beside_the_record(tmp_path: Path, record: WallRecord) -> None:
    assert load_measured(written(tmp_path, record)).reference is None
    wall = bare_wall()
    named = {"reference": "wall.npz", "reference_sha256": save_reference(tmp_path / "wall.npz", wall)}
    path = written(tmp_path, record.model_copy(update=named))
    measured = load_measured(path)
    assert measured.reference.frames == wall.frames
    (tmp_path / "wall.npz").unlink()
    with pytest.raises(RecordFileError, match=r"wall\.npz"):
        load_measured(path)
