"""Turn: mean maps of some frames with the object in or out, under each setting, and its file."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from nlos_calibration.arrays import Float32
from numpy.typing import NDArray

from nlos_cam.errors import RecordingError
from nlos_cam.files import atomic_file, read_arrays
from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, Frame, maps_from_frame

CHANNELS = "depth", "infrared", "confidence"
MAPS = len(CHANNELS), MAP_ROWS, MAP_COLUMNS
TURN_LIMIT = 64 << 20
"""Bytes that one turn may unpack to."""


@dataclass(frozen=True)
class Turn:
    """Statistics of one turn: S settings, three channels (depth in m, infrared in counts,
    confidence from 0 to 15).
    """

    object_in: bool
    time_s: NDArray[np.float64]
    """(S,); middle of the setting's frames, in seconds since 1970."""
    mean: Float32
    """(S, 3, 64, 80); NaN where fewer than half of the frames had a return."""
    std: Float32
    """(S, 3, 64, 80); of one frame."""
    frames: int
    celsius: Mapping[str, float] = field(default_factory=dict[str, float])
    """Temperatures after the turn, by the SDK's names."""

    def save(self, path: Path) -> None:
        """Write the turn to an .npz file: it is there as a whole, or not at all."""
        facts = {"object_in": self.object_in, "frames": self.frames, "celsius": dict(self.celsius)}
        with atomic_file(path) as part:
            np.savez_compressed(
                part,
                time_s=self.time_s,
                mean=self.mean,
                std=self.std,
                facts=np.frombuffer(json.dumps(facts).encode(), np.uint8),
            )

    @classmethod
    def load(cls, path: Path, settings: int) -> "Turn":
        """Read a turn of that many settings. Raises RecordingError where it is none."""
        try:
            arrays = read_arrays(path, ("time_s", "mean", "std", "facts"), TURN_LIMIT)
            facts = json.loads(arrays["facts"].tobytes())
            turn = cls(
                bool(facts["object_in"]),
                arrays["time_s"].astype(np.float64),
                arrays["mean"].astype(np.float32),
                arrays["std"].astype(np.float32),
                int(facts["frames"]),
                {str(name): float(value) for name, value in facts["celsius"].items()},
            )
        except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
            raise RecordingError(
                f"{path} is not a turn of `nlos-cam detect`: delete it, and the same command"
                " measures its four turns again"
            ) from error
        shapes = turn.time_s.shape, turn.mean.shape, turn.std.shape
        if shapes != ((settings,), (settings, *MAPS), (settings, *MAPS)):
            raise RecordingError(
                f"{path} has arrays of shapes {shapes}, not those of {settings} settings: delete"
                " it, and the same command measures its four turns again"
            )
        if not np.isfinite(turn.time_s).all():
            raise RecordingError(
                f"{path} holds no time for a setting: delete it, and the same command measures its"
                " four turns again"
            )
        return turn


class TurnSums:
    """Sums over the frames of one setting, from which mean and standard deviation follow."""

    def __init__(self) -> None:
        self._count = np.zeros(MAPS)
        self._shift: NDArray[np.float64] | None = None
        self._sum = np.zeros(MAPS)
        self._squares = np.zeros(MAPS)
        self._times_s: list[float] = []

    def add(self, frame: Frame) -> None:
        """Add the maps of a frame."""
        maps = maps_from_frame(frame)
        infrared = np.where(maps.valid, maps.intensity, np.float32(np.nan))
        # The confidence of a cell without depth counts too: it is what the device reports.
        confidence = cv2.resize(
            frame.confidence.astype(np.float32),
            (MAP_COLUMNS, MAP_ROWS),
            interpolation=cv2.INTER_AREA,
        )
        values = np.stack([maps.depth_m, infrared, confidence]).astype(np.float64)
        known = np.isfinite(values)
        # Sums of differences from the first values: squares of small numbers lose no digits.
        if self._shift is None:
            self._shift = np.zeros(MAPS)
        first = known & (self._count == 0)
        self._shift[first] = values[first]
        off = np.where(known, values - self._shift, 0.0)
        self._count += known
        self._sum += off
        self._squares += off**2
        self._times_s.append(frame.timestamp_s)

    def statistics(self) -> tuple[float, Float32, Float32]:
        """Return the mean time in seconds, and mean and standard deviation (3, 64, 80)."""
        frames = len(self._times_s)
        enough = self._count >= max(2.0, frames / 2)
        count = np.maximum(self._count, 2.0)
        shift = np.zeros(MAPS) if self._shift is None else self._shift
        mean = np.where(enough, shift + self._sum / count, np.nan)
        variance = (self._squares - self._sum**2 / count) / (count - 1.0)
        std = np.where(enough, np.sqrt(np.maximum(variance, 0.0)), np.nan)
        return float(np.mean(self._times_s)), mean.astype(np.float32), std.astype(np.float32)
