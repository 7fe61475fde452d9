"""Bare-wall reference: mean and spread of every pixel and map cell over many frames, and the file
that holds them.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from io import BytesIO
from math import inf
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
from numpy.typing import NDArray

from nlos_calibration.arrays import Float32, Float64, Mask, UInt8
from nlos_calibration.errors import RecordFileError
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.noise import DepthMean
from nlos_calibration.rig_check import MAP_SHAPE

FULL_SCALE = 255
"""IR counts of a saturated pixel."""
MAX_BYTES = 1 << 28
"""Bound on a reference file, and on its unpacked content: one of 640 x 480 pixels has some 20
MB.
"""
ABSOLUTE_ZERO_C = -273.15


def is_temperature(celsius: float) -> bool:
    """Return False for a reading that is none: an L515 reports -9999 until it has measured the
    photodiode's temperature, and a broken thermometer may read NaN or infinity.
    """
    return ABSOLUTE_ZERO_C < celsius < inf


class Moments:
    """Streaming mean and standard deviation of arrays of one shape, ignoring NaN. One thread."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.count = np.zeros(shape, np.int64)
        self._mean = np.zeros(shape)
        self._squares = np.zeros(shape)

    def add(self, values: NDArray[Any]) -> None:
        """Add one array of the shape."""
        # Welford's update (1962): the sum of squares grows by (x - old mean) (x - new mean), free
        # of cancellation
        known = np.isfinite(values)
        self.count += known
        off = np.where(known, values - self._mean, 0.0)
        self._mean += off / np.maximum(self.count, 1)
        self._squares += off * np.where(known, values - self._mean, 0.0)

    def mean(self) -> Float64:
        """Return the mean; NaN without a sample."""
        return np.where(self.count > 0, self._mean, np.nan)

    def spread(self) -> Float64:
        """Return the standard deviation of a sample; NaN with fewer than two."""
        return np.sqrt(self._squares / np.where(self.count > 1, self.count - 1.0, np.nan))


@dataclass(frozen=True, eq=False)
class BareWall:
    """Statistics of the lidar's frames with nothing hidden: the reference that difference maps are
    formed from.
    """

    depth_m: Float32
    """(height, width); the mean, NaN where fewer than half of the frames had a return."""
    depth_std_m: Float32
    """(height, width); of one sample, like all *_std; NaN where there are fewer than two."""
    ir: Float32
    """(height, width); in counts."""
    ir_std: Float32
    saturated: Float32
    """(height, width); share of the frames in which the IR was at its full scale."""
    inliers: Mask
    """(height, width); pixels of the wall's plane fit."""
    map_depth_m: Float32
    """(64, 80), like all map_*; NaN where no frame had a return in the cell."""
    map_depth_std_m: Float32
    map_intensity: Float32
    """NaN, like the depth, where no frame had a return."""
    map_intensity_std: Float32
    frames: int
    intrinsics: Intrinsics
    serial: str = ""
    settings: Mapping[str, float] = field(default_factory=dict[str, float])
    """Device options as read back when streaming began."""
    celsius: Mapping[str, float] = field(default_factory=dict[str, float])
    """Mean temperatures by the SDK's name; empty where the device reports none."""
    celsius_span: Mapping[str, float] = field(default_factory=dict[str, float])
    """Maximum less minimum of each temperature during the measurement."""


# The arrays come first among the fields and are stored as such; the rest is one JSON text.
ARRAYS = [known.name for known in fields(BareWall)][:10]
FACTS = [known.name for known in fields(BareWall)][10:]


class BareWallStatistics:
    """Collector of a BareWall from frames. Holds maps of sums, not the frames; one thread."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        shape = intrinsics.height, intrinsics.width
        self.depth = DepthMean(*shape)
        """Mean depth, which the wall's plane is fitted to."""
        self._intrinsics = intrinsics
        self._ir = Moments(shape)
        self._saturated = np.zeros(shape)
        self._map_depth = Moments(MAP_SHAPE)
        self._map_intensity = Moments(MAP_SHAPE)
        self._celsius: dict[str, list[float]] = {}

    def add(
        self, depth_m: Float32, ir: UInt8, map_depth_m: Float32, map_intensity: Float32
    ) -> None:
        """Add one frame (height, width) and its maps (64, 80)."""
        self.depth.add(depth_m)
        self._ir.add(ir)
        self._saturated += ir == FULL_SCALE
        self._map_depth.add(map_depth_m)
        # Without a return a cell's intensity is that of background light: leave it out like the
        # depth.
        self._map_intensity.add(np.where(np.isfinite(map_depth_m), map_intensity, np.nan))

    def add_temperatures(self, celsius: Mapping[str, float]) -> None:
        """Add one reading of the device's temperatures, by the SDK's name; may be empty. Values
        that are no temperatures are left out.
        """
        for name, value in celsius.items():
            if is_temperature(value):
                self._celsius.setdefault(name, []).append(value)

    def ir_mean(self) -> Float64:
        """Return the mean infrared (height, width) in counts; NaN before the first frame."""
        return self._ir.mean()

    def celsius(self) -> dict[str, float]:
        """Return the mean of each thermometer's readings."""
        return {name: float(np.mean(values)) for name, values in sorted(self._celsius.items())}

    def reference(self, inliers: Mask, *, serial: str, settings: Mapping[str, float]) -> BareWall:
        """Return the statistics so far; `inliers` (height, width) are the pixels of the wall's
        plane fit.
        """
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
            celsius_span={
                name: max(values) - min(values) for name, values in sorted(self._celsius.items())
            },
        )


def save_reference(path: Path, wall: BareWall) -> str:
    """Write the reference (.npz) and return its SHA-256 in hexadecimal digits, for the record."""
    facts = {name: getattr(wall, name) for name in FACTS} | {"intrinsics": asdict(wall.intrinsics)}
    arrays: dict[str, Any] = {name: getattr(wall, name) for name in ARRAYS}
    with path.open("wb") as file:
        np.savez_compressed(file, facts=json.dumps(facts), **arrays)
    return hashlib.sha256(path.read_bytes()).hexdigest()


def load_reference(path: Path, sha256: str) -> BareWall:
    """Read the reference that a record names. Raises RecordFileError if it is missing, damaged or
    another record's.
    """
    advice = "calibrate the wall again"
    # A file that is too long is not read; its digest is then that of no bytes, which matches none.
    try:
        content = path.read_bytes() if path.stat().st_size <= MAX_BYTES else b""
        digest = hashlib.sha256(content).hexdigest()
    except OSError as error:
        raise RecordFileError(
            f"cannot read the bare-wall reference {path} ({error.strerror}): keep it beside its"
            f" record, or {advice}"
        ) from error
    if digest != sha256:
        raise RecordFileError(
            f"{path} is not the reference that the record was written with (SHA-256 {digest[:12]},"
            f" not {sha256[:12]}): restore the original file, or {advice}"
        )
    try:
        # Before numpy allocates: a crafted archive of a few kB may claim gigabytes.
        _check_unpacked_size(content)
        with np.load(BytesIO(content)) as file:
            facts = json.loads(str(file["facts"]))
            arrays = {name: file[name] for name in ARRAYS}
        return BareWall(**arrays, **(facts | {"intrinsics": Intrinsics(**facts["intrinsics"])}))
    except Exception as error:  # numpy, zipfile and JSON raise almost anything for crafted bytes
        reason = " ".join(str(error).split()) or type(error).__name__
        raise RecordFileError(
            f"{path} is not a bare-wall reference ({reason:.200}): {advice}"
        ) from error


def _check_unpacked_size(content: bytes) -> None:
    with ZipFile(BytesIO(content)) as archive:
        if (unpacked := sum(entry.file_size for entry in archive.infolist())) > MAX_BYTES:
            raise ValueError(f"it unpacks to {unpacked} bytes")
