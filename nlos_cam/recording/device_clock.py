"""Samples of a recording on a clock that does not wrap."""

from collections.abc import Collection, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

from nlos_cam.camera import FORMATS, ClockUnwrap, Sample
from nlos_cam.recording.bag_messages import HARDWARE_CLOCK

if TYPE_CHECKING:
    from nlos_cam.recording.bag_reader import BagReader
    from nlos_cam.recording.ros_reader import RosReader


def unwrapped_samples(
    bag: "BagReader | RosReader", streams: Collection[str]
) -> Iterator[tuple[int, Sample]]:
    """Yield the recorder's time in ns of each sample, and the sample on a clock that does not
    wrap.
    """
    lidar = ClockUnwrap()
    clocks: dict[str, ClockUnwrap | None] = {}
    """By stream; None for a clock that does not wrap."""
    for time_ns, sample in bag.timed_samples(streams):
        stream = sample.stream
        if stream not in clocks:
            # A device's own clock is a counter that wraps; the lidar's streams share theirs.
            is_counter = bag.metadata(stream, 0).domain == HARDWARE_CLOCK
            own = lidar if stream in FORMATS else ClockUnwrap()
            clocks[stream] = own if is_counter else None
        clock = clocks[stream]
        timestamp_s = clock.add(sample.timestamp_s) if clock else sample.timestamp_s
        yield time_ns, replace(sample, timestamp_s=timestamp_s)
