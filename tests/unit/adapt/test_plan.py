"""Plan of an adaptation: what fits into the minutes."""

from pathlib import Path
from typing import Any

import pytest
from made_benches import wall_of
from nlos_calibration import MeasuredWall, OccluderRecord, load_rig

from nlos_cam.adapt import Plan, Stage, calibration_spread
from nlos_cam.adapt.plan import FIRST_OBJECTS, NETWORK_SHARE, PASSES, PLAN, Pace, load_plan
from nlos_cam.dataset import SHARD
from nlos_cam.errors import RecordingError
from nlos_cam.render import SensorModel


def plan_at(objects_per_s: float = 50.0, samples_per_s: float = 400.0) -> Plan:
    return Plan(
        rig_checksum=load_rig("paper-rig").checksum,
        start="0" * 64,
        spread=calibration_spread(None),
        sensor=SensorModel(),
        seed=0,
        pace=Pace(objects_per_s=objects_per_s, samples_per_s=samples_per_s),
    )


def samples(plan: Plan) -> int:
    return sum(stage.samples for stage in plan.stages)


def seconds(plan: Plan) -> float:
    """Return how long a plan's rendering and training take at its pace."""
    return plan.stages[-1].objects / plan.pace.objects_per_s + samples(plan) / (
        plan.pace.samples_per_s
    )


@pytest.mark.parametrize("minutes", [[1.0], [10.0], [60.0], [10.0, 12.0], [10.0, 30.0, 60.0]])
def test_rendering_and_training_take_their_share(minutes: list[float]) -> None:
    plan = plan_at()
    for each in minutes:
        plan = plan.extended(each)

    share = NETWORK_SHARE * 60 * minutes[-1]
    assert 0.9 * share < seconds(plan) <= 1.05 * share


@pytest.mark.parametrize("pace", [(50.0, 400.0), (68.0, 770.0), (450.0, 4000.0)])
def test_each_object_is_passed_some_times(pace: tuple[float, float]) -> None:
    stage = plan_at(*pace).extended(10.0).stages[0]

    assert stage.samples / stage.objects == pytest.approx(PASSES, rel=0.1)
    assert stage.objects % SHARD == 0


def test_a_short_further_stage_trains_on_what_is_there() -> None:
    """Two minutes more are too few to show each of the earlier objects some times again."""
    plan = plan_at().extended(30.0).extended(32.0)

    assert plan.stages[1].objects == plan.stages[0].objects
    assert plan.stages[1].samples > 0


def test_slow_machines_render_the_fewest_objects() -> None:
    stage = plan_at(2.0, 10.0).extended(1.0).stages[0]

    assert stage.objects == FIRST_OBJECTS


def test_a_second_stage_has_the_minutes_that_are_more() -> None:
    plan = plan_at().extended(10.0).extended(30.0)

    assert [stage.minutes for stage in plan.stages] == [10.0, 20.0]
    assert plan.stages[1].objects > plan.stages[0].objects


def test_fewer_minutes_than_were_spent_change_nothing() -> None:
    plan = plan_at().extended(30.0)

    assert plan.extended(10.0) == plan


def test_minutes_that_are_there_add_no_stage() -> None:
    """The sum of the stages' minutes is off by rounding."""
    plan = plan_at().extended(15.4).extended(31.8)

    assert plan.extended(31.8) == plan


def test_a_plan_is_read_back_as_it_was_saved(tmp_path: Path) -> None:
    plan = plan_at().extended(10.0)

    plan.save(tmp_path)

    assert load_plan(tmp_path) == plan


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"seed": 1e400}', '{"rig_checksum": 3}'])
def test_a_damaged_plan_is_said_in_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / PLAN).write_text(text)

    with pytest.raises(RecordingError, match="damaged") as caught:
        load_plan(tmp_path)

    assert "\n" not in str(caught.value)


def test_a_stage_of_any_length_has_a_recipe_that_averages() -> None:
    recipe = Stage(minutes=1.0, objects=SHARD, epochs=1, steps=3).recipe()

    assert 0 <= recipe.average < 1


@pytest.mark.parametrize(
    ("occluder", "place_m"),
    [
        ({"source": "detected", "x_std_m": 0.0001, "gap_std_m": 0.0001}, 0.0005),
        ({"source": "detected", "x_std_m": 0.0001, "gap_std_m": 0.002}, 0.004),
        ({"source": "detected", "x_std_m": 0.002, "gap_std_m": 0.0001}, 0.004),
        ({"source": "entered"}, 0.001),
    ],
)
def test_the_spread_has_the_occluders_uncertainty(occluder: Any, place_m: float) -> None:
    wall = wall_of()
    record = OccluderRecord(x_m=0.2, gap_m=0.1, **occluder)
    with_occluder = wall.record.model_copy(update={"occluder": record})

    spread = calibration_spread(MeasuredWall(with_occluder, wall.reference))

    assert spread.place_m == pytest.approx(place_m)
