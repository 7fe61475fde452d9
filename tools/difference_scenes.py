"""What a hidden object changes in the maps of a bench: renderings, the receiver, and the expected difference maps."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from difference_waveform import Array, Peak, first_order, pulse_sigma_m, received
from nlos_calibration.arrays import Float32
from nlos_calibration.rig import Rig, load_rig
from numpy.typing import NDArray

from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, SATURATED
from nlos_cam.objects.placement import object_depth
from nlos_cam.render.echoes import MultiBounce
from nlos_cam.render.geometry import SPEED_OF_LIGHT_M_PER_S, Beams, cast
from nlos_cam.render.renderer import three_bounce
from nlos_cam.render.scene import Radiometry, Scene
from nlos_cam.render.sensor.model import SensorModel

SHAPE = MAP_ROWS, MAP_COLUMNS
Value = TypeVar("Value", np.float64, np.bool_)
FIRST_SEED = 20_000_000
"""Of the objects that tests use: no network is trained on them."""
FINE = 8
"""Beams along a side of a cell that the sensor's chain looks at: as many as it has pixels."""


def paper_rig(receiver_cell_m2: float) -> Rig:
    """The paper's rig with a receiver cell of that size."""
    rig = load_rig("paper-rig")
    return rig.model_copy(update={"device": rig.device.model_copy(update={"receiver_cell_m2": receiver_cell_m2})})


def later_light(rig: Rig, radiometry: Radiometry, objects: Iterable[int]) -> Iterator[Float32]:
    """Three-bounce histograms (5120, bins) of the test objects of these numbers, at `standard` accuracy."""
    empty = Scene(rig, radiometry=radiometry)
    for number in objects:
        depth_m = object_depth(FIRST_SEED + number, empty.box)[1]
        yield three_bounce(replace(empty, object_depth_m=depth_m)).astype(np.float32, copy=False)


@dataclass(frozen=True)
class Signal:
    """What an object changes: expected maps (64, 80) with it minus those without."""

    depth_m: Array
    """0 where the cell sees no wall, or nothing is changed."""
    counts: Array
    """Of intensity, in IR counts up to full scale."""
    margin: Array
    """Of the direct return's lead over the strongest bin of later light; all 0 with a pulse, which mixes them."""
    direct_wins: NDArray[np.bool_]
    """The echo that is reported is the direct return, or one that merged with it."""
    lit: NDArray[np.bool_]
    """Light comes back by way of the object."""


@dataclass(frozen=True)
class Bench:
    """A rig whose lidar has a pulse of some width; one beam a cell."""

    rig: Rig
    radiometry: Radiometry = "paper"
    pulse_ns: float = 0.0

    @cached_property
    def beams(self) -> Beams:
        return cast(self.rig, Scene(self.rig).cell_intrinsics, lambertian=self.radiometry == "lambertian")

    @property
    def on_wall(self) -> NDArray[np.bool_]:
        """(5120,)."""
        return self.beams.on_wall

    @property
    def counts_of_light(self) -> float:
        """The sensor's gain: IR counts for an intensity of 1."""
        bare = self.rig.model_copy(update={"occluder": None})
        brightest = cast(bare, bare.pinhole, lambertian=self.radiometry == "lambertian").direct.max()
        return SensorModel().bare_wall_counts / float(brightest)

    def echoes(self, later: Float32 | None) -> tuple[Array, Array]:
        """Path length and intensity (k,) that the beams on the wall report; `later` (5120, bins) is None for nothing.

        Without a pulse: S5, the strongest bin or the direct return. With one: the highest peak of the waveform.
        """
        direct, path_m = self.beams.direct[self.on_wall], 2 * self.beams.length_m[self.on_wall]
        if later is None:
            return path_m, direct
        some, bin_m = later[self.on_wall].astype(np.float64), self.rig.device.bin_m
        if self.pulse_ns:
            return received(direct, path_m, some, bin_m, pulse_sigma_m(self.pulse_ns))
        wins = some.max(1) > direct
        return np.where(wins, (some.argmax(1) + 0.5) * bin_m, path_m), np.where(wins, some.max(1), direct)

    def first_order_m(self, later: Float32, peak: Peak) -> Array:
        """Change of depth (64, 80) that weak later light makes to such a peak."""
        direct, path_m = self.beams.direct[self.on_wall], 2 * self.beams.length_m[self.on_wall]
        shift_m = first_order(direct, path_m, later[self.on_wall].astype(np.float64), self.rig.device.bin_m, peak)
        return self._map(shift_m / 2 * self.beams.cos_axis[self.on_wall])

    def merges(self, path_m: Array) -> NDArray[np.bool_]:
        """Whether paths (k,) are the direct returns' own: with a pulse, within half of its width at half height."""
        reach_m = 0.5e-9 * self.pulse_ns * SPEED_OF_LIGHT_M_PER_S
        return np.abs(path_m - 2 * self.beams.length_m[self.on_wall]) <= reach_m

    def signal(self, later: Float32) -> Signal:
        """What an object changes, whose histograms are `later` (5120, bins)."""
        (bare_path_m, bare), (path_m, light) = self.echoes(None), self.echoes(later)
        second = later[self.on_wall].max(1).astype(np.float64)
        counts = self.counts_of_light
        margin = np.zeros(len(bare)) if self.pulse_ns else -np.minimum(second, bare) / np.maximum(second, bare)
        return Signal(
            depth_m=self._map((path_m - bare_path_m) / 2 * self.beams.cos_axis[self.on_wall]),
            counts=self._map(np.minimum(counts * light, SATURATED) - np.minimum(counts * bare, SATURATED)),
            margin=self._map(margin),
            direct_wins=self._map(self.merges(path_m), fill=True),
            lit=self._map(second > 0, fill=False),
        )

    def multi(self, later: Float32 | None) -> MultiBounce:
        """The echoes as the sensor's chain takes them, direct returns included, at FINE x FINE beams a cell.

        A direct return is shifted and raised as that of its cell's one beam is; any other echo is its cell's.
        """
        (bare_path_m, bare), (path_m, light) = self.echoes(None), self.echoes(later)
        fine = cast(self.rig, Scene(self.rig).intrinsics(FINE), lambertian=self.radiometry == "lambertian")
        own = _finer(self._map(self.merges(path_m), fill=True))
        length_m, direct = (values.reshape(fine.shape) for values in (2 * fine.length_m, fine.direct))
        path = np.where(own, length_m + _finer(self._map(path_m - bare_path_m)), _finer(self._map(path_m)))
        peak = np.where(own, direct * _finer(self._map(light / bare, fill=1.0)), _finer(self._map(light)))
        nothing = np.zeros(fine.shape, np.float32)
        return MultiBounce(peak.astype(np.float32), nothing, path.astype(np.float32), direct_included=True)

    def _map(self, values: NDArray[Value], fill: float = 0.0) -> NDArray[Value]:
        """Values (k,) of the beams on the wall as a map (64, 80) of all."""
        every = np.full(len(self.on_wall), fill, values.dtype)
        every[self.on_wall] = values
        return every.reshape(SHAPE)


def _finer(values: NDArray[Value]) -> NDArray[Value]:
    """A map (64, 80) as one of FINE x FINE beams a cell."""
    return values.repeat(FINE, axis=0).repeat(FINE, axis=1)
