"""Statistics of a live run: rate, latency, time of each stage, verdicts, warnings, stalls."""

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from nlos_calibration.arrays import Float64

from nlos_cam.camera import Camera
from nlos_cam.errors import NlosCamError
from nlos_cam.frames import Frame
from nlos_cam.reconstruct import (
    FrameReader,
    FrameResult,
    OnWarning,
    QualityLog,
    RecentValues,
    Verdict,
    WarningLog,
    frames_by_verdict,
    ignore,
)

SHARES = 50, 95, 99
STALLED_AFTER_S = 0.5
"""Fifteen frames: a healthy camera never pauses this long."""
STALLED = f"the camera stalled: no frame for {STALLED_AFTER_S:g} s, the view is old"
MAX_FAILED_IN_A_ROW = 30
"""Failed frames in a row after which the cause cannot be the frames."""
OUTSIDE_LATENCY = "wait", "view"
"""Stages before a frame's arrival and after its result; the latency consists of the others."""
LATENCY = "latency"
DELIVERY = "delivery"

Percentiles = dict[str, float]
"""p50, p95 and p99, rising."""

log = logging.getLogger(__name__)


@runtime_checkable
class ComputedCamera(Protocol):
    """Camera whose images this machine computes: a simulated one."""

    exposures_s: Sequence[float]
    """Seconds that the last images took to compute."""


def percentiles_ms(seconds: Float64) -> Percentiles:
    """Return the percentiles of times in seconds, in milliseconds; 0 for no times."""
    values = np.percentile(seconds, SHARES) if seconds.size else np.zeros(len(SHARES))
    return {f"p{share}": 1e3 * float(value) for share, value in zip(SHARES, values, strict=True)}


WARM_UP_FRAMES = 45
"""First frames (1.5 s) that raise no alarm when they are late: caches fill and libraries load."""
SLOW_FRAMES = 150
MAX_SLOW_SHARE = 0.02
"""Of this many frames (5 s), the share dropped by slow processing above which there is a
warning.
"""


class PaceWatch:
    """Detector of processing that is too slow, by the frames it drops; a warning begins and ends
    with it.
    """

    def __init__(self, on_warning: OnWarning) -> None:
        self.warnings: tuple[str, ...] = ()
        self._on_warning = on_warning
        self._before = (0, 0)
        self._is_warm = False

    def update(self, frames: int, dropped: int) -> None:
        """Take the numbers of frames with a result and of frames dropped so far; judged every
        SLOW_FRAMES.
        """
        if not self._is_warm:
            self._before = frames, dropped
            self._is_warm = frames + dropped >= WARM_UP_FRAMES
        new = frames - self._before[0]
        lost = dropped - self._before[1]
        if new + lost < SLOW_FRAMES:
            return
        self._before = frames, dropped
        slow = lost > MAX_SLOW_SHARE * (new + lost)
        text = (
            f"processing is too slow: {lost} of the last {new + lost} frames were dropped; stop"
            " other programs (another live run on these processors?), or give each run processors"
            " of its own (taskset)"
        )
        if slow != bool(self.warnings):
            self._on_warning(text if slow else self.warnings[0], slow)
        self.warnings = (text,) if slow else ()


class StallWatch:
    """Detector of stalls: a warning begins and ends with each. Used by the loop's thread."""

    def __init__(self, on_stall: OnWarning) -> None:
        self.stalls = 0
        self.stalled_s = 0.0
        """Sum over the stalls, from the last frame before each to the first after it."""
        self._on_stall = on_stall
        self._since_s: float | None = None
        """Arrival of the last frame, during a stall."""
        self._shown_s = 0.0

    def update(self, now_s: float, newest_s: float | None) -> bool:
        """Return whether to show the stall (again); `newest_s` is the newest frame's arrival, None
        before the first.
        """
        if newest_s is None:
            return False
        self.frame_arrived(newest_s)
        if now_s - newest_s < STALLED_AFTER_S:
            return False
        begins = self._since_s is None
        if begins:
            self._since_s = newest_s
            self.stalls += 1
            self._on_stall(STALLED, True)
        is_due = begins or now_s - self._shown_s >= STALLED_AFTER_S
        if is_due:
            self._shown_s = now_s
        return is_due

    def frame_arrived(self, newest_s: float) -> None:
        """End the stall if the frame arrived after it began."""
        if self._since_s is not None and newest_s > self._since_s:
            self.close(newest_s)
            self._on_stall(STALLED, False)

    def close(self, now_s: float) -> None:
        """End a stall with the run, without a call of `on_stall`."""
        if self._since_s is not None:
            self.stalled_s += now_s - self._since_s
            self._since_s = None


@dataclass(frozen=True)
class RunReport:
    """Summary of a live run. Start-up, until the first frame's result, is in no number."""

    frames: int
    fps: float
    dropped: int
    """Frames taken by the camera that have no result."""
    latency_ms: Mapping[str, float]
    """p50, p95 and p99 from timestamp to result; see `FrameReader.offset_s` for the two clocks."""
    stages_ms: Mapping[str, float]
    """Median by stage: delivery (from the timestamp to the reader), wait (for a frame), queue,
    maps, bench (difference and drift), network, doubt (the uncertainty network), view (hand-over
    to the viewer)."""
    counts: Mapping[str, int]
    """Counts above 0, by name: the camera's own, incomplete and dropped_camera; dropped_loop:
    processing was too slow; failed; blank, half_invalid, saturated (see `frame_issues`); stalls."""
    warnings: Mapping[str, int] = field(default_factory=dict[str, int])
    """Number of frames by warning of the bench."""
    stages_percentiles_ms: Mapping[str, Percentiles] = field(default_factory=dict[str, Percentiles])
    """By stage; the latency consists of all but OUTSIDE_LATENCY."""
    verdicts: Mapping[str, int] = field(default_factory=dict[str, int])
    """Number of frames by verdict; empty without an uncertainty model."""
    stalled_s: float = 0.0
    """Sum of the times without a frame; see `StallWatch`."""
    quality: Mapping[str, float] = field(default_factory=dict[str, float])
    """Of the frames with an object: medians `expected_iou` and `expected_error_mm`, share
    `trusted`; empty without.
    """
    camera_ms: Mapping[str, float] = field(default_factory=dict[str, float])
    """p50, p95 and p99 of computing a simulated camera's images, beside the latency; empty for
    other cameras.
    """


class RunStatistics:
    """Collector of a RunReport's numbers, in memory that does not grow with the frames. Used by the
    loop's thread.
    """

    def __init__(self, on_warning: OnWarning = ignore) -> None:
        self.warnings = WarningLog(on_warning)
        self.stall = StallWatch(on_warning)
        self.pace = PaceWatch(on_warning)
        self.frames = 0
        self.failed = 0
        """Frames whose processing raised an error."""
        self.quality = QualityLog()
        self.verdicts: Counter[Verdict] = Counter()
        self._times = RecentValues()
        """Latency and delivery as differences of two clocks, the loop's and the frames'."""
        self._first_s = self._last_s = 0.0

    def add(self, result: FrameResult, view_s: float) -> None:
        """Add a result, and the seconds that it took to hand it to the viewer."""
        if self.frames == 0:
            self._first_s = result.published_s
        self.frames += 1
        self._last_s = result.published_s
        ages_s = {LATENCY: result.published_s - result.timestamp_s}
        if result.arrived_s is not None:
            ages_s[DELIVERY] = result.arrived_s - result.timestamp_s
            self.stall.frame_arrived(result.arrived_s)
        self._times.add({**ages_s, **result.stages_s, "view": view_s})
        self.warnings.add(result)
        self.quality.add(result)
        if result.verdict:
            self.verdicts[result.verdict] += 1

    def fail(self, frame: Frame, error: Exception, in_a_row: int) -> None:
        """Count a failed frame. Raises errors that are not the frame's, and NlosCamError after
        MAX_FAILED_IN_A_ROW.
        """
        if isinstance(error, NlosCamError):
            raise error
        self.failed += 1
        reason = f"{type(error).__name__}: {error}"
        if in_a_row >= MAX_FAILED_IN_A_ROW:
            raise NlosCamError(
                f"{in_a_row} frames in a row failed ({reason}): record some with `capture` and"
                " report it"
            ) from error
        log.warning("frame %d failed (%s)", frame.frame_number, reason)

    def duration_s(self, now_s: float) -> float:
        """Return the seconds since the first result; 0 before it."""
        return now_s - self._first_s if self.frames else 0.0

    def lost(self, camera: Camera, reader: FrameReader) -> dict[str, int]:
        """Return the number of frames without a result, by cause."""
        return {
            "incomplete": camera.incomplete,
            "dropped_camera": camera.dropped,
            "dropped_loop": reader.dropped,
            "failed": self.failed,
        }

    def report(self, camera: Camera, reader: FrameReader) -> RunReport:
        stages = self._percentiles_ms(reader.offset_s)
        latency_ms = stages.pop(LATENCY)
        duration_s = self.duration_s(self._last_s)
        lost = self.lost(camera, reader)
        counts = {**camera.counts, **lost, **reader.issues, "stalls": self.stall.stalls}
        return RunReport(
            self.frames,
            fps=(self.frames - 1) / duration_s if duration_s > 0 else 0.0,
            dropped=sum(lost.values()),
            latency_ms=latency_ms,
            stages_ms={name: stage["p50"] for name, stage in stages.items()},
            counts={name: count for name, count in counts.items() if count},
            warnings=self.warnings.frames,
            stages_percentiles_ms=stages,
            verdicts=frames_by_verdict(self.verdicts),
            stalled_s=self.stall.stalled_s,
            quality=self.quality.summary,
            camera_ms=camera_ms(camera),
        )

    def _percentiles_ms(self, offset_s: float) -> dict[str, Percentiles]:
        """Return percentiles by stage, latency first; the loop's clock is `offset_s` later than the
        frames'.
        """
        offsets_s = {LATENCY: offset_s, DELIVERY: offset_s}
        names = [LATENCY, *(name for name in self._times.names if name != LATENCY)]
        return {
            name: percentiles_ms(self._times.of(name) - offsets_s.get(name, 0.0)) for name in names
        }


def camera_ms(camera: Camera) -> Percentiles:
    """Return percentiles of the time in which a simulated camera computes an image; empty for other
    cameras.
    """
    if not isinstance(camera, ComputedCamera) or not camera.exposures_s:
        return {}
    return percentiles_ms(np.array(camera.exposures_s))
