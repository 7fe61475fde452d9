"""Plans: written down and read again they are the same, older ones at their defaults; drawn rigs stay in bounds."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from nlos_calibration.rig import load_rig
from pydantic import ValidationError

from nlos_cam.dataset.plan import FIRST_OBJECTS, SCENE_COLUMNS, DatasetPlan, Objects, RigSpread, scene_row
from nlos_cam.errors import SceneError
from nlos_cam.objects.generators import CATEGORIES
from nlos_cam.render.material import Material
from nlos_cam.render.scene_file import SceneFile
from nlos_cam.render.sensor.model import SensorModel

RIG, SENSOR = load_rig("paper-rig"), SensorModel()
PLAN = DatasetPlan(RIG, 7)
SPREAD = RigSpread(place_m=0.02, angle_deg=5, gain_share=0.3)
CHANGES = {
    "rig": RIG.model_copy(update={"name": "other"}),
    "first_seed": 8,
    "sensor": SensorModel(shot_noise=0),
    "accuracy": "fine",
    "objects": Objects.without(["hat"]),
    "spread": SPREAD,
    "radiometry": "lambertian",
    "jump_m": 0.5,
    "material": Material(kind="phong"),
    "rendering_version": 1,
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_plan_is_read_as_it_was_written_and_every_field_tells(name: str) -> None:
    other = replace(PLAN, **{name: CHANGES[name]})
    assert DatasetPlan.from_provenance(other.provenance) == other
    assert other.differences(PLAN) == [name.replace("_", " ")]
    assert PLAN.differences(replace(PLAN)) == []


def test_where_the_meshes_are_is_nobodys_business() -> None:
    meshes = Objects((), (("a/b.stl", "0" * 64),), folder=Path("/somewhere"))
    plan = replace(PLAN, objects=meshes)
    assert "somewhere" not in plan.provenance
    assert DatasetPlan.from_provenance(plan.provenance) == plan


def test_what_an_older_program_did_not_write_is_at_its_default() -> None:
    facts = json.loads(PLAN.provenance)
    for name in ("objects", "spread", "radiometry", "jump_m", "material"):
        del facts[name]
    for name in ("ripple_m", "warm_up", "range_offset_m"):
        del facts["sensor"][name]
    older = DatasetPlan.from_provenance(json.dumps(facts))
    assert PLAN.differences(older) == ["objects"]  # its generators were others
    assert (older.objects.categories, older.objects.version) == (FIRST_OBJECTS["categories"], 1)
    facts["objects"] = {"categories": list(CATEGORIES)}
    assert DatasetPlan.from_provenance(json.dumps(facts)) == PLAN


@pytest.mark.parametrize("text", ["", "{}", '{"rig": 1}', json.dumps(json.loads(PLAN.provenance) | {"lens": 2})])
def test_what_is_no_plan_or_a_newer_one_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        DatasetPlan.from_provenance(text)


def test_a_newer_plan_says_what_it_has() -> None:
    with pytest.raises(ValueError, match="'lens', which this nlos-cam does not know: update it"):
        DatasetPlan.from_provenance(json.dumps(json.loads(PLAN.provenance) | {"lens": 2}))


def test_left_out_is_left_out() -> None:
    assert set(CATEGORIES) - set(Objects.without(["hat", "boat"]).categories) == {"hat", "boat"}
    with pytest.raises(SceneError, match="no object category 'hut'"):
        Objects.without(["hut"])
    with pytest.raises(SceneError, match="keep at least one"):
        Objects.without(list(CATEGORIES))


def test_a_scene_gives_all_but_its_object() -> None:
    scene = SceneFile.model_validate(
        {
            "name": "s",
            "rig": "paper-rig",
            "radiometry": "lambertian",
            "jump_m": 0.03,
            "sensor": {"pulse_ns": 1.0},
            "object": {"category": "cup", "material": {"kind": "phong"}},
        }
    )
    plan = DatasetPlan.of_scene(scene, 3, accuracy="draft")
    assert (plan.rig, plan.first_seed, plan.accuracy) == (scene.rig, 3, "draft")
    assert (plan.sensor, plan.radiometry, plan.jump_m) == (scene.sensor, "lambertian", 0.03)
    assert plan.material == Material(kind="phong")
    assert plan.objects == Objects()


def test_drawn_rigs_fill_the_spread_and_never_leave_it() -> None:
    drawn = np.array([scene_row(*SPREAD.drawn(RIG, SENSOR, seed)) for seed in range(300)])
    half = np.array([0.02, 5, 5, 0.02, 0.02, 0.3 * SENSOR.bare_wall_counts])
    middle = np.array(scene_row(RIG, SENSOR))
    share = (drawn - middle) / half
    assert drawn.shape[1] == len(SCENE_COLUMNS)
    assert np.abs(share).max() <= 1 + 1e-9
    assert share.min(0).max() < -0.95
    assert share.max(0).min() > 0.95
    assert np.abs(np.corrcoef(share.T) - np.eye(6)).max() < 0.25


def test_a_drawn_rig_is_its_seeds_and_without_a_spread_the_given_one() -> None:
    assert SPREAD.drawn(RIG, SENSOR, 5) == SPREAD.drawn(RIG, SENSOR, 5)
    assert SPREAD.drawn(RIG, SENSOR, 5) != SPREAD.drawn(RIG, SENSOR, 6)
    rig, sensor = RigSpread().drawn(RIG, SENSOR, 5)
    assert rig is RIG
    assert sensor is SENSOR


def test_a_rig_without_an_occluder_has_none_drawn() -> None:
    bare = RIG.model_copy(update={"occluder": None})
    rig, sensor = SPREAD.drawn(bare, SENSOR, 1)
    assert rig.occluder is None
    assert np.isnan(scene_row(rig, sensor)).tolist() == [False, False, False, True, True, False]


@pytest.mark.parametrize(
    ("spread", "words"),
    [
        ({"place_m": 0.1}, "100 mm reaches the wall: keep it below 100"),
        ({"angle_deg": 45}, "45 degrees turns the lidar away"),
        ({"gain_share": 1.0}, "100% leaves no light"),
    ],
)
def test_a_spread_that_leaves_what_a_rig_can_be_is_refused(spread: dict[str, float], words: str) -> None:
    with pytest.raises(SceneError, match=words):
        replace(PLAN, spread=RigSpread(**spread)).check()


def test_an_occluder_may_not_be_drawn_into_the_box() -> None:
    assert RIG.occluder is not None
    near = RIG.model_copy(update={"occluder": RIG.occluder.model_copy(update={"x_m": 0.31})})
    with pytest.raises(SceneError, match="into the object box: 15 mm are free"):
        replace(PLAN, rig=near, spread=SPREAD).check()


def test_a_negative_spread_is_none() -> None:
    with pytest.raises(ValidationError):
        RigSpread(place_m=-1)


def test_three_albedos_are_too_many() -> None:
    with pytest.raises(SceneError, match="one intensity"):
        replace(PLAN, material=Material(albedo=(1, 0, 0))).check()


def test_a_rig_without_a_box_has_nowhere_to_hide_objects() -> None:
    with pytest.raises(SceneError, match="object_box"):
        DatasetPlan(load_rig("bare-wall"), 0).check()
