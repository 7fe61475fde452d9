"""Locked differences: maps with the object in less those with it out, in turns, averaged over many
frames.

Drift cancels in the turns (docs/detect.md), so that the sensor's noise is all that is left, and it
falls with the root of the number of frames. In Lambertian radiometry three-bounce light is weaker
than the wall's own return everywhere: it raises the waveform's peak a little and moves it by
micrometers, which one frame does not show.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Float32, Float64

from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, LidarMaps
from nlos_cam.render import (
    Radiometry,
    Scene,
    Sensor,
    SensorModel,
    cast,
    render,
    three_bounce,
    transient,
    with_pulse,
)

LOCKED = "locked differences"
"""Accuracy of a plan whose samples are locked differences, rendered in draft accuracy: no other
reader takes them for maps."""
ACCURACY = "draft"
OF_THE_OBJECT = ("three-bounce", "occluder", "self-occlusion", "tilt", "brdf")
"""Effects of the light that an object adds. Inter-reflection is not among them: it comes later, past
most of the pulse, and changes a difference by 2.5 % at most (14 of the test objects, 1 ns)."""
STENCIL = 5
"""Bins between the three samples through which a peak is interpolated."""
STEPS = np.array([-STENCIL, 0, STENCIL])
"""Bins of those samples, from the strongest one."""
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
    if bare.receiver:
        added = three_bounce(scene, ACCURACY, OF_THE_OBJECT)
        depth_m, peak = bare.receiver.peaks(added)
    else:
        found = render(scene, ACCURACY)
        depth_m = found.depth_m.astype(np.float64)
        peak = found.intensity.astype(np.float64)
    share = np.divide(peak, bare.peak, out=np.ones_like(bare.peak), where=bare.peak > 0)
    counts = bare.counts * (share - 1.0)
    moved_m = depth_m - bare.depth_m
    valid = np.isfinite(moved_m)
    return LidarMaps(
        moved_m.astype(np.float32), np.where(valid, counts, 0).astype(np.float32), valid
    )


def difference_noise(rig: Rig, sensor: SensorModel, radiometry: Radiometry, frames: int) -> Float32:
    """Return the standard deviation of a locked difference of `frames` frames in all, half of them
    with the object: (2, 64, 80), in m and counts; NaN where nothing returns.
    """
    device = Sensor(rig, sensor, radiometry)
    # The pulse lowers the peaks, and the sensor's gain makes up for it: without the pulse in the
    # scene every cell would be saturated, and have no noise.
    bare = Scene(rig, None, radiometry=radiometry, pulse_ns=sensor.pulse_ns)
    echoes = render(bare, ACCURACY).multi
    generator = np.random.default_rng(0)
    drawn = [device.maps(echoes, generator) for _ in range(NOISE_DRAWS)]
    maps = np.stack([[each.depth_m, each.intensity] for each in drawn]).astype(np.float64)
    # The mean of N / 2 frames has 2 / N of a frame's variance, a difference of two means 4 / N.
    return (maps.std(axis=0, ddof=1) * 2.0 / np.sqrt(frames)).astype(np.float32)


def interpolated_peak(samples: Float64) -> tuple[Float64, Float64]:
    """Return the place, in bins from the middle one, and the height of the peak through three
    samples (..., 3) of a waveform, STENCIL bins apart; no shift where they do not bend down.
    """
    # The logarithm of a Gaussian is a parabola: its top from three samples.
    before, middle, after = np.moveaxis(np.log(np.maximum(samples, 1e-30)), -1, 0)
    curved = before - 2.0 * middle + after
    bent = np.where(curved < 0.0, curved, -np.inf)
    shift = (before - after) / (2.0 * bent)
    return shift * STENCIL, np.exp(middle - (before - after) ** 2 / (8.0 * bent))


class _Receiver:
    """Receiver that interpolates each cell's peak between three samples of the waveform, about the
    bare wall's strongest bin: light of an object moves the peak within it. The renderer reports the
    middle of a bin.
    """

    def __init__(self, scene: Scene, returns: Float32) -> None:
        """Take a scene, and the light (n, bins) of its bare wall before the pulse."""
        bin_m = scene.rig.device.bin_m
        self._top = returns.argmax(axis=1)
        # A lone bin's light is spread over itself and `half` bins on each side.
        half = with_pulse(np.ones((1, 1), np.float32), scene.pulse_ns, bin_m).shape[1] - 1
        self._reach = half + STENCIL
        lone = np.eye(2 * self._reach + 1, dtype=np.float32)
        self._weights = with_pulse(lone, scene.pulse_ns, bin_m)[:, self._reach + STEPS]

        # Half of the path there and back; bins of path along the beam, depth along the axis.
        rig = scene.rig
        intrinsics = rig.pinhole.scaled(MAP_COLUMNS, MAP_ROWS)
        beams = cast(rig, intrinsics, lambertian=scene.radiometry == "lambertian")
        self._depth_of_bin_m = bin_m / 2.0 * beams.cos_axis
        self._returns = beams.direct > 0
        self._bare = self._samples(returns)

    def _samples(self, histograms: Float32) -> Float64:
        """Return the waveform (n, 3) at the three samples, of light (n, bins) before the pulse."""
        reach = self._reach
        after = max(int(self._top.max()) + reach + 1 - histograms.shape[1], 0)
        padded = np.pad(histograms, [(0, 0), (reach, after)])
        # A waveform is linear in the light, so three weighted sums stand for the whole convolution.
        near = self._top[:, None] + np.arange(2 * reach + 1)
        light = np.take_along_axis(padded, near, axis=1)
        return (light @ self._weights).astype(np.float64)

    def peaks(self, added: Float32 | None = None) -> tuple[Float64, Float64]:
        """Return depth in m and height of each cell's peak (64, 80), of the bare wall and light
        (n, bins) added to it; NaN depth where nothing returns.
        """
        samples = self._bare if added is None else self._bare + self._samples(added)
        shift, height = interpolated_peak(samples)
        depth_m = (self._top + 0.5 + shift) * self._depth_of_bin_m
        depth_m = np.where(self._returns, depth_m, np.nan)
        return depth_m.reshape(MAP_ROWS, MAP_COLUMNS), height.reshape(MAP_ROWS, MAP_COLUMNS)


class _Bare:
    """Bare wall as the difference's subtrahend."""

    def __init__(self, scene: Scene, sensor: SensorModel) -> None:
        rendering = render(scene, ACCURACY)
        device = Sensor(scene.rig, sensor, scene.radiometry)
        self.counts = device.maps(rendering.multi, None).intensity.astype(np.float64)
        self.receiver: _Receiver | None = None
        self.depth_m = rendering.depth_m.astype(np.float64)
        self.peak = rendering.intensity.astype(np.float64)
        if scene.pulse_ns:
            returns = transient(replace(scene, pulse_ns=0.0), ACCURACY)
            self.receiver = _Receiver(scene, returns.reshape(MAP_ROWS * MAP_COLUMNS, -1))
            self.depth_m, self.peak = self.receiver.peaks()


@lru_cache(maxsize=2)
def _bare(rig: Rig, sensor: SensorModel, radiometry: Radiometry, pulse_ns: float) -> _Bare:
    return _Bare(Scene(rig, None, radiometry=radiometry, pulse_ns=pulse_ns), sensor)
