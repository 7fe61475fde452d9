from collections import Counter
from collections.abc import Iterable, Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nlos_calibration import Intrinsics

from nlos_cam.camera import FORMATS, FRAMES_PER_S, FrameSet, FrameSynchronizer, Sample, frame_in_si
from nlos_cam.camera.streams import CONSISTENT_SETS, LATE_NUMBERS, MAX_GAP, WAITING_SETS

STREAMS = tuple(FORMATS)
SHAPE = (1, 1)
PIXELS = np.zeros(SHAPE, np.uint16)
JITTER_S = {"depth": 0.0, "infrared": 0.004, "confidence": -0.003}


def sample(stream: str, number: int, late_s: float = 0.0, shape: tuple[int, int] = SHAPE) -> Sample:
    return Sample(stream, number, number / 30 + late_s, np.full(shape, number))


def whole(*numbers: int, late_s: float = 0.0) -> list[Sample]:
    return [sample(stream, number, late_s) for number in numbers for stream in STREAMS]


def paired(pairing: FrameSynchronizer, samples: Iterable[Sample]) -> list[FrameSet]:
    return [found for one in samples if (found := pairing.add(one)) is not None]


def numbers_of(found: list[FrameSet]) -> list[int]:
    return [one.number for one in found]


@pytest.mark.slow
@given(
    st.lists(st.sets(st.sampled_from(STREAMS)), max_size=WAITING_SETS).filter(lambda sets: len(sets) > 0),
    st.permutations(STREAMS),
)
def test_pairing_completes_or_counts_every_number(came: list[set[str]], order: list[str]) -> None:
    pairing = FrameSynchronizer()
    samples = [sample(stream, number) for number, streams in enumerate(came) for stream in order if stream in streams]
    found = paired(pairing, samples)
    pairing.finish()
    assert numbers_of(found) == [number for number, streams in enumerate(came) if len(streams) == 3]
    assert pairing.incomplete == sum(0 < len(streams) < 3 for streams in came)
    if found:
        came_until = max(number for number, streams in enumerate(came) if streams)
        assert pairing.dropped == sum(len(streams) == 0 for streams in came[found[0].number : came_until])
    assert not pairing.counts


@st.composite
def deliveries(draw: st.DrawFn) -> list[Sample]:
    """Draw what a poor link delivers: samples dropped, repeated and late, of each stream on its own."""
    sent: list[tuple[float, Sample]] = []
    for number in range(draw(st.integers(1, 25))):
        for stream in STREAMS:
            copies = draw(st.sampled_from((1, 1, 1, 1, 0, 2)))
            delays = draw(st.lists(st.sampled_from((0, 0, 0, 1.5, 4.5)), min_size=copies, max_size=copies))
            sent += [(number + delay, sample(stream, number)) for delay in delays]
    return [one for _, one in sorted(sent, key=lambda pair: pair[0])]


@pytest.mark.slow
@given(deliveries())
def test_pairing_gives_each_set_once_and_counts_the_rest(samples: list[Sample]) -> None:
    in_time: dict[int, list[str]] = {}
    late: dict[int, list[str]] = {}
    sets: list[int] = []
    for one in samples:
        came = (late if sets and one.number <= sets[-1] else in_time).setdefault(one.number, [])
        came.append(one.stream)
        if came is in_time.get(one.number) and set(came) == set(STREAMS):
            sets.append(one.number)
    pairing = FrameSynchronizer()
    assert numbers_of(paired(pairing, samples)) == sets == sorted(set(sets))
    pairing.finish()
    first = sets[0] if sets else min(in_time, default=0)
    expected = range(first, max(in_time, default=-1) + 1)
    assert pairing.incomplete == len(in_time.keys() - set(sets))
    assert len(sets) + pairing.incomplete + pairing.dropped == len(expected) + sum(number < first for number in in_time)
    again = [Counter(came) - Counter(STREAMS) for came in in_time.values()]
    again += [Counter(came) for number, came in late.items() if number in sets]
    passed_over = [Counter(came) for number, came in late.items() if number not in sets]
    assert pairing.counts["out_of_order"] == sum(max(streams.values()) for streams in passed_over)
    if not late:
        assert pairing.counts["duplicate"] == sum(max(streams.values(), default=0) for streams in again)
    assert (pairing.counts["duplicate"] > 0) == any(again)


@pytest.mark.slow
@given(st.data())
def test_pairing_does_not_depend_on_which_stream_is_ahead(data: st.DataObject) -> None:
    waiting = {stream: list(range(12)) for stream in STREAMS}
    samples: list[Sample] = []
    while any(waiting.values()):
        stream = data.draw(st.sampled_from([stream for stream in STREAMS if waiting[stream]]))
        samples.append(sample(stream, waiting[stream].pop(0)))
    pairing = FrameSynchronizer()
    assert numbers_of(paired(pairing, samples)) == list(range(12))
    assert (pairing.incomplete, pairing.dropped, pairing.counts) == (0, 0, Counter())


def test_pairing_puts_each_stream_in_its_place_once_in_time() -> None:
    samples = [Sample(stream, 7, 0.0, np.full((1, 1), place)) for place, stream in enumerate(STREAMS)]
    [found] = paired(FrameSynchronizer(), reversed(samples))
    assert (found.depth_z16[0, 0], found.ir[0, 0], found.confidence_raw8[0, 0]) == (0, 1, 2)
    pairing = FrameSynchronizer()
    torn = [sample("depth", 1), sample("infrared", 1), sample("confidence", 1, late_s=0.02)]
    assert paired(pairing, torn) == []  # one number, two instants
    assert pairing.incomplete == 1
    assert len(paired(pairing, whole(2, late_s=0.01))) == 1


@pytest.mark.slow
@given(st.lists(st.tuples(st.sampled_from(STREAMS), st.integers(0, 2**40)), max_size=300))
def test_pairing_bounds_memory_and_delivers_despite_wild_numbers(wild: list[tuple[str, int]]) -> None:
    pairing = FrameSynchronizer()
    found: list[FrameSet] = []
    for number in range(1000, 1100):
        found += paired(pairing, whole(number))
        found += paired(pairing, [sample(*one) for one in wild[3 * (number - 1000) : 3 * (number - 999)]])
        assert len(pairing._waiting) <= WAITING_SETS
        assert len(pairing._occurrences._streams) <= WAITING_SETS
    assert set(numbers_of(found)) >= set(range(1000, 1100))


@pytest.mark.parametrize("late", [1, LATE_NUMBERS])
def test_pairing_counts_a_late_number_as_out_of_order(late: int) -> None:
    pairing = FrameSynchronizer()
    paired(pairing, whole(0, 100))
    assert paired(pairing, whole(100 - late)) == []
    assert pairing.counts == {"out_of_order": 1}
    assert pairing.dropped == 99


@pytest.mark.parametrize("copies", [1, 2])
@pytest.mark.parametrize("streams", [STREAMS, STREAMS[1:2]])
@pytest.mark.parametrize("again", [5, 6])
def test_pairing_counts_repeats_in_frames(copies: int, streams: tuple[str, ...], again: int) -> None:
    pairing = FrameSynchronizer()
    samples = [*whole(4, 5), sample("depth", 6), sample("infrared", 6)]
    repeated = [
        sample(stream, again) for _ in range(copies) for stream in streams if again == 5 or stream != "confidence"
    ]
    found = paired(pairing, [*samples, *repeated, sample("confidence", 6), *whole(7)])
    assert numbers_of(found) == [4, 5, 6, 7]
    assert pairing.counts == {"duplicate": copies}


@pytest.mark.parametrize("streams", [STREAMS, ("depth",)])
def test_pairing_counts_another_shape_in_frames(streams: tuple[str, ...]) -> None:
    pairing = FrameSynchronizer(SHAPE)
    odd = [sample(stream, 2, shape=(2, 1) if stream in streams else SHAPE) for stream in STREAMS]
    assert numbers_of(paired(pairing, [*whole(1), *odd, *whole(3)])) == [1, 3]
    assert pairing.counts == {"wrong_size": 1}
    assert (pairing.incomplete, pairing.dropped) == (1, 0)


@pytest.mark.parametrize("gap", [0, 1, 7, MAX_GAP - 1])
def test_pairing_counts_a_gap_as_dropped(gap: int) -> None:
    pairing = FrameSynchronizer()
    paired(pairing, whole(0, 1 + gap))
    assert pairing.dropped == gap
    assert not pairing.counts


@pytest.mark.parametrize("number", [10_000_000, 5000 + MAX_GAP + 1, 5000 - LATE_NUMBERS - 1, 0])
def test_pairing_takes_a_restarted_count_for_no_gap(number: int) -> None:
    pairing = FrameSynchronizer()
    samples = [*whole(4999, 5000), sample("depth", 5001), *whole(number, number + 1)]
    assert numbers_of(paired(pairing, samples)) == [4999, 5000, number, number + 1]
    assert pairing.counts == {"renumbered": 1}
    assert (pairing.incomplete, pairing.dropped) == (1, 0)


def test_pairing_counts_a_stray_sample_and_goes_on() -> None:
    pairing = FrameSynchronizer()
    assert numbers_of(paired(pairing, [*whole(0, 1), sample("depth", 10_000_000), *whole(2)])) == [0, 1, 2]
    pairing.finish()
    assert pairing.counts == {"stray": 1}
    assert (pairing.incomplete, pairing.dropped) == (0, 0)


@pytest.mark.parametrize(("pause_s", "stalled"), [(0.1, 0), (0.2, 1), (5.0, 1)])
def test_pairing_counts_a_pause_that_numbers_hide(pause_s: float, stalled: int) -> None:
    pairing = FrameSynchronizer()
    paired(pairing, [*whole(0, 1, 8), *whole(9, 10, late_s=pause_s)])
    assert pairing.counts["stalled"] == stalled
    assert pairing.dropped == 6


def counted_apart(instants: range, lost: dict[str, int]) -> Iterator[Sample]:
    """Number each stream's samples from 1, where a stream loses the frame of one instant."""
    counts: Counter[str] = Counter()
    for instant in instants:
        for stream in STREAMS:
            if lost.get(stream) != instant:
                counts[stream] += 1
                yield Sample(stream, counts[stream], instant / FRAMES_PER_S + JITTER_S[stream], PIXELS)


@pytest.mark.parametrize("stream", STREAMS)
@pytest.mark.parametrize("instant", [0, 20])
def test_pairing_realigns_a_stream_that_lost_a_frame(stream: str, instant: int) -> None:
    pairing = FrameSynchronizer()
    found = [one for sample in counted_apart(range(60), {stream: instant}) if (one := pairing.add(sample))]
    assert len(found) == 60 - 1 - CONSISTENT_SETS
    assert pairing.incomplete == 60 - len(found)
    assert pairing.counts == {}
    numbers, times_s = (np.array([getattr(one, name) for one in found]) for name in ("number", "timestamp_s"))
    np.testing.assert_allclose(times_s - times_s[-1], (numbers - numbers[-1]) / FRAMES_PER_S, atol=1e-9)


def test_frame_in_si_has_metres_levels_and_nan() -> None:
    depth, ir = np.array([[0, 4000, 65535]], np.uint16), np.array([[0, 48, 255]], np.uint8)
    raw, truth_m = np.array([[0, 0x70, 0xF0]], np.uint8), np.ones((64, 64), np.float32)
    pinhole, settings = Intrinsics(3, 1, 1.0, 1.0, 1.0, 0.5), {"laser_power": 93.0}
    frame = frame_in_si(FrameSet(9, 1.5, depth, ir, raw), 0.00025, pinhole, settings, truth_m)
    np.testing.assert_allclose(frame.depth_m, [[np.nan, 1.0, 16.38375]], rtol=1e-6)
    assert frame.depth_m.dtype == np.float32
    np.testing.assert_array_equal(frame.confidence, [[0, 7, 15]])
    assert frame.ir is ir
    assert (frame.frame_number, frame.timestamp_s, frame.intrinsics) == (9, 1.5, pinhole)
    assert (frame.settings, frame.truth_depth_m) == (settings, truth_m)
