"""Names of files of single frames."""

from collections import Counter

FRAME_STEM = r"\d{6,}(-\d+)?"
"""Pattern of a frame's stem."""
FRAME_GLOB = "[0-9][0-9][0-9][0-9][0-9][0-9]*"
"""Names that begin with a frame's stem, as a pattern of `fnmatch`."""


class FrameNames:
    """Stems of files of single frames, by frame number: a number that comes again, as after a
    restart of the device, gets a suffix.
    """

    def __init__(self) -> None:
        self._repeats: Counter[int] = Counter()

    def stem(self, number: int) -> str:
        """Return the stem of the next frame of a number: 000123, then 000123-2."""
        self._repeats[number] += 1
        repeats = self._repeats[number]
        return f"{number:06d}" if repeats == 1 else f"{number:06d}-{repeats}"
