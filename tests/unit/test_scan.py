"""The raster: what stands still is one instant, what moves is seen row by row where it then is."""

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.render.accuracy import STOPS
from nlos_cam.render.effects import Effect
from nlos_cam.render.renderer import render
from nlos_cam.render.scanning import render_scan, scan_effect, slices
from nlos_cam.render.scene import Scene

RIG = load_rig("paper-rig")


def _plate(share: float) -> Scene:
    """A plate that comes 4 cm nearer to the wall during a scan."""
    depth = np.full((16, 16), np.nan, np.float32)
    depth[4:12, 4:12] = 0.3 - 0.04 * share
    return Scene(RIG, depth)


def _still(_share: float) -> Scene:
    return _plate(0.0)


def test_what_stands_still_does_not_call_for_it_and_is_one_rendering() -> None:
    assert not scan_effect(_still).included
    assert scan_effect(_still).bound == 0
    scan, instant = render_scan(_still), render(_still(0.0))
    np.testing.assert_array_equal(scan.depth_m, instant.depth_m)
    np.testing.assert_array_equal(scan.multi.peak, instant.multi.peak)
    assert scan.plan[-1].name == "scan-time"


def test_a_bare_wall_does_not_move() -> None:
    bare = Scene(load_rig("bare-wall"))
    assert not scan_effect(lambda _share: bare).included


def test_what_moves_calls_for_it_and_leaving_it_out_changes_more_than_the_tolerance() -> None:
    verdict = scan_effect(_plate)
    assert verdict.included
    scan, instant = render_scan(_plate).multi.peak, render(_plate(0.0)).multi.peak
    change = np.abs(scan - instant).sum() / scan.sum()
    assert STOPS["standard"].tolerance < change <= verdict.bound


def test_what_moves_less_than_the_tolerance_tells_is_left_out() -> None:
    hardly = scan_effect(lambda share: _plate(share * 1e-4), "draft")
    assert 0 < hardly.bound < STOPS["draft"].tolerance
    assert not hardly.included


def test_the_top_is_seen_at_the_start_and_the_bottom_at_the_end() -> None:
    scan = render_scan(_plate).multi.peak
    start, end = render(_plate(0.0)).multi.peak, render(_plate(1.0)).multi.peak
    count = slices(scan_effect(_plate), STOPS["standard"])
    assert count >= 2
    for rows, near, far in ((slice(0, 8), start, end), (slice(56, 64), end, start)):
        assert np.abs(scan[rows] - near[rows]).sum() < 0.5 * np.abs(scan[rows] - far[rows]).sum()


def test_every_slice_is_what_that_instant_gives_for_its_rows() -> None:
    scan, count = render_scan(_plate), slices(scan_effect(_plate), STOPS["standard"])
    rows = np.array_split(np.arange(64), count)[0]
    instant = render(_plate(float(rows.mean() + 0.5) / 64))
    np.testing.assert_array_equal(scan.depth_m[rows], instant.depth_m[rows])
    assert scan.depth_m.shape == (64, 80)


@pytest.mark.parametrize(("bound", "count"), [(0.01, 2), (0.1, 5), (1.0, 50)])
def test_slices_grow_with_what_moves(bound: float, count: int) -> None:
    assert slices(Effect("scan-time", included=True, reason="", bound=bound), STOPS["standard"]) == count
    assert slices(Effect("scan-time", included=False, reason="", bound=bound), STOPS["standard"]) == 1
