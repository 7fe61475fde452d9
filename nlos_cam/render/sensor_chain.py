"""The sensor's stages, in the order in which light meets them, and the loop that leads each pixel through them.

    echo (S5) -> wall texture -> gain -> ambient light -> shot and read noise -> saturation -> 8 bits            IR
    signal above the noise, winner above the second -> 4 bits                                    confidence
    path / 2 x cos(beam, optical axis) -> bias -> range noise -> 0.25 mm -> dead pixels          depth

Shot and read noise are independent, so one deviate carries the root of their summed variances. A pixel without an echo
is left black: the device measures the amplitude of the echo that it finds.
"""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from nlos_cam.frames import SATURATED, Float32
from nlos_cam.render.sensor_model import DEPTH_UNIT_M, FARTHEST, MOST_CONFIDENT, SURE_COUNTS

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]


class Chain(NamedTuple):
    """What the stages know of the sensor, in IR counts and metres; a stage that is left out stands at 0."""

    gain: float
    """Counts for an intensity of I0."""
    ambient_counts: float
    shot_variance: float
    """For each count of light."""
    read_variance: float
    range_noise_m: float
    range_noise_per_m: float


class Optics(NamedTuple):
    """What each pixel meets whatever is hidden: its own direct return and where it looks; all of one length."""

    direct: Float32
    """In units of I0."""
    surety: Array
    """`signal_surety` of the direct return."""
    length_m: Float32
    cos_axis: Float32
    dead: NDArray[np.bool_]
    """Empty where no pixel is dead."""
    texture: Float32
    """Factors of the light; empty for an even wall."""


class Echoes(NamedTuple):
    """The map cells' echoes, flattened; 0 <= runner_up <= peak, and both are finite."""

    peak: Float32
    surety: Array
    """`signal_surety` of the peak."""
    runner_up: Float32
    path_m: Float32


@numba.njit(cache=True)
def compete(optics: Optics, pixel: int, echoes: Echoes, cell: int) -> tuple[float, float, float, float]:
    """S5: intensity, surety and length of the pixel's own return or the cell's echo, the stronger; and the second."""
    own, peak, runner_up = optics.direct[pixel], echoes.peak[cell], echoes.runner_up[cell]
    if peak > own:
        return peak, echoes.surety[cell], echoes.path_m[cell] / 2, max(own, runner_up)
    return own, optics.surety[pixel], optics.length_m[pixel], max(peak, runner_up)


@numba.njit(cache=True)
def noise_counts(light_counts: float, chain: Chain) -> float:
    """The standard deviation that shot and read noise give to this much light, the ambient's own included."""
    return np.sqrt(chain.read_variance + chain.shot_variance * light_counts)


@numba.njit(cache=True)
def saturate(light_counts: float, chain: Chain) -> float:
    """The full scale cuts echo and ambient light together; then the ambient's mean is subtracted."""
    return min(light_counts, SATURATED) - chain.ambient_counts


@numba.njit(cache=True)
def quantise(value: float, most: int) -> int:
    """The nearest whole number from 0 to `most`; 0 for what is no number."""
    return int(np.floor(min(value, most) + 0.5)) if value > 0 else 0


@numba.njit(cache=True)
def sure(counts: float, chain: Chain) -> float:
    """From 0 to 1, how far a signal stands above the noise: as if dimmed by what ambient light adds to it."""
    if chain.ambient_counts > 0:
        noise = noise_counts(counts + chain.ambient_counts, chain)
        if noise > 0:
            counts *= noise_counts(counts, chain) / noise
    return 1 - np.exp(-counts / SURE_COUNTS)


@numba.njit(cache=True, nogil=True)
def signal_surety(intensity: Float32, chain: Chain) -> Array:
    """`sure` of intensities (n,), in units of I0."""
    surety = np.empty(intensity.size)
    for i in range(intensity.size):
        surety[i] = sure(chain.gain * intensity[i], chain)
    return surety


@numba.njit(cache=True, nogil=True)  # a simulated camera exposes while others reconstruct
def expose(
    optics: Optics,
    echoes: Echoes,
    cell: NDArray[np.int32],
    light_deviates: Float32,
    range_deviates: Float32,
    bias_m: Float32,
    chain: Chain,
) -> tuple[NDArray[np.uint16], Bytes, Bytes]:
    """Depth, IR and confidence (n,) of n pixels, each with the cell it looks at; empty deviates are no noise."""
    pixels = optics.direct.size
    z16, ir, confidence = np.zeros(pixels, np.uint16), np.zeros(pixels, np.uint8), np.zeros(pixels, np.uint8)
    for i in range(pixels):
        intensity, surety, length_m, second = compete(optics, i, echoes, cell[i])
        if intensity <= 0:
            continue
        counts = chain.gain * intensity
        if optics.texture.size:
            counts *= optics.texture[i]
            surety = sure(counts, chain)
        light = counts + chain.ambient_counts
        if light_deviates.size:
            light += light_deviates[i] * noise_counts(light, chain)
        ir[i] = quantise(saturate(light, chain), SATURATED)
        # half of the signal's own surety is the winner's lead
        confidence[i] = int(MOST_CONFIDENT * (surety * (0.5 + 0.5 * (1 - second / intensity))) + 0.5)
        if confidence[i] == 0 or (optics.dead.size and optics.dead[i]):
            continue
        depth_m = length_m * optics.cos_axis[i]
        if bias_m.size:
            depth_m += bias_m[i]
        if range_deviates.size:
            depth_m += range_deviates[i] * (chain.range_noise_m + chain.range_noise_per_m * depth_m)
        z16[i] = quantise(depth_m / DEPTH_UNIT_M, FARTHEST)
    return z16, ir, confidence
