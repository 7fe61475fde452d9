"""Recording in the page: reconstructed once as fast as possible, then played, scrubbed and
exported.
"""

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from threading import Event, Lock
from typing import Any

from nlos_models import Reconstructor, UncertaintyModel

from nlos_cam.camera import Camera, open_camera
from nlos_cam.errors import NlosCamError, RecordingError
from nlos_cam.reconstruct import (
    CalibratedRig,
    FrameReader,
    PeriodicPhysicsCheck,
    PhysicsCheck,
    Pipeline,
    build_pipeline,
    iterate_batched,
)
from nlos_cam.recording import with_telemetry
from nlos_cam.view import Moment, PlaybackViewer, WrittenFiles, save_moment


class Playback(PlaybackViewer):
    """View of a recording, served while entered. `reconstruct` fills it; the page plays meanwhile.

    Its one command, `export`, writes a frame's arrays, picture and mesh into `folder`.
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
        self._camera = camera
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
                    self.show(Moment.recorded(result, telemetry.celsius))
                    self.frames += 1

        if not self.frames and not stop.is_set():
            raise RecordingError(
                f"{camera.uri} has no frame with depth, infrared and confidence: record it again"
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
            "camera": self._camera.uri,
            "control": {
                "commands": ["export"],
                "options": [],
                "note": "",
                "files": self._files.newest,
            },
        }

    def run(self, command: str, arguments: Mapping[str, Any]) -> str:
        """Export a frame by its number. Raises NlosCamError for another command, number, or while
        exporting.
        """
        number = arguments.get("frame")
        if command != "export" or not isinstance(number, int):
            raise NlosCamError(
                f"no command {command!r} with {dict(arguments)!r}: this view exports a frame by"
                " number"
            )
        with self._exporting:
            return self._export(number)

    def _export(self, number: int) -> str:
        """Reconstruct one frame again, since the page's copy is rounded, and write its files."""
        bag = Path(self._camera.uri.removeprefix("bag:"))
        with open_camera(self._camera.uri) as camera:
            frame = next((each for each in camera if each.frame_number == number), None)
        if frame is None:
            raise NlosCamError(f"{bag} has no frame {number}")

        with FrameReader([frame], lossless=True, stop=Event()) as reader:
            (result,) = iterate_batched(reader, self._pipeline(self._calibrated.afresh()))
        path = self._folder / f"{bag.stem}-{number:06d}-{datetime.now().astimezone():%H%M%S}.npz"
        outcome = save_moment(path, Moment.recorded(result))
        return f"{outcome}, {self._files.note(path)}"

    def file(self, name: str) -> Path | None:
        """Return the path of an exported file, by its name; None for any other."""
        return self._files.get(name)
