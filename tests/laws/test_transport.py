"""Laws of transport on every backend: energy, reciprocity, causality, symmetry, scaling,
superposition.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from depth_maps import depth_map
from hypothesis import given, settings
from hypothesis import strategies as st
from nlos_calibration import load_rig

from nlos_cam.render import (
    EFFECTS,
    Accuracy,
    Radiometry,
    Scene,
    Surface,
    TransportJob,
    phong,
    prepare,
)
from nlos_cam.render.geometry import Relay

RIG = load_rig("paper-rig")
OPEN = load_rig("bare-wall").model_copy(update={"object_box": RIG.object_box})
"""The paper's rig without an occluder."""
COARSE = Accuracy("coarse", relay_columns=8, relay_rows=6)
SOME = np.arange(5120)[::41]
BIN_M = RIG.device.bin_m
PHONG = phong(0.4, 0.6, 10)
RADIOMETRIES: tuple[Radiometry, ...] = ("paper", "lambertian")
ALL_BUT_MORE = [name for name in EFFECTS if name != "inter-reflection"]
NO_WIDTH = [name for name in ALL_BUT_MORE if name != "pulse"]


def _rough(
    seed: int,
    low_m: float = 0.15,
    high_m: float = 0.35,
) -> np.ndarray:
    return np.random.default_rng(seed).uniform(low_m, high_m, (8, 8)).astype(np.float32)


def _job(scene: Scene, accuracy: Accuracy = COARSE) -> TransportJob:
    return prepare(scene, accuracy, ALL_BUT_MORE).job


def _arrived(implementation: Any, job: TransportJob) -> np.ndarray:
    """Share of the light of each laser spot that arrives on the relay wall, before the leg to the
    detector.
    """
    far_m = 10.0
    there = np.full_like(job.relay.x_m, far_m)
    relay = replace(job.relay, length_m=there, cos_lidar=np.ones_like(there))
    even = replace(
        job,
        relay=relay,
        receiver_cell_m2=1.0,
        bin_m=1.0,
        bins=40,
        brdf=None,
    )
    even = replace(even, cos_incidence=np.ones_like(job.cos_incidence))
    return implementation.histograms(even).sum(1) * job.solid_angle * far_m**2


@pytest.mark.slow
@pytest.mark.parametrize("radiometry", RADIOMETRIES)
@settings(max_examples=8, deadline=None, derandomize=True)
@given(
    base_m=st.floats(1e-3, 0.4), rough_m=st.sampled_from([0.0, 0.01, 0.1]), seed=st.integers(0, 99)
)
def test_relay_receives_less_light_than_left_the_spot(
    implementation: Any, radiometry: Radiometry, base_m: float, rough_m: float, seed: int
) -> None:
    depth = _rough(seed, base_m, base_m + rough_m)
    job = _job(Scene(OPEN, depth, radiometry=radiometry, jump_m=0.5))
    arrived = _arrived(
        implementation,
        job.select(np.arange(len(job.laser_spot_m))[::37]),
    )

    assert arrived.max() <= 1
    assert arrived.min() >= 0
    assert arrived.max() > 0


def _swapped(job: TransportJob) -> TransportJob:
    """The same with the feet where the relay cells were and the other way round."""
    relay = job.relay
    foot = job.laser_spot_m
    there = Relay(
        *foot[:, :2].T.copy(), job.length_m, np.ones(len(foot)), relay.cell_m2, relay.diagonal_m
    )
    feet = np.stack(
        [relay.x_m, relay.y_m, np.zeros_like(relay.x_m)],
        1,
    )
    return replace(
        job,
        laser_spot_m=feet,
        length_m=relay.length_m,
        cos_incidence=np.ones(len(feet)),
        relay=there,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "brdf",
    [None, PHONG],
    ids=["diffuse", "phong"],
)
def test_transport_is_reciprocal(implementation: Any, brdf: Any) -> None:
    """Light from spot p over the object to cell q equals that from q to p, with the same delay
    (Lambertian).
    """
    scene = Scene(
        OPEN,
        _rough(1, 0.25, 0.35),
        Surface(0.7, brdf),
        "lambertian",
        jump_m=0.5,
    )
    job = _job(scene, replace(COARSE, relay_columns=40, relay_rows=40))

    assert job.near_m < 0.25  # near contact depends on the direction

    job = replace(
        job,
        relay=job.relay.select(np.arange(len(job.relay.x_m)) == 905),
    ).select(np.array([1500]))
    there = job
    back = _swapped(job)
    sent = implementation.histograms(there)[0] / there.relay_weight[0]
    returned = implementation.histograms(back)[0] / back.relay_weight[0]

    assert sent.any()
    # The CPU interpolates a lobe over the incoming direction alone: its error is bounded by the
    # accuracy's. The reference interpolates nothing.
    interpolated = brdf is not None and implementation.name == "cpu"
    error = COARSE.scatter_error if interpolated else 1e-5

    np.testing.assert_allclose(returned.sum(), sent.sum(), rtol=error)

    moved = np.abs(np.cumsum(returned) - np.cumsum(sent)).sum() / sent.sum()
    # In bins: a fast renderer may round a path across an edge, and the light of a lobe may err by
    # its share in every bin.
    spread = np.ptp(np.flatnonzero(sent)) if interpolated else 0

    assert moved < 0.1 + error * spread


def test_echoes_lie_between_shortest_and_longest_path(implementation: Any) -> None:
    scene = Scene(RIG, _rough(2))
    job = _job(scene).select(np.arange(0, 2700, 50))
    histogram = implementation.histograms(job)
    point = job.patches.point_m
    relay = job.relay
    d2 = np.linalg.norm(
        job.laser_spot_m[:, None] - point,
        axis=-1,
    )
    cells = np.stack(
        [relay.x_m, relay.y_m, np.zeros_like(relay.x_m)],
        1,
    )
    rest = (
        np.linalg.norm(
            point[:, None] - cells,
            axis=-1,
        )
        + relay.length_m
    )
    shortest = job.length_m + (d2 + rest.min(1)).min(1)
    longest = job.length_m + (d2 + rest.max(1)).max(1)
    bins = np.arange(histogram.shape[1])
    early = (bins + 1) * BIN_M < shortest[:, None] - 0.1 * BIN_M
    late = bins * BIN_M > longest[:, None] + 0.1 * BIN_M

    assert (early | late).any()
    assert not histogram[early | late].any()
    assert histogram.any()


def test_single_path_has_its_bin_and_the_weight_of_s2(implementation: Any) -> None:
    scene = Scene(
        OPEN,
        depth_map(8, np.nan, ((3, 3), 0.3)),
    )
    job = _job(
        scene,
        replace(COARSE, relay_columns=40, relay_rows=40, sub_bins=64),
    )
    job = replace(
        job,
        relay=job.relay.select(np.arange(len(job.relay.x_m)) == 905),
    )
    foot = job.laser_spot_m
    point = job.patches.point_m[0]
    relay = job.relay
    cell = np.array(
        [
            relay.x_m[0],
            relay.y_m[0],
            0,
        ]
    )
    d2 = np.linalg.norm(foot - point, axis=1)
    d3 = np.linalg.norm(cell - point)
    path = (job.length_m + d2 + d3 + relay.length_m[0]) / BIN_M
    histogram = implementation.histograms(job)

    assert ((histogram > 0).sum(1) == 1).all()

    clear = np.abs(path - np.rint(path)) > 0.02

    assert clear.any()
    np.testing.assert_array_equal(
        histogram.argmax(1)[clear],
        np.floor(path[clear]),
    )

    cos_2 = 0.3 / d2
    cos_3 = 0.3 / d3
    expected = job.cos_incidence * cos_2 * cos_3 * relay.cell_m2 * job.patches.cell_m2
    expected /= (2 * np.pi) ** 3 * d2**2 * d3**2 * relay.length_m[0] ** 2  # S2

    assert min(d2.min(), d3, relay.length_m[0]) > job.near_m
    np.testing.assert_allclose(histogram.sum(1), expected, rtol=1e-5)


@pytest.mark.slow
def test_mirrored_object_gives_mirrored_maps(implementation: Any) -> None:
    # level: the forward differences of S3 are not symmetric on a slope
    depth = depth_map(
        8,
        np.nan,
        (np.s_[2:5, 1:6], 0.25),
        (np.s_[4:7, 4:7], 0.2),
    )
    one = implementation.render(Scene(RIG, depth))
    other = implementation.render(
        Scene(
            RIG,
            depth[::-1].copy(),
        )
    )

    np.testing.assert_allclose(
        one.multi.peak[::-1],
        other.multi.peak,
        rtol=3e-2,
    )

    whole = implementation.three_bounce(Scene(RIG, depth)).sum(1).reshape(64, 80)
    turned = (
        implementation.three_bounce(
            Scene(
                RIG,
                depth[::-1].copy(),
            )
        )
        .sum(1)
        .reshape(64, 80)
    )

    np.testing.assert_allclose(whole[::-1], turned, rtol=1e-4)


@pytest.mark.parametrize("albedo", [0.0, 0.25, 1.0])
def test_three_bounce_scales_with_the_albedo(implementation: Any, albedo: float) -> None:
    white = implementation.three_bounce(Scene(RIG, _rough(3)), SOME)
    grey = implementation.three_bounce(
        Scene(RIG, _rough(3), Surface(albedo)),
        SOME,
    )

    np.testing.assert_allclose(grey, albedo * white, rtol=1e-5, atol=1e-30)


def test_albedo_of_each_cell_weighs_that_cell(implementation: Any) -> None:
    albedo = np.zeros((8, 8))
    albedo[:, :4] = 1
    left = np.where(
        albedo > 0,
        _rough(4),
        np.nan,
    ).astype(np.float32)
    without = [
        name for name in EFFECTS if name not in {"self-occlusion", "tilt", "inter-reflection"}
    ]
    painted = implementation.three_bounce(
        Scene(RIG, _rough(4), Surface(albedo)),
        SOME,
        without,
    )
    cut = implementation.three_bounce(Scene(RIG, left), SOME, without)
    bins = min(painted.shape[1], cut.shape[1])

    np.testing.assert_allclose(
        painted[:, :bins],
        cut[:, :bins],
        rtol=1e-4,
        atol=1e-6 * cut.max(),
    )
    assert not painted[:, bins:].any()


def test_parts_that_do_not_shade_each_other_add_up(implementation: Any) -> None:
    left = (np.s_[1:4, 1:3], 0.22)
    right = (np.s_[5:7, 5:8], 0.22)
    whole = implementation.three_bounce(
        Scene(RIG, depth_map(8, np.nan, left, right)),
        SOME,
    )
    parts = np.zeros_like(whole)
    for part in (
        depth_map(8, np.nan, left),
        depth_map(8, np.nan, right),
    ):
        found = implementation.three_bounce(Scene(RIG, part), SOME)[:, : whole.shape[1]]
        parts[:, : found.shape[1]] += found

    np.testing.assert_allclose(
        whole,
        parts,
        rtol=1e-4,
        atol=1e-6 * whole.max(),
    )


def test_front_part_shades_the_part_behind_it(implementation: Any) -> None:
    behind = (np.s_[2:6, 5:8], 0.35)
    front = (np.s_[2:6, 2:5], 0.14)
    scenes = [
        Scene(RIG, depth_map(8, np.nan, *parts))
        for parts in (
            [behind],
            [front],
            [behind, front],
        )
    ]
    *apart, together = (implementation.three_bounce(scene, SOME).sum() for scene in scenes)

    assert together < 0.98 * sum(apart)


@pytest.mark.slow
@pytest.mark.parametrize("radiometry", RADIOMETRIES)
def test_transient_is_three_bounces_plus_the_direct_return(
    implementation: Any, radiometry: Radiometry
) -> None:
    scene = Scene(RIG, _rough(5), radiometry=radiometry)
    three = implementation.three_bounce(scene, effects=ALL_BUT_MORE)
    whole = implementation.transient(scene, ALL_BUT_MORE).reshape(5120, -1)
    rest = whole.copy()
    rest[:, : three.shape[1]] -= three.astype(np.float32)
    direct = prepare(scene, COARSE, ALL_BUT_MORE).beams.direct

    np.testing.assert_allclose(
        rest.sum(1),
        direct,
        rtol=1e-5,
        atol=1e-6 * whole.max(),
    )

    rendering = implementation.render(scene, NO_WIDTH)
    stronger = np.maximum(three.max(1), direct).astype(np.float32)

    np.testing.assert_allclose(rendering.intensity.ravel(), stronger, rtol=1e-6)
