from collections import Counter

import numpy as np
import pytest
from nlos_calibration.geometry import Intrinsics

from nlos_cam.frames import Frame
from nlos_cam.live.loop import in_words, watched
from nlos_cam.reconstruct.verdict import frame_issues

SMALL = Intrinsics(80, 64, 57.0, 61.0, 39.5, 31.5)
PIXELS = 80 * 64


def frame(with_depth: int, at_255: int = 0) -> Frame:
    """A frame of which so many pixels have a depth, and so many are saturated."""
    depth_m, ir = np.full(PIXELS, np.nan, np.float32), np.full(PIXELS, 254, np.uint8)
    depth_m[:with_depth], ir[:at_255] = 0.3, 255
    shape = 64, 80
    return Frame(depth_m.reshape(shape), ir.reshape(shape), ir.reshape(shape), 0.0, 0, SMALL)


@pytest.mark.parametrize(
    ("seen", "names"),
    [
        (frame(PIXELS), []),
        (frame(PIXELS // 2 + 1), []),
        (frame(PIXELS // 2), ["half_invalid"]),
        (frame(1), ["half_invalid"]),
        (frame(0), ["blank"]),
        (frame(PIXELS, PIXELS // 1000), []),
        (frame(PIXELS, PIXELS // 1000 + 1), ["saturated"]),
        (frame(0, PIXELS), ["blank", "saturated"]),
    ],
)
def test_what_is_amiss_is_told_by_name(seen: Frame, names: list[str]) -> None:
    assert frame_issues(seen) == names


def test_frames_that_are_watched_are_the_same_and_counted() -> None:
    frames, seen = [frame(0), frame(PIXELS), frame(0, PIXELS), frame(9)], Counter[str]()
    given = list(watched(frames, seen))
    assert all(one is other for one, other in zip(frames, given, strict=True))
    assert seen == {"blank": 2, "saturated": 1, "half_invalid": 1}


def test_counts_are_told_in_words() -> None:
    assert in_words({"out_of_order": 3, "blank": 1}) == "3 out of order, 1 blank"
    assert not in_words({})
