"""The sensor's stages, in the order in which light meets them, and the loop that leads each pixel through them.

    echo (S5) -> gain -> ambient light -> shot and read noise -> saturation -> 8 bits            IR
    margin and signal above the noise -> 4 bits                                                  confidence
    path / 2 x cos(beam, optical axis) -> range noise -> 0.25 mm -> dead pixels                  depth

Shot and read noise are independent, so one deviate carries the root of their summed variances. A pixel without an echo
is left black: the device measures the amplitude of the echo that it finds.
"""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from nlos_cam.frames import Float32
from nlos_cam.render.sensor_model import DEPTH_UNIT_M, FARTHEST, MOST_CONFIDENT, SATURATED, SURE_COUNTS

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
    length_m: Float32
    cos_axis: Float32
    dead: NDArray[np.bool_]
    """Empty where no pixel is dead."""


class Echoes(NamedTuple):
    """The map cells' echoes, flattened."""

    peak: Float32
    runner_up: Float32
    path_m: Float32


@numba.njit(cache=True)
def compete(own: float, echoes: Echoes, cell: int) -> tuple[bool, float, float]:
    """S5: whether the cell's echo wins over the pixel's own direct return, the winner, and the second strongest."""
    peak = echoes.peak[cell]
    wins = peak > own
    return wins, peak if wins else own, max(own if wins else peak, echoes.runner_up[cell])


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
def surety(counts: float, margin: float, chain: Chain) -> float:
    """From 0 to 1, how sure: the winner's lead, weighted by how far the signal stands above the noise."""
    if chain.ambient_counts > 0:
        noisy = noise_counts(counts + chain.ambient_counts, chain)
        if noisy > 0:
            counts *= noise_counts(counts, chain) / noisy
    return (1 - np.exp(-counts / SURE_COUNTS)) * (0.5 + 0.5 * margin)


@numba.njit(cache=True)
def expose(
    optics: Optics,
    echoes: Echoes,
    cell: NDArray[np.int32],
    light_deviates: Float32,
    range_deviates: Float32,
    chain: Chain,
) -> tuple[NDArray[np.uint16], Bytes, Bytes]:
    """Depth, IR and confidence (n,) of n pixels, each with the cell it looks at; no deviates, no noise."""
    pixels = optics.direct.size
    z16, ir, confidence = np.zeros(pixels, np.uint16), np.zeros(pixels, np.uint8), np.zeros(pixels, np.uint8)
    for i in range(pixels):
        c = cell[i]
        wins, intensity, second = compete(optics.direct[i], echoes, c)
        if not 0 < intensity < np.inf:
            continue
        counts = chain.gain * intensity
        light = counts + chain.ambient_counts
        if light_deviates.size:
            light += light_deviates[i] * noise_counts(light, chain)
        ir[i] = quantise(saturate(light, chain), SATURATED)
        confidence[i] = quantise(MOST_CONFIDENT * surety(counts, 1 - second / intensity, chain), MOST_CONFIDENT)
        if confidence[i] == 0 or (optics.dead.size and optics.dead[i]):
            continue
        depth_m = (echoes.path_m[c] / 2 if wins else optics.length_m[i]) * optics.cos_axis[i]
        if range_deviates.size:
            depth_m += range_deviates[i] * (chain.range_noise_m + chain.range_noise_per_m * depth_m)
        z16[i] = quantise(depth_m / DEPTH_UNIT_M, FARTHEST)
    return z16, ir, confidence
