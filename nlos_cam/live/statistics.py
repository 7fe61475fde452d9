"""What a live run did: how fast, how late, and what it saw.

How long each stage of the last frames took, in memory of a fixed size.

Notices that a camera gives no frames any more, and that it gives some again.
"""

import logging
import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from nlos_cam.camera import Camera
from nlos_cam.errors import NlosCamError
from nlos_cam.frames import Frame
from nlos_cam.live.frame_queue import FrameReader
from nlos_cam.reconstruct import FrameResult, Verdict

REMEMBERED = 100_000
"""Frames: 55 minutes at 30 frames/s, and 0.8 MB for each stage, which are taken at the first frame."""
SHARES = 50, 95, 99

Percentiles = dict[str, float]
"""p50, p95 and p99, rising."""


class StageTimes:
    """Seconds by stage of the last frames; a stage may be missing from some."""

    def __init__(self, remembered: int = REMEMBERED) -> None:
        self._remembered, self._next = remembered, 0
        self._columns: dict[str, NDArray[np.float64]] = {}

    def add(self, seconds: Mapping[str, float]) -> None:
        """Take one frame's in, in the place of the oldest where there is no other."""
        for name in seconds:
            if name not in self._columns:
                self._columns[name] = np.full(self._remembered, np.nan)
        for name, column in self._columns.items():
            column[self._next] = seconds.get(name, np.nan)
        self._next = (self._next + 1) % self._remembered

    @property
    def stages(self) -> list[str]:
        """In the order in which they were first told."""
        return list(self._columns)

    def of(self, stage: str) -> NDArray[np.float64]:
        """What is remembered of a stage, in no order."""
        column = self._columns.get(stage, np.empty(0))
        return column[~np.isnan(column)]


def percentiles_ms(seconds: NDArray[np.float64]) -> Percentiles:
    """Of any number of times; 0 of none."""
    values = np.percentile(seconds, SHARES) if seconds.size else np.zeros(len(SHARES))
    return {f"p{share}": 1e3 * float(value) for share, value in zip(SHARES, values, strict=True)}


STALLED_AFTER_S = 0.5
"""Fifteen frames: no pause of a camera that is well is as long."""
STALLED = f"the camera stalled: no frame for {STALLED_AFTER_S:g} s, what is shown is old"

OnStall = Callable[[str, bool], None]
"""Called with what to tell, and whether it begins (or ends)."""


class StallWatch:
    """Tells of each stall once, however often it looks."""

    def __init__(self, on_stall: OnStall) -> None:
        self.stalls = 0
        self.stalled_s = 0.0
        """In all, from the last frame before each stall to the first after it."""
        self._on_stall = on_stall
        self._since_s: float | None = None
        """The last frame's arrival, while stalled."""
        self._told_s = 0.0

    def look(self, now_s: float, newest_s: float | None) -> bool:
        """Whether it is time to show the stall, again; `newest_s` is when the newest frame came, None before any."""
        if newest_s is None:
            return False
        self.came(newest_s)
        if now_s - newest_s < STALLED_AFTER_S:
            return False
        if self._since_s is None:
            self._since_s, self.stalls, self._told_s = newest_s, self.stalls + 1, now_s
            self._on_stall(STALLED, True)
            return True
        if due := now_s - self._told_s >= STALLED_AFTER_S:
            self._told_s = now_s
        return due

    def came(self, newest_s: float) -> None:
        """A stall ends with a frame that came after it began."""
        if self._since_s is not None and newest_s > self._since_s:
            self.close(newest_s)
            self._on_stall(STALLED, False)

    def close(self, now_s: float) -> None:
        """The run ends: a stall under way ends with it, and nothing is told."""
        if self._since_s is not None:
            self.stalled_s += now_s - self._since_s
            self._since_s = None


MAX_FAILED_IN_A_ROW = 30
"""Frames in a row that come to no result: so many are not the frames' fault."""
OUTSIDE_LATENCY = "wait", "view"
"""Stages before a frame's arrival and after its result: the others are parts of its latency."""
LATENCY, DELIVERY = "latency", "delivery"

FIGURES = re.compile(r"\d+(\.\d+)?")

log = logging.getLogger(__name__)


OnWarning = Callable[[str, bool], None]
"""Called with a warning, and whether it begins (or ends)."""


def ignore(warning: str, begins: bool) -> None:
    """Nobody listens to warnings as they come."""
    del warning, begins


@dataclass
class WarningSpan:
    """The frames that a warning held for."""

    text: str
    """As it was told last."""
    frames: int
    first: int
    last: int
    """Frame numbers; it may have ended and begun again between."""


class WarningLog:
    """Which warnings held for which frames; tells when one begins and when it ends, not when its figures change."""

    def __init__(self, on_warning: OnWarning = ignore) -> None:
        self._held: dict[str, WarningSpan] = {}
        self._on_warning, self._now = on_warning, set[str]()

    def add(self, step: FrameResult) -> None:
        number, before = step.frame.frame_number, self._now
        self._now = {self._note(warning, number) for warning in step.warnings}
        for subject, held in self._held.items():
            if (begins := subject in self._now) != (subject in before):
                self._on_warning(held.text, begins)

    def _note(self, warning: str, number: int) -> str:
        """Count a frame for a warning; what it is about."""
        subject = FIGURES.sub("", warning)
        held = self._held.setdefault(subject, WarningSpan(warning, 0, number, number))
        held.text, held.frames, held.last = warning, held.frames + 1, number
        return subject

    @property
    def held(self) -> list[WarningSpan]:
        """Each warning, in the order in which they first began."""
        return list(self._held.values())

    def frames(self) -> dict[str, int]:
        """How many frames each held for."""
        return {held.text: held.frames for held in self.held}


@dataclass(frozen=True)
class RunReport:
    """What a live run did. Start-up, until the first frame's result, is in no figure."""

    frames: int
    fps: float
    dropped: int
    """Frames that the camera took and that came to no result."""
    latency_ms: Mapping[str, float]
    """p50, p95 and p99 from timestamp to result; `FrameReader.offset_s` tells how clocks are matched."""
    stages_ms: Mapping[str, float]
    """Median by stage: delivery (from the frame's timestamp until the loop's reader has it), wait (for a frame), queue
    (until its turn), maps, bench (their difference and what has drifted), network, view (handing over to it)."""
    counts: Mapping[str, int]
    """By name, those that are not 0: what the camera counts, incomplete and dropped_camera; dropped_loop, for which the
    loop was too slow; failed, which came to no result; blank, half_invalid, saturated (see `sightings`); stalls."""
    warnings: Mapping[str, int] = field(default_factory=dict[str, int])
    """Of the bench, and the frames that each held for."""
    stages_percentiles_ms: Mapping[str, Percentiles] = field(default_factory=dict[str, Percentiles])
    """By stage; all but OUTSIDE_LATENCY are parts of the latency."""
    verdicts: Mapping[str, int] = field(default_factory=dict[str, int])
    """By verdict, the frames that it was passed on; empty from networks that pass none."""
    stalled_s: float = 0.0
    """For how long, in all, the camera gave no frame; see `stall`."""


class RunStatistics:
    """Collects what RunReport tells, in memory that does not grow with the frames."""

    def __init__(self, on_warning: OnWarning = ignore) -> None:
        self.warned = WarningLog(on_warning)
        self.stall = StallWatch(on_warning)
        self.frames = 0
        self.failed = 0
        """Frames of which no result could be made."""
        self.seen: Counter[str] = Counter()
        """What was amiss with frames, by name."""
        self.verdicts: Counter[Verdict] = Counter()
        self._times = StageTimes()
        """With latency and delivery as by two clocks, the frames' and the loop's."""
        self._first_s = self._last_s = 0.0

    def add(self, step: FrameResult, view_s: float) -> None:
        if self.frames == 0:
            self._first_s = step.published_s
        self.frames += 1
        self._last_s = step.published_s
        ages_s = {LATENCY: step.published_s - step.frame.timestamp_s}
        if step.arrived_s is not None:
            ages_s[DELIVERY] = step.arrived_s - step.frame.timestamp_s
            self.stall.came(step.arrived_s)
        self._times.add({**ages_s, **step.stages_s, "view": view_s})
        self.warned.add(step)
        if step.verdict:
            self.verdicts[step.verdict] += 1

    def fail(self, frame: Frame, error: Exception, in_a_row: int) -> None:
        """Count a frame that came to no result. Raises an error that is not the frame's, and after MAX_FAILED_IN_A_ROW."""
        if isinstance(error, NlosCamError):
            raise error
        self.failed += 1
        what = f"{type(error).__name__}: {error}"
        if in_a_row >= MAX_FAILED_IN_A_ROW:
            message = f"{in_a_row} frames in a row came to no result ({what}): record some with `capture`, report it"
            raise NlosCamError(message) from error
        log.warning("frame %d came to no result (%s)", frame.frame_number, what)

    def lasted_s(self, now_s: float) -> float:
        """Since the first result."""
        return now_s - self._first_s if self.frames else 0.0

    def lost(self, camera: Camera, reader: FrameReader) -> dict[str, int]:
        """Frames that the camera took and that came to no result, by who lost them."""
        lost = {"incomplete": camera.incomplete, "dropped_camera": camera.dropped, "dropped_loop": len(reader.dropped)}
        return {**lost, "failed": self.failed}

    def report(self, camera: Camera, reader: FrameReader) -> RunReport:
        stages = self._percentiles_ms(reader.offset_s)
        latency_ms = stages.pop(LATENCY)
        stages_ms = {name: stage["p50"] for name, stage in stages.items()}
        lasted_s = self.lasted_s(self._last_s)
        fps = (self.frames - 1) / lasted_s if lasted_s > 0 else 0.0
        lost = self.lost(camera, reader)
        counts = {**camera.counts, **lost, **self.seen, "stalls": self.stall.stalls}
        told = {name: count for name, count in counts.items() if count}
        report = RunReport(self.frames, fps, sum(lost.values()), latency_ms, stages_ms, told, self.warned.frames())
        return replace(
            report,
            stages_percentiles_ms=stages,
            verdicts=frames_by_verdict(self.verdicts),
            stalled_s=self.stall.stalled_s,
        )

    def _percentiles_ms(self, offset_s: float) -> dict[str, Percentiles]:
        """Of the latency and each stage, by the loop's clock, which is `offset_s` later than the frames'."""
        offsets_s = {LATENCY: offset_s, DELIVERY: offset_s}
        names = [LATENCY, *(name for name in self._times.stages if name != LATENCY)]
        return {name: percentiles_ms(self._times.of(name) - offsets_s.get(name, 0.0)) for name in names}


def frames_by_verdict(verdicts: Counter[Verdict]) -> dict[str, int]:
    """Those that were passed, in the order in which they overrule each other."""
    return {verdict.value: verdicts[verdict] for verdict in Verdict if verdicts[verdict]}
