from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_wall import RIG, SERIAL, SMALL, bare_wall, measured_wall, other_intrinsics, wall_frame, write_wall
from nlos_calibration.errors import CalibrationError, RecordFileError
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.rig import load_rig

from nlos_cam.frames import LidarMaps, maps_from_frame
from nlos_cam.reconstruct.bench import BenchObservation, CalibratedRig, difference_of, open_bench


def camera(intrinsics: Intrinsics = SMALL, **others: Any) -> Any:
    return SimpleNamespace(**{"intrinsics": intrinsics, "rig": None, "identity": {"serial": SERIAL}, **others})


@pytest.fixture
def wall(tmp_path: Path) -> Path:
    return write_wall(tmp_path / "wall.toml", bare_wall())


def test_without_a_record_the_rig_is_the_cameras_if_it_can_hide_something_else_the_papers() -> None:
    own = RIG.model_copy(update={"name": "own"})
    assert open_bench(None, camera(rig=own)).rig is own
    assert open_bench(None, camera(rig=load_rig("bare-wall"))).rig == RIG
    assert open_bench(None, camera(Intrinsics(320, 240, 1.0, 1.0, 0.0, 0.0))).rig == RIG


def test_a_bench_without_a_record_has_no_difference_and_nothing_to_warn_of() -> None:
    frame = wall_frame(0)
    bench = CalibratedRig(RIG)
    bench.look_at({"ldd_temperature": 90.0})
    look = bench.look(frame, maps_from_frame(frame))
    assert (look.difference, look.warnings, bench.reference) == (None, (), None)


def test_a_record_brings_its_rig_and_its_reference(wall: Path) -> None:
    bench = open_bench(wall, camera())
    assert bench.rig.name == "measured"
    assert bench.reference is not None
    assert bench.reference.frames == 20
    assert bench.measured is not None
    assert bench.measured.record.serial == SERIAL


def test_a_record_without_a_reference_has_no_difference(tmp_path: Path) -> None:
    bench, frame = open_bench(write_wall(tmp_path / "wall.toml"), camera()), wall_frame(0)
    assert bench.rig.name == "measured"
    assert bench.look(frame, maps_from_frame(frame)).difference is None


def test_the_bare_wall_differs_from_itself_by_its_noise_alone(tmp_path: Path) -> None:
    frame, bench = wall_frame(999), CalibratedRig(RIG, measured_wall(tmp_path))
    difference = bench.look(frame, maps_from_frame(frame)).difference
    assert difference is not None
    off_m = difference.depth_m[difference.valid]
    assert abs(off_m.mean()) < 1e-4
    assert off_m.std() == pytest.approx(5e-4, rel=0.1)
    assert abs(difference.intensity[difference.valid].mean()) < 0.5


def test_a_drift_of_the_whole_range_is_taken_out_of_the_difference(tmp_path: Path) -> None:
    bench = CalibratedRig(RIG, measured_wall(tmp_path))
    levels_m = list[float]()
    for number in range(100, 160):
        frame = wall_frame(number, nearer_m=0.0006)
        difference = bench.look(frame, maps_from_frame(frame)).difference
        assert difference is not None
        levels_m.append(float(difference.depth_m[difference.valid].mean()))
    assert levels_m[0] == pytest.approx(-0.0006, abs=1e-4)
    assert np.mean(levels_m[-20:]) == pytest.approx(0.0, abs=1e-4)


def test_a_difference_is_what_was_added_to_the_wall_valid_where_both_are() -> None:
    reference = bare_wall()
    added_m, added = np.random.default_rng(0).normal(0.0, 0.01, (2, 64, 80)).astype(np.float32)
    depth_m = reference.map_depth_m + added_m
    depth_m[:, 3] = np.nan
    maps = LidarMaps(depth_m, reference.map_intensity + added, ~np.isnan(depth_m))
    found = difference_of(maps, reference)
    np.testing.assert_array_equal(found.valid, maps.valid & np.isfinite(reference.map_depth_m))
    assert not found.valid[:, 3].any()
    assert not found.valid.all(axis=0)[79]  # the wall as far as 0.6 m is all that the reference has
    np.testing.assert_allclose(found.depth_m[found.valid], added_m[found.valid], atol=1e-6)
    np.testing.assert_allclose(found.intensity[found.valid], added[found.valid], atol=1e-4)
    assert np.isnan(found.depth_m[~found.valid]).all()
    assert (found.intensity[~found.valid] == 0.0).all()
    assert found.depth_m.dtype == found.intensity.dtype == np.float32


def last_warnings(bench: CalibratedRig, nearer_m: float = 0.0, frames: int = 40) -> tuple[str, ...]:
    found: tuple[str, ...] = ()
    for number in range(frames):
        frame = wall_frame(number + 500, nearer_m)
        found = bench.look(frame, maps_from_frame(frame)).warnings
    return found


def test_a_lidar_that_stays_is_no_cause_for_a_warning_and_one_that_moves_is(tmp_path: Path) -> None:
    measured = measured_wall(tmp_path)
    assert last_warnings(CalibratedRig(RIG, measured)) == ()
    assert last_warnings(CalibratedRig(RIG, measured), nearer_m=0.01) != ()


@pytest.mark.parametrize(("nearer_m", "moved"), [(0.0, False), (0.002, False), (0.01, True)])
def test_a_range_that_drifts_a_little_has_not_moved_the_lidar_and_by_a_centimetre_it_has(
    tmp_path: Path, nearer_m: float, moved: bool
) -> None:
    bench, looks = CalibratedRig(RIG, measured_wall(tmp_path)), list[BenchObservation]()
    for number in range(40):
        frame = wall_frame(number + 500, nearer_m)
        looks.append(bench.look(frame, maps_from_frame(frame)))
    assert looks[-1].moved == moved
    assert bool(looks[-1].warnings) == (nearer_m > 0)


def test_a_lidar_that_no_longer_sees_the_wall_has_moved(tmp_path: Path) -> None:
    bench, frame = CalibratedRig(RIG, measured_wall(tmp_path)), wall_frame(0)
    looks = [bench.look(replace(frame, depth_m=frame.depth_m + 1.0), maps_from_frame(frame)) for _ in range(300)]
    assert not looks[0].moved
    assert looks[-1].moved


def test_a_lidar_that_is_hotter_by_far_is_a_cause_for_a_warning(tmp_path: Path) -> None:
    bench = CalibratedRig(RIG, measured_wall(tmp_path))
    bench.look_at({"ldd_temperature": 41.0})
    assert last_warnings(bench) == ()
    bench.look_at({"ldd_temperature": 75.0})
    assert last_warnings(bench) != ()


@pytest.mark.parametrize("reference", [False, True])
def test_another_size_is_refused_with_what_to_do(tmp_path: Path, reference: bool) -> None:
    wall = write_wall(tmp_path / "wall.toml", bare_wall() if reference else None)
    with pytest.raises(
        CalibrationError, match=r"measured at 80x64, the camera gives 40x32: .*calibrate the wall again"
    ):
        open_bench(wall, camera(SMALL.scaled(40, 32)))


@pytest.mark.parametrize("reference", [False, True])
@pytest.mark.parametrize("name", ["fx", "fy", "ppx", "ppy"])
def test_other_intrinsics_are_refused_and_their_last_digits_are_not(tmp_path: Path, name: str, reference: bool) -> None:
    wall = write_wall(tmp_path / "wall.toml", bare_wall() if reference else None)
    value = getattr(SMALL, name)
    open_bench(wall, camera(other_intrinsics(**{name: np.float32(value * 1.000001)})))
    with pytest.raises(CalibrationError, match=r"with other intrinsics .*calibrate the wall with this camera"):
        open_bench(wall, camera(other_intrinsics(**{name: value * 1.03})))


def test_a_reference_of_other_intrinsics_than_its_record_says_is_refused(tmp_path: Path) -> None:
    wall = write_wall(tmp_path / "wall.toml", bare_wall(), intrinsics=other_intrinsics(fx=60.0))
    with pytest.raises(CalibrationError, match="other intrinsics"):
        open_bench(wall, camera(other_intrinsics(fx=60.0)))


def test_another_camera_is_a_warning_that_stays(wall: Path) -> None:
    bench, frame = open_bench(wall, camera(identity={"serial": "f9"})), wall_frame(0)
    [warning] = bench.look(frame, maps_from_frame(frame)).warnings
    assert f"measured with the camera {SERIAL}, this is f9" in warning


@pytest.mark.parametrize("serial", ["", SERIAL])
def test_the_same_camera_and_one_that_does_not_tell_are_not_warned_of(wall: Path, serial: str) -> None:
    assert open_bench(wall, camera(identity={"serial": serial} if serial else {})).notes == ()


def test_a_record_that_cannot_be_read_is_told(tmp_path: Path, wall: Path) -> None:
    with pytest.raises(RecordFileError, match=r"no wall record .*none\.toml"):
        open_bench(tmp_path / "none.toml", camera())
    wall.with_suffix(".npz").unlink()
    with pytest.raises(RecordFileError, match="calibrate the wall again"):
        open_bench(wall, camera())
