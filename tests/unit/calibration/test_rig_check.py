import re

import numpy as np
import pytest
from nlos_calibration import rig_check
from nlos_calibration.geometry import wall_from_plane
from nlos_calibration.rig import (
    DeviceConstants,
    Extent,
    LidarPose,
    ObjectBox,
    Occluder,
    PinholeRecord,
    Rig,
    load_rig,
)
from nlos_calibration.rig_check import (
    combined,
    judge_rig,
    lidar_visible_share,
    rig_difference,
    wall_visible_share,
)
from nlos_calibration.wall_record import OccluderRecord
from numpy.typing import NDArray

PAPER = load_rig("paper-rig")
BOX = PAPER.object_box or pytest.fail("the paper's rig hides something")
WALL = -1.0, 2.0, -1.5, 1.5


def changed(**fields: object) -> Rig:
    return PAPER.model_copy(update=fields)


def rig(
    x_m: float = 0.2,
    gap_m: float = 0.1,
    distance_m: float = 0.2,
    yaw_deg: float = 45.0,
    pitch_deg: float = 0.0,
) -> Rig:
    lidar = LidarPose(distance_m=distance_m, yaw_deg=yaw_deg, pitch_deg=pitch_deg)
    return changed(lidar=lidar, occluder=Occluder(x_m=x_m, z_min_m=gap_m))


def on_wall(bench: Rig, x_min_m: float, x_max_m: float, y_min_m: float, y_max_m: float) -> Rig:
    wall = Extent(x_min_m=x_min_m, x_max_m=x_max_m, y_min_m=y_min_m, y_max_m=y_max_m)
    return bench.model_copy(update={"wall": wall})


def seen_by(bench: Rig) -> rig_check.Footprint:
    return rig_check.footprint(bench.wall_from_lidar, bench.pinhole, bench.wall)


def problems(
    bench: Rig, *, tilt_deg: float | None = None, measured: bool = True
) -> tuple[str, ...]:
    if not measured or bench.occluder is None:
        return judge_rig(bench, seen_by(bench), None)
    at = bench.occluder
    record = OccluderRecord(source="detected", x_m=at.x_m, gap_m=at.z_min_m, tilt_deg=tilt_deg)
    return judge_rig(bench, seen_by(bench), record)


def amount(problem: str, unit: str) -> int:
    """Return the last whole number of that unit: the advice comes after the problem."""
    return int(re.findall(rf" (\d+) {unit}", problem)[-1])


@pytest.mark.parametrize("distance_m", [0.15, 0.2, 0.3])
@pytest.mark.parametrize("yaw_deg", [15.0, 30.0, 45.0, 60.0, 75.0])
def test_papers_poses_have_no_problems(distance_m: float, yaw_deg: float) -> None:
    bench = rig(distance_m=distance_m, yaw_deg=yaw_deg)

    assert problems(bench) == ()
    assert problems(bench, measured=False) == ()


@pytest.mark.parametrize(
    "bench",
    [load_rig("bare-wall"), rig(distance_m=0.36), rig(yaw_deg=79.0, distance_m=0.3)],
    ids=["bare wall", "distance", "angle"],
)
def test_distance_and_angle_are_left_to_the_wall(bench: Rig) -> None:
    assert problems(bench) == ()
    assert problems(bench, measured=False) == ()


@pytest.mark.parametrize("yaw_deg", [-22.0, -45.0])
def test_lidar_that_looks_away_from_the_object_is_told_to_turn(yaw_deg: float) -> None:
    (problem,) = problems(rig(yaw_deg=yaw_deg), measured=False)

    assert "away from the object" in problem


@pytest.mark.parametrize(
    ("gap_m", "advice"),
    [
        (0.032, r"0\.032 m.* 2 cm away"),
        (0.23, r"0\.230 m.* 3 cm towards"),
        (0.0485, r"0\.04[89] m"),
    ],
)
def test_judge_rig_advises_on_a_gap_out_of_range(gap_m: float, advice: str) -> None:
    assert any(re.search(advice, problem) for problem in problems(rig(gap_m=gap_m)))
    assert any("assumed" in problem for problem in problems(rig(gap_m=gap_m), measured=False))


def test_gap_is_not_compared_more_finely_than_it_is_measured() -> None:
    assert problems(rig(gap_m=0.0495)) == ()


@pytest.mark.parametrize(
    ("x_m", "tilt_deg", "fault", "move"),
    [
        (-0.05, None, "x = -0.050 m", "25 cm away"),
        (0.4, None, "x = 0.400 m", "20 cm towards"),
        (0.2, 3.0, "+3.0 degrees", "towards"),
        (0.2, -3.0, "-3.0 degrees", "away"),
    ],
)
def test_judge_rig_advises_on_a_misplaced_sheet(
    x_m: float, tilt_deg: float | None, fault: str, move: str
) -> None:
    (problem,) = problems(rig(x_m), tilt_deg=tilt_deg)

    assert fault in problem
    assert move in problem


@pytest.mark.parametrize(
    ("x_min_m", "sheet_m", "cure", "box_m", "place_m"),
    [
        (0.02, 0.2, "move the object 19 cm away from the lidar", 0.21, 0.2),
        (0.02, 0.25, "19 cm away .*, and move it 5 cm towards the lidar", 0.21, 0.2),
        (0.04, -0.03, "17 cm away .*, and move it 23 cm away from the lidar", 0.21, 0.2),
        (0.15, 0.2, "move it 6 cm towards the lidar, to 0.14 m", 0.15, 0.14),
        (0.3, 0.4, "move it 20 cm towards the lidar, to the paper's 0.20 m", 0.3, 0.2),
    ],
)
def test_judge_rig_says_what_to_move_for_a_sheet_before_the_box(
    x_min_m: float, sheet_m: float, cure: str, box_m: float, place_m: float
) -> None:
    def bench(sheet_m: float, x_min_m: float) -> Rig:
        box = BOX.model_copy(update={"x_min_m": x_min_m, "x_max_m": x_min_m + 0.25})
        return rig(sheet_m).model_copy(update={"object_box": box})

    (problem,) = [one for one in problems(bench(sheet_m, x_min_m)) if "not between" in one]

    assert re.search(cure, problem)
    assert not any("not between" in one for one in problems(bench(place_m, box_m)))


def test_judge_rig_says_that_a_bench_is_a_mirror_image() -> None:
    (problem,) = problems(rig(-0.2, yaw_deg=-45.0))

    assert "x = -0.200 m" in problem
    assert "mirror the bench" in problem


@pytest.mark.parametrize("tilt_deg", [-1.5, 1.5])
def test_slight_tilt_is_no_problem(tilt_deg: float) -> None:
    assert problems(rig(), tilt_deg=tilt_deg) == ()


@pytest.mark.parametrize(
    "bench", [rig(gap_m=0.2), rig(0.3, 0.15), rig(gap_m=0.18, distance_m=0.15, yaw_deg=70.0)]
)
def test_judge_rig_advises_the_least_move_that_hides(bench: Rig) -> None:
    (problem,) = problems(bench)

    assert re.search(r"\d+\.\d%", problem)

    by_m = amount(problem, "cm") / 100

    def leak(closer_m: float) -> float:
        nearer = Occluder(x_m=bench.occluder.x_m, z_min_m=bench.occluder.z_min_m - closer_m)
        return lidar_visible_share(bench.model_copy(update={"occluder": nearer}), bench.object_box)

    assert leak(by_m) <= 0.001 < leak(by_m - 0.01)


def test_endless_wall_is_seen_from_another_foot() -> None:
    endless = on_wall(PAPER, -100.0, 100.0, -100.0, 100.0)

    moved = endless.seen_from(np.array([0.003, -0.002, 0.2]))

    assert (moved.wall.x_min_m, moved.wall.y_max_m) == pytest.approx((-100.003, 100.002))
    assert moved.occluder
    assert PAPER.occluder
    assert moved.occluder.x_m == pytest.approx(PAPER.occluder.x_m - 0.003)


def test_sheet_behind_the_lidar_hides_nothing() -> None:
    open_share = lidar_visible_share(changed(occluder=None), BOX)

    assert lidar_visible_share(rig(-0.01), BOX) == open_share > 0.01


@pytest.mark.parametrize("gap_m", [0.1, 0.15, 0.2])
def test_mirrored_bench_shows_the_lidar_as_much(gap_m: float) -> None:
    bench = rig(gap_m=gap_m)
    sides = {"x_min_m": -BOX.x_max_m, "x_max_m": -BOX.x_min_m}

    mirrored = lidar_visible_share(rig(-0.2, gap_m, yaw_deg=-45.0), BOX.model_copy(update=sides))

    assert mirrored == pytest.approx(lidar_visible_share(bench, BOX), abs=1e-9)


def with_low_box(bench: Rig, x_min_m: float) -> Rig:
    """Return the bench with a small box near the wall, which a lower edge does not hide."""
    size = {"x_min_m": x_min_m, "x_max_m": x_min_m + 0.05, "z_near_m": 0.01, "z_far_m": 0.06}
    return bench.model_copy(update={"object_box": BOX.model_copy(update=size)})


def test_judge_rig_moves_the_sheet_if_no_gap_hides_the_object() -> None:
    bench = rig(0.32, 0.06, distance_m=0.3, yaw_deg=50.0)
    (problem,) = problems(with_low_box(bench, 0.33))

    assert "cm towards the lidar" in problem


def test_judge_rig_moves_the_object_if_no_sheet_hides_it() -> None:
    bench = rig(0.05, 0.055, distance_m=0.05, yaw_deg=70.0)
    (problem,) = problems(with_low_box(bench, 0.1))

    assert "move the object" in problem


def test_judge_rig_advises_an_occluder_where_there_is_none() -> None:
    (problem,) = problems(rig(yaw_deg=70.0).model_copy(update={"occluder": None}))
    assert "0.20 m" in problem


def test_judge_rig_advises_the_least_turn_to_the_occluder() -> None:
    (problem,) = problems(rig(0.3, 0.05, yaw_deg=5.0))
    turn = amount(problem, "degrees")

    def seen(yaw_deg: float) -> float:
        bench = rig(0.3, 0.05, yaw_deg=yaw_deg)
        return wall_visible_share(bench, bench.object_box, seen_by(bench))

    assert seen(turn + 5.0) >= rig_check.MIN_SEEN > seen(turn + 4.0)


def test_judge_rig_widens_an_aperture_that_no_turn_opens() -> None:
    narrow = -1.0, 0.15, -1.5, 1.5
    (problem,) = problems(on_wall(rig(0.3, 0.05, yaw_deg=15.0), *narrow))

    assert (
        problems(on_wall(rig(0.3, 0.05 + amount(problem, "cm") / 100, yaw_deg=15.0), *narrow)) == ()
    )


def test_judge_rig_advises_the_least_turn_onto_the_wall() -> None:
    wall = -0.1, 0.25, -0.2, 0.2
    problem = problems(on_wall(rig(yaw_deg=60.0), *wall))[0]

    assert f"{rig_check.MIN_SHARE:.0%}" in problem

    yaw_deg = 60.0 - amount(problem, "degrees")
    shares = [seen_by(on_wall(rig(yaw_deg=each), *wall)).share for each in (yaw_deg, yaw_deg + 1.0)]

    assert shares[0] >= rig_check.MIN_SHARE > shares[1]


def test_judge_rig_advises_a_larger_wall_where_no_turn_helps() -> None:
    tiny = on_wall(rig(), 0.0, 0.05, 0.0, 0.05)
    assert any("larger wall" in problem for problem in problems(tiny))


def test_combined_verdict_joins_wall_and_rig() -> None:
    assert combined("good", "all is well", ()) == ("good", "all is well")
    assert combined("good", "all is well", ("a: b", "c: d")) == (
        "out of range",
        "all is well; a: b; c: d",
    )
    assert combined("doubtful", "bent", ("a: b",)) == ("doubtful", "bent; a: b")
    assert combined("out of range", "far", ("a: b",)) == ("out of range", "far; a: b")


def points_in_box(count: int) -> NDArray[np.float64]:
    low = (BOX.x_min_m, BOX.y_min_m, BOX.z_near_m)
    high = (BOX.x_max_m, BOX.y_max_m, BOX.z_far_m)
    return np.random.default_rng(0).uniform(low, high, (count, 3))


def passes(
    rig: Rig, eye_m: NDArray[np.float64], points_m: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return whether the straight line from the eye (3,) to points (n, 3) misses the occluder."""
    share = (rig.occluder.x_m - eye_m[0]) / (points_m[:, 0] - eye_m[0])
    return eye_m[2] + share * (points_m[:, 2] - eye_m[2]) < rig.occluder.z_min_m


@pytest.mark.parametrize(
    "bench",
    [
        rig(0.2, 0.1),
        rig(0.2, 0.2),
        rig(0.3, 0.15, yaw_deg=50.0, pitch_deg=10.0),
        rig(0.2, 0.18, 0.15, 70.0),
        rig(0.25, 0.22, 0.2, 75.0, -30.0),
    ],
)
def test_lidar_sees_the_share_of_sampled_points(bench: Rig) -> None:
    points_m = points_in_box(40_000)
    pose = bench.wall_from_lidar
    pinhole = bench.pinhole
    seen = (points_m - pose[:3, 3]) @ pose[:3, :3]
    with np.errstate(divide="ignore"):
        column = pinhole.fx * seen[:, 0] / seen[:, 2] + pinhole.ppx
        row = pinhole.fy * seen[:, 1] / seen[:, 2]
    row = row + pinhole.ppy
    inside = (seen[:, 2] > 0) & (column > -0.5) & (column < 639.5) & (row > -0.5) & (row < 479.5)
    share = (inside & passes(bench, pose[:3, 3], points_m)).mean()

    assert lidar_visible_share(bench, BOX) == pytest.approx(share, abs=0.008)


@pytest.mark.parametrize(
    "bench", [rig(0.2, 0.1, yaw_deg=-45.0), rig(0.3, 0.05, 0.15, 15.0), rig(0.2, 0.1)]
)
def test_wall_sees_as_much_as_its_best_lit_cell(bench: Rig) -> None:
    seen = seen_by(bench)
    cells = seen.cells_m[32][seen.on_wall[32]]
    points_m = points_in_box(4000)
    lidar_m = bench.wall_from_lidar[:3, 3]
    feet_m = np.column_stack([cells, np.zeros(len(cells))])
    lit = [
        foot
        for foot in feet_m
        if foot[0] <= bench.occluder.x_m or passes(bench, lidar_m, foot[np.newaxis])[0]
    ]
    best = max(
        (passes(bench, foot, points_m) | (foot[0] >= bench.occluder.x_m)).mean() for foot in lit
    )

    assert wall_visible_share(bench, BOX, seen) == pytest.approx(best, abs=0.03)


def test_wall_sees_nothing_from_unlit_wall() -> None:
    def share(bench: Rig, x_min_m: float, x_max_m: float) -> float:
        return wall_visible_share(bench, BOX, seen_by(on_wall(bench, x_min_m, x_max_m, -1.0, 1.0)))

    assert share(rig(), -3.0, -2.0) == 0.0
    assert share(rig(0.2, 0.001, yaw_deg=60.0), 0.21, 2.0) == 0.0  # behind the sheet it is dark
    assert share(rig(0.2, 0.1, yaw_deg=60.0), 0.21, 2.0) == 1.0


def test_footprint_is_the_field_of_view_along_the_beams() -> None:
    seen = seen_by(on_wall(rig(yaw_deg=0.0), *WALL))
    wide = 0.2 * np.tan(np.radians(35.0))
    tall = 0.2 * np.tan(np.radians(27.5))
    expected = [[-wide, tall], [wide, tall], [wide, -tall], [-wide, -tall]]

    np.testing.assert_allclose(seen.corners_m, expected, atol=1e-6)
    assert seen.cells_m.shape == (64, 80, 2)
    assert seen.share == 1.0

    bench = on_wall(rig(yaw_deg=40.0, pitch_deg=10.0), *WALL)
    world = np.concatenate(
        [seen_by(bench).cells_m, np.zeros((64, 80, 1)), np.ones((64, 80, 1))], axis=-1
    )
    lidar = (world @ np.linalg.inv(bench.wall_from_lidar).T)[..., :3]

    np.testing.assert_allclose(
        lidar / lidar[..., 2:], bench.pinhole.scaled(80, 64).rays(), atol=1e-9
    )


def test_footprint_of_beams_that_miss_the_wall_is_nan() -> None:
    seen = seen_by(on_wall(rig(yaw_deg=75.0), *WALL))
    away = np.isnan(seen.cells_m).any(axis=-1)

    assert away.any()
    assert not seen.on_wall[away].any()
    assert np.isnan(seen.corners_m[1]).all()
    assert np.isfinite(seen.corners_m[0]).all()

    upwards = np.array([0.0, 0.0, 1.0])

    assert np.isnan(rig_check.on_plane(wall_from_plane(upwards, 0.2), upwards[np.newaxis])).all()


def test_rig_difference_ignores_calibration_error_and_size() -> None:
    measured = LidarPose(distance_m=0.2008, yaw_deg=44.9, pitch_deg=0.1)
    small = PinholeRecord.model_validate(vars(PAPER.pinhole.scaled(320, 240)))
    for rig in (PAPER, changed(name="measured", lidar=measured), changed(intrinsics=small)):
        assert rig_difference(rig, PAPER) == ()


SMALL_BOX = ObjectBox(
    x_min_m=0.3, x_max_m=0.5, y_min_m=-0.1, y_max_m=0.1, z_near_m=0.1, z_far_m=0.4
)


@pytest.mark.parametrize(
    ("field", "value", "amounts"),
    [
        ("lidar", LidarPose(distance_m=0.25, yaw_deg=45.0), "50 mm farther"),
        ("lidar", LidarPose(distance_m=0.15, yaw_deg=45.0), "50 mm closer"),
        ("lidar", LidarPose(distance_m=0.2, yaw_deg=30.0), "yaw -15.0 degrees"),
        ("lidar", LidarPose(distance_m=0.2, yaw_deg=45.0, pitch_deg=2.0), "pitch +2.0 degrees"),
        ("occluder", Occluder(x_m=0.25, z_min_m=0.1), "50 mm farther"),
        ("occluder", Occluder(x_m=0.2, z_min_m=0.06), "40 mm narrower"),
        ("occluder", None, "no occluder"),
        ("intrinsics", PinholeRecord(fx=400.0), "77.3 x 55.0"),
        ("device", DeviceConstants(receiver_cell_m2=1e-3), "device"),
        ("object_box", SMALL_BOX, "object box"),
    ],
)
def test_rig_difference_names_field_and_amount(field: str, value: object, amounts: str) -> None:
    (problem,) = rig_difference(changed(**{field: value}), PAPER)

    assert amounts in problem
    assert rig_difference(PAPER, changed(occluder=None)) == ("an occluder",)
