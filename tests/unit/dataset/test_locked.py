"""Locked differences: what an object changes in Lambertian radiometry, and the noise of many frames."""

import numpy as np
import pytest
from nlos_calibration import load_rig
from nlos_models import CellNormal
from nlos_models.training import MapSet

from nlos_cam.adapt import Locked, LockedNoise, Stage
from nlos_cam.dataset import difference_noise, locked_difference
from nlos_cam.objects import benchmark_objects, object_box
from nlos_cam.render import Scene, SensorModel, cast, transient

RIG = load_rig("paper-rig")
SENSOR = SensorModel(pulse_ns=1.0)
LOCKED = Locked(frames=9000)


def scene_of(depth_m: object) -> Scene:
    return Scene(RIG, depth_m, radiometry="lambertian", pulse_ns=1.0)  # type: ignore[arg-type]


def test_nothing_hidden_changes_nothing() -> None:
    found = locked_difference(scene_of(None), SENSOR)

    assert not found.intensity.any()
    assert not np.nan_to_num(found.depth_m).any()


def test_object_moves_the_peak_by_micrometers() -> None:
    depth_m = benchmark_objects(object_box(RIG))[20].depth_m
    found = locked_difference(scene_of(depth_m), SENSOR)

    # docs/detect.md: 25 um at most, for another object
    assert 1e-5 < np.nanmax(np.abs(found.depth_m)) < 5e-5
    assert found.intensity.min() >= 0
    assert 1e-4 < found.intensity.max() < 1e-2


def test_peak_is_that_of_the_whole_waveform() -> None:
    """Fast against reference: the parabola through three samples of the convolved histograms."""
    depth_m = benchmark_objects(object_box(RIG))[0].depth_m
    wave, bare = (
        transient(scene_of(each), "draft").astype(np.float64).reshape(64 * 80, -1)
        for each in (depth_m, None)
    )
    top = bare.argmax(axis=1)
    beams = cast(RIG, RIG.pinhole.scaled(80, 64), lambertian=True)
    inside = (beams.direct > 0) & (top >= 5)

    def shift(waves: np.ndarray) -> np.ndarray:
        cells = np.arange(len(waves))
        before, middle, after = (np.log(waves[cells, top + k]) for k in (-5, 0, 5))
        return 5 * (before - after) / (2 * (before - 2 * middle + after))

    bins = shift(wave[inside]) - shift(bare[inside])

    found = locked_difference(scene_of(depth_m), SENSOR).depth_m.ravel()[inside]
    expected = bins * RIG.device.bin_m / 2 * beams.cos_axis[inside]
    # what inter-reflection adds is left out
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.03 * np.sqrt(np.mean(expected**2))


def test_noise_falls_with_the_root_of_the_frames() -> None:
    few = difference_noise(RIG, SENSOR, "lambertian", 900)
    more = difference_noise(RIG, SENSOR, "lambertian", 3600)

    np.testing.assert_allclose(more, few / 2, rtol=1e-6)


def test_every_cell_that_returns_light_has_noise() -> None:
    """A pulse lowers the peaks and raises the gain: without it in the bare wall, cells saturate."""
    noise = difference_noise(RIG, SENSOR, "lambertian", 900)

    assert np.isfinite(noise[0]).mean() > 0.9
    assert noise[:, np.isfinite(noise[0])].min() > 0


def test_normalized_noise_has_one_strength_in_all_cells() -> None:
    noise = LockedNoise.of(RIG, SENSOR, LOCKED)
    normal = CellNormal()
    some = MapSet(*np.zeros((2, 1, 64, 80), np.float32), np.zeros((1, 64, 64), np.float16))
    strong = MapSet(some.depth_m + 1e-5, some.intensity + 0.1, some.image)

    recipe = noise.fitted(
        Stage(minutes=1.0, objects=100, epochs=1, steps=9).recipe(), normal, strong
    )

    many = MapSet(*np.zeros((2, 200, 64, 80), np.float32), np.zeros((200, 64, 64), np.float16))
    import torch

    maps = noise.added_to(many)
    seen = normal(torch.from_numpy(maps.depth_m), torch.from_numpy(maps.intensity))
    strength = seen[:, 0][:, 20:44].std(dim=0)
    assert recipe.noise < 1
    assert float(strength.median()) == pytest.approx(recipe.noise, rel=0.1)
