from collections import Counter
from collections.abc import Iterator

import numpy as np
import pytest

from nlos_cam.camera.streams import FORMATS, FRAMES_PER_S, TELLING, FrameSynchronizer, Sample, StreamOffsets

STREAMS = tuple(FORMATS)
PIXELS = np.zeros((1, 1), np.uint16)
JITTER_S = {"depth": 0.0, "infrared": 0.004, "confidence": -0.003}


def counted_apart(instants: range, lost: dict[str, int]) -> Iterator[Sample]:
    """Each stream's own count, from 1, of what came at each instant; a stream loses the frame of one instant."""
    counts: Counter[str] = Counter()
    for instant in instants:
        for stream in STREAMS:
            if lost.get(stream) != instant:
                counts[stream] += 1
                yield Sample(stream, counts[stream], instant / FRAMES_PER_S + JITTER_S[stream], PIXELS)


@pytest.mark.parametrize("stream", STREAMS)
@pytest.mark.parametrize("instant", [0, 20])
def test_a_stream_that_lost_a_frame_is_paired_by_time_again(stream: str, instant: int) -> None:
    pairing = FrameSynchronizer()
    found = [one for sample in counted_apart(range(60), {stream: instant}) if (one := pairing.add(sample))]
    assert len(found) == 60 - 1 - TELLING
    assert pairing.incomplete == 60 - len(found)
    assert pairing.counts == {}
    numbers, times_s = (np.array([getattr(one, name) for one in found]) for name in ("number", "timestamp_s"))
    np.testing.assert_allclose(times_s - times_s[-1], (numbers - numbers[-1]) / FRAMES_PER_S, atol=1e-9)


def test_two_streams_may_be_behind() -> None:
    pairing = FrameSynchronizer()
    lost = {"infrared": 0, "confidence": 30}
    found = [one for sample in counted_apart(range(90), lost) if (one := pairing.add(sample))]
    assert len(found) >= 90 - 2 * (2 + TELLING)
    assert found[-1].timestamp_s == 89 / FRAMES_PER_S


def test_numbers_stay_where_the_timestamps_agree_or_differ_once() -> None:
    alignment = StreamOffsets(FRAMES_PER_S)
    late = {"depth": 1.0, "infrared": 1.0 + 1 / FRAMES_PER_S}
    for _ in range(10):
        for times_s in (late, late, {"depth": 1.0, "infrared": 1.01}):
            alignment.note(times_s)
    sample = Sample("infrared", 7, 1.0, PIXELS)
    assert alignment.add(sample) is sample


def test_a_lag_is_taken_once_until_it_is_told_anew() -> None:
    alignment = StreamOffsets(FRAMES_PER_S)
    for _ in range(TELLING + 1):
        alignment.note({"depth": 1.0, "infrared": 1.0 + 2 / FRAMES_PER_S})
    assert alignment.add(Sample("infrared", 7, 1.0, PIXELS)).number == 9
    assert alignment.add(Sample("depth", 7, 1.0, PIXELS)).number == 7
