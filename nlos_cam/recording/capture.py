"""Takes of one running camera, each recorded with its sidecar and then verified."""

from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Event, Thread

from nlos_calibration import Rig

from nlos_cam.camera import RESERVE_BYTES, Camera, Recording
from nlos_cam.errors import CameraError, DiskFullError, NlosCamError, RecordingError
from nlos_cam.frames import Frame
from nlos_cam.recording.playback import VerifyResult
from nlos_cam.recording.quality import Quality, QualityMeter
from nlos_cam.recording.repair import recoverable_frames
from nlos_cam.recording.sidecar import (
    SidecarFile,
    Summary,
    TakeState,
    WallFile,
    sidecar_path,
    summary_of,
)

POLL_S = 0.1
LAST_FRAME_S = 1.0
"""Interval at which a capture looks whether it is to stop, and the time in which a frame may still
come that ends it.
"""


@dataclass(frozen=True)
class CaptureTarget:
    """File and label of a take to be recorded."""

    path: Path
    label: str | None = None


@dataclass(frozen=True)
class CaptureResult:
    """Outcome of a take."""

    target: CaptureTarget
    state: TakeState
    sets: int
    """Complete sets of the three streams that came while it recorded."""
    quality: Quality
    sidecar: SidecarFile
    error: NlosCamError | None = None
    """Reason for its end, other than its limit or the user."""
    follows_another: bool = False
    """Whether the device ran when it began: with several device threads, the first set may be in
    part before it.
    """
    events: Counter[str] = field(default_factory=Counter[str])
    verified: VerifyResult | None = None
    """Contents of the file, once verified."""
    closed: bool = True
    """Whether the file has its index, without which it cannot be read."""
    recoverable: Mapping[str, int] | None = None
    """Frames of each stream in a file without an index."""

    @property
    def summary(self) -> Summary:
        summary = summary_of(self.verified, self.quality, self.events)
        if self.recoverable is None:
            return summary
        frames = min(self.recoverable.values(), default=0)
        return summary.model_copy(update={"frames": frames, "streams": dict(self.recoverable)})


class CaptureSession:
    """Recorder of takes one after another while a camera runs, from one thread.

    Takes a camera that was opened with `recording`, the first of the `targets`; `record` enters and
    leaves it.
    """

    def __init__(
        self,
        camera: Camera,
        recording: Recording,
        targets: Sequence[CaptureTarget],
        *,
        wall: tuple[Rig, WallFile] | None = None,
    ) -> None:
        self.targets = targets
        self._camera = camera
        self._recording = recording
        self._wall = wall

    def record(self, stop: Event, on_sets: Callable[[int], None]) -> Generator[CaptureResult]:
        """Yield each take when its file is closed; the camera is left before the last one, and runs
        on before others.

        `on_sets` gets the number of sets recorded so far. A take that ends before its limit is the
        last. Raises CameraError where the camera does not start.
        """
        take: CaptureResult | None = None
        try:
            with ExitStack() as entered:
                frames = iter(entered.enter_context(self._camera))
                for number, target in enumerate(self.targets):
                    if take:
                        self._recording.close()
                        yield take
                        take = None
                        self._recording.next_take(target.path, last=target is self.targets[-1])
                    take = replace(
                        self._take(target, frames, stop, on_sets), follows_another=number > 0
                    )
                    if take.state != "complete":
                        break
        except DiskFullError as error:
            if take is None:
                raise
            take = replace(take, state=self._recording.cause, error=error, closed=False)
        if take:
            yield replace(
                take, sets=self._recording.sets
            )  # with the set that was in flight at its end

    def _take(
        self,
        target: CaptureTarget,
        frames: Iterator[Frame],
        stop: Event,
        on_sets: Callable[[int], None],
    ) -> CaptureResult:
        sidecar = SidecarFile(
            sidecar_path(target.path), self._camera, label=target.label, wall=self._wall
        )
        meter = QualityMeter()
        state: TakeState = "complete"
        error: NlosCamError | None = None
        counts_before = Counter(self._camera.counts)
        try:
            with _leaving_on(stop, self._camera) as left:
                for frame in self._recorded(frames):
                    meter.add(frame)
                    sidecar.on_frame(frame)
                    on_sets(self._recording.sets)
                    if stop.is_set():
                        state = "interrupted"
                        break
            if left.is_set():
                state = "interrupted"
        except CameraError as lost:
            state = "lost"
            error = lost
        if self._recording.disk_full:
            state = "disk full"
            error = DiskFullError(
                f"less than {RESERVE_BYTES / 1e6:.0f} MB and room for its index were left for"
                f" {target.path}: free some, or choose an --out on another disk"
            )
        events = Counter(self._camera.counts) - counts_before
        return CaptureResult(
            target, state, self._recording.sets, meter.quality(), sidecar, error, events=events
        )

    def _recorded(self, frames: Iterator[Frame]) -> Iterator[Frame]:
        """Yield the frames that belong to the take, until it ends."""
        for frame in frames:
            if self._recording.covers(frame.timestamp_s):
                yield frame
            elif self._recording.done:
                return


@contextmanager
def _leaving_on(stop: Event, camera: Camera) -> Generator[Event]:
    """Leave a camera that gives no frame after `stop`, which ends its iteration; yield an event that
    tells so.

    A silent camera restarts its device and waits for it for minutes, in which no frame asks for
    `stop`.
    """
    ended = Event()
    left = Event()

    def watch() -> None:
        while not ended.wait(POLL_S):
            if stop.is_set():
                if not ended.wait(LAST_FRAME_S):
                    left.set()
                    camera.__exit__(None, None, None)
                return

    thread = Thread(target=watch, name="stop of a capture", daemon=True)
    thread.start()
    try:
        yield left
    finally:
        ended.set()
        thread.join()


def finalize(
    take: CaptureResult, read_back: Callable[[Path], VerifyResult | None]
) -> CaptureResult:
    """Verify a closed take with `read_back`, and write its outcome into the sidecar.

    One without any frame has no files: its `Recording` has put back those from before. `read_back`
    returns None when interrupted.
    """
    if take.sets == 0:
        return take
    final = _verify(take, read_back) if take.closed else _count(take)
    try:
        final.sidecar.finish(final.state, final.summary)
    except DiskFullError as error:
        return replace(final, error=final.error or error)
    return final


def _count(take: CaptureResult) -> CaptureResult:
    """Count the frames in a file that was not closed: not all that came were written."""
    try:
        return replace(take, recoverable=recoverable_frames(take.target.path))
    except OSError:
        return take


def _verify(take: CaptureResult, read_back: Callable[[Path], VerifyResult | None]) -> CaptureResult:
    try:
        found = read_back(take.target.path)
    except RecordingError as error:
        return replace(take, state="damaged", error=error)
    if found is None:
        return replace(take, state="interrupted")
    # Without metadata a reader pairs the streams differently, so that some recorded frames are in
    # no set.
    recorded = max(found.frames, min(found.streams.values(), default=0))
    if recorded < take.sets - take.follows_another:
        error = RecordingError(
            f"{take.target.path} holds {found.frames} of the {take.sets} frames that came: check"
            " the disk's free space and speed, and record again"
        )
        return replace(take, state="damaged", error=error, verified=found)
    return replace(take, verified=found)
