"""The sensor: echoes to the three images a device delivers, by the ordered chain of `sensor_chain`.

Not modelled: the raster's scan time, mixed edges, IR and confidence that change with temperature. A pulse's width is
the renderer's.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from nlos_calibration.projection import Intrinsics
from nlos_calibration.rig import Rig
from numpy.typing import NDArray

from nlos_cam.errors import SceneError
from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, Float32, Frame
from nlos_cam.render.beams import Beams, cast
from nlos_cam.render.echo import peak_share
from nlos_cam.render.effects import Effect, included
from nlos_cam.render.renderer import MultiBounce
from nlos_cam.render.scene import Radiometry
from nlos_cam.render.sensor_bias import DepthBias
from nlos_cam.render.sensor_chain import Bytes, Chain, Echoes, Optics, expose, signal_surety
from nlos_cam.render.sensor_effects import sensor_effects
from nlos_cam.render.sensor_model import DEPTH_UNIT_M, SensorModel
from nlos_cam.render.sensor_texture import texture

NO_DEVIATES = np.zeros(0, np.float32)


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


class Sensor:
    """A sensor on a rig: what depends on neither the object nor the frame is worked out once."""

    def __init__(self, rig: Rig, model: SensorModel, radiometry: Radiometry = "paper") -> None:
        self.rig = rig
        verdicts, lambertian = sensor_effects(model), radiometry == "lambertian"
        self._chain = _chain(rig, model, verdicts, lambertian=lambertian)
        direct = cast(rig, rig.pinhole, lambertian=lambertian)
        shape = (rig.intrinsics.height, rig.intrinsics.width)
        reflectance = texture(shape, model.wall_texture if included(verdicts, "wall texture") else 0.0)
        dead_share = model.dead_share if included(verdicts, "dead pixels") else 0.0
        self._optics = _optics(direct, self._chain, dead_share, reflectance)
        self._echoes_only = self._optics._replace(direct=np.zeros_like(self._optics.direct))
        self._bias = DepthBias(shape, model, verdicts)
        self._lights = included(verdicts, "shot noise") or included(verdicts, "read noise")
        self._ranges = included(verdicts, "range noise")

    def expose(
        self, multi: MultiBounce, generator: np.random.Generator, *, celsius: float | None = None
    ) -> SensedImages:
        """The images of one instant, with the generator's noise; maps (64 k, 80 k) hold k x k beams for each cell.

        `celsius` is the device's temperature; the warm device's unless given.
        """
        shape = (self.rig.intrinsics.height, self.rig.intrinsics.width)
        cell = cell_of_pixels(shape, multi.peak.shape)
        light, ranges = (self._deviates(generator, wanted=wanted) for wanted in (self._lights, self._ranges))
        optics = self._echoes_only if multi.direct_included else self._optics
        echoes, bias_m = _echoes(multi, self._chain), self._bias.at_m(celsius)
        z16, ir, confidence = expose(optics, echoes, cell, light, ranges, bias_m, self._chain)
        return SensedImages(z16.reshape(shape), ir.reshape(shape), confidence.reshape(shape))

    def _deviates(self, generator: np.random.Generator, *, wanted: bool) -> Float32:
        """One normal deviate for each pixel, or none: noise that is left out is not drawn."""
        return generator.standard_normal(self._optics.direct.size, np.float32) if wanted else NO_DEVIATES


def _chain(rig: Rig, model: SensorModel, verdicts: tuple[Effect, ...], *, lambertian: bool) -> Chain:
    """The stages' constants, with 0 for each stage that the verdicts leave out."""

    def called_for(name: str, value: float) -> float:
        return value if included(verdicts, name) else 0.0

    bare = rig.model_copy(update={"occluder": None})
    brightest = float(cast(bare, bare.pinhole, lambertian=lambertian).direct.max())
    brightest *= peak_share(model.pulse_ns, rig.device.bin_m)  # the waveform's peak, as a renderer with a pulse has it
    return Chain(
        gain=model.bare_wall_counts / brightest if brightest > 0 else 0.0,
        ambient_counts=called_for("ambient light", model.ambient_counts),
        shot_variance=called_for("shot noise", model.shot_noise) ** 2,
        read_variance=called_for("read noise", model.read_noise_counts) ** 2,
        range_noise_m=called_for("range noise", model.range_noise_m),
        range_noise_per_m=called_for("range noise", model.range_noise_per_m),
    )


def _optics(beams: Beams, chain: Chain, dead_share: float, reflectance: Float32) -> Optics:
    direct = beams.direct.astype(np.float32)
    surety, length_m = signal_surety(direct, chain), beams.length_m.astype(np.float32)
    dead = np.random.default_rng(0).random(direct.size if dead_share else 0) < dead_share
    return Optics(direct, surety, length_m, beams.cos_axis.astype(np.float32), dead, reflectance)


def _echoes(multi: MultiBounce, chain: Chain) -> Echoes:
    """The echoes flattened; an intensity that is no finite number is no echo."""
    peak, runner_up = (
        np.where((map_ > 0) & (map_ < np.inf), map_, np.float32(0)).ravel() for map_ in (multi.peak, multi.runner_up)
    )
    return Echoes(peak, signal_surety(peak, chain), np.minimum(runner_up, peak), multi.path_m.ravel())


@lru_cache(maxsize=4)
def cell_of_pixels(image: tuple[int, int], maps: tuple[int, int]) -> NDArray[np.int32]:
    """The flat index of the map cell that holds each pixel's centre, for (64 k, 80 k) cells; else SceneError."""
    (height, width), (rows, columns) = image, maps
    if rows < MAP_ROWS or rows % MAP_ROWS or columns * MAP_ROWS != rows * MAP_COLUMNS:
        raise SceneError(f"echo maps of shape {maps}: give (64 k, 80 k) for k x k beams in each map cell")
    row = (np.arange(height) + 0.5) * rows // height
    column = (np.arange(width) + 0.5) * columns // width
    return (row[:, None] * columns + column).astype(np.int32).ravel()
