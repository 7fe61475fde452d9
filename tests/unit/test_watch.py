import numpy as np
import pytest
from nlos_calibration.rig import LidarPose, Rig, load_rig
from nlos_calibration.wall import wall_depth

from nlos_cam.calibrate.measure import glance, thinned
from nlos_cam.frames import Frame


def frame_of(rig: Rig, width: int = 640, height: int = 480) -> Frame:
    intrinsics = rig.pinhole.scaled(width, height)
    depth_m = wall_depth(rig.wall_from_lidar, intrinsics)
    depth_m[depth_m > 5.0] = np.nan
    depth_m += np.random.default_rng(0).standard_normal(depth_m.shape) * (0.0005 + 0.002 * depth_m)
    counts = np.full(depth_m.shape, 48, np.uint8)
    return Frame(depth_m.astype(np.float32), counts, counts, 0.0, 0, intrinsics)


@pytest.mark.parametrize(("width", "height"), [(640, 480), (320, 240), (1024, 768), (100, 75)])
@pytest.mark.parametrize(("distance_m", "yaw_deg"), [(0.2, 45.0), (0.15, 15.0), (0.3, -60.0)])
def test_one_thinned_frame_tells_where_the_wall_is(width: int, height: int, distance_m: float, yaw_deg: float) -> None:
    pose = LidarPose(distance_m=distance_m, yaw_deg=yaw_deg)
    seen = glance(frame_of(load_rig("bare-wall").model_copy(update={"lidar": pose}), width, height))
    assert seen.fit is not None
    assert seen.fit.distance_m == pytest.approx(distance_m, abs=max(0.0005, 4 * seen.fit.distance_std_m))
    assert seen.fit.yaw_deg == pytest.approx(yaw_deg, abs=max(0.1, 4 * seen.fit.yaw_std_deg))


@pytest.mark.parametrize("width", [640, 320, 1024, 100])
def test_thinned_pixels_lie_on_the_same_rays(width: int) -> None:
    intrinsics = load_rig("bare-wall").pinhole.scaled(width, width * 3 // 4)
    rays = intrinsics.rays()
    few_x, few = thinned(rays[..., 0].astype(np.float32), intrinsics)
    few_y, _ = thinned(rays[..., 1].astype(np.float32), intrinsics)
    np.testing.assert_allclose(few.rays()[..., 0], few_x, atol=1e-6)
    np.testing.assert_allclose(few.rays()[..., 1], few_y, atol=1e-6)
    assert few.width <= 240


def test_what_is_no_wall_is_told_as_the_calibration_would() -> None:
    frame = frame_of(load_rig("bare-wall"))
    blind = Frame(np.full_like(frame.depth_m, np.nan), np.full_like(frame.ir, 255), frame.ir, 0.0, 0, frame.intrinsics)
    seen = glance(blind)
    assert seen.fit is None
    assert "of the pixels have depth" in seen.refused
    assert seen.saturated == 1.0
