"""Noise and bias of the maps: from frames of the sensor's own chain, and how the noise falls as frames are averaged."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from difference_waveform import Array
from nlos_calibration.rig import Rig
from nlos_calibration.wall import fit_wall, wall_depth
from numpy.typing import NDArray

from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, maps_from_frame
from nlos_cam.render.geometry import cast
from nlos_cam.render.renderer import MultiBounce
from nlos_cam.render.sensor.bias import DepthBias
from nlos_cam.render.sensor.effects import sensor_effects
from nlos_cam.render.sensor.model import SensorModel, WarmUp
from nlos_cam.render.sensor.sensor import Sensor

USUAL_NOISE_FRAMES = 300
COLD_CELSIUS, WARM_CELSIUS = 25.0, 45.0
REFERENCE_CELSIUS = 35.0
"""The device's temperature while the bare wall was measured."""


def biased(ripple_m: float = 0.0, offset_m: float = 0.0) -> SensorModel:
    """The sensor's defaults, with ripples, an offset and drift: 0.1 mm a degree, patches of 1 mm over 20 degrees."""
    return SensorModel(
        ripple_m=ripple_m,
        range_offset_m=offset_m,
        patch_drift_m=0.001,
        drift_m_per_celsius=0.0001,
        warm_up=WarmUp(from_celsius=COLD_CELSIUS, to_celsius=WARM_CELSIUS, time_constant_s=900.0),
    )


@dataclass(frozen=True)
class MapNoise:
    """What single frames' maps of the bare wall spread by."""

    depth_m: Array
    """(64, 80); standard deviation, NaN where a cell has no depth."""
    counts: Array
    """(64, 80)."""
    frames: int
    falls: list[dict[str, float]]
    """RMS deviation of means over so many frames, over the cells, and over what 1 / sqrt(frames) says of it."""


def maps_of(
    sensor: Sensor, multi: MultiBounce, numbers: Iterable[int], celsius: float | None = None
) -> tuple[Array, Array]:
    """Depth and intensity maps (n, 64, 80) of frames of the chain; each number seeds its frame's noise."""
    frames = [
        maps_from_frame(sensor.expose(multi, np.random.default_rng([k, 5]), celsius=celsius).frame(sensor.rig.pinhole))
        for k in numbers
    ]
    depth_m, counts = (np.stack([getattr(one, name) for one in frames]) for name in ("depth_m", "intensity"))
    return depth_m.astype(np.float64), counts.astype(np.float64)


def noise_of(depth_m: Array, counts: Array, averaged: Iterable[int] = (1, 3, 10, 30, 100)) -> MapNoise:
    """The noise of frames' maps (n, 64, 80), and how it falls: the mean of each block of frames against that of all."""
    frames = len(depth_m)
    seen = np.isfinite(depth_m).all(0)
    depth_std_m = np.where(seen, depth_m.std(0, ddof=1), np.nan)
    counts_std = counts.std(0, ddof=1)
    falls = [
        {
            "frames": n,
            "depth_um": 1e6 * (spread := block_spread(depth_m[:, seen], n)),
            "depth_over_law": spread / rms(depth_std_m[seen] / np.sqrt(n)),
            "counts": (counts_spread := block_spread(counts[:, seen], n)),
            "counts_over_law": counts_spread / rms(counts_std[seen] / np.sqrt(n)),
        }
        for n in averaged
        if 2 * n <= frames
    ]
    return MapNoise(depth_std_m, counts_std, frames, falls)


def rms(values: Array) -> float:
    """The root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))


def block_spread(frames: Array, averaged: int) -> float:
    """RMS over cells of the standard deviation of means of `averaged` frames each; frames (n, cells)."""
    blocks = len(frames) // averaged
    means = frames[: blocks * averaged].reshape(blocks, averaged, -1).astype(np.float64).mean(1)
    return rms(means.std(0, ddof=1))


def cell_means(image: Array) -> Array:
    """Means (64, 80) over the pixels of each cell, of an image (480, 640): 8 columns by 7 or 8 rows."""
    columns = image.reshape(image.shape[0], MAP_COLUMNS, -1).mean(-1)
    edges = np.ceil(np.arange(MAP_ROWS) * image.shape[0] / MAP_ROWS - 0.5).astype(int).clip(0)
    sizes = np.diff([*edges, image.shape[0]])
    return np.add.reduceat(columns, edges, axis=0) / sizes[:, None]


def wall_cells(rig: Rig) -> NDArray[np.bool_]:
    """The cells (64, 80) all of whose pixels see the wall."""
    seen = cast(rig, rig.pinhole).on_wall.reshape(rig.pinhole.height, rig.pinhole.width)
    return cell_means(seen.astype(np.float64)) == 1


class Pattern:
    """The fixed pattern that a device's bias leaves in the maps, at one temperature while the wall was measured."""

    def __init__(self, rig: Rig, model: SensorModel) -> None:
        self._shape = rig.pinhole.height, rig.pinhole.width
        self._bias = DepthBias(self._shape, model, sensor_effects(model))
        self._rig = rig

    def bias_m(self, celsius: float) -> Array:
        """(480, 640); what each pixel's depth is too much by."""
        bias_m = self._bias.at_m(celsius)
        return bias_m.reshape(self._shape).astype(np.float64) if bias_m.size else np.zeros(self._shape)

    def drift_m(self, celsius: float) -> Array:
        """(64, 80); left in a difference map at some temperature, when the reference is from REFERENCE_CELSIUS."""
        return cell_means(self.bias_m(celsius) - self.bias_m(REFERENCE_CELSIUS))

    def misfit_m(self, celsius: float) -> tuple[Array, str]:
        """(64, 80) left in a raw map when the ideal wall of the plane is subtracted that was fitted at the reference.

        The fit is `fit_wall` to the biased depth of the wall alone, without noise. Also tells its verdict.
        """
        bare = self._rig.model_copy(update={"occluder": None, "object_box": None})
        true_m = wall_depth(bare.wall_from_lidar, bare.pinhole)
        beams = cast(bare, bare.pinhole)
        seen_m = np.where(beams.on_wall.reshape(self._shape), true_m + self.bias_m(REFERENCE_CELSIUS), np.nan)
        fit = fit_wall(seen_m, bare.pinhole, np.random.default_rng(0))
        left_m = true_m + self.bias_m(celsius) - wall_depth(fit.wall_from_lidar, bare.pinhole)
        return cell_means(np.where(np.isfinite(left_m), left_m, 0.0)), fit.verdict
