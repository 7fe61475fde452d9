"""Sensor: from echoes to the three images that a device delivers, by an ordered chain of stages.

    echo (S5) -> wall texture -> gain -> ambient light -> shot and read noise -> saturation -> 8
    bits            IR signal above the noise, winner above the second -> 4 bits
    confidence path / 2 x cos(beam, optical axis) -> bias -> range noise -> 0.25 mm -> dead pixels
    depth

Shot and read noise are independent, so one deviate with the root of their summed variances carries
both. A pixel without an echo is black: the device measures the amplitude of the echo that it finds.

Not modeled: mixed edges, and IR and confidence that change with temperature. The raster's scan time
and a pulse's width belong to the renderer.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numba
import numpy as np
from nlos_calibration import Intrinsics, Rig
from nlos_calibration.arrays import Float32, Float64, UInt8
from numpy.typing import NDArray

from nlos_cam.errors import SceneError
from nlos_cam.frames import (
    MAP_COLUMNS,
    MAP_ROWS,
    SATURATED,
    Frame,
    LidarMaps,
    inner,
    maps_from_frame,
)
from nlos_cam.render.echoes import StoppedBeams, peak_share
from nlos_cam.render.effects import Effect, included
from nlos_cam.render.geometry import Beams, cast
from nlos_cam.render.renderer import MultiBounce
from nlos_cam.render.scene import Radiometry
from nlos_cam.render.sensor.bias import DepthBias, texture
from nlos_cam.render.sensor.cells import PixelOrder, expose_cells, normal_quantiles
from nlos_cam.render.sensor.effects import sensor_effects
from nlos_cam.render.sensor.model import (
    DEPTH_UNIT_M,
    FARTHEST,
    MAX_CONFIDENCE,
    SURE_COUNTS,
    SensorModel,
)


class Chain(NamedTuple):
    """Constants of the stages, in IR counts and meters; 0 for a stage that is left out."""

    gain: float
    """Counts for an intensity of I0."""
    ambient_counts: float
    shot_variance: float
    """Variance per count of light."""
    read_variance: float
    range_noise_m: float
    range_noise_per_m: float


class PixelOptics(NamedTuple):
    """Direct return and direction of each pixel (n,): of a rig alone, but for the pixels whose
    beams the hidden object stops.
    """

    direct: Float32
    """In units of I0."""
    surety: Float64
    """`signal_surety` of the direct return."""
    length_m: Float32
    cos_axis: Float32
    dead: NDArray[np.bool_]
    """Empty if no pixel is dead."""
    texture: Float32
    """Factors of the light; empty for an even wall."""


class CellEchoes(NamedTuple):
    """Echoes of the map cells, flattened; 0 <= runner_up <= peak, and both are finite."""

    peak: Float32
    surety: Float64
    """`signal_surety` of the peak."""
    runner_up: Float32
    path_m: Float32


@inner()
def compete(
    optics: PixelOptics, pixel: int, echoes: CellEchoes, cell: int
) -> tuple[float, float, float, float]:
    """Return intensity, surety and length of the stronger of direct return and cell's echo (S5),
    and the second.
    """
    # The device halves every path, also one of three bounces (S5); a tie goes to the direct return.
    own = optics.direct[pixel]
    peak = echoes.peak[cell]
    runner_up = echoes.runner_up[cell]
    if peak > own:
        return peak, echoes.surety[cell], echoes.path_m[cell] / 2, max(own, runner_up)
    return own, optics.surety[pixel], optics.length_m[pixel], max(peak, runner_up)


@inner()
def noise_counts(light_counts: float, chain: Chain) -> float:
    """Return the standard deviation of shot and read noise for an amount of light, ambient light
    included.
    """
    # Shot noise is Poisson: its variance grows with the light. Independent of read noise, so that
    # variances add.
    return np.sqrt(chain.read_variance + chain.shot_variance * light_counts)


@inner()
def saturate(light_counts: float, chain: Chain) -> float:
    """Return the light cut at full scale together with the ambient light, of which the mean is then
    subtracted.
    """
    # The converter saturates on echo and ambient light together, before the mean is subtracted.
    return min(light_counts, SATURATED) - chain.ambient_counts


@inner()
def quantise(value: float, most: int) -> int:
    """Return the nearest whole number from 0 to `most`; 0 for NaN."""
    # NaN compares false, so it becomes 0 like everything else that is not above 0.
    return int(np.floor(min(value, most) + 0.5)) if value > 0 else 0


@inner()
def sure(counts: float, chain: Chain) -> float:
    """Return from 0 to 1 how far a signal stands above the noise, dimmed by the noise that ambient
    light adds.
    """
    # Confidence follows the signal over its noise: ambient light scales it by the ratio of the
    # noise without it to that with it.
    if chain.ambient_counts > 0:
        noise = noise_counts(counts + chain.ambient_counts, chain)
        if noise > 0:
            counts *= noise_counts(counts, chain) / noise
    # Saturating, as confidence has a largest value: SURE_COUNTS is its scale.
    return 1 - np.exp(-counts / SURE_COUNTS)


@numba.njit(cache=True, nogil=True)
def _fill_surety(surety: Float64, intensity: Float32, chain: Chain) -> None:
    for i in range(intensity.size):
        surety[i] = sure(chain.gain * intensity[i], chain)


def signal_surety(intensity: Float32, chain: Chain) -> Float64:
    """Return `sure` of intensities (n,), in units of I0."""
    surety = np.empty(intensity.size)
    _fill_surety(surety, intensity, chain)
    return surety


@numba.njit(cache=True, nogil=True)  # a simulated camera exposes while others reconstruct
def expose(
    optics: PixelOptics,
    echoes: CellEchoes,
    cell: NDArray[np.int32],
    light_deviates: Float32,
    range_deviates: Float32,
    bias_m: Float32,
    chain: Chain,
    z16: NDArray[np.uint16],
    ir: UInt8,
    confidence: UInt8,
) -> None:
    """Fill in depth, IR and confidence (n,) of n pixels, each with its map cell; empty deviates are
    no noise.
    """
    # The stages in the order of the chain. Images start black, so that a pixel without an echo is
    # left out.
    for i in range(z16.size):
        intensity, surety, length_m, second = compete(optics, i, echoes, cell[i])
        if intensity <= 0:
            continue
        counts = chain.gain * intensity
        if optics.texture.size:
            counts *= optics.texture[i]
            surety = sure(counts, chain)
        # One deviate carries shot and read noise: a sum of independent normal deviates is normal.
        light = counts + chain.ambient_counts
        if light_deviates.size:
            light += light_deviates[i] * noise_counts(light, chain)
        ir[i] = quantise(saturate(light, chain), SATURATED)
        # Half of the signal's own surety is the winner's lead over the second echo.
        lead = 1 - second / intensity
        confidence[i] = int(MAX_CONFIDENCE * (surety * (0.5 + 0.5 * lead)) + 0.5)
        if confidence[i] == 0 or (optics.dead.size and optics.dead[i]):
            continue
        # S5: depth is the range along the beam, projected on the optical axis.
        depth_m = length_m * optics.cos_axis[i]
        if bias_m.size:
            depth_m += bias_m[i]
        if range_deviates.size:
            # The data sheet gives a standard deviation that grows with distance: an affine law.
            depth_m += range_deviates[i] * (chain.range_noise_m + chain.range_noise_per_m * depth_m)
        z16[i] = quantise(depth_m / DEPTH_UNIT_M, FARTHEST)


NO_DEVIATES = np.zeros(0, np.float32)


@dataclass(frozen=True)
class SensedImages:
    """One frame as the device delivers it."""

    depth_z16: NDArray[np.uint16]
    """(height, width); in units of 0.25 mm, 0 is no depth."""
    ir: UInt8
    """(height, width)."""
    confidence: UInt8
    """(height, width); 0 to 15."""

    def frame(self, intrinsics: Intrinsics) -> Frame:
        """Return the images in SI units, as a camera yields them."""
        depth_m = np.where(
            self.depth_z16 == 0, np.float32(np.nan), self.depth_z16 * np.float32(DEPTH_UNIT_M)
        )
        return Frame(
            depth_m,
            self.ir,
            self.confidence,
            timestamp_s=0.0,
            frame_number=0,
            intrinsics=intrinsics,
        )


class Sensor:
    """Sensor on a rig, with all that depends on neither object nor frame computed once; safe to
    share among threads.
    """

    def __init__(self, rig: Rig, model: SensorModel, radiometry: Radiometry = "paper") -> None:
        self.rig = rig
        # Everything here depends on rig and model alone: frames differ in echoes and noise.
        verdicts = sensor_effects(model)
        lambertian = radiometry == "lambertian"
        self._chain = _chain(rig, model, verdicts, lambertian=lambertian)
        direct = cast(rig, rig.pinhole, lambertian=lambertian)
        shape = (rig.intrinsics.height, rig.intrinsics.width)
        reflectance = texture(
            shape, model.wall_texture if included(verdicts, "wall texture") else 0.0
        )
        dead_share = model.dead_share if included(verdicts, "dead pixels") else 0.0
        self._optics = _optics(direct, self._chain, dead_share, reflectance)
        self._echoes_only = self._optics._replace(direct=np.zeros_like(self._optics.direct))
        self._ordered: tuple[tuple[int, ...], PixelOrder, PixelOptics] | None = None
        self._bias = DepthBias(shape, model, verdicts)
        self._lights = included(verdicts, "shot noise") or included(verdicts, "read noise")
        self._ranges = included(verdicts, "range noise")

    def expose(
        self, multi: MultiBounce, generator: np.random.Generator, *, celsius: float | None = None
    ) -> SensedImages:
        """Return the images of one instant, with the generator's noise.

        Maps (64 k, 80 k) hold k x k beams for each cell. `celsius` is the device's temperature
        (default: warm).
        """
        shape = (self.rig.intrinsics.height, self.rig.intrinsics.width)
        cell = cell_of_pixels(shape, multi.peak.shape)
        light, ranges = (
            self._deviates(generator, wanted=wanted) for wanted in (self._lights, self._ranges)
        )
        optics = self._echoes_only if multi.direct_included else self._optics
        if multi.stopped is not None:
            optics = _with_stops(optics, multi.stopped, cell, self._chain)
        echoes = _echoes(multi, self._chain)
        bias_m = self._bias.at_m(celsius)
        z16 = np.zeros(shape, np.uint16)
        ir = np.zeros(shape, np.uint8)
        confidence = np.zeros(shape, np.uint8)
        images = z16.ravel(), ir.ravel(), confidence.ravel()  # views
        expose(optics, echoes, cell, light, ranges, bias_m, self._chain, *images)
        return SensedImages(z16, ir, confidence)

    def maps(self, multi: MultiBounce, generator: np.random.Generator | None) -> LidarMaps:
        """Return the maps of one exposure of the warm device: `expose` and the reduction of frames,
        in less time.

        The noise has the law of `expose`, not its deviates. A textured wall takes the long way.
        Without a generator the maps are the expected ones, without a draw of noise. Raises
        SceneError for those of a textured wall.
        """
        if self._optics.texture.size:
            if generator is None:
                raise SceneError(
                    "expected maps are not available for a wall_texture: set it to 0, or draw the"
                    " noise"
                )
            return maps_from_frame(self.expose(multi, generator).frame(self.rig.pinhole))
        # Cell by cell in memory: each cell's pixels are drawn and reduced while they are in the
        # cache.
        order, optics = self._in_order(multi.peak.shape)
        optics = (
            optics._replace(direct=np.zeros_like(optics.direct))
            if multi.direct_included
            else optics
        )
        if multi.stopped is not None:
            image = self.rig.intrinsics.height, self.rig.intrinsics.width
            cell = cell_of_pixels(image, multi.peak.shape)[order.pixel]
            optics = _with_stops(optics, multi.stopped, cell, self._chain)
        seed = generator.integers(1 << 64, dtype=np.uint64) if generator else np.uint64(0)
        bias_m = self._bias.at_m(None)
        noise = normal_quantiles(), seed, (self._lights, self._ranges)
        bias_m = bias_m[order.pixel] if bias_m.size else bias_m
        expected = generator is None
        found = expose_cells(
            optics, _echoes(multi, self._chain), order, *noise, bias_m, self._chain, expected
        )
        depth_m, intensity = (column.reshape(MAP_ROWS, MAP_COLUMNS) for column in found)
        return LidarMaps(depth_m, intensity, ~np.isnan(depth_m))

    def _in_order(self, echoes: tuple[int, ...]) -> tuple[PixelOrder, PixelOptics]:
        """Return the order of the pixels for echo maps of that shape, with the optics in it; the
        last is kept.
        """
        # Through a name of its own: another thread may keep maps of another shape meanwhile.
        ordered = self._ordered
        if ordered is None or ordered[0] != echoes:
            image = self.rig.intrinsics.height, self.rig.intrinsics.width
            maps = (MAP_ROWS, MAP_COLUMNS), (echoes[0], echoes[1])
            order = PixelOrder.of(*(cell_of_pixels(image, shape) for shape in maps))
            optics = PixelOptics._make(c[order.pixel] if c.size else c for c in self._optics)
            ordered = echoes, order, optics
            self._ordered = ordered
        return ordered[1:]

    def _deviates(self, generator: np.random.Generator, *, wanted: bool) -> Float32:
        """Return one normal deviate per pixel, or none: noise that is left out is not drawn."""
        return (
            generator.standard_normal(self._optics.direct.size, np.float32)
            if wanted
            else NO_DEVIATES
        )


def _chain(
    rig: Rig, model: SensorModel, verdicts: tuple[Effect, ...], *, lambertian: bool
) -> Chain:
    """Return the stages' constants, with 0 for each stage that the verdicts leave out."""

    def called_for(name: str, value: float) -> float:
        return value if included(verdicts, name) else 0.0

    # The bare wall fixes the gain: an occluder nearer to the lidar would change it.
    bare = rig.model_copy(update={"occluder": None})
    brightest = float(cast(bare, bare.pinhole, lambertian=lambertian).direct.max())
    # With a pulse the renderer's echo is the waveform's peak, which holds a share of the light.
    brightest *= peak_share(model.pulse_ns, rig.device.bin_m)
    return Chain(
        gain=model.bare_wall_counts / brightest if brightest > 0 else 0.0,
        ambient_counts=called_for("ambient light", model.ambient_counts),
        shot_variance=called_for("shot noise", model.shot_noise) ** 2,
        read_variance=called_for("read noise", model.read_noise_counts) ** 2,
        range_noise_m=called_for("range noise", model.range_noise_m),
        range_noise_per_m=called_for("range noise", model.range_noise_per_m),
    )


def _optics(beams: Beams, chain: Chain, dead_share: float, reflectance: Float32) -> PixelOptics:
    direct = beams.direct.astype(np.float32)
    surety = signal_surety(direct, chain)
    length_m = beams.length_m.astype(np.float32)
    # A seed of its own: the same pixels are dead in every frame and every run.
    dead = np.random.default_rng(0).random(direct.size if dead_share else 0) < dead_share
    return PixelOptics(
        direct, surety, length_m, beams.cos_axis.astype(np.float32), dead, reflectance
    )


def _with_stops(
    optics: PixelOptics, stopped: StoppedBeams, cell: NDArray[np.int32], chain: Chain
) -> PixelOptics:
    """Return the optics of pixels with their cells where the hidden object stops some beams: it
    returns them, from nearer and without the wall's texture.
    """
    # The lidar sees the object itself there, and nothing of the wall behind it.
    direct = stopped.direct.ravel()
    of_object = ~np.isnan(direct)[cell]
    surety = signal_surety(np.nan_to_num(direct), chain)
    factor = optics.texture
    return optics._replace(
        direct=np.where(of_object, direct[cell], optics.direct),
        surety=np.where(of_object, surety[cell], optics.surety),
        length_m=np.where(of_object, stopped.length_m.ravel()[cell], optics.length_m),
        texture=np.where(of_object, np.float32(1), factor) if factor.size else factor,
    )


def _echoes(multi: MultiBounce, chain: Chain) -> CellEchoes:
    """Return the echoes flattened, without intensities that are not finite."""
    # An echo that is not finite is none; a runner-up never exceeds its peak.
    peak, runner_up = (
        np.where((map_ > 0) & (map_ < np.inf), map_, np.float32(0)).ravel()
        for map_ in (multi.peak, multi.runner_up)
    )
    return CellEchoes(
        peak, signal_surety(peak, chain), np.minimum(runner_up, peak), multi.path_m.ravel()
    )


@lru_cache(maxsize=4)
def cell_of_pixels(image: tuple[int, int], maps: tuple[int, int]) -> NDArray[np.int32]:
    """Return the flat index of each pixel's map cell, for (64 k, 80 k) cells. Raises SceneError for
    other shapes.
    """
    height, width = image
    rows, columns = maps
    if rows < MAP_ROWS or rows % MAP_ROWS or columns * MAP_ROWS != rows * MAP_COLUMNS:
        raise SceneError(
            f"echo maps have shape {maps}: it must be (64 k, 80 k) for k x k beams in each map cell"
        )
    # The cell that holds a pixel's center; images need not be whole multiples of the maps.
    row = (np.arange(height) + 0.5) * rows // height
    column = (np.arange(width) + 0.5) * columns // width
    return (row[:, None] * columns + column).astype(np.int32).ravel()
