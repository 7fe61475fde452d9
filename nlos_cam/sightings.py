"""What can be seen to be amiss with a frame: blank, half invalid, saturated."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping

from nlos_cam.frames import Frame
from nlos_cam.verdict import amiss


def in_words(counts: Mapping[str, int]) -> str:
    """Counts by name as a person reads them; empty where there are none."""
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items())


def watched(frames: Iterable[Frame], seen: Counter[str]) -> Iterator[Frame]:
    """The same frames; what is amiss with them is counted in `seen`."""
    for frame in frames:
        seen.update(amiss(frame))
        yield frame
