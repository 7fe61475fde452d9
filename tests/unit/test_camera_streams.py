from collections import Counter
from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nlos_cam.camera.streams import FORMATS, LATE_NUMBERS, MAX_GAP, WAITING_SETS, FrameSet, FrameSynchronizer, Sample

STREAMS = tuple(FORMATS)
SHAPE = (1, 1)


def sample(stream: str, number: int, late_s: float = 0.0, shape: tuple[int, int] = SHAPE) -> Sample:
    return Sample(stream, number, number / 30 + late_s, np.full(shape, number))


def whole(*numbers: int, late_s: float = 0.0) -> list[Sample]:
    return [sample(stream, number, late_s) for number in numbers for stream in STREAMS]


def paired(pairing: FrameSynchronizer, samples: Iterable[Sample]) -> list[FrameSet]:
    return [found for one in samples if (found := pairing.add(one)) is not None]


def numbers_of(found: list[FrameSet]) -> list[int]:
    return [one.number for one in found]


@given(
    st.lists(st.sets(st.sampled_from(STREAMS)), max_size=WAITING_SETS).filter(lambda sets: len(sets) > 0),
    st.permutations(STREAMS),
)
def test_every_number_is_a_set_or_is_counted(came: list[set[str]], order: list[str]) -> None:
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
    """What a poor link makes of frames: some samples dropped, some sent twice, some late; each stream on its own."""
    sent: list[tuple[float, Sample]] = []
    for number in range(draw(st.integers(1, 25))):
        for stream in STREAMS:
            copies = draw(st.sampled_from((1, 1, 1, 1, 0, 2)))
            delays = draw(st.lists(st.sampled_from((0, 0, 0, 1.5, 4.5)), min_size=copies, max_size=copies))
            sent += [(number + delay, sample(stream, number)) for delay in delays]
    return [one for _, one in sorted(sent, key=lambda pair: pair[0])]


@given(deliveries())
def test_whatever_comes_each_whole_set_comes_once_in_order_and_every_number_is_told(samples: list[Sample]) -> None:
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
    told = range(first, max(in_time, default=-1) + 1)
    assert pairing.incomplete == len(in_time.keys() - set(sets))
    assert len(sets) + pairing.incomplete + pairing.dropped == len(told) + sum(number < first for number in in_time)
    again = [Counter(came) - Counter(STREAMS) for came in in_time.values()]
    again += [Counter(came) for number, came in late.items() if number in sets]
    passed_over = [Counter(came) for number, came in late.items() if number not in sets]
    assert pairing.counts["out_of_order"] == sum(max(streams.values()) for streams in passed_over)
    if not late:
        assert pairing.counts["duplicate"] == sum(max(streams.values(), default=0) for streams in again)
    assert (pairing.counts["duplicate"] > 0) == any(again)


@given(st.data())
def test_it_does_not_matter_which_stream_runs_ahead(data: st.DataObject) -> None:
    waiting = {stream: list(range(12)) for stream in STREAMS}
    samples: list[Sample] = []
    while any(waiting.values()):
        stream = data.draw(st.sampled_from([stream for stream in STREAMS if waiting[stream]]))
        samples.append(sample(stream, waiting[stream].pop(0)))
    pairing = FrameSynchronizer()
    assert numbers_of(paired(pairing, samples)) == list(range(12))
    assert (pairing.incomplete, pairing.dropped, pairing.counts) == (0, 0, Counter())


def test_each_stream_goes_to_its_place() -> None:
    samples = [Sample(stream, 7, 0.0, np.full((1, 1), place)) for place, stream in enumerate(STREAMS)]
    [found] = paired(FrameSynchronizer(), reversed(samples))
    assert (found.depth_z16[0, 0], found.ir[0, 0], found.confidence_raw8[0, 0]) == (0, 1, 2)


def test_frames_of_one_number_and_two_instants_are_no_set() -> None:
    pairing = FrameSynchronizer()
    torn = [sample("depth", 1), sample("infrared", 1), sample("confidence", 1, late_s=0.02)]
    assert paired(pairing, torn) == []
    assert pairing.incomplete == 1
    assert len(paired(pairing, whole(2, late_s=0.01))) == 1


def test_a_stream_that_never_comes_does_not_fill_the_memory() -> None:
    pairing = FrameSynchronizer()
    assert paired(pairing, (sample("depth", number) for number in range(1000))) == []
    assert pairing.incomplete == 1000 - WAITING_SETS
    pairing.finish()
    assert pairing.incomplete == 1000


@given(st.lists(st.tuples(st.sampled_from(STREAMS), st.integers(0, 2**40)), max_size=300))
def test_wild_numbers_do_not_fill_the_memory_and_do_not_hold_up_what_is_right(wild: list[tuple[str, int]]) -> None:
    pairing = FrameSynchronizer()
    found: list[FrameSet] = []
    for number in range(1000, 1100):
        found += paired(pairing, whole(number))
        found += paired(pairing, [sample(*one) for one in wild[3 * (number - 1000) : 3 * (number - 999)]])
        assert len(pairing._waiting) <= WAITING_SETS
        assert len(pairing._occurrences._streams) <= WAITING_SETS
    assert set(numbers_of(found)) >= set(range(1000, 1100))


@pytest.mark.parametrize("late", [1, LATE_NUMBERS])
def test_a_late_number_is_counted_and_not_delivered(late: int) -> None:
    pairing = FrameSynchronizer()
    paired(pairing, whole(0, 100))
    assert paired(pairing, whole(100 - late)) == []
    assert pairing.counts == {"out_of_order": 1}
    assert pairing.dropped == 99


@pytest.mark.parametrize("copies", [1, 2])
@pytest.mark.parametrize("streams", [STREAMS, STREAMS[1:2]])
@pytest.mark.parametrize("again", [5, 6])
def test_what_comes_again_is_counted_in_frames(copies: int, streams: tuple[str, ...], again: int) -> None:
    pairing = FrameSynchronizer()
    samples = [*whole(4, 5), sample("depth", 6), sample("infrared", 6)]
    repeated = [
        sample(stream, again) for _ in range(copies) for stream in streams if again == 5 or stream != "confidence"
    ]
    found = paired(pairing, [*samples, *repeated, sample("confidence", 6), *whole(7)])
    assert numbers_of(found) == [4, 5, 6, 7]
    assert pairing.counts == {"duplicate": copies}


@pytest.mark.parametrize("streams", [STREAMS, ("depth",)])
def test_another_shape_is_counted_in_frames_and_is_no_set(streams: tuple[str, ...]) -> None:
    pairing = FrameSynchronizer(SHAPE)
    odd = [sample(stream, 2, shape=(2, 1) if stream in streams else SHAPE) for stream in STREAMS]
    assert numbers_of(paired(pairing, [*whole(1), *odd, *whole(3)])) == [1, 3]
    assert pairing.counts == {"wrong_size": 1}
    assert (pairing.incomplete, pairing.dropped) == (1, 0)


@pytest.mark.parametrize("gap", [0, 1, 7, MAX_GAP - 1])
def test_a_gap_in_the_numbers_is_counted_as_dropped(gap: int) -> None:
    pairing = FrameSynchronizer()
    paired(pairing, whole(0, 1 + gap))
    assert pairing.dropped == gap
    assert not pairing.counts


@pytest.mark.parametrize("number", [10_000_000, 5000 + MAX_GAP + 1, 5000 - LATE_NUMBERS - 1, 0])
def test_a_count_that_begins_anew_is_no_gap(number: int) -> None:
    pairing = FrameSynchronizer()
    samples = [*whole(4999, 5000), sample("depth", 5001), *whole(number, number + 1)]
    assert numbers_of(paired(pairing, samples)) == [4999, 5000, number, number + 1]
    assert pairing.counts == {"renumbered": 1}
    assert (pairing.incomplete, pairing.dropped) == (1, 0)


def test_one_stray_sample_does_not_begin_a_count() -> None:
    pairing = FrameSynchronizer()
    found = paired(pairing, [*whole(0, 1), sample("depth", 10_000_000), *whole(2)])
    assert numbers_of(found) == [0, 1, 2]
    pairing.finish()
    assert pairing.counts == {"stray": 1}
    assert (pairing.incomplete, pairing.dropped) == (0, 0)


@pytest.mark.parametrize(("pause_s", "stalled"), [(0.1, 0), (0.2, 1), (5.0, 1)])
def test_a_pause_that_the_numbers_do_not_tell_is_counted(pause_s: float, stalled: int) -> None:
    pairing = FrameSynchronizer()
    paired(pairing, [*whole(0, 1, 8), *whole(9, 10, late_s=pause_s)])
    assert pairing.counts["stalled"] == stalled
    assert pairing.dropped == 6
