import re
from itertools import product

import pytest
from nlos_calibration.rig import Extent, LidarPose, Occluder, Rig, load_rig
from nlos_calibration.rig_check import MIN_SEEN, MIN_SHARE, combined, footprint, judge_rig, lidar_sees, wall_sees
from nlos_calibration.wall_record import OccluderRecord

PAPER = load_rig("paper-rig")


def rig(
    x_m: float = 0.2,
    gap_m: float = 0.1,
    distance_m: float = 0.2,
    yaw_deg: float = 45.0,
    wall: tuple[float, float, float, float] | None = None,
) -> Rig:
    lidar = LidarPose(distance_m=distance_m, yaw_deg=yaw_deg)
    bench = PAPER.model_copy(update={"lidar": lidar, "occluder": Occluder(x_m=x_m, z_min_m=gap_m)})
    names = "x_min_m", "x_max_m", "y_min_m", "y_max_m"
    return bench.model_copy(update={"wall": Extent(**dict(zip(names, wall, strict=True)))}) if wall else bench


def problems(bench: Rig, *, tilt_deg: float | None = None, measured: bool = True) -> tuple[str, ...]:
    seen = footprint(bench.wall_from_lidar, bench.pinhole, bench.wall)
    if not measured or bench.occluder is None:
        return judge_rig(bench, seen, None)
    at = bench.occluder
    record = OccluderRecord(source="detected", x_m=at.x_m, gap_m=at.z_min_m, tilt_deg=tilt_deg)
    return judge_rig(bench, seen, record)


def amount(told: str, unit: str) -> int:
    match = re.search(rf"(\d+) {unit}", told.rsplit(":", 1)[1])
    assert match, told
    return int(match[1])


@pytest.mark.parametrize(("distance_m", "yaw_deg"), list(product((0.15, 0.2, 0.3), (15.0, 30.0, 45.0, 60.0, 75.0))))
def test_the_papers_rig_has_no_problems_at_any_of_its_poses(distance_m: float, yaw_deg: float) -> None:
    assert problems(rig(distance_m=distance_m, yaw_deg=yaw_deg)) == ()
    assert problems(rig(distance_m=distance_m, yaw_deg=yaw_deg), measured=False) == ()


def test_a_bare_wall_has_none_either() -> None:
    assert problems(load_rig("bare-wall")) == ()


def test_distance_and_angle_are_left_to_the_walls_verdict() -> None:
    assert problems(rig(distance_m=0.36)) == ()
    assert problems(rig(yaw_deg=79.0, distance_m=0.3)) == ()


@pytest.mark.parametrize(
    ("gap_m", "advice"),
    [
        (0.032, "has a gap of 0.032 m, 0.05 to 0.20 needed: move it 2 cm away from the wall"),
        (0.23, "has a gap of 0.230 m, 0.05 to 0.20 needed: move it 3 cm towards the wall"),
    ],
)
def test_a_gap_out_of_the_papers_range_says_how_far_to_move(gap_m: float, advice: str) -> None:
    assert f"the occluder {advice}" in problems(rig(gap_m=gap_m))
    assert any("(not measured, the paper's is assumed)" in told for told in problems(rig(gap_m=gap_m), measured=False))


def test_a_gap_is_not_judged_finer_than_it_is_measured() -> None:
    assert problems(rig(gap_m=0.0495)) == ()
    assert len(problems(rig(gap_m=0.0485))) == 1


@pytest.mark.parametrize(("x_m", "move"), [(-0.05, "25 cm away from"), (0.4, "20 cm towards")])
def test_a_sheet_that_is_not_between_lidar_and_object_is_told_alone(x_m: float, move: str) -> None:
    (told,) = problems(rig(x_m))
    assert f"x = {x_m:.3f} m, not between" in told
    assert f"move it {move} the lidar, to the paper's 0.20 m" in told


@pytest.mark.parametrize(("tilt_deg", "way"), [(3.0, "towards the lidar"), (-3.0, "away from the lidar")])
def test_a_leaning_sheet_is_told(tilt_deg: float, way: str) -> None:
    (told,) = problems(rig(), tilt_deg=tilt_deg)
    assert told.endswith(way)
    assert problems(rig(), tilt_deg=tilt_deg / 2) == ()


@pytest.mark.parametrize("bench", [rig(gap_m=0.2), rig(0.3, 0.15), rig(gap_m=0.18, distance_m=0.15, yaw_deg=70.0)])
def test_the_least_move_that_hides_the_object_is_told(bench: Rig) -> None:
    (told,) = problems(bench)
    assert re.search(r"the lidar sees \d+\.\d% of the object's box itself, past the occluder", told)
    by_m = amount(told, "cm towards the wall") / 100

    def leak(closer_m: float) -> float:
        nearer = Occluder(x_m=bench.occluder.x_m, z_min_m=bench.occluder.z_min_m - closer_m)
        return lidar_sees(bench.model_copy(update={"occluder": nearer}), bench.object_box)

    assert leak(by_m) <= 0.001 < leak(by_m - 0.01)


def test_where_no_gap_hides_the_object_the_sheet_comes_nearer_or_the_object_moves() -> None:
    (told,) = problems(rig(0.32, 0.06, distance_m=0.3, yaw_deg=50.0).model_copy(update={"object_box": low_box(0.33)}))
    assert "cm towards the lidar" in told
    (told,) = problems(rig(0.05, 0.055, distance_m=0.05, yaw_deg=70.0).model_copy(update={"object_box": low_box(0.1)}))
    assert told.endswith("move the object out of its sight, away from the wall")


def low_box(x_min_m: float) -> object:
    update = {"x_min_m": x_min_m, "x_max_m": x_min_m + 0.05, "z_near_m": 0.01, "z_far_m": 0.06}
    return PAPER.object_box.model_copy(update=update)


def test_an_object_before_the_lidar_needs_an_occluder() -> None:
    (told,) = problems(rig(yaw_deg=70.0).model_copy(update={"occluder": None}))
    assert told.endswith("put an occluder at x = 0.20 m before it")


def test_a_lidar_that_looks_away_is_told_how_far_to_turn() -> None:
    (told,) = problems(rig(yaw_deg=-45.0))
    turn = amount(told, "degrees towards the occluder")

    def seen(yaw_deg: float) -> float:
        bench = rig(yaw_deg=yaw_deg)
        return wall_sees(bench, bench.object_box, footprint(bench.wall_from_lidar, bench.pinhole, bench.wall))

    assert seen(turn - 45.0) >= MIN_SEEN > seen(turn - 46.0)


def test_an_aperture_that_no_turn_opens_is_widened() -> None:
    (told,) = problems(rig(0.3, 0.05, wall=(-1.0, 0.15, -1.5, 1.5), yaw_deg=15.0))
    by_m = amount(told, "cm away from the wall") / 100
    opened = rig(0.3, 0.05 + by_m, wall=(-1.0, 0.15, -1.5, 1.5), yaw_deg=15.0)
    assert problems(opened) == ()


def test_a_map_that_misses_the_wall_says_how_far_to_turn() -> None:
    wall = (-0.1, 0.25, -0.2, 0.2)
    told = problems(rig(yaw_deg=60.0, wall=wall))[0]
    assert f"of the map's cells meet the wall, {MIN_SHARE:.0%} needed" in told
    yaw_deg = 60.0 - amount(told, "degrees towards the wall")

    def share(yaw_deg: float) -> float:
        bench = rig(yaw_deg=yaw_deg, wall=wall)
        return footprint(bench.wall_from_lidar, bench.pinhole, bench.wall).share

    assert share(yaw_deg) >= MIN_SHARE > share(yaw_deg + 1.0)
    assert any(told.endswith("take a larger wall") for told in problems(rig(wall=(0.0, 0.05, 0.0, 0.05))))


def test_problems_join_the_walls_verdict() -> None:
    assert combined("good", "all is well", ()) == ("good", "all is well")
    assert combined("good", "all is well", ("a: b", "c: d")) == ("out of range", "all is well; a: b; c: d")
    assert combined("doubtful", "bent", ("a: b",)) == ("doubtful", "bent; a: b")
    assert combined("out of range", "far", ("a: b",)) == ("out of range", "far; a: b")
