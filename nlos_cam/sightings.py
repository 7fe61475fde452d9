"""What can be seen to be amiss with a frame: blank, half invalid, saturated."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from nlos_cam.camera.laser_power import MOST_SATURATED, saturated_share
from nlos_cam.frames import Frame


def amiss(frame: Frame) -> list[str]:
    """By name: blank (no depth at all), else half_invalid (for half the pixels or more); and saturated."""
    pixels, with_depth = frame.depth_m.size, np.count_nonzero(frame.depth_m > 0)  # NaN is not
    names: list[str] = []
    if with_depth == 0:
        names.append("blank")
    elif 2 * with_depth <= pixels:
        names.append("half_invalid")
    if saturated_share(frame.ir) > MOST_SATURATED:
        names.append("saturated")
    return names


def in_words(counts: Mapping[str, int]) -> str:
    """Counts by name as a person reads them; empty where there are none."""
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items())


def watched(frames: Iterable[Frame], seen: Counter[str]) -> Iterator[Frame]:
    """The same frames; what is amiss with them is counted in `seen`."""
    for frame in frames:
        seen.update(amiss(frame))
        yield frame
