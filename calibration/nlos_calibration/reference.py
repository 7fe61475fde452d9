"""The bare wall as the lidar sees it: mean and spread of every pixel and map cell over many frames, and their file."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from nlos_calibration.arrays import Float32, Float64
from nlos_calibration.errors import RecordFileError
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.noise import DepthMean
from nlos_calibration.rig_check import MAP_SHAPE

FULL_SCALE = 255
"""IR counts that say no more than that there was too much light."""


class Moments:
    """Streaming mean and spread of arrays of one shape; NaN is no sample."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.count = np.zeros(shape, np.int64)
        self._mean, self._squares = np.zeros(shape), np.zeros(shape)

    def add(self, values: NDArray[Any]) -> None:
        """Take one array of the shape in (Welford's update: no cancellation, whatever the offset)."""
        known = np.isfinite(values)
        self.count += known
        off = np.where(known, values - self._mean, 0.0)
        self._mean += off / np.maximum(self.count, 1)
        self._squares += off * np.where(known, values - self._mean, 0.0)

    def mean(self) -> Float64:
        """NaN where there was no sample."""
        return np.where(self.count > 0, self._mean, np.nan)

    def spread(self) -> Float64:
        """The standard deviation of a sample; NaN where there are fewer than two."""
        return np.sqrt(self._squares / np.where(self.count > 1, self.count - 1.0, np.nan))


@dataclass(frozen=True, eq=False)
class BareWall:
    """What the lidar gives of a bench with nothing hidden: the reference that difference maps are formed from."""

    depth_m: Float32
    """(height, width); the mean, NaN where fewer than half of the frames had a return."""
    depth_std_m: Float32
    """(height, width); of one sample, as all *_std are; NaN where there are fewer than two."""
    ir: Float32
    """(height, width); in counts."""
    ir_std: Float32
    saturated: Float32
    """(height, width); share of the frames in which the IR was at its full scale."""
    inliers: NDArray[np.bool_]
    """(height, width); the pixels that the wall's plane rests on."""
    map_depth_m: Float32
    """(64, 80); of the maps, as all map_*; NaN where no frame had a return in the cell."""
    map_depth_std_m: Float32
    map_intensity: Float32
    """NaN, like the depth, where no frame had a return."""
    map_intensity_std: Float32
    frames: int
    intrinsics: Intrinsics
    serial: str = ""
    settings: Mapping[str, float] = field(default_factory=dict[str, float])
    """The device's options as read back when streaming began."""
    celsius: Mapping[str, float] = field(default_factory=dict[str, float])
    """Mean temperatures by the SDK's name; empty where the device tells none."""
    celsius_span: Mapping[str, float] = field(default_factory=dict[str, float])
    """By how much each rose or fell meanwhile."""


ARRAYS = [known.name for known in fields(BareWall)][:10]
FACTS = [known.name for known in fields(BareWall)][10:]


class BareWallStatistics:
    """Collects a BareWall from frames; holds maps of sums, not the frames."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        shape = intrinsics.height, intrinsics.width
        self.depth = DepthMean(*shape)
        """What the wall's plane is fitted to."""
        self._intrinsics = intrinsics
        self._ir, self._saturated = Moments(shape), np.zeros(shape)
        self._map_depth, self._map_intensity = Moments(MAP_SHAPE), Moments(MAP_SHAPE)
        self._celsius: list[Mapping[str, float]] = []

    def add(self, depth_m: Float32, ir: NDArray[np.uint8], map_depth_m: Float32, map_intensity: Float32) -> None:
        """Take one frame (height, width) and its maps (64, 80) in."""
        self.depth.add(depth_m)
        self._ir.add(ir)
        self._saturated += ir == FULL_SCALE
        self._map_depth.add(map_depth_m)
        self._map_intensity.add(np.where(np.isfinite(map_depth_m), map_intensity, np.nan))

    def look_at(self, celsius: Mapping[str, float]) -> None:
        """Take one reading of the device's temperatures in; an empty one says nothing."""
        if celsius:
            self._celsius.append(dict(celsius))

    def ir_mean(self) -> Float64:
        """(height, width), in counts; NaN before the first frame."""
        return self._ir.mean()

    def celsius(self) -> dict[str, float]:
        """The mean of each thermometer's readings."""
        return {name: float(np.mean(values)) for name, values in self._series().items()}

    def _series(self) -> dict[str, list[float]]:
        names = sorted(set[str]().union(*self._celsius))
        return {name: [look[name] for look in self._celsius if name in look] for name in names}

    def reference(self, inliers: NDArray[np.bool_], *, serial: str, settings: Mapping[str, float]) -> BareWall:
        """What was collected, with the pixels that the wall's plane rests on."""
        series = self._series()
        statistics = {
            "depth_m": self.depth.mean_m(),
            "depth_std_m": self.depth.spread_m(),
            "ir": self._ir.mean(),
            "ir_std": self._ir.spread(),
            "saturated": self._saturated / max(self.depth.frames, 1),
            "map_depth_m": self._map_depth.mean(),
            "map_depth_std_m": self._map_depth.spread(),
            "map_intensity": self._map_intensity.mean(),
            "map_intensity_std": self._map_intensity.spread(),
        }
        return BareWall(
            **{name: array.astype(np.float32) for name, array in statistics.items()},
            inliers=inliers,
            frames=self.depth.frames,
            intrinsics=self._intrinsics,
            serial=serial,
            settings=dict(settings),
            celsius=self.celsius(),
            celsius_span={name: max(values) - min(values) for name, values in series.items()},
        )


def save_reference(path: Path, wall: BareWall) -> str:
    """Write the reference (.npz) and return its SHA-256 in hexadecimal digits, for the record."""
    facts = {name: getattr(wall, name) for name in FACTS} | {"intrinsics": asdict(wall.intrinsics)}
    arrays: dict[str, Any] = {name: getattr(wall, name) for name in ARRAYS}
    with path.open("wb") as file:
        np.savez_compressed(file, facts=json.dumps(facts), **arrays)
    return hashlib.sha256(path.read_bytes()).hexdigest()


def load_reference(path: Path, sha256: str) -> BareWall:
    """The reference that a record names. Raises RecordFileError where it is gone, damaged, or not that record's."""
    advice = "calibrate the wall again"
    try:
        found = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise RecordFileError(
            f"the bare wall's reference {path} cannot be read ({error.strerror}): keep it beside its record, or "
            f"{advice}",
        ) from error
    if found != sha256:
        raise RecordFileError(
            f"{path} is not the reference that the record was written with (SHA-256 {found[:12]}, not {sha256[:12]}): "
            f"put back the file that was beside it, or {advice}"
        )
    try:
        with np.load(path) as file:
            facts = json.loads(str(file["facts"]))
            arrays = {name: file[name] for name in ARRAYS}
        return BareWall(**arrays, **(facts | {"intrinsics": Intrinsics(**facts["intrinsics"])}))
    except (OSError, ValueError, KeyError, TypeError, BadZipFile) as error:
        raise RecordFileError(f"{path} is no reference of a bare wall ({error}): {advice}") from error
