"""Maps that no hidden object can cause are found without a reconstruction, others are not."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from nlos_calibration import load_rig

from nlos_cam.camera import open_world
from nlos_cam.evaluate import sense
from nlos_cam.frames import LidarMaps, maps_from_frame
from nlos_cam.objects import object_box, object_depth
from nlos_cam.reconstruct import CalibratedRig
from nlos_cam.reconstruct.consistency import (
    MapConsistency,
    MapProblem,
    echo_range_m,
    objects_on_bench,
)
from nlos_cam.render import Scene, SensorModel, render

RIG = load_rig("paper-rig")
SEEDS = range(700, 706)
ECHOES = [render(Scene(RIG, object_depth(seed, object_box(RIG))[1])).multi for seed in SEEDS]
EMPTY = render(Scene(RIG)).multi
CHECK = MapConsistency(CalibratedRig(RIG))
MAPS = sense(ECHOES, RIG)
ROW, COLUMN = np.mgrid[:64, :80]

Change = Callable[[LidarMaps, LidarMaps], LidarMaps]


def without(maps: LidarMaps, gone: np.ndarray) -> LidarMaps:
    depth_m = np.where(gone, np.float32(np.nan), maps.depth_m)
    return LidarMaps(depth_m, np.where(gone, np.float32(0), maps.intensity), maps.valid & ~gone)


def rows_of(maps: LidarMaps, rows: slice, other: LidarMaps) -> LidarMaps:
    joined = LidarMaps(maps.depth_m.copy(), maps.intensity.copy(), maps.valid.copy())
    joined.depth_m[rows] = other.depth_m[rows]
    joined.intensity[rows] = other.intensity[rows]
    return joined


def everywhere(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda maps, _: LidarMaps(*map(change, (maps.depth_m, maps.intensity, maps.valid)))


WRONG: dict[str, tuple[MapProblem, Change]] = {
    "right half black": (MapProblem.LOST, lambda maps, _: without(maps, COLUMN >= 40)),
    "a tenth of the rows black": (MapProblem.LOST, lambda maps, _: without(maps, ROW < 7)),
    "infrared of another object": (
        MapProblem.UNLIKE,
        lambda maps, other: replace(maps, intensity=other.intensity),
    ),
    "torn": (MapProblem.TORN, lambda maps, other: rows_of(maps, slice(32, 64), other)),
    "left and right exchanged": (
        MapProblem.OFF_RECORD,
        everywhere(lambda array: array[:, ::-1].copy()),
    ),
    "wrong unit of depth": (
        MapProblem.OFF_RECORD,
        lambda maps, _: replace(maps, depth_m=maps.depth_m * np.float32(0.95)),
    ),
    "wall 7 mm off": (
        MapProblem.OFF_RECORD,
        lambda maps, _: replace(maps, depth_m=maps.depth_m + np.float32(0.007)),
    ),
    "wall 12 mm off": (
        MapProblem.OFF_RECORD,
        lambda maps, _: replace(maps, depth_m=maps.depth_m + np.float32(0.012)),
    ),
    "wall 20 mm off": (
        MapProblem.OFF_RECORD,
        lambda maps, _: replace(maps, depth_m=maps.depth_m + np.float32(0.020)),
    ),
    "turned up by four rows": (
        MapProblem.TILTED,
        everywhere(lambda array: np.roll(array, 4, axis=0)),
    ),
}


@pytest.mark.parametrize("maps", [*MAPS, *sense([EMPTY], RIG)])
def test_unharmed_maps_have_no_problem(maps: LidarMaps) -> None:
    found = CHECK.examine(maps)

    assert found.problems == ()
    assert found.kept_share == 1.0


def test_object_that_moves_while_it_is_scanned_is_no_seam() -> None:
    world = open_world("")
    frames = [world.images(number).frame(RIG.pinhole) for number in (42, 43, 499, 582, 583, 589)]

    found = [CHECK.examine(maps_from_frame(frame)).problems for frame in frames]

    assert found == [()] * len(frames)


@pytest.mark.parametrize("name", WRONG)
def test_each_kind_of_wrong_maps_is_named(name: str) -> None:
    problem, change = WRONG[name]
    found = [CHECK.examine(change(maps, MAPS[k - 1])) for k, maps in enumerate(MAPS)]

    named = sum(problem in each.problems for each in found)

    assert named >= len(MAPS) - 1


@pytest.mark.parametrize("factor", [0.5, 1.5])
def test_gain_of_the_device_is_no_problem(factor: float) -> None:
    found = [
        CHECK.examine(replace(maps, intensity=np.minimum(maps.intensity * np.float32(factor), 255)))
        for maps in MAPS
    ]

    assert sum(bool(each.problems) for each in found) <= 1


def test_measured_reference_takes_the_wall_texture_out() -> None:
    sensor = SensorModel(wall_texture=0.12, ambient_counts=12.0)
    bare = sense([EMPTY], RIG, sensor, frames=30)[0]
    reference = SimpleNamespace(map_depth_m=bare.depth_m, map_intensity=bare.intensity)
    bench = SimpleNamespace(rig=RIG, reference=reference, range_offset_m=0.0)
    check = MapConsistency(cast("CalibratedRig", bench))

    found = [check.examine(maps).problems for maps in sense(ECHOES, RIG, sensor)]

    assert sum(map(bool, found)) <= 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("distance_m", "yaw_deg", "gap_m"), [(0.212, 21.0, 0.07), (0.24, 58.0, 0.095)]
)
def test_echoes_that_win_by_little_are_no_contradiction(
    distance_m: float, yaw_deg: float, gap_m: float
) -> None:
    """A lidar that is turned, or far: small regions, which are mostly rim."""
    lidar = RIG.lidar.model_copy(update={"distance_m": distance_m, "yaw_deg": yaw_deg})
    assert RIG.occluder
    occluder = RIG.occluder.model_copy(update={"z_min_m": gap_m})
    rig = RIG.model_copy(update={"lidar": lidar, "occluder": occluder})
    things = [object_depth(seed, object_box(rig))[1] for seed in range(700, 720)]
    maps = sense([render(Scene(rig, thing)).multi for thing in things], rig)
    check = MapConsistency(CalibratedRig(rig))

    flagged = [bool(check.examine(one).problems) for one in maps]
    exchanged = [
        bool(check.examine(replace(one, intensity=other.intensity)).problems)
        for one, other in zip(maps, [*maps[1:], maps[0]], strict=True)
    ]

    assert sum(flagged) <= 1
    assert sum(exchanged) >= 14
    assert check.examine(sense([EMPTY], RIG)[0]).problems


@pytest.mark.parametrize("shape", ["left", "right", "top", "bottom", "disc", "scattered"])
def test_every_missing_cell_lowers_what_is_kept(shape: str) -> None:
    order = {
        "left": COLUMN,
        "right": -COLUMN,
        "top": ROW,
        "bottom": -ROW,
        "disc": np.hypot(ROW - 31.5, COLUMN - 39.5),
        "scattered": np.random.default_rng(3).random(ROW.shape),
    }[shape]
    shares = [0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.9]

    kept = [
        CHECK.examine(without(MAPS[0], order < np.quantile(order, share))).kept_share
        for share in shares
    ]

    assert (np.diff(kept) <= 0).all()
    assert kept[-1] < 0.2


def test_information_is_a_share_and_lies_where_echoes_win() -> None:
    cells = objects_on_bench(RIG).information
    wins = np.mean([(echo.peak.reshape(64, 80) > 0) for echo in ECHOES], axis=0) > 0

    assert cells.sum() == pytest.approx(1.0)
    assert cells[~wins].sum() < 0.01


def test_missing_cells_that_tell_nothing_are_no_problem() -> None:
    found = CHECK.examine(without(MAPS[0], COLUMN < 8))

    assert found.lost_share < 0.01
    assert found.missing_share == pytest.approx(0.1, abs=0.04)
    assert found.problems == ()


def test_depth_before_the_wall_everywhere_is_off_the_record() -> None:
    nearer = replace(MAPS[0], depth_m=MAPS[0].depth_m * np.float32(0.5))

    assert CHECK.examine(nearer).problems == (MapProblem.OFF_RECORD,)


@pytest.mark.parametrize("farther_m", [0.04, 1.0, 60.0])
def test_depth_of_no_path_over_the_box_is_off_the_record(farther_m: float) -> None:
    for maps in (MAPS[0], sense([EMPTY], RIG)[0]):
        farther = replace(maps, depth_m=maps.depth_m + np.float32(farther_m))
        assert CHECK.examine(farther).problems == (MapProblem.OFF_RECORD,)


def test_object_whose_echo_wins_in_every_cell_is_no_problem() -> None:
    rig = load_rig("wide-rig")
    hidden_m = object_depth(3_000_012, object_box(rig))[1]
    echoes = render(Scene(rig, hidden_m), "draft").multi
    check = MapConsistency(CalibratedRig(rig))
    (maps,) = sense([echoes], rig)
    wall_m = render(Scene(rig), "draft").depth_m

    assert not (np.abs(maps.depth_m - wall_m) < 0.01)[:, :60].any()
    assert check.examine(maps).problems == ()


@pytest.mark.parametrize("name", ["paper-rig", "wide-rig"])
def test_echoes_of_objects_in_the_box_are_within_their_range(name: str) -> None:
    rig = load_rig(name)
    least_m, largest_m = echo_range_m(rig)
    wall_m = render(Scene(rig), "draft").depth_m
    for seed in SEEDS:
        rendering = render(Scene(rig, object_depth(seed, object_box(rig))[1]), "draft")
        bounced = rendering.intensity <= rendering.multi.peak
        bounced &= rendering.multi.peak > 0
        beyond_m = (rendering.depth_m - wall_m)[bounced]

        assert (beyond_m >= least_m[bounced]).all()
        assert (beyond_m <= largest_m[bounced]).all()
