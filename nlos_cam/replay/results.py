"""Results of a replay, collected frame by frame in memory that does not grow with large arrays."""

from collections import Counter
from collections.abc import Callable
from typing import IO, Any, NamedTuple

import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Float32

from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, OBJECT_PIXELS
from nlos_cam.objects import object_box
from nlos_cam.reconstruct import (
    UNEXPLAINED,
    CalibratedRig,
    FrameResult,
    OnWarning,
    PhysicsCheckResult,
    QualityLog,
    Verdict,
    WarningLog,
    frames_by_verdict,
)

NewFile = Callable[[], IO[bytes]]
"""Opens a temporary file."""


class ArrayStack:
    """Arrays of one shape, written to a file one by one, so that an hour of them fits into
    memory.
    """

    def __init__(self, file: IO[bytes], *shape: int) -> None:
        self._file = file
        self._shape = shape
        self._count = 0

    def add(self, array: Float32) -> None:
        self._file.write(np.ascontiguousarray(array, np.float32).tobytes())
        self._count += 1

    def all(self) -> Float32:
        """Return (count, *shape), mapped from the file."""
        self._file.flush()
        return np.memmap(self._file, np.float32, "r", shape=(self._count, *self._shape))


class CheckedFrame(NamedTuple):
    """Frame with a physics check."""

    number: int
    score: float
    unexplained: bool
    """True if the score is one from which on the maps are not explained."""


class ReplayResults:
    """Collector of the frames' results; `new_file` opens the files of the large arrays.

    `unexplained_empty` is the score of the physics check from which on maps without a surface are
    not explained; with one it is UNEXPLAINED. `weights` are name and checksum of the networks'.
    """

    def __init__(
        self,
        new_file: NewFile,
        on_warning: OnWarning,
        unexplained_empty: float = UNEXPLAINED,
        weights: str = "",
    ) -> None:
        self.unexplained_empty = unexplained_empty
        self.weights = weights
        self.numbers: list[int] = []
        self.timestamps_s: list[float] = []
        self.frames_with_surface = 0
        self.uncertainty_mm: list[float] = []
        """Median over the surface, by frame with a surface and an uncertainty model."""
        self.checks: list[CheckedFrame] = []
        self._newest: PhysicsCheckResult | None = None
        """Last check; each holds for several frames, whose numbers a restarted device repeats."""
        self.quality = QualityLog()
        self.warnings = WarningLog(on_warning)
        self._verdicts: list[Verdict | None] = []
        self._expected: list[tuple[float, float]] = []
        """Predicted IoU and error in metres by frame; NaN where unknown."""
        self._depth_m = ArrayStack(new_file(), OBJECT_PIXELS, OBJECT_PIXELS)
        self._uncertainty_m = ArrayStack(new_file(), OBJECT_PIXELS, OBJECT_PIXELS)
        self._difference_m = ArrayStack(new_file(), MAP_ROWS, MAP_COLUMNS)
        self._difference_intensity = ArrayStack(new_file(), MAP_ROWS, MAP_COLUMNS)

    def add(self, result: FrameResult) -> None:
        self.numbers.append(result.frame_number)
        self.timestamps_s.append(result.timestamp_s)
        self._verdicts.append(result.verdict)
        self.quality.add(result)
        self.warnings.add(result)
        if result.check and result.check is not self._newest:
            self._newest = result.check
            limit = UNEXPLAINED if result.check.has_surface else self.unexplained_empty
            score = result.check.score
            self.checks.append(CheckedFrame(result.check.frame_number, score, score >= limit))
        quality = result.reconstruction.quality
        self._expected.append((quality.iou[1], quality.error_m) if quality else (np.nan, np.nan))

        depth_m = result.depth_m
        uncertainty_m = result.uncertainty_m
        has_surface = result.reconstruction.has_surface
        self.frames_with_surface += has_surface
        if has_surface and uncertainty_m is not None:
            self.uncertainty_mm.append(1e3 * float(np.median(uncertainty_m[np.isfinite(depth_m)])))

        if uncertainty_m is None:
            uncertainty_m = np.full_like(depth_m, np.nan)
        self._depth_m.add(depth_m)
        self._uncertainty_m.add(uncertainty_m)
        if result.difference:
            self._difference_m.add(result.difference.depth_m)
            self._difference_intensity.add(result.difference.intensity)

    @property
    def verdicts(self) -> dict[str, int]:
        """Number of frames by verdict; empty without an uncertainty model."""
        return frames_by_verdict(Counter(verdict for verdict in self._verdicts if verdict))

    @property
    def duration_s(self) -> float:
        """Recorded time from the first frame to the last, without steps of the clock backwards, as
        after a restart of the device.
        """
        return float(np.maximum(np.diff(self.timestamps_s), 0.0).sum())

    def hidden_arrays(self, rig: Rig) -> dict[str, Any]:
        """Return the arrays of reconstruction.npz."""
        box = object_box(rig)
        pitch_x_m = (box.x_max_m - box.x_min_m) / OBJECT_PIXELS
        pitch_y_m = (box.y_max_m - box.y_min_m) / OBJECT_PIXELS
        expected = np.array(self._expected)
        # Wall (x, y) of pixel (0, 0), and from one column and one row to the next:
        origin_m = np.array([box.x_min_m + pitch_x_m / 2, box.y_max_m - pitch_y_m / 2])
        pitch_m = np.array([pitch_x_m, -pitch_y_m])
        return {
            **self._frame_arrays(rig),
            "weights": np.array(self.weights, np.str_),
            "depth_m": self._depth_m.all(),
            "uncertainty_m": self._uncertainty_m.all(),
            "verdict": np.array([verdict or "" for verdict in self._verdicts], np.str_),
            "expected_iou": expected[:, 0],
            "expected_error_m": expected[:, 1],
            "origin_m": origin_m,
            "pitch_m": pitch_m,
            "z_near_m": box.z_near_m,
            "z_far_m": box.z_far_m,
            "check_frame_number": np.array([each.number for each in self.checks], np.int64),
            "check_score": np.array([each.score for each in self.checks], np.float64),
        }

    def difference_arrays(self, bench: CalibratedRig) -> dict[str, Any]:
        """Return the arrays of difference.npz."""
        return {
            **self._frame_arrays(bench.rig),
            "depth_m": self._difference_m.all(),
            "intensity": self._difference_intensity.all(),
            "reference_sha256": bench.measured.record.reference_sha256 if bench.measured else "",
        }

    def _frame_arrays(self, rig: Rig) -> dict[str, Any]:
        return {
            "timestamp_s": np.array(self.timestamps_s),
            "frame_number": np.array(self.numbers, np.int64),
            "rig_name": rig.name,
            "rig_checksum": rig.checksum,
        }
