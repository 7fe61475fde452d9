from pathlib import Path

import numpy as np
import pytest
from nlos_calibration.errors import RecordFileError
from nlos_calibration.rig import dump_toml, load_rig


def test_paper_rig_is_that_of_the_paper() -> None:
    rig = load_rig("paper-rig")
    assert rig.wall_from_lidar[2, 3] == 0.2
    assert rig.facing_deg == pytest.approx(45.0)
    assert (rig.occluder.x_m, rig.occluder.z_min_m) == (0.2, 0.1)
    rays = rig.pinhole.scaled(2, 2)
    width_deg, height_deg = (2 * np.degrees(np.arctan(1 / f)) for f in (rays.fx, rays.fy))
    assert (width_deg, height_deg) == (pytest.approx(70.0, abs=1e-3), pytest.approx(55.0, abs=1e-3))


def test_bare_wall_rig_has_no_occluder_and_no_object_box() -> None:
    bare, paper = load_rig("bare-wall"), load_rig("paper-rig")
    assert bare.occluder is None
    assert bare.object_box is None
    np.testing.assert_array_equal(bare.wall_from_lidar, paper.wall_from_lidar)


@pytest.mark.parametrize("name", ["paper-rig", "bare-wall"])
def test_rig_survives_a_file(tmp_path: Path, name: str) -> None:
    rig = load_rig(name)
    (tmp_path / "rig.toml").write_text(dump_toml(rig), encoding="utf-8")
    again = load_rig(tmp_path / "rig.toml")
    assert again == rig
    assert again.checksum == rig.checksum


def test_rig_checksum_changes_with_a_field() -> None:
    rig = load_rig("paper-rig")
    moved = rig.model_copy(update={"lidar": rig.lidar.model_copy(update={"distance_m": 0.201})})
    assert moved.checksum != rig.checksum


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("distance_m = 0.2", "distance_m = -0.2", r"lidar.distance_m: .*\(got "),
        ("yaw_deg = 45.0", "yaw_degrees = 45.0", "lidar.yaw_deg: is missing"),
        ("x_max_m = 0.575", "x_max_m = 0.1", r"object_box: .*x_min_m < x_max_m .*\(got .*x_max_m = 0.1"),
        ("z_far_m = 0.4", "z_far_m = 0.1", r"object_box: .*z_near_m < z_far_m \(got z_near_m = .*, z_far_m = 0.1\)"),
        ('name = "paper-rig"', 'name = "paper-rig"\nroof = 1', r"roof: .*\(got "),
    ],
)
def test_rig_file_error_names_the_field(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = dump_toml(load_rig("paper-rig"))
    assert old in text
    path = tmp_path / "rig.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(RecordFileError, match=message):
        load_rig(path)


def test_rig_that_does_not_exist_is_refused() -> None:
    for name in ("no-such-rig", "."):
        with pytest.raises(RecordFileError):
            load_rig(name)
