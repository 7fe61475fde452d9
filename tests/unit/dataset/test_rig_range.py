"""Rigs drawn at random are benches of the paper's kind: hidden from the lidar, within its range."""

import pytest
from nlos_calibration import Rig, lidar_visible_share, load_rig
from pydantic import ValidationError

from nlos_cam.dataset import DatasetPlan, RigRange, RigSpread
from nlos_cam.errors import SceneError
from nlos_cam.objects import object_box

HOME = load_rig("paper-rig")
DRAWN = [RigRange().draw(HOME, seed) for seed in range(40)]


@pytest.mark.parametrize("rig", DRAWN[:12])
def test_lidar_never_sees_the_hidden_box_directly(rig: Rig) -> None:
    assert lidar_visible_share(rig, object_box(rig)) == 0


def test_rigs_fill_their_ranges() -> None:
    distances_m = [rig.lidar.distance_m for rig in DRAWN]

    assert min(distances_m) < 0.17
    assert max(distances_m) > 0.28
    assert all(15 <= rig.lidar.yaw_deg <= 75 for rig in DRAWN)


def test_box_keeps_its_size() -> None:
    wanted = object_box(HOME)
    for rig in DRAWN:
        box = object_box(rig)
        assert box.x_max_m - box.x_min_m == pytest.approx(wanted.x_max_m - wanted.x_min_m)


def test_objects_that_share_a_rig_share_the_draw() -> None:
    plan = DatasetPlan(HOME, 0, rigs=RigRange(), objects_per_rig=10)

    assert plan.known_rig(3) == plan.known_rig(9) != plan.known_rig(10)


def test_record_of_a_rig_does_not_know_its_deviation() -> None:
    plan = DatasetPlan(HOME, 0, rigs=RigRange(), spread=RigSpread(place_m=0.001))

    assert plan.known_rig(5) == RigRange().draw(HOME, 5)
    assert plan.bench_of(5)[0].lidar.distance_m != plan.known_rig(5).lidar.distance_m


def test_plan_with_rigs_survives_its_storage() -> None:
    plan = DatasetPlan(HOME, 0, rigs=RigRange(distance_m=(0.2, 0.25)))

    assert DatasetPlan.from_provenance(plan.provenance) == plan


def test_rig_without_an_occluder_cannot_be_drawn_around() -> None:
    with pytest.raises(SceneError, match="no occluder"):
        RigRange().draw(load_rig("bare-wall"), 0)


@pytest.mark.parametrize("x_min_m", [0.0, 0.01])
def test_box_that_every_gap_shows_cannot_be_drawn_around(x_min_m: float) -> None:
    box = object_box(HOME).model_copy(update={"x_min_m": x_min_m, "x_max_m": x_min_m + 0.25})
    with pytest.raises(SceneError, match="past any occluder"):
        RigRange().extremes(HOME.model_copy(update={"object_box": box}))


def test_range_needs_its_lower_end_first() -> None:
    with pytest.raises(ValidationError, match="lower end"):
        RigRange(gap_m=(0.2, 0.1))


@pytest.mark.parametrize(
    ("spread", "words"),
    [
        (RigSpread(place_m=0.1), "reaches the wall"),
        (RigSpread(angle_deg=15), "15 degrees"),
        (RigSpread(gain_share=1.5), "150%"),
    ],
)
def test_spread_around_a_range_has_to_keep_every_rig(spread: RigSpread, words: str) -> None:
    with pytest.raises(SceneError, match=words):
        DatasetPlan(HOME, 0, rigs=RigRange(), spread=spread).check()


def test_occluder_moves_into_the_box_from_the_end_of_its_range() -> None:
    rigs = RigRange(occluder_m=(-0.02, 0.11), gap_m=(0.08, 0.1), distance_m=(0.4, 0.5))

    with pytest.raises(SceneError, match="below 15 mm"):
        DatasetPlan(HOME, 0, rigs=rigs, spread=RigSpread(place_m=0.02)).check()


def test_spread_of_the_documented_range_is_possible() -> None:
    spread = RigSpread(place_m=0.001, angle_deg=0.2, gain_share=0.1)

    DatasetPlan(HOME, 0, rigs=RigRange(), spread=spread).check()


def test_no_drawn_rig_is_beyond_the_extremes() -> None:
    extremes = RigRange().extremes(HOME)
    gap_m = min(rig.occluder.z_min_m for rig in extremes)

    assert all(rig.occluder.z_min_m >= gap_m for rig in DRAWN)
    assert min(rig.lidar.distance_m for rig in extremes) == pytest.approx(0.15)
