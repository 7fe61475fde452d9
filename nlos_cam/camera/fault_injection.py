"""Faults of a simulated device: what it delivers of each instant of the world, instead of one good frame."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nlos_cam.camera.streams import FORMATS, FRAMES_PER_S
from nlos_cam.camera.timestamps import WRAP_PERIOD_S
from nlos_cam.render import Fault, FaultKind, SensedImages


@dataclass(frozen=True)
class Delivery:
    """One frame that a device hands over."""

    instant: int
    """Of the world, 30 a second."""
    number: int
    """As the device counts."""
    timestamp_s: float
    images: SensedImages
    streams: tuple[str, ...] = tuple(FORMATS)
    """Those that it comes on."""


def _black(images: SensedImages) -> SensedImages:
    return SensedImages(np.zeros_like(images.depth_z16), np.zeros_like(images.ir), np.zeros_like(images.confidence))


def _saturated(images: SensedImages) -> SensedImages:
    return replace(images, ir=np.full_like(images.ir, 255))


def _half_invalid(images: SensedImages) -> SensedImages:
    depth_z16 = images.depth_z16.copy()
    depth_z16[depth_z16.shape[0] // 2 :] = 0
    return replace(images, depth_z16=depth_z16)


def _half_size(images: SensedImages) -> SensedImages:
    return SensedImages(images.depth_z16[::2, ::2], images.ir[::2, ::2], images.confidence[::2, ::2])


SPOILED: dict[FaultKind, Callable[[SensedImages], SensedImages]] = {
    "all_zero": _black,
    "saturated": _saturated,
    "half_invalid": _half_invalid,
    "wrong_size": _half_size,
}
"""The faults that change the images."""


class FaultyDevice:
    """What a device hands over, instant by instant, once `faults` have acted; without any, each instant as it is.

    It numbers frames from 0 at the instant that it is plugged in, leaving out those that it does not count. Once
    unplugged it stays so: what is plugged in again is another one.
    """

    def __init__(self, faults: Sequence[Fault] = (), plugged_in_at: int = 0) -> None:
        self._faults = tuple(faults)
        self._plugged_in_at = self._counted_from = plugged_in_at
        self._held: list[Delivery] = []
        wraps = [fault.at_frame for fault in faults if fault.kind == "clock_wrap"]
        self.has_own_clock = bool(wraps)
        """Whether its timestamps are not the host's time: they begin at 0 with it, but for the first, which wraps."""
        self._clock_from = plugged_in_at or sum(wraps)
        self.has_other_size = any(fault.kind == "wrong_size" for fault in faults)

    def is_there(self, instant: int) -> bool:
        """Whether it is still plugged in, and never was unplugged."""
        unplugs = [fault for fault in self._faults if fault.kind == "unplug"]
        return not any(fault.at_frame <= instant and fault.until_frame > self._plugged_in_at for fault in unplugs)

    def is_gone(self, instant: int) -> bool:
        """Whether nothing is plugged in, neither this device nor another in its place."""
        return self._befallen(instant, "unplug")

    def unplug(self, instant: int, instants: int) -> None:
        """Unplug it for so long."""
        self._faults = (*self._faults, Fault(kind="unplug", at_frame=instant, frames=instants))

    def hand_over(self, instant: int, due_s: float, images: SensedImages) -> list[Delivery]:
        """The frames of one instant, in the order in which they come; instants rise from call to call."""
        late, self._held = self._held, []
        if not self.is_there(instant):
            return []
        if self._befallen(instant, "stall"):
            self._counted_from += 1
            return late
        taken = Delivery(instant, instant - self._counted_from, self._timestamp_s(instant, due_s), images)
        handed = [] if self._befallen(instant, "drops") else [self._spoil(taken, instant)]
        if self._is_held(instant):
            self._held = handed
            return late
        return [*handed * (2 if self._befallen(instant, "duplicate") else 1), *late]

    def _timestamp_s(self, instant: int, due_s: float) -> float:
        return (instant - self._clock_from) / FRAMES_PER_S % WRAP_PERIOD_S if self.has_own_clock else due_s

    def _spoil(self, delivery: Delivery, instant: int) -> Delivery:
        images = delivery.images
        for fault in self._faults:
            if fault.befalls(instant) and (change := SPOILED.get(fault.kind)):
                images = change(images)
        streams = tuple(stream for stream in delivery.streams if not self._befallen(instant, "drops", stream))
        return replace(delivery, images=images, streams=streams)

    def _is_held(self, instant: int) -> bool:
        """Whether the next frame comes before it."""
        swaps = [fault for fault in self._faults if fault.kind == "out_of_order" and fault.befalls(instant)]
        return any((instant - fault.at_frame) % 2 == 0 for fault in swaps)

    def _befallen(self, instant: int, kind: FaultKind, stream: str | None = None) -> bool:
        return any(fault.kind == kind and fault.stream == stream and fault.befalls(instant) for fault in self._faults)
