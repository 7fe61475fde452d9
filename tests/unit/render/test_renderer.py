"""Renderings, echoes, the rolling scan, BRDF tables and the numba backend (laws: tests/laws)."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from depth_maps import depth_map
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from nlos_calibration.rig import load_rig

from nlos_cam.errors import SceneError
from nlos_cam.objects import object_box, object_depth
from nlos_cam.render import (
    STOPS,
    Accuracy,
    Rendering,
    Scene,
    Surface,
    backend_numba,
    beam_sums,
    phong,
    prepare,
    render,
    render_all,
    retroreflective,
    three_bounce,
    transient,
)
from nlos_cam.render import echoes as echoes_module
from nlos_cam.render.backend_numba import echoes, histograms
from nlos_cam.render.echoes import MultiBounce, compete, no_echoes, strongest, with_pulse
from nlos_cam.render.effects import Effect
from nlos_cam.render.geometry import Beams
from nlos_cam.render.job import TransportJob
from nlos_cam.render.material import Brdf
from nlos_cam.render.renderer import render_scan, scan_effect, slices
from nlos_cam.render.scene import Radiometry

RIG = load_rig("paper-rig")
COARSE = Accuracy("coarse", relay_columns=4, relay_rows=3)
DEPTH = np.full((4, 4), 0.25, np.float32)


def test_rendering_has_maps_of_cells_and_echoes_of_beams() -> None:
    for beams in (1, 2):
        rendering = render(Scene(RIG, DEPTH), replace(COARSE, beams_per_cell=beams))
        for image in (rendering.depth_m, rendering.intensity, rendering.margin):
            assert image.shape == (64, 80)
            assert image.dtype == np.float32
        assert rendering.multi.peak.shape == (64 * beams, 80 * beams)
        assert rendering.color is None
        assert transient(
            Scene(RIG, DEPTH),
            replace(COARSE, beams_per_cell=beams),
        ).shape[:2] == (
            64 * beams,
            80 * beams,
        )


def test_cell_takes_the_median_depth_of_its_beams() -> None:
    rendering = render(Scene(RIG), replace(COARSE, beams_per_cell=2))
    every = render(Scene(RIG), COARSE)
    both = np.isfinite(rendering.depth_m) & np.isfinite(every.depth_m)

    assert both.mean() > 0.5
    assert np.median(np.abs(rendering.depth_m - every.depth_m)[both]) < 1e-3


def test_color_is_the_winning_echo_in_each_channel() -> None:
    albedo = np.array([1.0, 0.5, 0.0])
    rendering = render(Scene(RIG, DEPTH, Surface(albedo)), COARSE)
    wins = rendering.multi.peak == rendering.intensity

    assert wins.any()
    assert not wins.all()
    np.testing.assert_allclose(
        rendering.color[wins],
        rendering.intensity[wins, None] * albedo / albedo.mean(),
        rtol=1e-5,
        atol=1e-30,
    )
    np.testing.assert_allclose(
        rendering.color[~wins],
        np.repeat(
            rendering.intensity[~wins, None],
            3,
            1,
        ),
        rtol=1e-6,
    )


def test_color_of_what_the_lidar_sees_itself_is_its_own() -> None:
    rig = load_rig("bare-wall").model_copy(update={"object_box": RIG.object_box})
    albedo = np.array([1.0, 0.5, 0.0])
    scene = Scene(rig, np.full((8, 8), 0.06, np.float32), Surface(albedo))
    rendering = render(scene, COARSE)
    in_sight = rendering.depth_m < render(Scene(rig), COARSE).depth_m - 0.01

    assert in_sight.any()
    np.testing.assert_allclose(
        rendering.color[in_sight],
        rendering.intensity[in_sight, None] * albedo / albedo.mean(),
        rtol=1e-5,
    )


def test_transient_of_what_the_lidar_sees_has_its_color() -> None:
    rig = load_rig("bare-wall").model_copy(update={"object_box": RIG.object_box})
    albedo = np.array([1.0, 0.5, 0.0])
    depth = np.full((8, 8), 0.06, np.float32)
    problem = prepare(Scene(rig, depth, Surface(albedo)), COARSE)
    hit = (problem.tint != 1).any(-1)
    light = transient(
        Scene(rig, depth, Surface(albedo)),
        COARSE,
        ["direct", "three-bounce", "line-of-sight", "colour"],
    )
    at = np.floor(2 * problem.beams.length_m[hit] / rig.device.bin_m).astype(int)
    direct = light.reshape(-1, *light.shape[2:])[np.flatnonzero(hit), at]

    assert hit.any()
    assert (direct[:, 0] > direct[:, 1]).all()
    assert (direct[:, 1] > direct[:, 2]).all()


@pytest.mark.parametrize("pulse_ns", [0.0, 0.05])
def test_mean_of_the_channels_is_the_intensity(pulse_ns: float) -> None:
    albedo = np.array([1.0, 0.5, 0.2])
    finer = replace(COARSE, beams_per_cell=2)
    rendering = render(Scene(RIG, DEPTH, Surface(albedo), pulse_ns=pulse_ns), finer)

    np.testing.assert_allclose(rendering.color.mean(-1), rendering.intensity, rtol=1e-5, atol=1e-30)


def _valley() -> np.ndarray:
    """Return two slopes that light each other."""
    column = np.abs(np.arange(8) - 3.5)
    return np.tile(0.2 + 0.015 * column, (8, 1)).astype(np.float32)


@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_mean_of_the_channels_is_light_that_met_the_object_twice(backend: str) -> None:
    """It is quadratic in albedo: the mean of the channels' albedos would give less."""
    scene = Scene(RIG, _valley(), Surface(np.array([1.0, 0.2, 0.0])), "lambertian", jump_m=0.5)
    named = ["direct", "three-bounce", "colour", "inter-reflection"]
    grey = replace(scene, surface=Surface(0.4))

    rendering = next(render_all([scene], COARSE, named, backend))
    white = three_bounce(scene, COARSE, named, backend)
    channels = transient(scene, COARSE, named, backend)
    without_direct = [name for name in named if name != "direct"]
    lit = transient(scene, COARSE, without_direct, backend)

    np.testing.assert_allclose(rendering.color.mean(-1), rendering.intensity, rtol=1e-5, atol=1e-30)
    assert white.sum() == pytest.approx(float(lit.mean(-1).sum()), rel=1e-4)
    assert white.sum() > 1.01 * three_bounce(grey, COARSE, named, backend).sum()
    assert channels.shape[-1] == 3


def test_transient_of_a_channel_without_light_is_as_long() -> None:
    """Nothing blocks the lidar here, and no beam meets the wall past the object."""
    box = RIG.object_box.model_copy(update={"x_min_m": 0.1, "x_max_m": 1.1})
    lidar = RIG.lidar.model_copy(update={"distance_m": 0.5, "yaw_deg": 60.0})
    bench = RIG.model_copy(update={"object_box": box, "lidar": lidar, "occluder": None})
    near = np.full((4, 4), 0.02, np.float32)

    light = transient(Scene(bench, near, Surface(np.array([1.0, 1.0, 0.0]))), COARSE)

    assert light.shape[-1] == 3
    assert light[..., 2].sum() < light[..., 0].sum()


@pytest.mark.parametrize("kind", [phong, retroreflective])
@pytest.mark.parametrize("exponent", [20.0, 2000.0])
def test_surface_whose_lobe_is_left_out_gives_back_as_much(
    kind: Callable[[float, float, float], Brdf], exponent: float
) -> None:
    glossy = Scene(RIG, DEPTH, Surface(0.5, kind(0.3, 0.5, exponent)))
    matt = Scene(RIG, DEPTH, Surface(0.5 * 0.8))
    named = ["direct", "three-bounce"]

    np.testing.assert_allclose(
        three_bounce(glossy, COARSE, named), three_bounce(matt, COARSE, named), rtol=1e-6
    )


@pytest.mark.parametrize(
    ("surface", "backend"),
    [(Surface(), "cpu"), (Surface(1.0, phong(0.5, 0.5, 20)), "cpu"), (Surface(), "torch")],
    ids=["matt", "glossy", "torch"],
)
def test_tables_beyond_memory_are_refused_in_a_line(
    surface: Surface, backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backend_numba, "MAX_TABLE_BYTES", 1 << 10)

    with pytest.raises(SceneError, match=r"tables of \d+ patches with bins of 10 mm.*widen"):
        render(Scene(RIG, DEPTH, surface), COARSE, backend=backend)


def test_lone_return_has_no_rival_under_a_pulse() -> None:
    found = render(Scene(load_rig("bare-wall"), pulse_ns=1.0), COARSE)
    lit = found.intensity > 0

    assert lit.any()
    # A Gaussian has 1/16 of its peak one full width away.
    np.testing.assert_allclose(found.margin[lit], 1 - 1 / 16, atol=0.02)


def test_pulse_spreads_some_rows_at_a_time_as_all(monkeypatch: pytest.MonkeyPatch) -> None:
    light = np.random.default_rng(0).random((7, 60), np.float32)
    whole = with_pulse(light, 1.0, BIN_M)
    monkeypatch.setattr(echoes_module, "TRANSFORM_VALUES", 2 * whole.shape[1])

    np.testing.assert_array_equal(with_pulse(light, 1.0, BIN_M), whole)


@pytest.mark.parametrize("at_most", [1, 60, 65, 1000])
def test_pulse_up_to_a_bin_is_the_beginning_of_the_whole(at_most: int) -> None:
    light = np.random.default_rng(0).random((3, 60), np.float32)
    whole = with_pulse(light, 1.0, BIN_M)

    np.testing.assert_array_equal(with_pulse(light, 1.0, BIN_M, at_most), whole[:, :at_most])


BIN_M = 0.01


def _multi(
    peak: list[float],
    runner_up: list[float],
    path_m: float = 2.0,
) -> MultiBounce:
    paths = np.full(len(peak), path_m, np.float32)
    return MultiBounce(
        np.array(peak, np.float32),
        np.array(runner_up, np.float32),
        paths,
    ).reshape((1, len(peak)))


@settings(deadline=None, derandomize=True)
@given(
    arrays(
        np.float32,
        (5, 9),
        elements=st.sampled_from([0.0, 1e-6, 0.25, 0.5, 1.0]),
    )
)
def test_strongest_finds_the_two_highest_bins(histogram: np.ndarray) -> None:
    found = strongest(histogram, BIN_M)
    ordered = np.sort(histogram, axis=1)

    np.testing.assert_array_equal(found.peak, ordered[:, -1])
    np.testing.assert_array_equal(found.runner_up, ordered[:, -2])
    # The first of equals.
    expected = np.where(found.peak > 0, (histogram.argmax(1) + 0.5) * BIN_M, np.nan)

    np.testing.assert_allclose(found.path_m, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("direct", "multi", "depth_m", "intensity", "margin"),
    [
        (
            [0.4, 0.1],
            _multi([0.2, 0.2], [0.1, 0.15]),
            [0.25, 0.5],
            [0.4, 0.2],
            [0.5, 0.25],
        ),
        (
            [0.25],
            _multi([0.25], [0.0]),
            [0.25],
            [0.25],
            [0.0],
        ),  # a tie goes to the direct return
        (
            [0.0, 0.1],
            no_echoes(2).reshape((1, 2)),
            [np.nan, 0.25],
            [0.0, 0.1],
            [0.0, 1.0],
        ),
        (
            [0.4],
            replace(_multi([0.2], [0.05]), direct_included=True),
            [0.5],
            [0.2],
            [0.75],
        ),  # counted once
    ],
    ids=["stronger", "tie", "nothing", "included"],
)
def test_compete_takes_the_stronger_return(
    direct: list[float],
    multi: MultiBounce,
    depth_m: list[float],
    intensity: list[float],
    margin: list[float],
) -> None:
    n = len(direct)
    half = np.full(len(direct), 0.5)
    foot = np.zeros((len(direct), 3))
    beams = Beams(
        (1, n), foot, foot, half, half, half, np.ones(n, np.bool_), np.array(direct), np.zeros(3)
    )
    for found, expected in zip(
        compete(beams, multi),
        (depth_m, intensity, margin),
        strict=True,
    ):
        np.testing.assert_allclose(found[0], expected, rtol=1e-6)


def _plate(share: float) -> Scene:
    """A plate that comes 4 cm nearer to the wall during a scan."""
    return Scene(
        RIG,
        depth_map(
            16,
            np.nan,
            (np.s_[4:12, 4:12], 0.3 - 0.04 * share),
        ),
    )


def _still(_share: float) -> Scene:
    return _plate(0.0)


def test_scan_of_a_still_scene_is_one_rendering() -> None:
    assert not scan_effect(_still).included
    assert scan_effect(_still).bound == 0

    bare = Scene(load_rig("bare-wall"))

    assert not scan_effect(lambda _share: bare).included

    scan = render_scan(_still)
    instant = render(_still(0.0))

    np.testing.assert_array_equal(scan.depth_m, instant.depth_m)
    np.testing.assert_array_equal(scan.multi.peak, instant.multi.peak)
    assert scan.plan[-1].name == "scan-time"


def test_scan_effect_is_called_for_by_motion_above_the_tolerance() -> None:
    verdict = scan_effect(_plate)

    assert verdict.included

    scan = render_scan(_plate).multi.peak
    instant = render(_plate(0.0)).multi.peak
    change = np.abs(scan - instant).sum() / scan.sum()

    assert STOPS["standard"].tolerance < change <= verdict.bound

    hardly = scan_effect(lambda share: _plate(share * 1e-4), "draft")

    assert 0 < hardly.bound < STOPS["draft"].tolerance
    assert not hardly.included


@pytest.mark.slow
def test_scan_slice_is_the_rendering_of_its_instant() -> None:
    scan = render_scan(_plate)
    count = slices(scan_effect(_plate), STOPS["standard"])
    rows = np.array_split(np.arange(64), count)[0]
    instant = render(_plate(float(rows.mean() + 0.5) / 64))

    np.testing.assert_array_equal(scan.depth_m[rows], instant.depth_m[rows])
    assert scan.depth_m.shape == (64, 80)


@pytest.mark.parametrize(
    ("bound", "count"),
    [(0.01, 2), (0.1, 5), (1.0, 50)],
)
def test_slices_grow_with_the_motion(bound: float, count: int) -> None:
    assert (
        slices(
            Effect("scan-time", included=True, reason="", bound=bound),
            STOPS["standard"],
        )
        == count
    )
    assert (
        slices(
            Effect("scan-time", included=False, reason="", bound=bound),
            STOPS["standard"],
        )
        == 1
    )


BRDF = phong(0.4, 0.6, 10)


@pytest.fixture(scope="module")
def job() -> TransportJob:
    depth = np.random.default_rng(0).uniform(0.1, 0.3, (4, 4)).astype(np.float32)
    return prepare(
        Scene(
            load_rig("paper-rig"),
            depth,
            Surface(1.0, BRDF),
            jump_m=0.5,
        ),
        COARSE,
        "auto",
    ).job


@pytest.mark.parametrize("radiometry", ["paper", "lambertian"])
@pytest.mark.parametrize("stop", ["draft", "standard"])
def test_joined_patches_move_light_by_less_than_a_bin(
    stop: str, radiometry: Radiometry, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = prepare(
        Scene(
            RIG,
            object_depth(4, object_box(RIG))[1],
            radiometry=radiometry,
        ),
        STOPS[stop],
    ).job
    joined = histograms(job).astype(np.float64)
    groups_of = beam_sums.groups_of
    # Each patch alone.
    monkeypatch.setattr(backend_numba, "groups_of", lambda surface, _: groups_of(surface, -1.0))
    alone = histograms(job).astype(np.float64)
    below = [np.cumsum(each, axis=1) for each in (joined, alone)]
    weight = float((1 + beam_sums.JOIN_COSINE) * beam_sums.JOIN_WEIGHT) / job.accuracy.sub_bins

    assert (below[0][:, 1:] >= below[1][:, :-1] * (1 - weight)).all()
    assert (below[0][:, :-1] <= below[1][:, 1:] * (1 + weight) + 1e-6 * below[1][:, -1:]).all()
    np.testing.assert_allclose(
        below[0][:, -1],
        below[1][:, -1],
        rtol=0.05 * weight,
    )
    np.testing.assert_allclose(
        joined.max(1),
        alone.max(1),
        rtol=0.3 * weight,
    )
    assert np.abs(joined - alone).max() > 1e-4 * alone.max()


@pytest.mark.parametrize(
    "bound",
    [beam_sums.ROUNDED, np.float32(np.inf)],
)
@pytest.mark.parametrize("radiometry", ["paper", "lambertian"])
def test_echoes_are_the_histograms_strongest_bins_bit_for_bit(
    bound: np.float32, radiometry: Radiometry, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = prepare(
        Scene(
            RIG,
            object_depth(4, object_box(RIG))[1],
            radiometry=radiometry,
        ),
        STOPS["draft"],
    ).job
    job = job.select(np.arange(0, len(job.laser_spot_m), 7))
    # With bounds of infinity no window decides, and every beam sums all of its bins.
    window = backend_numba.strongest_in_window

    def undecided(*args: Any) -> Any:
        *found, sure = window(*args)
        return *found, sure & np.isfinite(bound)

    monkeypatch.setattr(backend_numba, "strongest_in_window", undecided)
    found = echoes(job)
    whole = strongest(histograms(job), job.bin_m)
    for name in ("peak", "runner_up", "path_m"):
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))


def test_scan_keeps_the_beams_that_the_object_stops() -> None:
    rig = load_rig("bare-wall").model_copy(update={"object_box": RIG.object_box})

    def leaving(share: float) -> Scene:
        """A plate in the lidar's sight until the middle of the scan."""
        return Scene(rig, np.full((8, 8), 0.06 if share < 0.5 else 0.39, np.float32))

    stopped = render_scan(leaving, COARSE).multi.stopped
    whole = render(leaving(0.0), COARSE).multi.stopped

    assert stopped.direct.shape == stopped.length_m.shape == (64, 80)
    np.testing.assert_array_equal(stopped.length_m[:32], whole.length_m[:32])
    assert np.isfinite(whole.length_m[32:]).any()
    assert np.isnan(stopped.length_m[32:]).all()


def _render_one_of_all(scene: Scene, *options: Any) -> list[Rendering]:
    return list(render_all([scene], *options))


@pytest.mark.parametrize("show", [render, transient, three_bounce, _render_one_of_all])
def test_unknown_backend_is_refused_also_of_a_bare_wall(show: Any) -> None:
    with pytest.raises(SceneError, match="no backend 'numpy'"):
        show(Scene(load_rig("bare-wall")), COARSE, "auto", "numpy")


@pytest.mark.parametrize("rows", [(-1, 4), (4, 4), (9, 4), (60, 65)])
def test_rows_that_the_map_does_not_have_are_refused(rows: tuple[int, int]) -> None:
    with pytest.raises(SceneError, match="rows are"):
        render(Scene(RIG), COARSE, rows=rows)
