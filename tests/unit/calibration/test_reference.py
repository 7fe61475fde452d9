import hashlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nlos_calibration.errors import RecordFileError
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.reference import BareWall, BareWallStatistics, Moments, load_reference, save_reference

INTRINSICS = Intrinsics(16, 12, 11.4, 11.5, 7.5, 5.5)
SHAPE, CELLS, FRAMES = (12, 16), (64, 80), 20


@pytest.fixture
def wall() -> BareWall:
    generator = np.random.default_rng(0)
    statistics = BareWallStatistics(INTRINSICS)
    for _ in range(FRAMES):
        depth_m = (0.2 + 0.001 * generator.standard_normal(SHAPE)).astype(np.float32)
        ir = generator.integers(40, 50, SHAPE).astype(np.uint8)
        ir[0, 0], depth_m[0, 1] = 255, np.nan
        statistics.add(depth_m, ir, np.full(CELLS, 0.2, np.float32), np.full(CELLS, 45, np.float32))
    for celsius in (30.0, 32.0):
        statistics.add_temperatures({"ldd_temperature": celsius})
    statistics.add_temperatures({})
    return statistics.reference(np.ones(SHAPE, np.bool_), serial="f1", settings={"laser_power": 40.0})


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e3), st.integers(2, 40))
def test_moments_are_those_of_all_samples_together(offset: float, scale: float, count: int) -> None:
    samples = offset + scale * np.random.default_rng(count).standard_normal((count, 3, 2))
    moments = Moments((3, 2))
    for values in samples:
        moments.add(values)
    np.testing.assert_allclose(moments.mean(), samples.mean(axis=0), rtol=1e-9)
    np.testing.assert_allclose(moments.spread(), samples.std(axis=0, ddof=1), rtol=1e-6)


def test_moments_leave_out_nan() -> None:
    moments = Moments((1, 2))
    for values in ([1.0, np.nan], [3.0, np.nan], [np.nan, 5.0]):
        moments.add(np.array([values]))
    np.testing.assert_array_equal(moments.mean(), [[2.0, 5.0]])
    np.testing.assert_array_equal(moments.spread(), [[np.sqrt(2.0), np.nan]])


def test_reference_holds_means_saturation_and_temperatures(wall: BareWall) -> None:
    assert wall.frames == FRAMES
    assert wall.saturated[0, 0] == 1.0
    assert wall.saturated.sum() == 1.0
    assert np.isnan(wall.depth_m[0, 1])
    assert abs(np.nanmean(wall.depth_m) - 0.2) < 3 * 0.001 / np.sqrt(FRAMES * wall.depth_m.size)
    assert wall.celsius == {"ldd_temperature": 31.0}
    assert wall.celsius_span == {"ldd_temperature": 2.0}


def test_reference_file_is_read_as_it_was_written(tmp_path: Path, wall: BareWall) -> None:
    path = tmp_path / "wall.npz"
    read = load_reference(path, save_reference(path, wall))
    for name, value in vars(wall).items():
        np.testing.assert_equal(getattr(read, name), value)


def test_reference_of_another_checksum_is_refused(tmp_path: Path, wall: BareWall) -> None:
    path = tmp_path / "wall.npz"
    digest = save_reference(path, wall)
    path.write_bytes(path.read_bytes() + b"!")
    for _ in range(2):
        with pytest.raises(RecordFileError, match=r"wall\.npz"):
            load_reference(path, digest)
        path.unlink(missing_ok=True)


def test_reference_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "wall.npz"
    np.savez(path, depth_m=np.zeros(3))
    with pytest.raises(RecordFileError, match=r"wall\.npz"):
        load_reference(path, hashlib.sha256(path.read_bytes()).hexdigest())
