"""A viewer that films what it is shown, as a video that browsers play (VP8 in WebM)."""

import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

from nlos_calibration.rig import Rig

from nlos_cam.errors import NlosCamError
from nlos_cam.view.still import HEIGHT, WIDTH, Still
from nlos_cam.view.viewer import Moment

FRAMES_PER_S = 15.0
SLACK_S = 0.01
"""Frames come at 30 per second: every second is filmed, and not every third because of a thousandth."""
LIDAR_EVERY = 5
CODEC = "VP80"


class Film:
    """Films moments while entered, 15 per second of their own clock; drawing is done by whoever shows them."""

    address: str | None = None

    def __init__(self, path: Path, rig: Rig) -> None:
        self.filmed = 0
        """Pictures."""
        self._path, self._rig = path, rig
        self._still: Still | None = None
        self._due_s = float("-inf")

    def __enter__(self) -> Self:
        self._writer = _writer(self._path)
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.release()

    def show(self, moment: Moment) -> None:
        """Film a moment if one is due."""
        if moment.published_s < self._due_s:
            return
        self._due_s = moment.published_s + 1.0 / FRAMES_PER_S - SLACK_S
        self._still = self._still or Still(self._rig, moment)
        self._writer.write(self._still.rgb(moment, with_lidar=self.filmed % LIDAR_EVERY == 0)[..., ::-1].copy())
        self.filmed += 1


def _writer(path: Path) -> Any:
    """Raises NlosCamError where this OpenCV has no such codec."""
    import cv2

    with _without_native_warnings():
        writer = cv2.VideoWriter(
            str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*CODEC), FRAMES_PER_S, (WIDTH, HEIGHT)
        )
    if not writer.isOpened():
        raise NlosCamError(
            f"{path} cannot be filmed: this OpenCV has no {CODEC} codec; reinstall it, or leave out --video"
        )
    return writer


@contextmanager
def _without_native_warnings() -> Generator[None]:
    """OpenCV tells the terminal that WebM has no name for VP8, which it then gives it."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
