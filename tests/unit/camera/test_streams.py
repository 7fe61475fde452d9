from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nlos_calibration import Intrinsics

from nlos_cam.camera import FORMATS, FRAMES_PER_S, FrameSet, FrameSynchronizer, Sample, frame_in_si
from nlos_cam.camera.streams import CONSISTENT_SETS, LATE_NUMBERS, MAX_GAP, WAITING_SETS
from nlos_cam.camera.timestamps import STEP_BACK, WRAP_PERIOD_S, ClockUnwrap, Continuity
from nlos_cam.frames import Frame

STREAMS = tuple(FORMATS)
SHAPE = (1, 1)
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
    st.lists(st.sets(st.sampled_from(STREAMS)), max_size=WAITING_SETS).filter(
        lambda sets: len(sets) > 0
    ),
    st.permutations(STREAMS),
)
def test_pairing_completes_or_counts_every_number(came: list[set[str]], order: list[str]) -> None:
    pairing = FrameSynchronizer()
    samples = [
        sample(stream, number)
        for number, streams in enumerate(came)
        for stream in order
        if stream in streams
    ]
    found = paired(pairing, samples)
    pairing.finish()

    assert numbers_of(found) == [number for number, streams in enumerate(came) if len(streams) == 3]
    assert pairing.incomplete == sum(0 < len(streams) < 3 for streams in came)

    if found:
        came_until = max(number for number, streams in enumerate(came) if streams)
        assert pairing.dropped == sum(
            len(streams) == 0 for streams in came[found[0].number : came_until]
        )

    assert not pairing.counts


@st.composite
def deliveries(draw: st.DrawFn) -> list[Sample]:
    """Draw what a poor link delivers: samples dropped, repeated and late, of each stream on its
    own.
    """
    sent: list[tuple[float, Sample]] = []
    for number in range(draw(st.integers(1, 25))):
        for stream in STREAMS:
            copies = draw(st.sampled_from((1, 1, 1, 1, 0, 2)))
            delays = draw(
                st.lists(st.sampled_from((0, 0, 0, 1.5, 4.5)), min_size=copies, max_size=copies)
            )
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
    assert len(sets) + pairing.incomplete + pairing.dropped == len(expected) + sum(
        number < first for number in in_time
    )

    again = [Counter(came) - Counter(STREAMS) for came in in_time.values()]
    again += [Counter(came) for number, came in late.items() if number in sets]
    passed_over = [Counter(came) for number, came in late.items() if number not in sets]

    assert pairing.counts["out_of_order"] == sum(max(streams.values()) for streams in passed_over)

    if not late:
        assert pairing.counts["duplicate"] == sum(
            max(streams.values(), default=0) for streams in again
        )

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
    assert pairing.incomplete == 0
    assert pairing.dropped == 0
    assert pairing.counts == Counter()


def test_pairing_puts_each_stream_in_its_place_once_in_time() -> None:
    samples = [
        Sample(stream, 7, 0.0, np.full((1, 1), place)) for place, stream in enumerate(STREAMS)
    ]
    [found] = paired(FrameSynchronizer(), reversed(samples))

    assert found.depth_z16[0, 0] == 0
    assert found.ir[0, 0] == 1
    assert found.confidence_raw8[0, 0] == 2

    pairing = FrameSynchronizer()
    torn = [sample("depth", 1), sample("infrared", 1), sample("confidence", 1, late_s=0.02)]

    assert paired(pairing, torn) == []  # one number, two instants
    assert pairing.incomplete == 1
    assert len(paired(pairing, whole(2, late_s=0.01))) == 1


@pytest.mark.slow
@given(st.lists(st.tuples(st.sampled_from(STREAMS), st.integers(0, 2**40)), max_size=300))
def test_pairing_bounds_memory_and_delivers_despite_wild_numbers(
    wild: list[tuple[str, int]],
) -> None:
    pairing = FrameSynchronizer()
    found: list[FrameSet] = []
    for number in range(1000, 1100):
        found += paired(pairing, whole(number))
        found += paired(
            pairing, [sample(*one) for one in wild[3 * (number - 1000) : 3 * (number - 999)]]
        )
        assert len(pairing._waiting) <= WAITING_SETS
        assert len(pairing._occurrences._streams) <= WAITING_SETS

    assert set(numbers_of(found)) >= set(range(1000, 1100))


def of_another_shape(number: int, *streams: str) -> list[Sample]:
    return [
        sample(stream, number, shape=(2, 1) if stream in streams else SHAPE) for stream in STREAMS
    ]


@pytest.mark.parametrize(
    ("samples", "numbers", "counts", "incomplete", "dropped"),
    [
        *(
            (whole(0, 100, 100 - late), [0, 100], {"out_of_order": 1}, 0, 99)
            for late in (1, LATE_NUMBERS)
        ),
        *(
            (
                [*whole(1), *of_another_shape(2, *streams), *whole(3)],
                [1, 3],
                {"wrong_size": 1},
                1,
                0,
            )
            for streams in (STREAMS, ("depth",))
        ),
        *((whole(0, 1 + gap), [0, 1 + gap], {}, 0, gap) for gap in (0, 1, 7, MAX_GAP - 1)),
        *(
            (
                [*whole(4999, 5000), sample("depth", 5001), *whole(n, n + 1)],
                [4999, 5000, n, n + 1],
                {"renumbered": 1},
                1,
                0,
            )
            for n in (10_000_000, 5000 + MAX_GAP + 1, 5000 - LATE_NUMBERS - 1, 0)
        ),
        ([*whole(0, 1), sample("depth", 10_000_000), *whole(2)], [0, 1, 2], {"stray": 1}, 0, 0),
        *(
            ([*whole(0, 1, 8), *whole(9, 10, late_s=pause_s)], [0, 1, 8, 9, 10], counts, 0, 6)
            for pause_s, counts in ((0.1, {}), (0.2, {"stalled": 1}), (5.0, {"stalled": 1}))
        ),
        *(
            (
                [*whole(5), *whole(6)[:2], *again * copies, *whole(6)[2:]],
                [5, 6],
                {"duplicate": copies},
                0,
                0,
            )
            for copies in (1, 2)
            for again in (whole(5), whole(5)[1:2], whole(6)[:2], whole(6)[1:2])
        ),
    ],
)
def test_pairing_counts_every_kind_of_irregular_set(
    samples: list[Sample], numbers: list[int], counts: dict[str, int], incomplete: int, dropped: int
) -> None:
    pairing = FrameSynchronizer(SHAPE)

    assert numbers_of(paired(pairing, samples)) == numbers

    pairing.finish()

    assert pairing.counts == counts
    assert pairing.incomplete == incomplete
    assert pairing.dropped == dropped


def counted_apart(instants: range, lost: dict[str, int]) -> Iterator[Sample]:
    """Number each stream's samples from 1, where a stream loses the frame of one instant."""
    counts: Counter[str] = Counter()
    for instant in instants:
        for stream in STREAMS:
            if lost.get(stream) != instant:
                counts[stream] += 1
                yield Sample(
                    stream,
                    counts[stream],
                    instant / FRAMES_PER_S + JITTER_S[stream],
                    np.zeros(SHAPE),
                )


@pytest.mark.parametrize("stream", STREAMS)
@pytest.mark.parametrize("instant", [0, 20])
def test_pairing_realigns_a_stream_that_lost_a_frame(stream: str, instant: int) -> None:
    pairing = FrameSynchronizer()
    found = [
        one
        for sample in counted_apart(range(60), {stream: instant})
        if (one := pairing.add(sample))
    ]

    assert len(found) == 60 - 1 - CONSISTENT_SETS
    assert pairing.incomplete == 60 - len(found)
    assert pairing.counts == {}

    numbers, times_s = (
        np.array([getattr(one, name) for one in found]) for name in ("number", "timestamp_s")
    )

    np.testing.assert_allclose(
        times_s - times_s[-1], (numbers - numbers[-1]) / FRAMES_PER_S, atol=1e-9
    )


def test_frame_in_si_has_metres_levels_and_nan() -> None:
    depth = np.array([[0, 4000, 65535]], np.uint16)
    ir = np.array([[0, 48, 255]], np.uint8)
    raw = np.array([[0, 0x70, 0xF0]], np.uint8)
    truth_m = np.ones((64, 64), np.float32)
    pinhole = Intrinsics(3, 1, 1.0, 1.0, 1.0, 0.5)
    settings = {"laser_power": 93.0}
    frame = frame_in_si(FrameSet(9, 1.5, depth, ir, raw), 0.00025, pinhole, settings, truth_m)

    np.testing.assert_allclose(frame.depth_m, [[np.nan, 1.0, 16.38375]], rtol=1e-6)
    assert frame.depth_m.dtype == np.float32
    np.testing.assert_array_equal(frame.confidence, [[0, 7, 15]])
    assert frame.ir is ir
    assert frame.frame_number == 9
    assert frame.timestamp_s == 1.5
    assert frame.intrinsics == pinhole
    assert frame.settings == settings
    assert frame.truth_depth_m is truth_m


STEP_BACK_S = STEP_BACK * WRAP_PERIOD_S


def unwrapped(timestamps_s: list[float], period_s: float = WRAP_PERIOD_S) -> list[float]:
    clock = ClockUnwrap(period_s)
    return [clock.add(timestamp_s) for timestamp_s in timestamps_s]


@given(
    first_s=st.floats(0.0, WRAP_PERIOD_S),
    gaps_s=st.lists(st.floats(-STEP_BACK_S / 2, WRAP_PERIOD_S - 2 * STEP_BACK_S), max_size=20),
)
def test_unwrap_gives_the_times_of_a_clock_without_wraps(
    first_s: float, gaps_s: list[float]
) -> None:
    true_s = [first_s]
    for gap_s in gaps_s:
        true_s.append(max(max(true_s) + gap_s, first_s))
    found_s = unwrapped([each_s % WRAP_PERIOD_S for each_s in true_s])
    offset_s = first_s - first_s % WRAP_PERIOD_S

    assert all(
        abs(found - true + offset_s) < 1e-6 for found, true in zip(found_s, true_s, strict=True)
    )


@pytest.mark.parametrize(
    ("stamps_s", "period_s", "expected_s"),
    [
        ([0.1, 1 / 3, 5.0, 5.0, 1.7e9], WRAP_PERIOD_S, [0.1, 1 / 3, 5.0, 5.0, 1.7e9]),
        ([100.0, 99.9, 100.1, 41.0], WRAP_PERIOD_S, [100.0, 99.9, 100.1, 41.0]),
        (
            [WRAP_PERIOD_S - 0.001, 0.001] * 2,
            WRAP_PERIOD_S,
            [WRAP_PERIOD_S - 0.001, WRAP_PERIOD_S + 0.001] * 2,
        ),
        ([90.0, 20.0, 85.0, 10.0], 100.0, [90.0, 120.0, 185.0, 210.0]),
    ],
    ids=["rising", "small steps back", "streams beside a wrap", "two wraps"],
)
def test_unwrap_adds_a_period_at_each_wrap(
    stamps_s: list[float], period_s: float, expected_s: list[float]
) -> None:
    assert unwrapped(stamps_s, period_s) == expected_s


def frame(number: int, timestamp_s: float) -> Frame:
    nothing = np.zeros((1, 1), np.uint8)
    pinhole = Intrinsics(1, 1, 1.0, 1.0, 0.0, 0.0)
    return Frame(nothing.astype(np.float32), nothing, nothing, timestamp_s, number, pinhole)


def passed_on(
    continuity: Continuity, numbers: range, zero_s: float, arrived_s: float
) -> list[Frame]:
    """Add a run at 30 frames/s whose number 0 is of `zero_s` (device clock); its first came at
    `arrived_s` (ours).
    """
    return [
        continuity.add(frame(number, zero_s + number / 30), arrived_s + (number - numbers[0]) / 30)
        for number in numbers
    ]


def test_continuity_keeps_first_run_and_counts_missed_once() -> None:
    given = frame(7, 1.5)

    assert Continuity().add(given, arrived_s=99.0) is given

    continuity = Continuity()
    continuity.restart(counted=0)  # after a run without frames

    assert continuity.add(frame(4, 2.0), arrived_s=0.0).frame_number == 4

    continuity = Continuity()
    passed_on(continuity, range(1), zero_s=0.0, arrived_s=0.0)
    continuity.restart(counted=20)
    continuity.restart(counted=5)
    passed_on(continuity, range(1), zero_s=1.0, arrived_s=1.0)

    assert continuity.missed == 29 - 25


@pytest.mark.parametrize("told", [True, False], ids=["streams restarted", "the count alone"])
@pytest.mark.parametrize(
    "zero_s", [1009.0, 0.0, 500_000.0], ids=["host's clock", "restarted", "jumped"]
)
def test_numbers_and_seconds_rise_together_over_an_outage(zero_s: float, told: bool) -> None:
    """The second run starts nine seconds after the first, whatever the device's clock says."""
    continuity = Continuity()
    before = passed_on(continuity, range(30), zero_s=1000.0, arrived_s=50.0)
    if told:
        continuity.restart(counted=0)
    after = passed_on(continuity, range(30), zero_s, arrived_s=59.0)
    for one, next_one in pairwise(before + after):
        later = next_one.frame_number - one.frame_number
        assert later > 0
        assert (next_one.timestamp_s - one.timestamp_s) * 30 == pytest.approx(later, abs=0.01)

    assert after[0].timestamp_s - before[0].timestamp_s == pytest.approx(9.0)
    assert continuity.missed == after[0].frame_number - before[-1].frame_number - 1 == 240


@pytest.mark.parametrize(
    ("device_s", "arrived_s", "number", "timestamp_s"),
    [(0.0, 4 / 30, 5, 10 + 5 / 30), (19.3, 9.0, 279, 19.3)],
    ids=["the next run follows at once", "the device's clock agrees with the host's"],
)
def test_continuity_splices_the_next_run(
    device_s: float, arrived_s: float, number: int, timestamp_s: float
) -> None:
    continuity = Continuity()
    passed_on(continuity, range(5), zero_s=10.0, arrived_s=0.0)
    continuity.restart(counted=0)
    found = continuity.add(frame(0, device_s), arrived_s)

    assert found.frame_number == number
    assert found.timestamp_s == pytest.approx(timestamp_s)
