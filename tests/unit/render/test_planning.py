"""Accuracy, scene facts and the plan of effects (two-sided laws: tests/laws/test_effects.py)."""

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import pytest
from depth_maps import depth_map
from hypothesis import given, settings
from hypothesis import strategies as st
from nlos_calibration import Occluder, load_rig

from nlos_cam.errors import SceneError
from nlos_cam.objects import object_box, object_depth
from nlos_cam.render import Radiometry, Scene, Surface, backend_reference, phong, planning
from nlos_cam.render.accuracy import (
    MAX_BEAMS_PER_CELL,
    MAX_RELAY_CELLS,
    STOPS,
    Accuracy,
    accuracy_named,
)
from nlos_cam.render.effects import EFFECTS, decide, included
from nlos_cam.render.energy_survey import CAUTION, EnergySurvey
from nlos_cam.render.geometry import NO_OCCLUDER, SPEED_OF_LIGHT_M_PER_S, spread
from nlos_cam.render.planning import RenderProblem, plan, prepare
from nlos_cam.render.scene_facts import SceneFacts

RIG = load_rig("paper-rig")
BARE = load_rig("bare-wall")


def _called_for(scene: Scene, stop: str = "standard") -> set[str]:
    return {effect.name for effect in plan(SceneFacts(scene, STOPS[stop])) if effect.included}


def _plate(slope: float = 0.0) -> np.ndarray:
    return depth_map(
        16,
        np.nan,
        (
            np.s_[4:12, 2:14],
            0.25 + slope * 0.25 / 16 * np.arange(12),
        ),
    )


@pytest.mark.parametrize(
    ("scene", "effects"),
    [
        (
            Scene(RIG, object_depth(3, object_box(RIG))[1]),
            {"three-bounce", "occluder", "self-occlusion", "tilt"},
        ),
        (Scene(BARE), set()),
        (Scene(RIG), {"occluder"}),
        (Scene(RIG, depth_map(8)), {"occluder"}),
        (Scene(RIG, _plate()), {"three-bounce", "occluder"}),
    ],
    ids=["paper", "bare wall", "no object", "empty object", "level plate"],
)
def test_plan_calls_for_the_effects_of_the_scene(scene: Scene, effects: set[str]) -> None:
    assert _called_for(scene) == {"direct"} | effects

    device = scene.rig.device.model_copy(update={"gate_s": 0.1 / SPEED_OF_LIGHT_M_PER_S})
    short = scene.rig.model_copy(update={"device": device})

    assert _called_for(replace(scene, rig=short)) <= {"occluder"}


def test_plan_calls_for_a_small_tilt_on_a_shiny_surface() -> None:
    """A lobe turns by twice the tilt, which the change of the cosines does not show."""
    gentle = _plate(1e-3)

    assert "tilt" not in _called_for(Scene(RIG, gentle), "draft")

    shiny = Surface(1.0, phong(0.1, 0.9, 2000))

    assert _called_for(Scene(RIG, gentle, shiny), "draft") >= {"tilt", "brdf"}


COARSE = Accuracy("coarse", relay_columns=8, relay_rows=6)
DEPTH = (0.25 + 0.01 * np.arange(8) * np.ones((8, 1))).astype(np.float32)
SCENE = Scene(
    RIG,
    DEPTH,
    Surface(
        np.array([0.9, 0.6, 0.3]),
        phong(0.5, 0.5, 3),
    ),
)


def _without(*names: str) -> RenderProblem:
    return prepare(SCENE, COARSE, set(EFFECTS) - set(names))


def test_problem_holds_every_effect() -> None:
    problem = _without()
    job = problem.job

    assert len(problem.color_jobs) == 3
    assert job.more_bounces
    assert job.field.shades
    assert job.brdf is SCENE.surface.brdf
    assert job.patches.beta.max() > 1
    assert job.edge_m == (0.2, 0.1)
    assert job.relay.x_m.max() < 0.4


def test_problem_drops_effects_left_out() -> None:
    assert not _without("direct").beams.direct.any()
    assert _without("three-bounce").job is None
    assert not _without("colour").color_jobs
    assert _without("tilt").job.patches.beta.max() == 1
    assert not _without("self-occlusion").job.field.shades


def test_problem_without_occluder_opens_wall_and_relay() -> None:
    job = _without("occluder").job

    assert job.edge_m == NO_OCCLUDER
    assert len(job.relay.x_m) == 48
    assert len(job.laser_spot_m) > len(_without().job.laser_spot_m)


def test_problem_without_interreflection_is_shorter() -> None:
    job = _without("inter-reflection").job

    assert not job.more_bounces
    assert job.bins < _without().job.bins


def test_problem_without_brdf_gives_back_as_much_light() -> None:
    job = _without("brdf").job

    assert job.brdf is None
    assert job.patches.albedo.mean() == pytest.approx(0.6 * (0.5 + 0.5))


def test_prepare_refuses_histograms_that_do_not_fit() -> None:
    device = RIG.device.model_copy(update={"bin_m": 1e-6})
    scene = Scene(RIG.model_copy(update={"device": device}), DEPTH)
    with pytest.raises(SceneError, match="GiB"):
        prepare(scene, COARSE)


def test_prepare_counts_the_bins_of_the_pulse(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(RIG, DEPTH)
    bins = prepare(scene, COARSE).job
    monkeypatch.setattr(planning, "MAX_BYTES", 4 * len(bins.laser_spot_m) * bins.bins)

    assert prepare(scene, COARSE).job.bins == bins.bins
    with pytest.raises(SceneError, match="GiB"):
        prepare(replace(scene, pulse_ns=10.0), COARSE)


@pytest.mark.parametrize("radiometry", ["paper", "lambertian"])
def test_job_weights_are_the_factors_of_s2(radiometry: Radiometry) -> None:
    job = prepare(Scene(RIG, DEPTH, Surface(0.5), radiometry), COARSE).job
    relay = job.relay
    solid = np.pi if radiometry == "lambertian" else 2 * np.pi

    np.testing.assert_allclose(
        job.strength,
        0.5 * job.patches.beta * job.patches.cell_m2,
    )

    far = relay.length_m > job.near_m
    expected = relay.cell_m2 / (solid**2 * relay.length_m**2)
    if radiometry == "lambertian":
        expected = expected * job.receiver_cell_m2 * relay.cos_lidar
        np.testing.assert_allclose(job.beam_weight, 1 / solid)
    else:
        np.testing.assert_allclose(job.beam_weight, job.cos_incidence / solid)

    np.testing.assert_allclose(job.relay_weight[far], expected[far])
    assert (job.relay_weight <= expected * (1 + 1e-12)).all()


bounds = st.lists(
    st.floats(0, 1),
    min_size=len(EFFECTS),
    max_size=len(EFFECTS),
)


def _findings(values: list[float]) -> list[tuple[str, float, str]]:
    return [
        (name, bound, f"because of {name}") for name, bound in zip(EFFECTS, values, strict=True)
    ]


@settings(deadline=None, derandomize=True)
@given(values=bounds, tolerance=st.floats(0, 1))
def test_decide_leaves_out_bounds_up_to_the_tolerance(
    values: list[float], tolerance: float
) -> None:
    plan = decide(_findings(values), tolerance)

    assert tuple(effect.name for effect in plan) == EFFECTS

    out, kept = ([e.bound for e in plan if e.included == wanted] for wanted in (False, True))

    assert sum(sorted(out)) <= tolerance
    assert not kept or sum(sorted(out)) + min(kept) > tolerance
    assert max(out, default=0) <= min(kept, default=1)


@pytest.mark.parametrize(
    "asked",
    [["tilt", "direct"], ("direct", "tilt"), {"tilt", "direct"}],
)
def test_decide_includes_exactly_the_named_effects(asked: Collection[str]) -> None:
    plan = decide(_findings([0.5] * len(EFFECTS)), 0.0, asked)

    assert {effect.name for effect in plan if effect.included} == {"direct", "tilt"}
    assert included(plan, "tilt")
    assert not included(plan, "occluder")
    assert all(e.reason.endswith(f"because of {e.name}") for e in plan)


def test_decide_takes_names_and_leaves_out_zero_bounds() -> None:
    assert {
        e.name
        for e in decide(
            _findings([1.0] * len(EFFECTS)),
            0.0,
            "direct",
        )
        if e.included
    } == {"direct"}

    with pytest.raises(SceneError, match="no light arrives"):
        decide(_findings([1.0] * len(EFFECTS)), 0.0, [])
    with pytest.raises(SceneError, match="fog"):
        decide(_findings([0.0] * len(EFFECTS)), 0.0, ["direct", "fog"])
    plan = decide(_findings([0.0] * 5 + [1e-12] * 5), 0.0)

    assert [effect.included for effect in plan] == [False] * 5 + [True] * 5


def test_accuracy_named_finds_stops_in_order_and_keeps_settings() -> None:
    assert all(stop.name == name and accuracy_named(name) is stop for name, stop in STOPS.items())

    own = Accuracy("own", sub_bins=2)

    assert accuracy_named(own) is own

    tolerances = [stop.tolerance for stop in STOPS.values()]

    assert tolerances == sorted(tolerances, reverse=True)
    assert tolerances[-1] == 0
    assert [name for name, stop in STOPS.items() if stop.sub_bins == 0] == ["reference"]

    with pytest.raises(SceneError, match="best"):
        accuracy_named("best")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *[
            ("relay_columns", 0),
            ("relay_rows", MAX_RELAY_CELLS + 1),
            ("object_stride", 0),
            ("sectors", 0),
        ],
        *[("beams_per_cell", MAX_BEAMS_PER_CELL + 1), ("scatter_error", 0.0)],
        *[("tolerance", value) for value in (-1e-9, float("nan"))],
        *[("sub_bins", value) for value in (3, 128, -1)],
    ],
)
def test_accuracy_refuses_values_out_of_range_by_field(field: str, value: float) -> None:
    with pytest.raises(SceneError, match=rf"{field}.*{value}"):
        replace(STOPS["standard"], **{field: value})


def test_survey_share_is_cautious_and_at_most_1() -> None:
    two = np.ones(2)
    none = np.zeros(2)
    for ratio in (1.0, 4.0):
        found = EnergySurvey(two, two, none, none, none, none, uneven=ratio)
        assert found.share(np.array([0.1, 0.0])) == pytest.approx(ratio * CAUTION * 0.05)
        assert found.share(np.array([5.0, 0.0])) == 1
        assert found.tilt == found.occluder == 0
    dark = EnergySurvey(none, two, two, two, two, two, 1.0)

    # A sample without light bounds nothing.
    assert dark.share(two) == 1
    assert dark.share(none) == 1


@pytest.mark.parametrize("z_m", [0.0, 1e-9])
def test_survey_bounds_the_energy_of_a_patch_on_the_wall(z_m: float) -> None:
    """A patch on the wall must not outweigh all others, whose bounds would then be too small."""
    light = SceneFacts(
        Scene(
            RIG,
            depth_map(8, 0.2, ((3, 3), z_m)),
            jump_m=0.5,
        ),
        COARSE,
    ).light

    assert np.isfinite(light.energy).all()
    assert light.energy.max() < 1e3 * np.median(light.energy)


@pytest.mark.parametrize("per_cell", [2, 4, 5, 8])
def test_bound_depends_little_on_how_many_beams_a_cell_has(per_cell: int) -> None:
    """At five beams a cell, every so many beams of the paper's rig lie in one column."""
    at = np.linspace(-1, 1, 32)
    bump = (0.2 + 0.1 * (at[:, None] ** 2 + at**2)).astype(np.float32)
    scene = Scene(RIG, bump, jump_m=0.5)
    one, several = (
        SceneFacts(scene, Accuracy("some", 24, 24, sub_bins=64, beams_per_cell=count)).light
        for count in (1, per_cell)
    )

    assert one is not None
    assert several is not None
    assert (several.energy > 0).mean() == pytest.approx((one.energy > 0).mean(), abs=0.05)
    assert several.tilt == pytest.approx(one.tilt, rel=0.2)


@pytest.mark.parametrize(("count", "sample"), [(5, 8), (320 * 295, 160), (64 * 80, 96), (48, 48)])
def test_sample_of_a_grid_is_spread_over_rows_and_columns(count: int, sample: int) -> None:
    found = spread(count, sample)
    columns = 295 if count % 295 == 0 else 80

    assert len(found) == min(count, sample)
    assert (np.diff(found) > 0).all()
    assert found[-1] < count
    if count > sample:
        shares = np.histogram(found % columns, 4, (0, columns))[0] / len(found)
        np.testing.assert_allclose(shares, 0.25, atol=0.1)


def test_occluder_that_is_left_out_stands_nowhere() -> None:
    # it hides the whole wall from this lidar
    wide = RIG.model_copy(update={"occluder": Occluder(x_m=0.005, z_min_m=0.02)})
    open_rig = RIG.model_copy(update={"occluder": None})
    effects = ["direct", "three-bounce", "line-of-sight"]
    without, none = (
        prepare(Scene(rig, np.full((8, 8), 0.12, np.float32)), COARSE, effects)
        for rig in (wide, open_rig)
    )

    assert without.job is not None
    np.testing.assert_array_equal(without.beams.direct, none.beams.direct)
    np.testing.assert_array_equal(without.beams.on_wall, none.beams.on_wall)
    np.testing.assert_array_equal(without.job.laser_spot_m, none.job.laser_spot_m)


def test_no_light_comes_back_from_beyond_the_wall() -> None:
    wall = RIG.wall.model_copy(update={"x_max_m": 0.3})
    facts = SceneFacts(Scene(RIG.model_copy(update={"wall": wall}), LEVEL), COARSE)

    assert RIG.relay.x_max_m > 0.3
    assert 0 < len(facts.relay.x_m) < len(SceneFacts(Scene(RIG, LEVEL), COARSE).relay.x_m)
    assert facts.relay.x_m.max() <= 0.3


LEVEL = np.full((8, 8), 0.25, np.float32)


@pytest.mark.parametrize(
    ("cells", "stride", "blocks"),
    [
        (8, 2, 4),
        (8, 1, 8),
        (7, 2, 7),
        (8, 4, 2),
    ],
)
def test_facts_take_blocks_where_the_stride_divides_the_grid(
    cells: int, stride: int, blocks: int
) -> None:
    scene = Scene(
        RIG, LEVEL[:cells, :cells], Surface(np.linspace(0, 1, cells**2).reshape(cells, cells))
    )
    facts = SceneFacts(scene, replace(COARSE, object_stride=stride))

    assert facts.depth_m.shape == facts.albedo.shape == (blocks, blocks)
    assert len(facts.patches.beta) == blocks**2
    assert facts.albedo.mean() == pytest.approx(0.5)


def test_facts_have_no_patches_of_empty_boxes_or_beyond_the_gate() -> None:
    for depth in (None, depth_map(8)):
        facts = SceneFacts(Scene(RIG, depth), COARSE)
        assert facts.patches is facts.light is facts.line_of_sight is None
        assert facts.interreflection == 0
    device = RIG.device.model_copy(update={"gate_s": 0.4999 / SPEED_OF_LIGHT_M_PER_S})

    assert (
        SceneFacts(
            Scene(RIG.model_copy(update={"device": device}), LEVEL),
            COARSE,
        ).patches
        is None
    )
    assert SceneFacts(Scene(RIG, LEVEL), COARSE).patches is not None


def test_bins_hold_every_detour_of_a_deep_object() -> None:
    """An object 2.5 m off the wall: light that goes by the wall twice more comes 4 m later."""
    box = object_box(RIG).model_copy(update={"z_near_m": 2.0, "z_far_m": 3.0})
    rig = RIG.model_copy(update={"object_box": box, "occluder": None})
    scene = Scene(rig, np.full((2, 2), 2.5, np.float32), radiometry="lambertian")
    few = Accuracy("few", relay_columns=2, relay_rows=2, sub_bins=0)
    job = prepare(scene, few, ["three-bounce", "inter-reflection"], bounded=False).job
    some = job.select(np.arange(0, len(job.length_m), 1000))
    light = backend_reference.histograms(some)
    longer = backend_reference.histograms(replace(some, bins=some.bins + 300))

    np.testing.assert_array_equal(longer[:, : some.bins], light)
    assert longer.sum() == pytest.approx(light.sum(), rel=1e-12)
