"""Log of a live run, one line per frame."""

import csv
import json
import logging
from pathlib import Path
from typing import IO, Any, Self

from nlos_cam.view import Moment

LOG_SUFFIXES = ".csv", ".jsonl"
FLUSH_INTERVAL_S = 1.0
"""Longest part of the log that is lost if the process is killed."""

log = logging.getLogger(__name__)


def log_line(moment: Moment) -> dict[str, Any]:
    """Return the fields of a moment's line; None for unknown values."""
    result = moment.result
    quality = result.reconstruction.quality
    return {
        "frame_number": result.frame_number,
        "timestamp_s": round(result.timestamp_s, 6),
        "published_s": round(moment.time_s, 6),
        "latency_ms": round(1e3 * moment.latency_s, 3),
        **{f"{stage}_ms": round(1e3 * seconds, 3) for stage, seconds in result.stages_s.items()},
        "dropped": moment.dropped,
        "verdict": result.verdict.value if result.verdict else None,
        "expected_iou": round(quality.iou[1], 4) if quality else None,
        "expected_error_mm": round(1e3 * quality.error_m, 2) if quality else None,
        "check_score": round(result.check.score, 4) if result.check else None,
        "celsius": max(moment.known_celsius.values(), default=None),
    }


class FrameLog:
    """Log file, open while entered: .csv with a header, or one JSON object per line (.jsonl). Used
    by one thread.

    The columns of a .csv are those of its first line. An earlier log stays until that line comes. A
    write error ends the log with a warning, not the run. Raises OSError on entering if the file
    cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: IO[str] | None = None
        self._table: csv.DictWriter[str] | None = None
        self._flushed_s = float("-inf")
        self._begun = False

    def __enter__(self) -> Self:
        self._file = self._path.open("a", encoding="utf-8", newline="")
        return self

    def __exit__(self, *_: object) -> None:
        file = self._file
        self._file = None
        if file is None:
            return
        try:
            file.close()
        except OSError as error:
            log.warning("%s: the log's end is lost (%s)", self._path, error.strerror)

    def add(self, moment: Moment) -> None:
        """Write one line; flushed once a second."""
        if self._file is None:
            return
        try:
            if not self._begun:
                self._file.truncate(0)
                self._begun = True
            self._write(self._file, log_line(moment))
            if moment.time_s - self._flushed_s >= FLUSH_INTERVAL_S:
                self._file.flush()
                self._flushed_s = moment.time_s
        except OSError as error:
            number = moment.result.frame_number
            log.warning("%s: the log ends at frame %d (%s)", self._path, number, error.strerror)
            self.__exit__()

    def _write(self, file: IO[str], line: dict[str, Any]) -> None:
        if self._path.suffix == ".jsonl":
            file.write(json.dumps(line) + "\n")
            return
        if self._table is None:
            self._table = csv.DictWriter(
                file, line.keys(), extrasaction="ignore", lineterminator="\n"
            )
            self._table.writeheader()
        self._table.writerow(line)
