"""CaptureSession: one recording after another of a camera that stays on, each with its sidecar, read back and summed up."""

from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Event

from nlos_calibration import Rig

from nlos_cam.camera import RESERVE_BYTES, Camera, Recording
from nlos_cam.errors import CameraError, DiskFullError, NlosCamError, RecordingError
from nlos_cam.frames import Frame
from nlos_cam.recording.playback import Verified
from nlos_cam.recording.quality import Quality, QualityMeter
from nlos_cam.recording.sidecar import SidecarFile, State, Summary, WallFile, sidecar_path, summary_of

Wall = tuple[Rig, WallFile]
OnSets = Callable[[int], None]
"""Called with the sets recorded so far."""


@dataclass(frozen=True)
class CaptureTarget:
    """A take to be made."""

    path: Path
    label: str | None = None


@dataclass(frozen=True)
class CaptureResult:
    """A take that was made."""

    job: CaptureTarget
    state: State
    sets: int
    """That came while it recorded."""
    quality: Quality
    sidecar: SidecarFile
    error: NlosCamError | None = None
    """Why it ended, where that is neither its limit nor whoever watched."""
    cut_in: bool = False
    """Begun while the device ran: in a device of several threads, the first set may have been on its way."""
    events: Counter[str] = field(default_factory=Counter[str])
    found: Verified | None = None
    """What the file holds, once it was read back."""

    closed: bool = True
    """Whether its file has its index; only then can it be read back."""

    @property
    def summary(self) -> Summary:
        return summary_of(self.found, self.quality, self.events)


class CaptureSession:
    """Records `jobs` one after another while a camera runs, which was opened with `recording`: the first of them."""

    def __init__(
        self, camera: Camera, recording: Recording, jobs: Sequence[CaptureTarget], *, wall: Wall | None = None
    ) -> None:
        self.jobs = jobs
        self._camera, self._recording, self._wall = camera, recording, wall

    def record(self, stop: Event, on_sets: OnSets) -> Generator[CaptureResult]:
        """Each take when it is closed; the camera runs on meanwhile, and is left before the last one is yielded.

        A take that was ended before its limit is the last. Raises CameraError where the camera does not start.
        """
        take: CaptureResult | None = None
        try:
            with ExitStack() as entered:
                frames = self._enter(entered)
                for number, job in enumerate(self.jobs):
                    if take:
                        self._recording.close()
                        yield take
                        take = None
                        self._recording.next_take(job.path, last=job is self.jobs[-1])
                    take = self._take(job, frames, stop, on_sets)
                    take = replace(take, cut_in=number > 0)
                    if take.state != "complete":
                        break
        except DiskFullError as error:
            if take is None:
                raise
            take = replace(take, state="disk full", error=error, closed=False)
        if take:
            yield replace(take, sets=self._recording.sets)  # with the one that was in flight when it ended

    def _enter(self, entered: ExitStack) -> Iterator[Frame]:
        try:
            return iter(entered.enter_context(self._camera))
        except BaseException:
            if self._recording.begun:  # and holds nothing
                self._recording.path.unlink(missing_ok=True)
            raise

    def _take(self, job: CaptureTarget, frames: Iterator[Frame], stop: Event, on_sets: OnSets) -> CaptureResult:
        sidecar = SidecarFile(sidecar_path(job.path), self._camera, label=job.label, wall=self._wall)
        meter = QualityMeter()
        state: State = "complete"
        error: NlosCamError | None = None
        try:
            for frame in self._recorded(frames):
                meter.add(frame)
                sidecar.on_frame(frame)
                on_sets(self._recording.sets)
                if stop.is_set():
                    state = "interrupted"
                    break
        except CameraError as lost:
            state, error = "lost", lost
        if self._recording.disk_full:
            state, error = "disk full", _short_of_space(job.path)
        events = Counter(self._camera.counts)
        return CaptureResult(job, state, self._recording.sets, meter.quality(), sidecar, error, events=events)

    def _recorded(self, frames: Iterator[Frame]) -> Iterator[Frame]:
        """The frames that are in the take, until it is done."""
        for frame in frames:
            if self._recording.covers(frame.timestamp_s):
                yield frame
            elif self._recording.done:
                return


def _short_of_space(path: Path) -> DiskFullError:
    left_mb = RESERVE_BYTES / 1e6
    return DiskFullError(f"less than {left_mb:.0f} MB were left for {path}: free some, or name a --out on another disk")


def settle(take: CaptureResult, read_back: Callable[[Path], Verified | None]) -> CaptureResult:
    """Read a closed take back, unless that is impossible, and write into its sidecar how it ended.

    `read_back` gives None when it was interrupted. What holds no frame at all is removed.
    """
    if take.sets == 0:
        for path in (take.job.path, take.sidecar.path):
            path.unlink(missing_ok=True)
        return take
    settled = _read_back(take, read_back) if take.closed else take
    try:
        settled.sidecar.finish(settled.state, settled.summary)
    except DiskFullError as error:
        return replace(settled, error=settled.error or error)
    return settled


def _read_back(take: CaptureResult, read_back: Callable[[Path], Verified | None]) -> CaptureResult:
    try:
        found = read_back(take.job.path)
    except RecordingError as error:
        return replace(take, state="damaged", error=error)
    if found is None:
        return replace(take, state="interrupted")
    # without metadata, a reader learns anew which frames belong together: some are there, and in no set
    held = max(found.frames, min(found.streams.values(), default=0))
    if held < take.sets - take.cut_in:
        error = RecordingError(
            f"{take.job.path} holds {found.frames} of the {take.sets} frames that came: check the disk's free space "
            "and speed, and record again"
        )
        return replace(take, state="damaged", error=error, found=found)
    return replace(take, found=found)
