import pytest

from nlos_cam.live.statistics import STALLED, STALLED_AFTER_S, StallWatch

JUST_BEFORE_S = 0.999 * STALLED_AFTER_S


@pytest.fixture
def told() -> list[tuple[str, bool]]:
    return []


@pytest.fixture
def watch(told: list[tuple[str, bool]]) -> StallWatch:
    return StallWatch(lambda *about: told.append(about))


def test_before_the_first_frame_nothing_stalls(watch: StallWatch, told: list[tuple[str, bool]]) -> None:
    assert not watch.look(1000.0, None)
    assert (watch.stalls, told) == (0, [])


def test_a_stall_is_told_once_shown_again_and_again_and_ends_with_a_frame(
    watch: StallWatch, told: list[tuple[str, bool]]
) -> None:
    assert not watch.look(10.0 + JUST_BEFORE_S, 10.0)
    shown = [time_s for time_s in (10.5, 10.6, 10.9, 11.0, 11.4, 11.6) if watch.look(time_s, 10.0)]
    assert shown == [10.5, 11.0, 11.6]
    assert told == [(STALLED, True)]
    watch.came(12.0)
    watch.came(12.1)
    assert told == [(STALLED, True), (STALLED, False)]
    assert (watch.stalls, watch.stalled_s) == (1, 2.0)


def test_a_frame_from_before_a_stall_does_not_end_it(watch: StallWatch, told: list[tuple[str, bool]]) -> None:
    watch.look(11.0, 10.0)
    watch.came(10.0)
    assert told == [(STALLED, True)]


def test_frames_that_come_to_no_result_end_a_stall_too(watch: StallWatch, told: list[tuple[str, bool]]) -> None:
    watch.look(11.0, 10.0)
    assert not watch.look(11.1, 11.05)
    assert [begins for _, begins in told] == [True, False]


def test_each_stall_is_told_and_the_last_may_last_to_the_end(watch: StallWatch, told: list[tuple[str, bool]]) -> None:
    for start_s in (0.0, 10.0):
        assert watch.look(start_s + 1.0, start_s)
        watch.came(start_s + 2.0)
    watch.look(21.0, 20.0)
    watch.close(23.0)
    watch.close(99.0)
    assert (watch.stalls, watch.stalled_s) == (3, 7.0)
    assert [begins for _, begins in told] == [True, False, True, False, True]
