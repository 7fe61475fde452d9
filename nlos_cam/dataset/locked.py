"""Locked differences: maps with the object in less those with it out, in turns, averaged over many
frames.

Drift cancels in the turns (docs/detect.md), so that the sensor's noise is all that is left, and it
falls with the root of the number of frames. In Lambertian radiometry three-bounce light is weaker
than the wall's own return everywhere: it raises the waveform's peak a little and moves it by
micrometers, which one frame does not show.
"""

from functools import lru_cache

import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Float32, Float64
from numpy.typing import NDArray

from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, LidarMaps
from nlos_cam.render import Radiometry, Scene, Sensor, SensorModel, cast, render, transient

LOCKED = "locked differences"
"""Accuracy of a plan whose samples are locked differences, rendered in draft accuracy: no other
reader takes them for maps."""
ACCURACY = "draft"
STENCIL = 5
"""Bins between the three samples through which a peak is interpolated."""
NOISE_DRAWS = 60


def locked_difference(scene: Scene, sensor: SensorModel) -> LidarMaps:
    """Return what a hidden object changes, without noise: depth in m, intensity in counts; NaN
    depth where the bare wall returns nothing.
    """
    # The records are frozen, so hashable, which pyright does not see.
    bare = _bare(
        scene.rig,  # pyright: ignore[reportArgumentType]
        sensor,  # pyright: ignore[reportArgumentType]
        scene.radiometry,
        scene.pulse_ns,
    )
    if scene.pulse_ns:
        place_m, peak = _peaks(scene, _waves(scene), bare.top)
        depth_m = place_m - bare.depth_m
    else:
        found = render(scene, ACCURACY)
        depth_m = found.depth_m - bare.depth_m
        peak = found.intensity.astype(np.float64)
    share = np.divide(peak, bare.peak, out=np.ones_like(bare.peak), where=bare.peak > 0)
    counts = bare.counts * (share - 1.0)
    valid = np.isfinite(depth_m)
    return LidarMaps(
        depth_m.astype(np.float32), np.where(valid, counts, 0).astype(np.float32), valid
    )


def difference_noise(rig: Rig, sensor: SensorModel, radiometry: Radiometry, frames: int) -> Float32:
    """Return the standard deviation of a locked difference of `frames` frames in all, half of them
    with the object: (2, 64, 80), in m and counts; NaN where nothing returns.
    """
    device = Sensor(rig, sensor, radiometry)
    echoes = render(Scene(rig, None, radiometry=radiometry), ACCURACY).multi
    generator = np.random.default_rng(0)
    drawn = [device.maps(echoes, generator) for _ in range(NOISE_DRAWS)]
    maps = np.stack([[each.depth_m, each.intensity] for each in drawn]).astype(np.float64)
    # The mean of N / 2 frames has 2 / N of a frame's variance, a difference of two means 4 / N.
    return (maps.std(axis=0, ddof=1) * 2.0 / np.sqrt(frames)).astype(np.float32)


class _Bare:
    """Bare wall as the difference's subtrahend."""

    def __init__(self, scene: Scene, sensor: SensorModel) -> None:
        rendering = render(scene, ACCURACY)
        device = Sensor(scene.rig, sensor, scene.radiometry)
        self.counts = device.maps(rendering.multi, None).intensity.astype(np.float64)
        self.top = np.zeros((MAP_ROWS, MAP_COLUMNS), np.int64)
        """Bin of each cell's peak: light of the object moves the peak within it."""
        if scene.pulse_ns:
            waves = _waves(scene)
            self.top = np.clip(waves.argmax(axis=-1), STENCIL, waves.shape[-1] - STENCIL - 1)
            self.depth_m, self.peak = _peaks(scene, waves, self.top)
        else:
            self.depth_m = rendering.depth_m.astype(np.float64)
            self.peak = rendering.intensity.astype(np.float64)


@lru_cache(maxsize=2)
def _bare(rig: Rig, sensor: SensorModel, radiometry: Radiometry, pulse_ns: float) -> _Bare:
    return _Bare(Scene(rig, None, radiometry=radiometry, pulse_ns=pulse_ns), sensor)


def _waves(scene: Scene) -> Float64:
    return transient(scene, ACCURACY).astype(np.float64)


def _peaks(scene: Scene, wave: Float64, top: NDArray[np.int64]) -> tuple[Float64, Float64]:
    """Return depth in m and height of each cell's peak (64, 80), about the bin `top`, for a receiver
    that interpolates between its samples; the renderer reports the middle of a bin. NaN depth where
    nothing returns.
    """
    steps = (-STENCIL, 0, STENCIL)
    samples = [np.take_along_axis(wave, (top + k)[..., None], -1)[..., 0] for k in steps]
    # The logarithm of a Gaussian is a parabola: its top from three samples.
    before, middle, after = np.log(np.maximum(samples, 1e-30))
    curved = before - 2.0 * middle + after
    flat = curved >= 0.0
    shift = np.where(flat, 0.0, (before - after) / np.where(flat, 1.0, 2.0 * curved))

    # Half of the path there and back; bins of path along the beam, depth along the axis.
    rig = scene.rig
    beams = cast(
        rig,
        rig.pinhole.scaled(MAP_COLUMNS, MAP_ROWS),
        lambertian=scene.radiometry == "lambertian",
    )
    along = beams.cos_axis.reshape(top.shape)
    depth_m = (top + 0.5 + shift * STENCIL) * rig.device.bin_m / 2.0 * along
    returns = beams.direct.reshape(top.shape) > 0
    return np.where(returns, depth_m, np.nan), wave.max(axis=-1)
