"""Faults of a simulated device: the frames that it delivers of each instant, instead of one good
one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nlos_cam.camera.streams import FORMATS, FRAMES_PER_S
from nlos_cam.camera.timestamps import WRAP_PERIOD_S
from nlos_cam.render import Fault, FaultKind, SensedImages


@dataclass(frozen=True)
class Delivery:
    """Frame that a device delivers."""

    instant: int
    """Index of the world's instant, 30 a second."""
    number: int
    """Number by the device's own count."""
    timestamp_s: float
    images: SensedImages
    streams: tuple[str, ...] = tuple(FORMATS)
    """Streams that deliver it."""


def _half_invalid(images: SensedImages) -> SensedImages:
    depth_z16 = images.depth_z16.copy()
    depth_z16[depth_z16.shape[0] // 2 :] = 0
    return replace(images, depth_z16=depth_z16)


IMAGE_FAULTS: dict[FaultKind, Callable[[SensedImages], SensedImages]] = {
    "all_zero": lambda images: SensedImages(*map(np.zeros_like, vars(images).values())),
    "saturated": lambda images: replace(images, ir=np.full_like(images.ir, 255)),
    "half_invalid": _half_invalid,
    "wrong_size": lambda images: SensedImages(
        *(pixels[::2, ::2] for pixels in vars(images).values())
    ),
}
"""Changes to the images, by kind of fault."""


class FaultyDevice:
    """Device with `faults`, which delivers frames instant by instant; without faults, one good
    frame of each.

    Stateful: deliver instants in rising order, from one thread. Frames are numbered from 0 at the
    instant of plugging in, without those that it does not count. Once unplugged it stays so:
    plugging in again makes another one.
    """

    def __init__(self, faults: Sequence[Fault] = (), plugged_in_at: int = 0) -> None:
        self._faults = tuple(faults)
        self._plugged_in_at = self._counted_from = plugged_in_at
        self._held: list[Delivery] = []
        wraps = [fault.at_frame for fault in faults if fault.kind == "clock_wrap"]
        self.has_own_clock = bool(wraps)
        """True if timestamps are on its own clock: 0 when plugged in, except for the first device,
        which wraps.
        """
        self._clock_from = plugged_in_at or sum(wraps)
        self.has_other_size = any(fault.kind == "wrong_size" for fault in faults)

    def is_connected(self, instant: int) -> bool:
        """Return True unless it has been unplugged."""
        unplugs = [fault for fault in self._faults if fault.kind == "unplug"]
        return not any(
            fault.at_frame <= instant and fault.until_frame > self._plugged_in_at
            for fault in unplugs
        )

    def is_gone(self, instant: int) -> bool:
        """Return True while neither this device nor a successor is plugged in."""
        return self._has_fault(instant, "unplug")

    def unplug(self, instant: int, instants: int) -> None:
        """Unplug it for this number of instants."""
        self._faults = (*self._faults, Fault(kind="unplug", at_frame=instant, frames=instants))

    def deliver(self, instant: int, due_s: float, images: SensedImages) -> list[Delivery]:
        """Return the frames that come at one instant, in order of arrival."""
        late = self._held
        self._held = []
        if not self.is_connected(instant):
            return []
        if self._has_fault(instant, "stall"):
            self._counted_from += 1
            return late
        if self._has_fault(instant, "drops"):
            frames: list[Delivery] = []
        else:
            own_s = (instant - self._clock_from) / FRAMES_PER_S % WRAP_PERIOD_S
            timestamp_s = own_s if self.has_own_clock else due_s
            number = instant - self._counted_from
            frames = [self._apply(Delivery(instant, number, timestamp_s, images), instant)]

        if self._is_held(instant):
            self._held = frames
            return late
        if self._has_fault(instant, "duplicate"):
            frames = frames * 2
        return [*frames, *late]

    def _apply(self, delivery: Delivery, instant: int) -> Delivery:
        images = delivery.images
        for fault in self._faults:
            if fault.befalls(instant) and (change := IMAGE_FAULTS.get(fault.kind)):
                images = change(images)
        streams = tuple(
            stream for stream in delivery.streams if not self._has_fault(instant, "drops", stream)
        )
        return replace(delivery, images=images, streams=streams)

    def _is_held(self, instant: int) -> bool:
        """Return True if the next frame is delivered before it."""
        swaps = [
            fault
            for fault in self._faults
            if fault.kind == "out_of_order" and fault.befalls(instant)
        ]
        return any((instant - fault.at_frame) % 2 == 0 for fault in swaps)

    def _has_fault(self, instant: int, kind: FaultKind, stream: str | None = None) -> bool:
        return any(
            fault.kind == kind and fault.stream == stream and fault.befalls(instant)
            for fault in self._faults
        )
