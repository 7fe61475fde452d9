from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nlos_cam.camera.streams import FORMATS, WAITING_SETS, FrameSet, Pairing, Sample

STREAMS = tuple(FORMATS)


def sample(stream: str, number: int, late_s: float = 0.0) -> Sample:
    return Sample(stream, number, number / 30 + late_s, np.full((1, 1), number))


def paired(pairing: Pairing, samples: Iterable[Sample]) -> list[FrameSet]:
    return [found for one in samples if (found := pairing.add(one)) is not None]


@given(
    st.lists(st.sets(st.sampled_from(STREAMS)), max_size=40).filter(lambda sets: len(sets) > 0),
    st.permutations(STREAMS),
)
def test_every_number_is_a_set_or_is_counted(came: list[set[str]], order: list[str]) -> None:
    pairing = Pairing()
    samples = [sample(stream, number) for number, streams in enumerate(came) for stream in order if stream in streams]
    found = paired(pairing, samples)
    pairing.finish()
    assert [one.number for one in found] == [number for number, streams in enumerate(came) if len(streams) == 3]
    assert pairing.incomplete == sum(0 < len(streams) < 3 for streams in came)
    if found:
        between = came[found[0].number : found[-1].number]
        assert pairing.dropped == sum(len(streams) == 0 for streams in between)


@given(st.data())
def test_it_does_not_matter_which_stream_runs_ahead(data: st.DataObject) -> None:
    waiting = {stream: list(range(12)) for stream in STREAMS}
    samples: list[Sample] = []
    while any(waiting.values()):
        stream = data.draw(st.sampled_from([stream for stream in STREAMS if waiting[stream]]))
        samples.append(sample(stream, waiting[stream].pop(0)))
    pairing = Pairing()
    assert [found.number for found in paired(pairing, samples)] == list(range(12))
    assert (pairing.incomplete, pairing.dropped) == (0, 0)


def test_each_stream_goes_to_its_place() -> None:
    samples = [Sample(stream, 7, 0.0, np.full((1, 1), place)) for place, stream in enumerate(STREAMS)]
    [found] = paired(Pairing(), reversed(samples))
    assert (found.depth_z16[0, 0], found.ir[0, 0], found.confidence_raw8[0, 0]) == (0, 1, 2)


def test_frames_of_one_number_and_two_instants_are_no_set() -> None:
    pairing = Pairing()
    torn = [sample("depth", 1), sample("infrared", 1), sample("confidence", 1, late_s=0.02)]
    assert paired(pairing, torn) == []
    assert pairing.incomplete == 1
    assert len(paired(pairing, [sample(stream, 2, late_s=0.01) for stream in STREAMS])) == 1


def test_a_stream_that_never_comes_does_not_fill_the_memory() -> None:
    pairing = Pairing()
    assert paired(pairing, (sample("depth", number) for number in range(1000))) == []
    assert pairing.incomplete == 1000 - WAITING_SETS


def test_a_number_that_was_passed_over_stays_so() -> None:
    pairing = Pairing()
    paired(pairing, [sample(stream, 5) for stream in STREAMS])
    assert paired(pairing, [sample(stream, 4) for stream in STREAMS]) == []


@pytest.mark.parametrize("gap", [0, 1, 7])
def test_a_gap_in_the_numbers_is_counted_as_dropped(gap: int) -> None:
    pairing = Pairing()
    paired(pairing, [sample(stream, number) for number in (0, 1 + gap) for stream in STREAMS])
    assert pairing.dropped == gap
