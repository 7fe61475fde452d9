from dataclasses import replace

import pytest
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.flatness import Flatness
from nlos_calibration.wall import check_flat, judge, warnings

FLAT = Flatness(
    bend_m=0.0,
    bend_deg=0.0,
    bend_std_m=1e-5,
    bend_std_deg=0.001,
    offset_m=0.0,
    offset_bend_m=0.0,
    offset_bend_deg=0.0,
)
OFFSET = replace(FLAT, bend_m=0.006, bend_deg=0.5, offset_m=0.0045)


@pytest.mark.parametrize(
    ("distance_m", "facing_deg", "advice"),
    [
        (0.140, 45.0, "0.140 m is outside 0.15 to 0.30 m: move the lidar 1 cm back"),
        (0.110, 45.0, "0.110 m is outside 0.15 to 0.30 m: move the lidar 4 cm back"),
        (0.400, 45.0, "0.400 m is outside 0.15 to 0.30 m: move the lidar 10 cm closer"),
        (0.312, 45.0, "0.312 m is outside 0.15 to 0.30 m: move the lidar 2 cm closer"),
        (0.200, 5.0, "5.0 degrees is outside 15 to 75: turn the lidar 10 degrees aside"),
        (0.200, 81.0, "81.0 degrees is outside 15 to 75: turn the lidar 6 degrees towards the wall"),
        (0.200, 75.5, "75.5 degrees is outside 15 to 75: turn the lidar 1 degree towards the wall"),
    ],
)
def test_out_of_range_says_what_to_move_and_by_how_much(distance_m: float, facing_deg: float, advice: str) -> None:
    assert judge(distance_m, facing_deg, FLAT, 0.0) == ("out of range", advice)


@pytest.mark.parametrize("distance_m", [0.11, 0.1333, 0.3111, 0.4])
@pytest.mark.parametrize("facing_deg", [3.3, 14.2, 76.1, 88.0])
def test_who_does_as_told_is_in_range(distance_m: float, facing_deg: float) -> None:
    move, turn = (
        part.rsplit("lidar ", 1)[1].split() for part in judge(distance_m, facing_deg, FLAT, 0.0)[1].split("; ")
    )
    moved_m = distance_m + (1 if move[2] == "back" else -1) * int(move[0]) / 100.0
    turned_deg = facing_deg + (1 if turn[2] == "aside" else -1) * int(turn[0])
    assert judge(moved_m, turned_deg, FLAT, 0.0)[0] == "good"


def test_both_ranges_are_told() -> None:
    assert len(judge(0.5, 5.0, FLAT, 0.0)[1].split("; ")) == 2


@pytest.mark.parametrize(("distance_m", "facing_deg"), [(0.15, 15.0), (0.3, 75.0), (0.1495, 14.9), (0.3005, 75.1)])
def test_the_ranges_include_their_ends_and_what_cannot_be_told_from_them(distance_m: float, facing_deg: float) -> None:
    assert judge(distance_m, facing_deg, FLAT, 0.0)[0] == "good"


@pytest.mark.parametrize(
    ("flat", "ripple_m", "why"),
    [
        (replace(FLAT, bend_m=0.0015), 0.0, "differs from the whole by 1.5 mm and 0.00 degrees: a bent wall"),
        (replace(FLAT, bend_deg=0.3), 0.0, "differs from the whole by 0.0 mm and 0.30 degrees: a bent wall"),
        (replace(FLAT, bend_deg=0.3, bend_std_deg=0.2), 0.0, "noise leaves 0.0 mm and 0.30 degrees"),
        (FLAT, 0.0013, "1.3 mm RMS off the plane"),
        (OFFSET, 0.0, r"+4.5 mm were missing from each"),
    ],
)
def test_what_may_be_another_plane_is_doubted_and_recorded(flat: Flatness, ripple_m: float, why: str) -> None:
    check_flat(flat, ripple_m)
    verdict, advice = judge(0.2, 45.0, flat, ripple_m)
    assert verdict == "doubtful"
    assert why in advice


def test_a_doubt_does_not_hide_what_to_move() -> None:
    verdict, advice = judge(0.11, 45.0, replace(FLAT, bend_deg=0.3), 0.0)
    assert verdict == "doubtful"
    assert "move the lidar 4 cm back" in advice


@pytest.mark.parametrize(
    "flat",
    [
        replace(FLAT, bend_deg=1.2),
        replace(FLAT, bend_m=0.006),
        replace(OFFSET, offset_bend_deg=0.4),  # an offset does not explain it
    ],
)
def test_what_surely_is_another_plane_is_refused(flat: Flatness) -> None:
    with pytest.raises(WallRefusedError, match="not one flat wall"):
        check_flat(flat, 0.0)


def test_noise_alone_refuses_nothing() -> None:
    check_flat(replace(FLAT, bend_m=0.006, bend_deg=1.2, bend_std_m=0.002, bend_std_deg=0.5), 0.0)


def test_a_rough_wall_is_refused() -> None:
    with pytest.raises(WallRefusedError, match=r"not flat: parts are 2\.5 mm RMS off"):
        check_flat(FLAT, 0.0025)


def test_ripples_and_noise_are_told_without_changing_the_verdict() -> None:
    assert judge(0.2, 45.0, FLAT, 0.0006)[0] == "good"
    ripples, noise = warnings(0.0006, 3.2)
    assert "0.6 mm RMS" in ripples
    assert "3.2 times as noisy" in noise
    assert warnings(0.0, 1.0) == ()
