"""Recording in the page: reconstructed once as fast as possible, then played, scrubbed and
exported.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from threading import Event, Lock
from typing import Any

from nlos_models import Reconstructor, UncertaintyModel

from nlos_cam.camera import Camera, open_camera
from nlos_cam.errors import NlosCamError, RecordingError
from nlos_cam.frames import Frame
from nlos_cam.reconstruct import (
    CalibratedRig,
    FrameReader,
    PeriodicPhysicsCheck,
    PhysicsCheck,
    Pipeline,
    Verdict,
    build_pipeline,
    iterate_batched,
)
from nlos_cam.recording import with_telemetry
from nlos_cam.view import Moment, PlaybackViewer, WrittenFiles, dated_file, save_moment

SAME_S = 1e-3
"""Difference of two times, in seconds, below which they are one: the page's are rounded."""
FRAMES_BEFORE = 30
"""Frames before an exported one that are reconstructed too: the lidar's drift, which the maps are
corrected by, is a median over as many.
"""


class Playback(PlaybackViewer):
    """View of a recording, served while entered. `reconstruct` fills it while the page plays.

    Its one command, `export`, writes a frame's arrays, picture and mesh into `folder`. Its arguments
    are the frame's number and, as a number may come again, `time_s` as the page shows it; without
    `time_s` the first frame of that number is exported.
    """

    def __init__(
        self,
        camera: Camera,
        bench: CalibratedRig,
        networks: tuple[Reconstructor, UncertaintyModel | None],
        *,
        folder: Path = Path(),
        host: str,
        port: int | None = None,
    ) -> None:
        super().__init__(bench.rig, bench.measured, host=host, port=port, controls=self)
        self.frames = 0
        """Frames reconstructed so far."""
        self._start_s = 0.0
        """Timestamp of the first frame, from which the page counts."""
        self._verdicts: dict[tuple[int, float], Verdict | None] = {}
        """Verdicts of the page, by number and timestamp. They depend on all frames before."""
        self._camera = camera
        self._bag = Path(camera.uri.removeprefix("bag:"))
        self._calibrated = bench
        self._networks = networks
        self._folder = folder
        self._exporting = Lock()
        self._files = WrittenFiles()
        self._state = "reconstructing"

    def reconstruct(self, stop: Event) -> None:
        """Reconstruct every frame until the end or `stop`. Raises RecordingError for a recording
        without a frame.
        """
        with self._camera as camera:
            frames, telemetry = with_telemetry(camera)
            checks = PeriodicPhysicsCheck(self._calibrated.rig)
            pipeline = self._pipeline(self._calibrated, checks)
            with FrameReader(frames, lossless=True, stop=stop) as reader, pipeline.checks:
                for result in iterate_batched(reader, pipeline, temperatures=telemetry):
                    if not self.frames:
                        self._start_s = result.timestamp_s
                    self.show(Moment.recorded(result, telemetry.celsius))
                    self._verdicts[result.frame_number, result.timestamp_s] = result.verdict
                    self.frames += 1

        if not self.frames and not stop.is_set():
            raise RecordingError(
                f"{camera.uri} has no frame with depth and infrared: record it again"
            )
        self.finish()
        self._state = "whole"

    def _pipeline(self, bench: CalibratedRig, checks: PhysicsCheck | None = None) -> Pipeline:
        network, uncertainty_model = self._networks
        return build_pipeline(bench, network, uncertainty_model=uncertainty_model, checks=checks)

    def status(self) -> dict[str, Any]:
        """Return the state for the page."""
        message = "" if self._state == "whole" else f"{self._state}, {self.frames} frames so far"
        return {
            "state": "playback",
            "message": message,
            "camera": f"bag:{self._bag.name}",  # without its folder: others may see the page
            "control": {
                "commands": ["export"],
                "options": [],
                "note": "",
                "files": self._files.newest,
            },
        }

    def run(self, command: str, arguments: Mapping[str, Any]) -> str:
        """Export a frame by its number. Raises NlosCamError for another command or number, and for
        files that cannot be read or written.
        """
        number = arguments.get("frame")
        time_s = arguments.get("time_s")
        has_time = isinstance(time_s, int | float | None)
        if command != "export" or not isinstance(number, int) or not has_time:
            raise NlosCamError(
                f"no command {command!r} with {dict(arguments)!r}: this view exports a frame by"
                " number"
            )
        if not self._exporting.acquire(blocking=False):
            raise NlosCamError("another frame is being exported: wait for its answer")
        try:
            return self._export(number, time_s)
        except NlosCamError:
            raise
        except OSError as error:
            place = error.filename or self._folder.resolve()
            raise NlosCamError(
                f"{place}: {error.strerror or error}: check that it is still there and that its"
                " folder has room and can be written"
            ) from error
        finally:
            self._exporting.release()

    def _export(self, number: int, time_s: float | None) -> str:
        """Reconstruct one frame again, since the page's copy is rounded, and write its files with the
        page's verdict.
        """
        frames = self._frames_up_to(number, time_s)
        with FrameReader(frames, lossless=True, stop=Event()) as reader:
            results = iterate_batched(reader, self._pipeline(self._calibrated.afresh()))
            (result,) = deque(results, maxlen=1)
        shown = self._verdicts.get((result.frame_number, result.timestamp_s), result.verdict)
        result = replace(result, verdict=shown)
        path = dated_file(self._folder, f"{self._bag.stem}-{number:06d}", ".npz")
        outcome = save_moment(path, Moment.recorded(result))
        return f"{outcome}, {self._files.note(path)}"

    def _frames_up_to(self, number: int, time_s: float | None) -> list[Frame]:
        """Return a frame, the last, and those before it. Raises NlosCamError where it is not
        there, and once the view closes: reading on to it may take long.
        """
        frames = deque[Frame](maxlen=FRAMES_BEFORE + 1)
        with open_camera(self._camera.uri) as camera:
            for frame in camera:
                if self._closed:
                    raise NlosCamError("the view ends: nothing was exported")
                frames.append(frame)
                if self._is_at(frame, number, time_s):
                    return [*frames]
        raise NlosCamError(f"{self._bag.name} has no frame {number}")

    def _is_at(self, frame: Frame, number: int, time_s: float | None) -> bool:
        """Return True for the frame of a number, at a time that the page shows if given."""
        if frame.frame_number != number:
            return False
        return time_s is None or abs(frame.timestamp_s - self._start_s - time_s) < SAME_S

    def file(self, name: str) -> Path | None:
        """Return the path of an exported file, by its name; None for any other."""
        return self._files.get(name)
