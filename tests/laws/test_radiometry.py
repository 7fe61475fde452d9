"""Laws of radiometry on every backend: materials, contact with the wall, pulse width, findings of
the paper.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from depth_maps import depth_map
from hypothesis import given, settings
from hypothesis import strategies as st
from nlos_calibration import LidarPose, load_rig

from nlos_cam.objects import object_depth
from nlos_cam.render import Accuracy, Scene, render, three_bounce, transient
from nlos_cam.render.echoes import pulse_bins, with_pulse
from nlos_cam.render.geometry import NEAR_DIAGONALS, cast, contact_m2, softened
from nlos_cam.render.material import Brdf, Surface, phong, retroreflective

RIG = load_rig("paper-rig")


@pytest.fixture(scope="module")
def objects() -> list[np.ndarray]:
    return [
        object_depth(seed, RIG.object_box)[1]
        for seed in (
            3,
            20_000_001,
            20_000_009,
        )
    ]


def test_depth_maps_of_direct_returns_do_not_show_the_object(objects: list[np.ndarray]) -> None:
    empty = render(Scene(RIG), "draft").depth_m
    for depth in objects:
        alone = render(
            Scene(RIG, depth),
            "draft",
            effects=["direct", "occluder", "line-of-sight"],
        )
        np.testing.assert_array_equal(alone.depth_m, empty)


def test_depth_maps_with_three_bounces_differ(objects: list[np.ndarray]) -> None:
    maps = [render(Scene(RIG, depth), "draft").depth_m for depth in objects]
    for one in range(len(maps)):
        for other in range(one):
            apart = np.abs(maps[one] - maps[other]) > RIG.device.bin_m
            assert apart.mean() > 0.05


def test_lambertian_third_bounce_wins_no_beam(objects: list[np.ndarray]) -> None:
    empty = render(Scene(RIG, radiometry="lambertian"), "draft")
    for depth in objects:
        scene = Scene(RIG, depth, radiometry="lambertian")
        rendering = render(scene, "draft")
        np.testing.assert_array_equal(rendering.depth_m, empty.depth_m)
        share = rendering.multi.peak.max() / empty.intensity.max()
        assert 1e-6 < share < 3e-3


def test_receiver_cell_scales_only_the_direct_return() -> None:
    wide = RIG.model_copy(
        update={"device": RIG.device.model_copy(update={"receiver_cell_m2": 2e-4})}
    )
    depth = np.full((8, 8), 0.25, np.float32)
    one, other = (
        three_bounce(
            Scene(rig, depth),
            "draft",
        )
        for rig in (RIG, wide)
    )

    np.testing.assert_array_equal(one, other)

    direct, wider = (transient(Scene(rig), "draft").sum() for rig in (RIG, wide))

    assert wider == pytest.approx(2 * direct, rel=1e-5)


KINDS = (phong, retroreflective)
SOME = np.arange(5120)[::61]
COARSE = Accuracy("coarse", relay_columns=8, relay_rows=6)
BRUTE_FORCE = replace(COARSE, sub_bins=0)


def _given_back(brdf: Brdf, cos_in: float) -> float:
    """The integral of f cos / pi over the hemisphere of outgoing light."""
    cos_out, turn = np.meshgrid(
        (np.arange(2000) + 0.5) / 2000, np.linspace(0, np.pi, 2001)[1:] - np.pi / 4000
    )
    across = np.sqrt((1 - cos_in**2) * (1 - cos_out**2)) * np.cos(turn)
    return float(
        2
        * (
            brdf(
                cos_in,
                cos_out,
                cos_in * cos_out + across,
            )
            * cos_out
        ).mean()
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("exponent", [1, 20, 500])
@pytest.mark.parametrize("cos_in", [1e-3, 0.3, 0.7, 1.0])
def test_brdf_returns_no_more_light_than_came(kind: Any, exponent: float, cos_in: float) -> None:
    for specular in (0.0, 0.5, 1.0):
        assert _given_back(kind(1 - specular, specular, exponent), cos_in) <= 1 + 2e-3


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("exponent", [1, 20, 500])
def test_brdf_along_the_normal_returns_all_light(kind: Any, exponent: float) -> None:
    assert _given_back(
        kind(0.5, 0.5, exponent),
        1.0,
    ) == pytest.approx(1, abs=2e-3)


cosines = st.floats(0.01, 1.0)


@pytest.mark.parametrize("kind", KINDS)
@settings(deadline=None, derandomize=True)
@given(
    cos_in=cosines,
    cos_out=cosines,
    turn=st.floats(0, np.pi),
)
def test_brdf_is_reciprocal_and_never_negative(
    kind: Any, cos_in: float, cos_out: float, turn: float
) -> None:
    between = cos_in * cos_out + np.sqrt((1 - cos_in**2) * (1 - cos_out**2)) * np.cos(turn)
    brdf = kind(0.3, 0.7, 20)

    assert brdf(
        cos_in,
        cos_out,
        between,
    ) == pytest.approx(brdf(cos_out, cos_in, between))
    assert brdf(cos_in, cos_out, between) >= 0.3


def test_brdf_is_brightest_in_its_own_direction() -> None:
    """At 45 degrees a mirror sends light onward and a retroreflector sends it back."""
    half = np.cos(np.pi / 4)
    onward = (half, half, 0.0)
    back = (half, half, 1.0)
    for brdf, bright, dark in (
        (phong(0, 1, 20), onward, back),
        (retroreflective(0, 1, 20), back, onward),
    ):
        assert brdf(*bright) > 10
        assert brdf(*dark) < 0.1


@pytest.mark.slow
def test_phong_without_its_lobe_is_lambertian(implementation: Any) -> None:
    """The effects are named because the plan would leave the BRDF out."""
    depth = np.random.default_rng(0).uniform(0.2, 0.3, (6, 6)).astype(np.float32)
    effects = ["three-bounce", "occluder", "tilt", "brdf"]
    dull = implementation.three_bounce(
        Scene(
            RIG,
            depth,
            Surface(1.0, phong(0.6, 0.0, 20)),
        ),
        SOME,
        effects,
    )
    plain = implementation.three_bounce(Scene(RIG, depth, Surface(0.6)), SOME, effects)

    np.testing.assert_allclose(
        dull,
        plain,
        rtol=1e-4,
        atol=1e-6 * plain.max(),
    )


@pytest.mark.slow
def test_brdf_agrees_with_brute_force() -> None:
    depth = np.random.default_rng(0).uniform(0.2, 0.3, (6, 6)).astype(np.float32)
    scene = Scene(RIG, depth, Surface(1.0, phong(0.4, 0.6, 10)))
    effects = ["three-bounce", "occluder", "tilt", "brdf"]
    found, exact = (
        three_bounce(
            scene,
            each,
            effects,
            chosen=SOME,
        ).sum(1)
        for each in (COARSE, BRUTE_FORCE)
    )
    dull = three_bounce(
        scene,
        BRUTE_FORCE,
        effects[:-1],
        chosen=SOME,
    ).sum(1)

    assert np.abs(found - exact).sum() < 1e-2 * exact.sum()
    assert np.abs(exact - dull).sum() > 0.05 * dull.sum()


CELLS = np.arange(-60, 61)


@settings(deadline=None, derandomize=True)
@given(
    height=st.floats(1e-6, 8.0),
    x=st.floats(-0.5, 0.5),
    y=st.floats(-0.5, 0.5),
    longer=st.floats(1.0, 2.0),
    lambertian=st.booleans(),
)
def test_plane_takes_no_more_than_was_sent(
    height: float, x: float, y: float, longer: float, lambertian: bool
) -> None:
    """Light from a point at any height over a plane of cells, each `longer` times as long as its
    width of 1.
    """
    solid_angle = np.pi if lambertian else 2 * np.pi
    squared = (CELLS[:, None] - x) ** 2 + ((CELLS - y) * longer) ** 2 + height**2
    cosine = height / np.sqrt(squared)
    near = NEAR_DIAGONALS * np.hypot(1, longer)
    soft = softened(squared, contact_m2(longer, solid_angle), near)

    assert (longer * cosine * (cosine if lambertian else 1) / (solid_angle * soft)).sum() <= 1


def test_softening_fades_out_at_the_near_distance() -> None:
    squared = np.linspace(0, 4, 400) ** 2
    soft = softened(squared, 0.3, 2.0)

    assert soft[0] == pytest.approx(0.3)
    assert (np.diff(soft) > -1e-3).all()
    np.testing.assert_array_equal(soft[squared >= 4], squared[squared >= 4])


def test_far_object_has_no_near_legs() -> None:
    assert (
        render(
            Scene(
                RIG,
                depth_map(
                    64,
                    np.nan,
                    (np.s_[20:40, 20:40], 0.3),
                ),
            ),
            "draft",
        ).near_legs
        == 0
    )


@settings(deadline=None, derandomize=True)
@given(distance_m=st.floats(1e-6, 1.0))
def test_lidar_on_the_wall_gets_no_more_than_it_sent(distance_m: float) -> None:
    rig = RIG.model_copy(
        update={"lidar": LidarPose(distance_m=distance_m, yaw_deg=45), "occluder": None}
    )
    for lambertian in (False, True):
        direct = cast(rig, Scene(rig).cell_intrinsics, lambertian=lambertian).direct
        assert np.isfinite(direct).all()
        assert 0 <= direct.min() <= direct.max() <= 1


BIN_M = RIG.device.bin_m
DEPTH = np.full((4, 4), 0.3, np.float32)
WIDTHS_NS = (1e-4, 0.01, 0.1, 0.3, 1.0)


@pytest.mark.slow
def test_pulse_keeps_energy_and_lowers_the_peak(implementation: Any) -> None:
    thin = implementation.transient(Scene(RIG, DEPTH)).astype(np.float64)
    peak = thin.max()
    for pulse_ns in WIDTHS_NS[1:4]:
        wide = implementation.transient(
            Scene(
                RIG,
                DEPTH,
                pulse_ns=pulse_ns,
            )
        ).astype(np.float64)
        np.testing.assert_allclose(
            wide.sum(-1),
            thin.sum(-1),
            rtol=1e-5,
        )
        assert wide.max() < peak
        peak = wide.max()


def test_pulse_of_zero_width_changes_nothing(implementation: Any) -> None:
    scene = Scene(RIG, DEPTH, pulse_ns=0.0)
    effects = ["direct", "three-bounce", "occluder"]
    with_it, without = (
        implementation.transient(scene, names) for names in ([*effects, "pulse"], effects)
    )

    np.testing.assert_array_equal(with_it, without)


@pytest.mark.parametrize("pulse_ns", WIDTHS_NS)
def test_pulse_spreads_an_echo_into_a_gaussian(pulse_ns: float) -> None:
    one = np.zeros((1, 400), np.float32)
    one[0, 200] = 2.0
    wide = with_pulse(one, pulse_ns, BIN_M)[0].astype(np.float64)
    at = np.arange(len(wide)) - 200
    sigma = pulse_bins(pulse_ns, BIN_M)

    assert wide.sum() == pytest.approx(2)
    assert (wide * at).sum() == pytest.approx(0, abs=1e-3)

    if sigma > 1:  # plus the variance of a bin
        assert (wide * at**2).sum() / 2 == pytest.approx(
            sigma**2 + 1 / 12,
            rel=1e-2,
        )

    assert wide.argmax() == 200
    assert len(wide) > 400 + 3 * sigma  # room for the tail
    assert pulse_ns < 1 or (wide >= wide.max() / 2).sum() * BIN_M == pytest.approx(
        0.30 * pulse_ns, abs=0.011
    )


def test_wide_pulse_mixes_direct_return_and_echoes(implementation: Any) -> None:
    """The highest bin of the waveform holds both."""
    rendering = implementation.render(Scene(RIG, DEPTH, pulse_ns=1.0))

    assert rendering.multi.direct_included

    seen = np.isfinite(rendering.multi.path_m)

    np.testing.assert_allclose(
        rendering.multi.path_m[seen] / BIN_M % 1,
        0.5,
        atol=1e-3,
    )
    np.testing.assert_array_equal(rendering.intensity, rendering.multi.peak)
