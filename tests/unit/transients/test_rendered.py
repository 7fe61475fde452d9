"""Laws of rendered transients: what the captures of one scene have in common, energy, causality."""

from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration import rig_named
from nlos_calibration.arrays import Float64

from nlos_cam.errors import SceneError
from nlos_cam.objects import cell_centers_m, object_box
from nlos_cam.render import Accuracy, Scene, Surface, phong
from nlos_cam.transients import Capture, Noise, Transient, render_transient

RIG = rig_named("paper-rig")
BOX = object_box(RIG)
SIDE = 4
EXACT = Accuracy("exact", relay_columns=SIDE, relay_rows=SIDE, sub_bins=0)
"""Every path by itself, with the detector's wall in as many cells as the wall grid."""
SLOPE = np.linspace(0.2, 0.3, 6, dtype=np.float32)
DEPTH = np.where(np.eye(6, dtype=np.bool_)[::-1], np.nan, SLOPE + np.zeros((6, 6), np.float32))
MATT = Scene(RIG, DEPTH)
GLOSSY = Scene(RIG, DEPTH, Surface(0.8, phong(0.4, 0.6, 15)), "lambertian")
SCENES = pytest.mark.parametrize("scene", [MATT, GLOSSY], ids=["matt", "glossy"])


def rendered(scene: Scene, kind: str, **options: object) -> Transient:
    capture = Capture(kind, SIDE, bins=230, **options)  # pyright: ignore[reportArgumentType]
    return render_transient(scene, capture, EXACT)


@SCENES
def test_confocal_is_the_diagonal_of_exhaustive(scene: Scene) -> None:
    every = rendered(scene, "exhaustive").matrix
    confocal = rendered(scene, "confocal").matrix[:, 0]

    assert confocal.any()
    assert np.array_equal(confocal, np.diagonal(every, axis1=1, axis2=2))


@SCENES
def test_lidar_is_the_sum_over_the_detectors_wall(scene: Scene) -> None:
    every = rendered(scene, "exhaustive").matrix
    lidar = rendered(scene, "lidar").matrix[:, :, 0]

    assert lidar.any()
    assert np.allclose(lidar, every.sum(2), rtol=1e-5, atol=1e-6 * lidar.max())


def test_single_is_one_laser_point_of_exhaustive() -> None:
    every = rendered(MATT, "exhaustive")
    x_m, y_m, _ = every.laser_grid_m[2, 1]
    single = rendered(MATT, "single", laser_m=(x_m, y_m))

    assert np.array_equal(single.histograms, every.histograms[:, 2, 1])


def surface_m() -> Float64:
    """Middles (n, 3) of the object's cells."""
    x_m, y_m = cell_centers_m(BOX, len(DEPTH))
    row, column = np.nonzero(~np.isnan(DEPTH))
    return np.stack([x_m[column], y_m[row], DEPTH[row, column]], -1)


def test_no_light_arrives_before_the_shortest_path() -> None:
    confocal = rendered(MATT, "confocal")
    points, _ = confocal.points
    lidar_m = RIG.wall_from_lidar[:3, 3]
    to_wall = np.linalg.norm(points - lidar_m, axis=-1)
    to_object = np.linalg.norm(points[:, None] - surface_m(), axis=-1).min(1)
    earliest = np.floor(2 * (to_wall + to_object) / confocal.bin_m)
    lit = confocal.matrix[:, 0].any(0)
    first = (confocal.matrix[:, 0] != 0).argmax(0)

    assert lit.any()
    assert (first >= earliest)[lit].all()
    assert (first == earliest)[lit].any()


def test_energy_is_the_rendering_equation_of_one_patch() -> None:
    depth_m = np.array([[0.3]], np.float32)
    scene = Scene(replace_box(), depth_m, Surface(0.5), "lambertian")
    found = render_transient(scene, Capture("single", 8, laser_m=(0.3, 0.02)), EXACT)
    patch = np.array([0.45, 0.0, 0.3])
    spot = np.array([0.3, 0.02, 0.0])
    lidar = RIG.wall_from_lidar[:3, 3]
    cells = found.points[1]
    area_m2 = 0.01**2
    d2 = np.linalg.norm(spot - patch)
    d3 = np.linalg.norm(cells - patch, axis=-1)
    d4 = np.linalg.norm(cells - lidar, axis=-1)
    # Each bounce spreads by 1 / pi; each leg has a cosine at both ends and 1 / d^2. Far from
    # contact.
    there = 0.5 * area_m2 * (0.3 / d2) ** 2 / d2**2
    cell_m2 = (0.5 / 8) ** 2
    back = cell_m2 * (0.3 / d3) ** 2 / d3**2 * 1e-4 * (lidar[2] / d4) / d4**2
    energy = there * back / np.pi**3
    seen = found.curve.sum() > 0
    lit = found.matrix[:, 0].sum(0)

    assert seen
    assert np.allclose(lit[lit > 0], energy[lit > 0], rtol=0.02)


def replace_box() -> object:
    """The rig with a small box, far from the wall, so that one cell is a small patch."""
    box = BOX.model_copy(
        update={"x_min_m": 0.445, "x_max_m": 0.455, "y_min_m": -0.005, "y_max_m": 0.005}
    )
    return RIG.model_copy(update={"object_box": box})


def test_legs_left_out_shift_each_histogram() -> None:
    whole = rendered(MATT, "confocal", bin_m=0.001).matrix[:, 0]
    inner = render_transient(
        MATT, Capture("confocal", SIDE, bins=2300, bin_m=0.001, first_and_last=False), EXACT
    )
    lidar_m = RIG.wall_from_lidar[:3, 3]
    legs_m = 2 * np.linalg.norm(inner.points[0] - lidar_m, axis=-1)
    outer = render_transient(MATT, Capture("confocal", SIDE, bins=2300, bin_m=0.001), EXACT)
    lit = outer.matrix[:, 0].any(0)
    apart = [(one[:, 0] != 0).argmax(0)[lit] for one in (outer.matrix, inner.matrix)]

    assert whole.shape[0] == 230
    assert not inner.first_and_last
    assert np.allclose(outer.curve.sum(), inner.curve.sum(), rtol=1e-6)
    assert np.abs(0.001 * (apart[0] - apart[1]) - legs_m[lit]).max() <= 0.0011


def test_window_is_a_part_of_the_whole_also_with_a_pulse() -> None:
    scene = replace(MATT, pulse_ns=0.3)
    whole = rendered(scene, "confocal")
    part = render_transient(scene, Capture("confocal", SIDE, start_m=1.15, bins=20), EXACT)

    assert part.start_m == pytest.approx(1.15)
    assert part.histograms.any()
    assert np.allclose(
        part.histograms, whole.histograms[115:135], atol=1e-6 * whole.histograms.max()
    )


def test_pulse_keeps_energy_and_mean_arrival() -> None:
    sharp = rendered(MATT, "confocal").curve
    wide = rendered(replace(MATT, pulse_ns=0.2), "confocal").curve
    path = np.arange(230)

    assert wide.max() < 0.9 * sharp.max()
    assert wide.sum() == pytest.approx(sharp.sum(), rel=1e-3)
    assert (wide @ path) / wide.sum() == pytest.approx((sharp @ path) / sharp.sum(), abs=0.05)


def test_noise_counts_the_photons_it_was_given() -> None:
    light = rendered(MATT, "confocal").matrix[:, 0]
    noisy = rendered(MATT, "confocal", noise=Noise(1e5, background=2.0, seed=3))
    counts = noisy.matrix[:, 0]
    expected = light * (1e5 / light.sum(0).max()) + 2.0
    again = rendered(MATT, "confocal", noise=Noise(1e5, background=2.0, seed=3))

    assert np.array_equal(counts, np.round(counts))
    assert np.array_equal(counts, again.matrix[:, 0])
    # The sum of squared residuals over the variance has the mean 1 per bin of Poisson counts.
    assert np.mean((counts - expected) ** 2 / expected) == pytest.approx(1, abs=0.15)


def test_noise_does_not_hide_that_no_light_returns() -> None:
    with pytest.raises(SceneError, match="no light returns"):
        rendered(Scene(RIG), "confocal", noise=Noise(100.0, background=2.0))


def test_points_that_the_lidar_cannot_see_give_no_light() -> None:
    found = rendered(MATT, "exhaustive").histograms.sum(0)
    points, _ = rendered(MATT, "exhaustive").points
    occluder = RIG.occluder
    assert occluder
    lidar_m = RIG.wall_from_lidar[:3, 3]
    share = (occluder.x_m - lidar_m[0]) / (points[:, 0] - lidar_m[0])
    height = lidar_m[2] * (1 - share)
    hidden = (share < 1) & (height >= occluder.z_min_m)
    pairs = found.reshape(SIDE**2, SIDE**2)

    assert hidden.any()
    assert not pairs[hidden].any()
    assert not pairs[:, hidden].any()
    assert pairs[~hidden][:, ~hidden].any()


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"kind": "exhaustive", "cells": 128}, "GiB"),
        ({"kind": "lidar", "cells": 128, "bin_m": 1e-5, "bins": 100}, "GiB"),
        ({"kind": "lidar", "first_and_last": False}, "wide detector"),
        ({"kind": "confokal"}, "confocal"),
        ({"kind": "confocal", "cells": 0}, "0 cells"),
        ({"bin_m": 0.0}, "bin_m"),
        ({"start_m": float("nan")}, "start_m"),
        ({"kind": "confocal", "laser_m": (0.0, 0.0)}, "single"),
        ({"kind": "single", "laser_m": (50.0, 0.0)}, "not on the wall"),
        ({"kind": "single", "laser_m": (float("nan"), 0.0)}, "not on the wall"),
    ],
)
def test_capture_out_of_range_is_refused(options: dict[str, object], word: str) -> None:
    with pytest.raises(SceneError, match=word):
        render_transient(MATT, Capture(**options), EXACT)  # pyright: ignore[reportArgumentType]


def test_capture_of_too_many_paths_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.transients.rendered.MAX_TABLES", 1 << 10)
    with pytest.raises(SceneError, match="the paths from the object"):
        render_transient(MATT, Capture("confocal", cells=8), EXACT)


@pytest.mark.parametrize("photons", [0.0, -1.0, float("nan")])
def test_noise_of_no_photons_is_refused(photons: float) -> None:
    with pytest.raises(SceneError, match="photons is"):
        Noise(photons)


def test_noise_of_a_negative_seed_is_refused() -> None:
    with pytest.raises(SceneError, match="seed is -1"):
        Noise(10.0, seed=-1)
