"""Dataset plans: equal after writing and reading, older plans at their defaults, drawn rigs within
their bounds.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nlos_calibration import load_rig
from nlos_models import SIMULATION_ONLY
from pydantic import ValidationError

from nlos_cam.dataset.plan import (
    FIRST_OBJECTS,
    SCENE_COLUMNS,
    DatasetPlan,
    Objects,
    RigSpread,
    scene_row,
)
from nlos_cam.errors import SceneError
from nlos_cam.objects import CATEGORIES, TEXTURES, object_box
from nlos_cam.render import Material, SceneFile, SensorModel

RIG = load_rig("paper-rig")
SENSOR = SensorModel()
PLAN = DatasetPlan(RIG, 7)
SPREAD = RigSpread(place_m=0.02, angle_deg=5, gain_share=0.3)
CHANGES: dict[str, Any] = {
    "rig": RIG.model_copy(update={"name": "other"}),
    "first_seed": 8,
    "sensor": SensorModel(shot_noise=0),
    "accuracy": "fine",
    "objects": Objects((), (("a/b.stl", "0" * 64),), folder=Path("/somewhere")),
    "spread": SPREAD,
    "radiometry": "lambertian",
    "jump_m": 0.5,
    "material": Material(kind="phong"),
    "rendering_version": 1,
    "textures": tuple(TEXTURES),
    "expected": True,
    "objects_per_rig": 50,
}


@pytest.mark.parametrize("name", CHANGES)
def test_plan_survives_json(name: str) -> None:
    other = replace(PLAN, **{name: CHANGES[name]})

    assert DatasetPlan.from_provenance(other.provenance) == other
    assert "somewhere" not in other.provenance  # the folder of meshes differs between machines


@pytest.mark.parametrize("name", CHANGES)
def test_plan_names_the_field_that_differs(name: str) -> None:
    other = replace(PLAN, **{name: CHANGES[name]})

    assert other.differences(PLAN) == [name.replace("_", " ")]


def test_equal_plans_have_no_differences() -> None:
    assert PLAN.differences(replace(PLAN)) == []


def test_plan_writes_later_fields_only_where_used() -> None:
    """Checksums of older plans stay."""
    facts = json.loads(PLAN.provenance)

    assert not {"textures", "note", "expected", "objects_per_rig"} & facts.keys()
    assert not {"share_generic", "up"} & facts["objects"].keys()


def test_textured_plan_carries_a_note() -> None:
    facts = json.loads(replace(PLAN, textures=tuple(TEXTURES)).provenance)

    assert facts["note"] == SIMULATION_ONLY


def test_plan_writes_share_of_generic_shapes() -> None:
    mixed = replace(PLAN, objects=Objects(share_generic=0.5))

    assert json.loads(mixed.provenance)["objects"]["share_generic"] == 0.5
    assert DatasetPlan.from_provenance(mixed.provenance) == mixed


def test_plan_writes_the_axis_of_meshes_that_lie() -> None:
    lying = replace(PLAN, objects=Objects((), (("a.stl", "0"),), up="z"))

    assert json.loads(lying.provenance)["objects"]["up"] == "z"
    assert DatasetPlan.from_provenance(lying.provenance) == lying


@pytest.fixture
def older_facts() -> dict[str, Any]:
    """Facts of a plan that the first version wrote."""
    facts = json.loads(PLAN.provenance)
    for name in ("objects", "spread", "radiometry", "jump_m", "material"):
        del facts[name]
    for name in ("ripple_m", "warm_up", "range_offset_m"):
        del facts["sensor"][name]
    return facts


def test_older_plan_has_defaults_and_objects_of_first_version(
    older_facts: dict[str, Any],
) -> None:
    older = DatasetPlan.from_provenance(json.dumps(older_facts))

    assert PLAN.differences(older) == ["objects"]  # the generators of the first version were others
    assert older.objects.categories == FIRST_OBJECTS["categories"]
    assert older.objects.version == 1


def test_older_plan_that_names_categories_has_defaults(older_facts: dict[str, Any]) -> None:
    older_facts["objects"] = {"categories": list(CATEGORIES)}

    assert DatasetPlan.from_provenance(json.dumps(older_facts)) == PLAN


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "."),
        ("{}", "."),
        ('{"rig": 1}', "."),
        (json.dumps(json.loads(PLAN.provenance) | {"lens": 2}), "lens"),
    ],
)
def test_plan_refuses_other_json_and_newer_plans(text: str, word: str) -> None:
    with pytest.raises(ValueError, match=word):
        DatasetPlan.from_provenance(text)


def test_objects_without_leaves_categories_out() -> None:
    assert set(CATEGORIES) - set(Objects.without(["hat", "boat"]).categories) == {"hat", "boat"}


def test_objects_without_refuses_unknown_category() -> None:
    with pytest.raises(SceneError, match="hut"):
        Objects.without(["hut"])


def test_objects_without_refuses_to_leave_none() -> None:
    with pytest.raises(SceneError):
        Objects.without(list(CATEGORIES))


def test_plan_of_scene_takes_all_but_the_object() -> None:
    hidden = {"category": "cup", "material": {"kind": "phong"}}
    facts = {
        "rig": "paper-rig",
        "radiometry": "lambertian",
        "jump_m": 0.03,
        "sensor": {"pulse_ns": 1.0},
    }
    scene = SceneFile.model_validate({"name": "s", "object": hidden, **facts})

    plan = DatasetPlan.of_scene(scene, 3, accuracy="draft")

    assert plan.rig == scene.rig
    assert plan.first_seed == 3
    assert plan.accuracy == "draft"
    assert plan.sensor == scene.sensor
    assert plan.radiometry == "lambertian"
    assert plan.jump_m == 0.03
    assert plan.material == Material(kind="phong")
    assert plan.objects == Objects()


@pytest.fixture(scope="module")
def drawn() -> np.ndarray:
    """Rows of facts of 300 rigs."""
    return np.array([scene_row(*SPREAD.draw(RIG, SENSOR, seed)) for seed in range(300)])


def test_scene_row_has_its_columns(drawn: np.ndarray) -> None:
    assert drawn.shape[1] == len(SCENE_COLUMNS)


def test_spread_draws_rigs_uniformly_within_bounds(drawn: np.ndarray) -> None:
    half = np.array([0.02, 5, 5, 0.02, 0.02, 0.3 * SENSOR.bare_wall_counts])
    share = (drawn - np.array(scene_row(RIG, SENSOR))) / half

    assert np.abs(share).max() <= 1 + 1e-9
    assert share.min(0).max() < -0.95
    assert share.max(0).min() > 0.95
    assert np.abs(np.corrcoef(share.T) - np.eye(6)).max() < 0.25


def test_spread_draws_rigs_by_seed() -> None:
    assert SPREAD.draw(RIG, SENSOR, 5) == SPREAD.draw(RIG, SENSOR, 5)
    assert SPREAD.draw(RIG, SENSOR, 5) != SPREAD.draw(RIG, SENSOR, 6)


def test_no_spread_keeps_the_rig() -> None:
    assert RigSpread().draw(RIG, SENSOR, 5) == (RIG, SENSOR)


def test_objects_share_a_rig_in_groups() -> None:
    shared = replace(PLAN, spread=SPREAD, objects_per_rig=5)

    benches = [shared.bench_of(seed) for seed in range(4, 7)]

    assert benches == [SPREAD.draw(RIG, SENSOR, draw) for draw in (0, 1, 1)]


def test_a_spread_off_the_record_is_not_known() -> None:
    known = replace(PLAN, spread=SPREAD)
    unknown = replace(known, off_record=True)

    assert unknown.bench_of(3) == known.bench_of(3)
    assert known.known_rig(3) == known.bench_of(3)[0]
    assert unknown.known_rig(3) == RIG
    assert DatasetPlan.from_provenance(unknown.provenance) == unknown
    assert "off_record" not in known.provenance  # checksums of older plans stay


def test_rig_without_occluder_is_drawn_without_one() -> None:
    rig, sensor = SPREAD.draw(RIG.model_copy(update={"occluder": None}), SENSOR, 1)

    assert rig.occluder is None
    assert np.isnan(scene_row(rig, sensor)).tolist() == [False, False, False, True, True, False]


NEAR = RIG.model_copy(update={"occluder": RIG.occluder.model_copy(update={"x_m": 0.31})})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"spread": RigSpread(place_m=0.1)}, "100 mm"),
        ({"spread": RigSpread(angle_deg=45)}, "45 degrees"),
        ({"spread": RigSpread(gain_share=1.0)}, "100%"),
        ({"rig": NEAR, "spread": SPREAD}, "15 mm"),  # would move the occluder into the object box
        ({"objects_per_rig": 2}, "--objects-per-rig"),
        ({"off_record": True}, "--off-record"),
        ({"material": Material(albedo=(1, 0, 0))}, "one intensity"),
        ({"material": Material(albedo=0.5), "textures": tuple(TEXTURES)}, "textures"),
        ({"material": Material(albedo=(1.0, 0.5, 0.5)), "textures": tuple(TEXTURES)}, "textures"),
        ({"rig": load_rig("bare-wall")}, "object_box"),
    ],
)
def test_plan_check_refuses_impossible_plans(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(SceneError, match=words):
        replace(PLAN, **changes).check()


@pytest.mark.parametrize("textures", [(), tuple(TEXTURES)])
def test_plan_check_accepts_possible_plans(textures: tuple[str, ...]) -> None:
    replace(PLAN, textures=textures).check()


def test_spread_within_a_rig_keeps_the_occluder_beside_the_box() -> None:
    rig = load_rig("paper-rig")
    assert rig.occluder is not None
    close = rig.occluder.model_copy(update={"x_m": object_box(rig).x_min_m - 0.0002})
    tight = rig.model_copy(update={"occluder": close})
    spread = RigSpread(place_m=0.0005, angle_deg=0.1)

    assert spread.within(rig) == spread
    spread.within(tight).check(tight)
    assert spread.within(tight).place_m == pytest.approx(0.0002)


def test_spread_refuses_negative_lengths() -> None:
    with pytest.raises(ValidationError, match="place_m"):
        RigSpread(place_m=-1)
