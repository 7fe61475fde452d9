"""nlos-cam from Python: open a camera, loop over its frames, and have what is hidden, in metres.

`import nlos_cam` is all that it takes, and costs nothing: what a camera needs is imported when it is opened.

    >>> import nlos_cam
    >>> with nlos_cam.open("bag:run.bag") as stream:
    ...     for seen in stream:
    ...         print(seen.frame_number, seen.depth_m.shape, seen.points_m.shape[1])
    0 (64, 64) 3
    1 (64, 64) 3
    2 (64, 64) 3

A live camera (`l515`, `sim`) goes on until the loop is left.
"""

import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from types import TracebackType
from typing import Self

import numpy as np
from nlos_calibration import ObjectBox, Rig
from nlos_calibration.arrays import Float32

from nlos_cam.camera import Camera, OnProgress, open_camera
from nlos_cam.errors import NlosCamError
from nlos_cam.frames import LidarMaps
from nlos_cam.live import FrameReader, RunStatistics, iterate_results, warm_up, with_telemetry
from nlos_cam.objects import cell_centers_m, object_box
from nlos_cam.reconstruct import (
    Clock,
    FrameResult,
    Pipeline,
    Verdict,
    build_pipeline,
    compatibility_warnings,
    load_networks,
    load_uncertainty,
    open_bench,
)


@dataclass(frozen=True)
class Glimpse:
    """What one frame tells of the hidden object."""

    step: FrameResult
    """The frame's whole way: the frame itself, the reconstruction with its pose, timings, the physics check."""
    box: ObjectBox
    """Where on the bench the object is looked for, in the wall frame."""

    @property
    def depth_m(self) -> Float32:
        """(64, 64) over the box: distance from the wall, NaN where there is no surface.

        Column j grows with wall x (away from the lidar's foot), row i with wall -y (row 0 is the top).
        """
        return self.step.reconstruction.depth_m

    @property
    def uncertainty_m(self) -> Float32 | None:
        """(64, 64): by how much `depth_m` may be off; None from networks that do not tell."""
        return self.step.reconstruction.uncertainty_m

    @property
    def verdict(self) -> Verdict | None:
        """What may be believed of the frame, in plain words; None from networks that do not tell."""
        return self.step.verdict

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the person at the bench should know now, such as that the lidar has moved."""
        return self.step.warnings

    @property
    def points_m(self) -> Float32:
        """(n, 3): the hidden surface's points in the wall frame, x along the wall, y up, z into the room."""
        x_m, y_m = np.meshgrid(*cell_centers_m(self.box))
        points_m = np.stack([x_m, y_m, self.depth_m], -1).astype(np.float32)
        return points_m[np.isfinite(self.depth_m)]

    @property
    def maps(self) -> LidarMaps:
        """What the lidar saw, in (64, 80) cells."""
        return self.step.maps

    @property
    def difference(self) -> LidarMaps | None:
        """The maps less the bare wall's; None without a wall record that has a reference."""
        return self.step.difference

    @property
    def timestamp_s(self) -> float:
        """When the frame was taken, by the camera's clock."""
        return self.step.frame.timestamp_s

    @property
    def frame_number(self) -> int:
        """As the camera counts."""
        return self.step.frame.frame_number

    @property
    def truth_depth_m(self) -> Float32 | None:
        """`depth_m` as it should be, where the camera knows it (a simulated one does)."""
        return self.step.frame.truth_depth_m


class Stream:
    """A camera's frames and what each tells. Entering starts the camera; leaving stops it, whatever happened inside.

    Iterate while it is entered; leaving a loop and beginning another goes on with the frames that come next. A live
    camera does not wait: of frames that come faster than they are taken, the oldest are dropped, and counted. A
    recording waits, and loses none. Raises what the camera raises.
    """

    def __init__(
        self, camera: Camera, processing: Pipeline, *, lossless: bool, notes: tuple[str, ...] = (), clock: Clock
    ) -> None:
        self.camera = camera
        self.notes = notes
        """What does not fit between the networks and this bench: believe less where there is any."""
        self._processing, self._keeps_all, self._clock = processing, lossless, clock
        self._box = object_box(self.rig)
        self._tally, self._inside = RunStatistics(), ExitStack()
        self._reader: FrameReader | None = None

    @property
    def rig(self) -> Rig:
        """The bench: of the wall record, else the camera's own, else the paper's."""
        return self._processing.bench.rig

    @property
    def dropped(self) -> int:
        """Frames that came to no result up to now, whoever lost them."""
        in_loop = len(self._reader.dropped) if self._reader else 0
        return self.camera.incomplete + self.camera.dropped + in_loop + self._tally.failed

    def __enter__(self) -> Self:
        camera = self._inside.enter_context(self.camera)
        frames, thermometer = with_telemetry(camera, camera)

        def leave() -> None:
            camera.__exit__(None, None, None)

        reader = FrameReader(frames, lossless=self._keeps_all, stop=Event(), clock=self._clock, let_go=leave)
        self._reader = self._inside.enter_context(reader)
        self._steps = iterate_results(reader, self._processing, self._clock, self._tally.fail, thermometer)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._inside.__exit__(kind, error, trace)

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Glimpse:
        if self._reader is None:
            raise NlosCamError("the camera has not been started: loop inside `with nlos_cam.open(...) as stream:`")
        return Glimpse(next(self._steps), self._box)


def open_stream(
    uri: str,
    *,
    wall: str | Path | None = None,
    weights: str | Path | None = None,
    average: int = 1,
    on_progress: OnProgress | None = None,
    clock: Clock = time.time,
) -> Stream:
    """The camera of that name with the networks before it, found and loaded but not started; call it `nlos_cam.open`.

    `uri` is `l515`, `l515:SERIAL`, `sim`, `sim:bare-wall`, `sim:scene.toml` or `bag:run.bag`; `wall` a record of
    `calibrate --wall`, `weights` a folder of other weights than the shipped ones; maps are the mean of the last
    `average` frames. `on_progress` hears how far a simulated world is rendered ahead, which takes seconds the first
    time. Raises the errors of `nlos_cam.errors`; RecordFileError and CalibrationError for the wall, CheckpointError for
    the weights.
    """
    camera = open_camera(uri, on_progress=on_progress)
    bench = open_bench(Path(wall) if wall else None, camera)
    folder = Path(weights) if weights else None
    network, doubter = load_networks(folder), load_uncertainty(folder)
    processing = build_pipeline(bench, network, average, uncertainty_model=doubter)
    warm_up(camera, processing)
    notes = tuple(compatibility_warnings(bench, network.record, doubter))
    return Stream(camera, processing, lossless=uri.startswith("bag:"), notes=notes, clock=clock)
