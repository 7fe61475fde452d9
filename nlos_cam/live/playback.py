"""Recording in the page: reconstructed once as fast as possible, then played, scrubbed and
exported.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from functools import cached_property
from pathlib import Path
from threading import Event, Lock
from typing import Any

from nlos_models import Reconstructor, UncertaintyModel

from nlos_cam import reconstruct as pipelines
from nlos_cam.camera import Camera
from nlos_cam.errors import NlosCamError, RecordingError
from nlos_cam.live.control import save_moment
from nlos_cam.live.frame_queue import FrameReader
from nlos_cam.live.loop import iterate_batched
from nlos_cam.live.replay_media import moment_of
from nlos_cam.live.telemetry import with_telemetry
from nlos_cam.view import PlaybackViewer


class Playback(PlaybackViewer):
    """View of a recording, served while entered. `reconstruct` fills it; the page plays meanwhile.

    Its one command, `export`, writes a frame's arrays, picture and mesh into `folder`.
    """

    def __init__(
        self,
        camera: Camera,
        bench: pipelines.CalibratedRig,
        *,
        folder: Path = Path(),
        host: str,
        port: int | None = None,
    ) -> None:
        super().__init__(bench.rig, bench.measured, host=host, port=port, controls=self)
        self._camera = camera
        self._measured_bench = bench
        self._folder = folder
        self._exporting = Lock()
        self.frames = 0
        """Frames reconstructed so far."""
        self._state = "loading the networks"

    def reconstruct(self, stop: Event) -> None:
        """Reconstruct every frame until the end or `stop`. Raises RecordingError for a recording
        without a frame.
        """
        with self._camera as camera:
            frames, telemetry = with_telemetry(camera)
            pipeline = self._pipeline(checks=True)
            self._state = "reconstructing"
            with FrameReader(frames, lossless=True, stop=stop) as reader, pipeline.checks:
                for result in iterate_batched(reader, pipeline, telemetry=telemetry):
                    self.show(moment_of(result, telemetry.celsius))
                    self.frames += 1
        if not self.frames and not stop.is_set():
            raise RecordingError(
                f"{camera.uri} has no frame with depth, infrared and confidence: record it again"
            )
        self.finish()
        self._state = "whole"

    @cached_property
    def _networks(self) -> tuple[Reconstructor, UncertaintyModel | None]:
        return pipelines.load_networks(), pipelines.load_uncertainty()

    def _pipeline(self, *, checks: bool) -> pipelines.Pipeline:
        network, uncertainty_model = self._networks
        check = pipelines.PeriodicPhysicsCheck(self._measured_bench.rig) if checks else None
        return pipelines.build_pipeline(
            self._measured_bench, network, uncertainty_model=uncertainty_model, checks=check
        )

    def status(self) -> dict[str, Any]:
        """Return the state for the page."""
        message = "" if self._state == "whole" else f"{self._state}, {self.frames} frames so far"
        control = {"commands": ["export"], "settings": [], "options": [], "note": ""}
        return {
            "state": "recording",
            "message": message,
            "camera": self._camera.uri,
            "control": control,
        }

    def run(self, command: str, arguments: Mapping[str, Any]) -> str:
        """Export a frame by its number. Raises NlosCamError for another command, number, or while
        exporting.
        """
        if command != "export" or not isinstance(number := arguments.get("frame"), int):
            raise NlosCamError(
                f"no command {command!r} with {dict(arguments)!r}: this view exports a frame by"
                " number"
            )
        with self._exporting:
            return self._export(number)

    def _export(self, number: int) -> str:
        """Reconstruct one frame again, since the page's copy is rounded, and write its files."""
        bag = Path(self._camera.uri.removeprefix("bag:"))
        with type(self._camera)(bag) as camera:  # type: ignore[call-arg]  a recording opens by its path
            frame = next((each for each in camera if each.frame_number == number), None)
        if frame is None:
            raise NlosCamError(f"{bag} has no frame {number}")
        with FrameReader([frame], lossless=True, stop=Event()) as reader:
            (result,) = iterate_batched(reader, pipeline := self._pipeline(checks=False))
        path = self._folder / f"{bag.stem}-{number:06d}-{datetime.now().astimezone():%H%M%S}.npz"
        return save_moment(path, moment_of(result), pipeline)
