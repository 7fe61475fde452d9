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
from nlos_cam.reconstruct.bench import BenchObservation, CalibratedRig, open_bench, subtract_reference


def camera(intrinsics: Intrinsics = SMALL, **others: Any) -> Any:
    return SimpleNamespace(**{"intrinsics": intrinsics, "rig": None, "identity": {"serial": SERIAL}, **others})


@pytest.fixture
def wall(tmp_path: Path) -> Path:
    return write_wall(tmp_path / "wall.toml", bare_wall())


@pytest.fixture
def bench(tmp_path: Path) -> CalibratedRig:
    return CalibratedRig(RIG, measured_wall(tmp_path))


def observe(bench: CalibratedRig, number: int = 0, nearer_m: float = 0.0) -> BenchObservation:
    frame = wall_frame(number, nearer_m)
    return bench.observe(frame, maps_from_frame(frame))


def test_open_bench_prefers_camera_rig_with_object_box() -> None:
    own = RIG.model_copy(update={"name": "own"})
    assert open_bench(None, camera(rig=own)).rig is own
    assert open_bench(None, camera(rig=load_rig("bare-wall"))).rig == RIG
    bench = open_bench(None, camera(Intrinsics(320, 240, 1.0, 1.0, 0.0, 0.0)))
    bench.update_temperatures({"ldd_temperature": 90.0})
    look = observe(bench)
    assert bench.rig == RIG
    assert (look.difference, look.warnings, bench.reference) == (None, (), None)


def test_open_bench_takes_rig_and_reference_from_the_record(wall: Path, tmp_path: Path) -> None:
    bench = open_bench(wall, camera())
    assert (bench.rig.name, bench.reference.frames, bench.measured.record.serial) == ("measured", 20, SERIAL)
    bare = open_bench(write_wall(tmp_path / "bare.toml"), camera())
    assert bare.rig.name == "measured"
    assert observe(bare).difference is None


def test_difference_of_the_bare_wall_is_noise_without_range_drift(bench: CalibratedRig) -> None:
    levels_m = list[float]()
    for number in range(100, 160):
        difference = observe(bench, number, nearer_m=0.0006).difference
        off_m = difference.depth_m[difference.valid]
        levels_m.append(float(off_m.mean()))
        assert off_m.std() == pytest.approx(5e-4, rel=0.1)
        assert abs(difference.intensity[difference.valid].mean()) < 0.5
    assert levels_m[0] == pytest.approx(-0.0006, abs=1e-4)
    assert np.mean(levels_m[-20:]) == pytest.approx(0.0, abs=1e-4)


def test_difference_is_valid_where_maps_and_reference_are() -> None:
    reference = bare_wall()
    added_m, added = np.random.default_rng(0).normal(0.0, 0.01, (2, 64, 80)).astype(np.float32)
    depth_m = reference.map_depth_m + added_m
    depth_m[:, 3] = np.nan
    maps = LidarMaps(depth_m, reference.map_intensity + added, ~np.isnan(depth_m))
    found = subtract_reference(maps, reference)
    np.testing.assert_array_equal(found.valid, maps.valid & np.isfinite(reference.map_depth_m))
    assert not found.valid[:, 3].any()
    assert not found.valid.all(axis=0)[79]  # the wall as far as 0.6 m is all that the reference has
    np.testing.assert_allclose(found.depth_m[found.valid], added_m[found.valid], atol=1e-6)
    np.testing.assert_allclose(found.intensity[found.valid], added[found.valid], atol=1e-4)
    assert np.isnan(found.depth_m[~found.valid]).all()
    assert (found.intensity[~found.valid] == 0.0).all()
    assert found.depth_m.dtype == found.intensity.dtype == np.float32


@pytest.mark.parametrize(
    ("nearer_m", "celsius", "moved", "frames"),
    [
        (0.0, 41.0, False, 40),
        (0.0, 75.0, False, 40),
        (0.002, 41.0, False, 40),
        (0.01, 41.0, True, 40),
        (-1.0, 41.0, True, 300),
    ],
)
def test_bench_warns_of_drift_heat_and_of_a_moved_lidar(
    bench: CalibratedRig, nearer_m: float, celsius: float, moved: bool, frames: int
) -> None:
    bench.update_temperatures({"ldd_temperature": celsius})
    looks = [observe(bench, number + 500, nearer_m) for number in range(frames)]
    assert not looks[0].moved
    assert looks[-1].moved == moved
    assert bool(looks[-1].warnings) == (nearer_m != 0 or celsius > 70.0)


@pytest.mark.parametrize("reference", [False, True])
def test_open_bench_refuses_other_intrinsics(tmp_path: Path, reference: bool) -> None:
    wall = write_wall(tmp_path / "wall.toml", bare_wall() if reference else None)
    with pytest.raises(CalibrationError, match=r"80x64.* 40x32"):
        open_bench(wall, camera(SMALL.scaled(40, 32)))
    for name in ("fx", "fy", "ppx", "ppy"):
        value = getattr(SMALL, name)
        open_bench(wall, camera(other_intrinsics(**{name: np.float32(value * 1.000001)})))
        with pytest.raises(CalibrationError, match="intrinsics"):
            open_bench(wall, camera(other_intrinsics(**{name: value * 1.03})))
    wall = write_wall(tmp_path / "wall.toml", bare_wall(), intrinsics=other_intrinsics(fx=60.0))
    with pytest.raises(CalibrationError, match="intrinsics"):
        open_bench(wall, camera(other_intrinsics(fx=60.0)))


@pytest.mark.parametrize(("serial", "warned"), [("f9", True), ("", False), (SERIAL, False)])
def test_open_bench_warns_of_another_camera(wall: Path, serial: str, warned: bool) -> None:
    warnings = observe(open_bench(wall, camera(identity={"serial": serial} if serial else {}))).warnings
    assert len(warnings) == warned
    assert all(SERIAL in warning and serial in warning for warning in warnings)


def test_open_bench_refuses_unreadable_records(tmp_path: Path, wall: Path) -> None:
    with pytest.raises(RecordFileError, match=r"none\.toml"):
        open_bench(tmp_path / "none.toml", camera())
    wall.with_suffix(".npz").unlink()
    with pytest.raises(RecordFileError, match=r"wall\.npz"):
        open_bench(wall, camera())
