"""Python API: open a camera, iterate over its frames, and get the hidden surface in metres.

`import nlos_cam` is enough, and cheap: the rest is imported when a camera is opened.

    >>> import nlos_cam
    >>> with nlos_cam.open("bag:run.bag") as stream:
    ...     for glimpse in stream:
    ...         print(glimpse.frame_number, glimpse.depth_m.shape, glimpse.points_m.shape[1])
    0 (64, 64) 3
    1 (64, 64) 3
    2 (64, 64) 3

A live camera (`l515`, `sim`) runs until the loop is left.
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

from nlos_cam import reconstruct
from nlos_cam.camera import Camera, OnProgress, open_camera
from nlos_cam.errors import NlosCamError
from nlos_cam.frames import LidarMaps
from nlos_cam.live import FrameReader, RunStatistics, iterate_results, warm_up, with_telemetry
from nlos_cam.objects import SurfaceMesh, cell_centers_m, mesh_from_depth, object_box


@dataclass(frozen=True)
class Glimpse:
    """Result of one frame: the hidden surface with its uncertainty and verdict."""

    step: reconstruct.FrameResult
    """Everything else about the frame: the frame itself, the reconstruction's pose, timings, the
    physics check.
    """
    box: ObjectBox
    """Box in which objects are reconstructed, in the wall frame."""

    @property
    def depth_m(self) -> Float32:
        """(64, 64) over the box: distance from the wall, NaN where there is no surface.

        Column j grows with wall x (away from the lidar's foot), row i with wall -y (row 0 is the
        top).
        """
        return self.step.reconstruction.depth_m

    @property
    def uncertainty_m(self) -> Float32 | None:
        """(64, 64): expected absolute error of `depth_m`; None without an uncertainty model."""
        return self.step.reconstruction.uncertainty_m

    @property
    def verdict(self) -> reconstruct.Verdict | None:
        """Reliability of the reconstruction, such as "object seen"; None without an uncertainty
        model.
        """
        return self.step.verdict

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings that hold now, such as that the lidar has moved."""
        return self.step.warnings

    @property
    def points_m(self) -> Float32:
        """(n, 3): points of the hidden surface in the wall frame, x along the wall, y up, z into
        the room.
        """
        x_m, y_m = np.meshgrid(*cell_centers_m(self.box))
        points_m = np.stack([x_m, y_m, self.depth_m], -1).astype(np.float32)
        return points_m[np.isfinite(self.depth_m)]

    def to_mesh(self) -> SurfaceMesh:
        """Return the hidden surface as a mesh in the wall frame; its `save` writes .ply, .glb,
        .obj, .csv or .npz.
        """
        return mesh_from_depth(self.depth_m, self.box, self.uncertainty_m)

    @property
    def maps(self) -> LidarMaps:
        """Lidar maps of (64, 80) cells."""
        return self.step.maps

    @property
    def difference(self) -> LidarMaps | None:
        """Maps less those of the bare wall; None without a wall record that has a reference."""
        return self.step.difference

    @property
    def timestamp_s(self) -> float:
        """Time of the frame by the camera's clock."""
        return self.step.frame.timestamp_s

    @property
    def frame_number(self) -> int:
        """Number of the frame, counted by the camera."""
        return self.step.frame.frame_number

    @property
    def truth_depth_m(self) -> Float32 | None:
        """Ground truth of `depth_m` from a simulated camera; else None."""
        return self.step.frame.truth_depth_m


class Stream:
    """Frames of a camera with their results. Entering starts the camera; leaving stops it, also
    after an error.

    Iterate from one thread while entered; a second loop continues with the next frames. A live
    camera does not wait: if frames come faster than they are taken, the oldest are dropped and
    counted. A recording waits and loses none. Raises the camera's errors.
    """

    def __init__(
        self,
        camera: Camera,
        pipeline: reconstruct.Pipeline,
        *,
        lossless: bool,
        notes: tuple[str, ...] = (),
        clock: reconstruct.Clock,
    ) -> None:
        self.camera = camera
        self.notes = notes
        """Mismatches between networks and bench: expect larger errors if there are any."""
        self._pipeline = pipeline
        self._lossless = lossless
        self._clock = clock
        self._box = object_box(self.rig)
        self._statistics = RunStatistics()
        self._entered = ExitStack()
        self._reader: FrameReader | None = None

    @property
    def rig(self) -> Rig:
        """Rig of the wall record; without one, the camera's own, else the paper's."""
        return self._pipeline.bench.rig

    @property
    def dropped(self) -> int:
        """Frames without a result up to now, for any reason."""
        return sum(self._statistics.lost(self.camera, self._reader).values()) if self._reader else 0

    def __enter__(self) -> Self:
        camera = self._entered.enter_context(self.camera)
        frames, telemetry = with_telemetry(camera)
        reader = FrameReader(
            frames,
            lossless=self._lossless,
            stop=Event(),
            clock=self._clock,
            abandon_source=lambda: camera.__exit__(None, None, None),
        )
        self._reader = self._entered.enter_context(reader)
        self._results = iterate_results(
            reader, self._pipeline, self._clock, self._statistics.fail, telemetry
        )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._entered.__exit__(kind, error, trace)

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Glimpse:
        if self._reader is None:
            raise NlosCamError(
                "the camera has not been started: loop inside `with nlos_cam.open(...) as stream:`"
            )
        return Glimpse(next(self._results), self._box)


def open_stream(
    uri: str,
    *,
    wall: str | Path | None = None,
    weights: str | Path | None = None,
    average: int = 1,
    on_progress: OnProgress | None = None,
    clock: reconstruct.Clock = time.time,
) -> Stream:
    """Open a camera and load the networks, without starting the camera yet; call it as
    `nlos_cam.open`.

    `uri` is `l515`, `l515:SERIAL`, `sim`, `sim:bare-wall`, `sim:scene.toml` or `bag:run.bag`;
    `wall` a record of `calibrate --wall`, `weights` a folder of other weights than the shipped
    ones; maps are the mean of the last `average` frames. `on_progress` is called while a simulated
    scene is pre-rendered, which takes time on its first run. Raises the errors of
    `nlos_cam.errors`; RecordFileError and CalibrationError for the wall, CheckpointError for the
    weights.
    """
    camera = open_camera(uri, on_progress=on_progress)
    bench = reconstruct.open_bench(Path(wall) if wall else None, camera)
    folder = Path(weights) if weights else None
    network = reconstruct.load_networks(folder)
    uncertainty_model = reconstruct.load_uncertainty(folder)
    pipeline = reconstruct.build_pipeline(
        bench, network, average, uncertainty_model=uncertainty_model
    )
    warm_up(camera, pipeline)
    notes = tuple(reconstruct.compatibility_warnings(bench, network.record, uncertainty_model))
    return Stream(camera, pipeline, lossless=uri.startswith("bag:"), notes=notes, clock=clock)
