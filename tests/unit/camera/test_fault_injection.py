"""Deliveries of a faulty device at each instant, before the SDK gets them."""

from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from nlos_cam.camera import FORMATS
from nlos_cam.camera.fault_injection import Delivery, FaultyDevice
from nlos_cam.render import Fault, SensedImages

START_S = 1e9


def images(instant: int) -> SensedImages:
    """Make images of 4 x 6 pixels that hold their instant."""
    return SensedImages(
        np.full((4, 6), 1000 + instant, np.uint16), np.full((4, 6), 100, np.uint8), np.full((4, 6), 9, np.uint8)
    )


def handed(*faults: Fault, until: int) -> list[Delivery]:
    device = FaultyDevice(faults)
    return [found for instant in range(until) for found in device.deliver(instant, START_S, images(instant))]


@given(st.integers(0, 1000))
def test_device_without_faults_changes_nothing(instant: int) -> None:
    seen = images(instant)
    [delivery] = FaultyDevice().deliver(instant, START_S, seen)
    assert delivery.images is seen
    assert (delivery.number, delivery.instant, delivery.timestamp_s) == (instant, instant, START_S)
    assert delivery.streams == tuple(FORMATS)


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
