"""Deliveries of a faulty device at each instant, before the SDK gets them."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nlos_cam.camera.fault_injection import Delivery, FaultyDevice
from nlos_cam.camera.streams import FORMATS
from nlos_cam.camera.timestamps import WRAP_PERIOD_S
from nlos_cam.render.scene_file import Fault
from nlos_cam.render.sensor.sensor import SensedImages

START_S = 1e9


def images(instant: int) -> SensedImages:
    """Make images of 4 x 6 pixels that hold their instant."""
    return SensedImages(
        np.full((4, 6), 1000 + instant, np.uint16), np.full((4, 6), 100, np.uint8), np.full((4, 6), 9, np.uint8)
    )


def handed(*faults: Fault, until: int = 12, plugged_in_at: int = 0) -> list[Delivery]:
    device, came = FaultyDevice(faults, plugged_in_at), list[Delivery]()
    for instant in range(plugged_in_at, until):
        came += device.deliver(instant, START_S + instant / 30, images(instant))
    return came


def numbers(came: list[Delivery]) -> list[int]:
    return [delivery.number for delivery in came]


def instants(came: list[Delivery]) -> list[int]:
    return [delivery.instant for delivery in came]


@given(st.integers(0, 1000))
def test_device_without_faults_changes_nothing(instant: int) -> None:
    seen = images(instant)
    [delivery] = FaultyDevice().deliver(instant, START_S, seen)
    assert delivery.images is seen
    assert (delivery.number, delivery.instant, delivery.timestamp_s) == (instant, instant, START_S)
    assert delivery.streams == tuple(FORMATS)


def test_out_of_order_frames_keep_their_own_time() -> None:
    came = handed(Fault(kind="out_of_order", at_frame=1, frames=2), until=7)
    assert numbers(came) == [0, 2, 1, 4, 3, 5, 6]
    assert [delivery.timestamp_s for delivery in came] == [START_S + number / 30 for number in numbers(came)]


def test_image_faults_spoil_images_as_named_and_add_up() -> None:
    def spoiled(*kinds: Any) -> SensedImages:
        return handed(*(Fault(kind=kind, at_frame=0) for kind in kinds), until=1)[0].images

    black = spoiled("all_zero")
    assert not any(image.any() for image in (black.depth_z16, black.ir, black.confidence))
    assert (spoiled("saturated").ir == 255).all()
    assert np.count_nonzero(spoiled("half_invalid").depth_z16) == 12
    assert spoiled("wrong_size").depth_z16.shape == spoiled("wrong_size").ir.shape == (2, 3)
    assert [each.images.ir.max() for each in handed(Fault(kind="saturated", at_frame=1), until=3)] == [100, 255, 100]
    both = spoiled("half_invalid", "saturated")
    assert (np.count_nonzero(both.depth_z16), both.ir.min()) == (12, 255)


def test_unplugged_device_stays_away_and_counts_from_0() -> None:
    fault, by_hand = Fault(kind="unplug", at_frame=3, frames=4), FaultyDevice()
    by_hand.unplug(3, 4)
    for device in (FaultyDevice([fault]), by_hand):
        assert [instant for instant in range(12) if device.is_connected(instant)] == [0, 1, 2]
        assert [instant for instant in range(12) if device.is_gone(instant)] == [3, 4, 5, 6]
    assert instants(handed(fault)) == [0, 1, 2]
    again = handed(fault, plugged_in_at=7)
    assert (instants(again), numbers(again)) == ([7, 8, 9, 10, 11], [0, 1, 2, 3, 4])


def test_clock_that_wraps_jumps_back_by_its_period() -> None:
    came = handed(Fault(kind="clock_wrap", at_frame=5))
    assert numbers(came) == list(range(12))
    times_s = [delivery.timestamp_s for delivery in came]
    assert all(0 <= time_s < WRAP_PERIOD_S for time_s in times_s)
    steps_s = np.diff(times_s)
    assert steps_s[4] == pytest.approx(1 / 30 - WRAP_PERIOD_S, abs=1e-6)
    np.testing.assert_allclose(np.delete(steps_s, 4), 1 / 30, atol=1e-6)


def test_replugged_device_has_its_own_clock_from_0() -> None:
    came = handed(Fault(kind="clock_wrap", at_frame=5), plugged_in_at=7)
    np.testing.assert_allclose([delivery.timestamp_s for delivery in came], np.arange(5) / 30, atol=1e-9)
