"""The sensor: echoes to the three images a device delivers, pixel by pixel.

In order: the map cells' multi-bounce echoes are spread over their pixels, where they compete with each pixel's own
direct return (S5); gain, shot and read noise, saturation and 8-bit quantisation make the IR; range noise and 0.25 mm
quantisation make the depth; margin and counts make the confidence; no confidence and dead pixels give no depth.

Not modelled: pulse width, ambient light, the raster's scan time, ripples, drift with temperature, mixed edges.
"""

from dataclasses import dataclass

import numba
import numpy as np
from nlos_calibration.projection import Intrinsics
from nlos_calibration.rig import Record, Rig
from numpy.typing import NDArray
from pydantic import Field

from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, Float32, Frame
from nlos_cam.render.beams import Beams, cast
from nlos_cam.render.renderer import MultiBounce

DEPTH_UNIT_M = 0.00025
"""The L515's Z16 unit."""
SATURATED = 255
MOST_CONFIDENT = 15
SURE_COUNTS = 6.0
"""IR counts at which the signal alone gives 63 % of the confidence it can give."""

Bytes = NDArray[np.uint8]


class SensorModel(Record):
    """Noise and gain. Every field at 0 (and the gain) leaves quantisation alone."""

    bare_wall_counts: float = Field(default=48.0, gt=0)
    """IR counts of the brightest bare-wall return: fixes the gain."""
    range_noise_m: float = Field(default=0.0005, ge=0)
    range_noise_per_m: float = Field(default=0.002, ge=0)
    """Standard deviation of range: the one, plus the other for each metre of depth."""
    read_noise_counts: float = Field(default=0.7, ge=0)
    shot_noise: float = Field(default=0.3, ge=0)
    """Standard deviation over the square root of the counts."""
    dead_share: float = Field(default=0.002, ge=0, lt=1)
    """Share of pixels that never give depth; which ones is a matter of the sensor, not of the frame."""


@dataclass(frozen=True)
class SensedImages:
    """One frame as the device delivers it."""

    depth_z16: NDArray[np.uint16]
    """(height, width); in units of 0.25 mm, 0 is no depth."""
    ir: Bytes
    """(height, width)."""
    confidence: Bytes
    """(height, width); 0 to 15."""

    def frame(self, intrinsics: Intrinsics) -> Frame:
        """The same in SI units, as a camera would yield it."""
        depth_m = np.where(self.depth_z16 == 0, np.float32(np.nan), self.depth_z16 * np.float32(DEPTH_UNIT_M))
        return Frame(depth_m, self.ir, self.confidence, timestamp_s=0.0, frame_number=0, intrinsics=intrinsics)


@numba.njit(cache=True)
def _expose(
    direct: Float32,
    length: Float32,
    cos_axis: Float32,
    peak: Float32,
    runner_up: Float32,
    path_m: Float32,
    cell: NDArray[np.int32],
    noise: Float32,
    alive: NDArray[np.bool_],
    gain: float,
    range_noise_m: float,
    range_noise_per_m: float,
    read_noise: float,
    shot_noise: float,
) -> tuple[NDArray[np.uint16], Bytes, Bytes]:
    z16, ir, confidence = (
        np.zeros(direct.size, np.uint16),
        np.zeros(direct.size, np.uint8),
        np.zeros(direct.size, np.uint8),
    )
    for i in range(direct.size):
        c = cell[i]
        wins = peak[c] > direct[i]
        intensity = peak[c] if wins else direct[i]
        if intensity <= 0:
            continue
        second = max(direct[i] if wins else peak[c], runner_up[c])
        depth = (path_m[c] / 2 if wins else length[i]) * cos_axis[i]
        counts = gain * intensity
        seen = counts + noise[0, i] * np.sqrt(read_noise**2 + shot_noise**2 * counts)
        ir[i] = min(max(int(np.floor(seen + 0.5)), 0), SATURATED)
        # how sure: the winner's lead, weighted by how far the signal stands above the noise
        sure = (1 - np.exp(-counts / SURE_COUNTS)) * (0.5 + 0.5 * (1 - second / intensity))
        confidence[i] = int(MOST_CONFIDENT * sure + 0.5)
        if confidence[i] == 0 or not alive[i]:
            continue
        depth += noise[1, i] * (range_noise_m + range_noise_per_m * depth)
        z16[i] = min(max(int(np.floor(depth / DEPTH_UNIT_M + 0.5)), 0), 65535)
    return z16, ir, confidence


class Sensor:
    """A sensor on a rig: what depends on neither the object nor the frame is worked out once."""

    def __init__(self, rig: Rig, model: SensorModel) -> None:
        self.rig, self.model = rig, model
        pinhole = rig.pinhole
        beams: Beams = cast(rig, pinhole)
        self._direct, self._length = beams.direct.astype(np.float32), beams.length_m.astype(np.float32)
        self._cos_axis = beams.cos_axis.astype(np.float32)
        bare = rig.model_copy(update={"occluder": None})
        brightest = cast(bare, pinhole).direct.max()
        self._gain = model.bare_wall_counts / brightest if brightest > 0 else 0.0
        self._alive = np.random.default_rng(0).random(self._direct.size) >= model.dead_share
        row = (np.arange(pinhole.height) + 0.5) * MAP_ROWS // pinhole.height
        column = (np.arange(pinhole.width) + 0.5) * MAP_COLUMNS // pinhole.width
        self._cell = (row[:, None] * MAP_COLUMNS + column).astype(np.int32).ravel()

    def expose(self, multi: MultiBounce, generator: np.random.Generator) -> SensedImages:
        """The images of one instant, with the generator's noise."""
        model = self.model
        z16, ir, confidence = _expose(
            self._direct,
            self._length,
            self._cos_axis,
            multi.peak.ravel(),
            multi.runner_up.ravel(),
            multi.path_m.ravel(),
            self._cell,
            generator.standard_normal((2, self._direct.size), np.float32),
            self._alive,
            self._gain,
            model.range_noise_m,
            model.range_noise_per_m,
            model.read_noise_counts,
            model.shot_noise,
        )
        shape = (self.rig.intrinsics.height, self.rig.intrinsics.width)
        return SensedImages(z16.reshape(shape), ir.reshape(shape), confidence.reshape(shape))
