"""What a live run did: how fast, how late, and what it saw."""

import logging
import re
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from nlos_cam.camera.base import Camera
from nlos_cam.errors import NlosCamError
from nlos_cam.frame_reader import FrameReader
from nlos_cam.frames import Frame, LidarMaps
from nlos_cam.physics_check import Check
from nlos_cam.reconstruct import Reconstruction
from nlos_cam.verdict import Verdict

MOST_FAILED = 30
"""Frames in a row that come to no result: so many are not the frames' fault."""
REMEMBERED = 100_000
"""Latencies are told of the last frames only (55 minutes at 30 frames/s): memory stays bounded."""

FIGURES = re.compile(r"\d+(\.\d+)?")

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Step:
    """One frame's way through the loop."""

    frame: Frame
    maps: LidarMaps
    reconstruction: Reconstruction
    published_s: float
    stages_s: Mapping[str, float]
    difference: LidarMaps | None = None
    """The maps less the bare wall's; None without a reference."""
    warnings: tuple[str, ...] = ()
    verdict: Verdict | None = None
    """None from networks that do not tell."""
    check: Check | None = None
    """The newest physics check, of this frame or an earlier one."""


OnWarning = Callable[[str, bool], None]
"""Called with a warning, and whether it begins (or ends)."""


def say_nothing(warning: str, begins: bool) -> None:
    """Nobody listens to warnings as they come."""
    del warning, begins


@dataclass
class Held:
    """The frames that a warning held for."""

    text: str
    """As it was told last."""
    frames: int
    first: int
    last: int
    """Frame numbers; it may have ended and begun again between."""


class Warned:
    """Which warnings held for which frames; tells when one begins and when it ends, not when its figures change."""

    def __init__(self, on_warning: OnWarning = say_nothing) -> None:
        self._held: dict[str, Held] = {}
        self._on_warning, self._now = on_warning, set[str]()

    def add(self, step: Step) -> None:
        number, before = step.frame.frame_number, self._now
        self._now = {self._note(warning, number) for warning in step.warnings}
        for subject, held in self._held.items():
            if (begins := subject in self._now) != (subject in before):
                self._on_warning(held.text, begins)

    def _note(self, warning: str, number: int) -> str:
        """Count a frame for a warning; what it is about."""
        subject = FIGURES.sub("", warning)
        held = self._held.setdefault(subject, Held(warning, 0, number, number))
        held.text, held.frames, held.last = warning, held.frames + 1, number
        return subject

    @property
    def held(self) -> list[Held]:
        """Each warning, in the order in which they first began."""
        return list(self._held.values())

    def frames(self) -> dict[str, int]:
        """How many frames each held for."""
        return {held.text: held.frames for held in self.held}


@dataclass(frozen=True)
class LiveReport:
    """What a live run did. Start-up, until the first frame's result, is in no figure."""

    frames: int
    fps: float
    dropped: int
    """Frames that the camera took and that came to no result."""
    latency_ms: Mapping[str, float]
    """p50, p95 and p99 from timestamp to result; `FrameReader.offset_s` tells how clocks are matched."""
    stages_ms: Mapping[str, float]
    """Median by stage: wait (for a frame), maps, bench (their difference and what has drifted), network, view (handing
    over to it)."""
    counts: Mapping[str, int]
    """By name, those that are not 0: what the camera counts, incomplete and dropped_camera; dropped_loop, for which the
    loop was too slow; failed, which came to no result; blank, half_invalid, saturated (see `sightings`)."""
    warnings: Mapping[str, int] = field(default_factory=dict[str, int])
    """Of the bench, and the frames that each held for."""


class Tally:
    """Collects what LiveReport tells."""

    def __init__(self, on_warning: OnWarning = say_nothing) -> None:
        self.warned = Warned(on_warning)
        self.frames = 0
        self.failed = 0
        """Frames of which no result could be made."""
        self.seen: Counter[str] = Counter()
        """What was amiss with frames, by name."""
        self._ages_s: deque[float] = deque(maxlen=REMEMBERED)
        self._stages_s: deque[Mapping[str, float]] = deque(maxlen=REMEMBERED)
        self._first_s = self._last_s = 0.0

    def add(self, step: Step, view_s: float) -> None:
        if self.frames == 0:
            self._first_s = step.published_s
        self.frames += 1
        self._last_s = step.published_s
        self._ages_s.append(step.published_s - step.frame.timestamp_s)
        self._stages_s.append({**step.stages_s, "view": view_s})
        self.warned.add(step)

    def fail(self, frame: Frame, error: Exception, in_a_row: int) -> None:
        """Count a frame that came to no result. Raises an error that is not the frame's, and after MOST_FAILED."""
        if isinstance(error, NlosCamError):
            raise error
        self.failed += 1
        what = f"{type(error).__name__}: {error}"
        if in_a_row >= MOST_FAILED:
            message = f"{in_a_row} frames in a row came to no result ({what}): record some with `capture`, report it"
            raise NlosCamError(message) from error
        log.warning("frame %d came to no result (%s)", frame.frame_number, what)

    def lasted_s(self, now_s: float) -> float:
        """Since the first result."""
        return now_s - self._first_s if self.frames else 0.0

    def report(self, camera: Camera, reader: FrameReader) -> LiveReport:
        latencies_ms = (np.array(self._ages_s) - reader.offset_s) * 1e3 if self.frames else np.zeros(1)
        latency_ms = {f"p{share}": float(np.percentile(latencies_ms, share)) for share in (50, 95, 99)}
        names = self._stages_s[0] if self._stages_s else {}
        stages_ms = {name: float(np.median([s[name] for s in self._stages_s])) * 1e3 for name in names}
        lasted_s = self.lasted_s(self._last_s)
        fps = (self.frames - 1) / lasted_s if lasted_s > 0 else 0.0
        lost = {"incomplete": camera.incomplete, "dropped_camera": camera.dropped, "dropped_loop": len(reader.dropped)}
        counts = {**camera.counts, **lost, "failed": self.failed, **self.seen}
        dropped = sum(lost.values()) + self.failed
        told = {name: count for name, count in counts.items() if count}
        return LiveReport(self.frames, fps, dropped, latency_ms, stages_ms, told, self.warned.frames())
