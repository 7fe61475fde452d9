"""What `nlos-cam live` leaves behind, where it is asked to: a recording, a log of its frames, a saved view."""

from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from nlos_cam.camera import Recording
from nlos_cam.cli.common import output_path, say
from nlos_cam.cli.view import SUFFIX
from nlos_cam.live.frame_log import SUFFIXES, FrameLog
from nlos_cam.view.viewer import Moment

RecordTo = Annotated[Path | None, typer.Option("--record", help="Also record the camera's streams (F.bag).")]
Log = Annotated[Path | None, typer.Option("--log", help="Write one line for each frame: F.csv, or F.jsonl.")]


@dataclass(frozen=True)
class Kept:
    """What a live run leaves behind, where it was asked to."""

    recording: Recording | None
    log: Path | None
    view: Path | None

    def say(self) -> None:
        """Where it is, once it is written."""
        if self.recording:
            say(f"recorded {self.recording.sets} frames to {self.recording.path}")
        if self.view:
            say(f"saved the view: nlos-cam view {self.view}")

    @contextmanager
    def logging(self) -> Generator[Callable[[Moment], None]]:
        """What is called with each frame's moment: a log's `add`, if there is a path to write it to."""
        if self.log is None:
            yield lambda _: None
            return
        with FrameLog(self.log) as frame_log:
            yield frame_log.add
        say(f"logged each frame to {self.log}")


def kept_of(record: Path | None, log: Path | None, save_view: Path | None, *, overwrite: bool) -> Kept:
    """Raises typer.BadParameter for a name that is not of its kind, or that is taken."""
    path = _named(record, "--record", "a recording", (".bag",), overwrite=overwrite)
    frame_log = _named(log, "--log", "a log", SUFFIXES, overwrite=overwrite)
    view = _named(save_view, "--save-view", "a saved view", (SUFFIX,), overwrite=overwrite)
    return Kept(Recording(path, optional=True) if path else None, frame_log, view)


def _named(path: Path | None, option: str, what: str, suffixes: tuple[str, ...], *, overwrite: bool) -> Path | None:
    """Where something is written, if it is. Raises typer.BadParameter for a name that is not of its kind."""
    if path is None:
        return None
    if path.suffix not in suffixes:
        raise typer.BadParameter(f"{option} {path}: {what}'s name ends in {' or '.join(suffixes)}")
    return output_path(path, "live", path.suffix, overwrite=overwrite)
