"""Numbers that mean the same instant on every stream, where librealsense counts the frames of each by itself.

It does on kernels without the patch that passes an L515's metadata on. A stream that begins a frame late, or loses one,
is then behind the others' numbers until it is started again, while its timestamps are right.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nlos_cam.camera.streams import Sample

TELLING = 3
"""Numbers in a row of which the streams' timestamps differ by the same number of frames."""


class Alignment:
    """Raises the numbers of a stream that is behind, once timestamps have told by how much."""

    def __init__(self, frames_per_s: float) -> None:
        self._frames_per_s = frames_per_s
        self._behind: Counter[str] = Counter()
        """In frames, by stream."""
        self._lags: Mapping[str, int] = {}
        self._told = 0

    def add(self, sample: "Sample") -> "Sample":
        """The sample with its number as the other streams count."""
        behind = self._behind[sample.stream]
        return replace(sample, number=sample.number + behind) if behind else sample

    def note(self, times_s: Mapping[str, float]) -> None:
        """Take note of when the frames of one number were taken, by stream."""
        first_s = min(times_s.values())
        lags = {stream: round((time_s - first_s) * self._frames_per_s) for stream, time_s in times_s.items()}
        self._told = self._told + 1 if lags == self._lags else 1
        self._lags = lags
        if self._told == TELLING:
            self._behind.update(lags)
