import numpy as np
from nlos_calibration.geometry import Intrinsics

from nlos_cam.camera.streams import FrameSet, frame_in_si

PINHOLE = Intrinsics(3, 1, 1.0, 1.0, 1.0, 0.5)


def test_counts_become_metres_levels_and_nothing_where_there_is_no_return() -> None:
    depth, ir = np.array([[0, 4000, 65535]], np.uint16), np.array([[0, 48, 255]], np.uint8)
    raw, truth_m = np.array([[0, 0x70, 0xF0]], np.uint8), np.ones((64, 64), np.float32)
    frame = frame_in_si(FrameSet(9, 1.5, depth, ir, raw), 0.00025, PINHOLE, {"laser_power": 93.0}, truth_m)
    np.testing.assert_allclose(frame.depth_m, [[np.nan, 1.0, 16.38375]], rtol=1e-6)
    assert frame.depth_m.dtype == np.float32
    np.testing.assert_array_equal(frame.confidence, [[0, 7, 15]])
    assert frame.ir is ir
    assert (frame.frame_number, frame.timestamp_s, frame.intrinsics) == (9, 1.5, PINHOLE)
    assert (frame.settings, frame.truth_depth_m) == ({"laser_power": 93.0}, truth_m)
