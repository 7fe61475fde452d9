"""Summaries of many results: warnings by frame, predicted qualities, verdicts."""

import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from nlos_calibration.arrays import Float64

from nlos_cam.reconstruct.frame_reader import ignore
from nlos_cam.reconstruct.pipeline import FrameResult
from nlos_cam.reconstruct.verdict import Verdict

REMEMBERED = 100_000
"""Frames: 55 minutes at 30 frames/s, and 0.8 MB for each name, allocated with the first frame."""
NUMBERS = re.compile(r"\d+(\.\d+)?")

OnWarning = Callable[[str, bool], None]
"""Called with a warning, and whether it begins (or ends)."""


class RecentValues:
    """Numbers of the last frames by name, in memory of a fixed size; a name may be missing from
    some frames.
    """

    def __init__(self, remembered: int = REMEMBERED) -> None:
        self._remembered = remembered
        self._next = 0
        self._columns: dict[str, Float64] = {}

    def add(self, values: Mapping[str, float]) -> None:
        """Add one frame's values, in place of the oldest if the memory is full."""
        for name in values:
            if name not in self._columns:
                self._columns[name] = np.full(self._remembered, np.nan)
        for name, column in self._columns.items():
            column[self._next] = values.get(name, np.nan)
        self._next = (self._next + 1) % self._remembered

    @property
    def names(self) -> list[str]:
        """Names, in order of their first frame."""
        return list(self._columns)

    def of(self, name: str) -> Float64:
        """Return the remembered values of a name, in no order."""
        column = self._columns.get(name, np.empty(0))
        return column[~np.isnan(column)]


@dataclass
class WarningSpan:
    """Frames during which a warning held."""

    text: str
    """Latest wording."""
    frames: int
    first: int
    last: int
    """Frame numbers; the warning may have ended and begun again between."""


ENDS_AFTER_FRAMES = 30
"""Frames without a warning after which it has ended: one that holds in every other frame would
begin and end many times a second."""


class WarningLog:
    """Record of warnings by frame. Calls `on_warning` when one begins or has ended, not when its
    numbers change.
    """

    def __init__(self, on_warning: OnWarning = ignore) -> None:
        self._spans: dict[str, WarningSpan] = {}
        self._on_warning = on_warning
        self._frames_since: dict[str, int] = {}
        """Frames since a warning that has not ended was there, by its subject."""

    def add(self, result: FrameResult) -> None:
        present = {self._count(warning, result.frame_number) for warning in result.warnings}
        for subject, span in self._spans.items():
            if subject in present:
                if subject not in self._frames_since:
                    self._on_warning(span.text, True)
                self._frames_since[subject] = 0
            elif subject in self._frames_since:
                self._frames_since[subject] += 1
                if self._frames_since[subject] == ENDS_AFTER_FRAMES:
                    del self._frames_since[subject]
                    self._on_warning(span.text, False)

    def _count(self, warning: str, number: int) -> str:
        """Count a frame for a warning, and return the warning's subject: its text without
        numbers.
        """
        subject = NUMBERS.sub("", warning)
        span = self._spans.setdefault(subject, WarningSpan(warning, 0, number, number))
        span.text = warning
        span.frames += 1
        span.last = number
        return subject

    @property
    def spans(self) -> list[WarningSpan]:
        """One for each warning, in order of their first frame."""
        return list(self._spans.values())

    @property
    def frames(self) -> dict[str, int]:
        """Number of frames by warning."""
        return {span.text: span.frames for span in self._spans.values()}


class QualityLog:
    """Predicted qualities of the last frames with a detected object."""

    def __init__(self) -> None:
        self._predicted = RecentValues()

    def add(self, result: FrameResult) -> None:
        quality = result.reconstruction.quality
        if result.verdict is Verdict.SEEN and quality:
            self._predicted.add(
                {
                    "expected_iou": quality.iou[1],
                    "expected_error_mm": 1e3 * quality.error_m,
                    "trusted": float(quality.trusted),
                }
            )

    @property
    def summary(self) -> dict[str, float]:
        """Medians of IoU and error, and share of trusted frames; empty without any frame."""
        summaries = {"expected_iou": np.median, "expected_error_mm": np.median, "trusted": np.mean}
        values = {name: self._predicted.of(name) for name in self._predicted.names}
        return {name: float(summaries[name](column)) for name, column in values.items()}


def frames_by_verdict(verdicts: Counter[Verdict]) -> dict[str, int]:
    """Return the counts above 0, in the order of Verdict."""
    return {verdict.value: verdicts[verdict] for verdict in Verdict if verdicts[verdict]}


def describe_counts(counts: Mapping[str, int]) -> str:
    """Return counts by name as text, "3 out of order, 1 blank"; empty if there are none."""
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items())
