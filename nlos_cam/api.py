"""Python API: open a camera, iterate over its frames, and get the hidden surface in metres.

`import nlos_cam` is enough, and cheap: the rest is imported when a camera is opened.

    >>> import nlos_cam
    >>> with nlos_cam.open("bag:run.bag") as stream:
    ...     for result in stream:
    ...         print(result.frame_number, result.depth_m.shape, result.points_m.shape[1])
    0 (64, 64) 3
    1 (64, 64) 3
    2 (64, 64) 3

A live camera (`l515`, `sim`) runs until the loop is left.
"""

import time
from contextlib import ExitStack
from pathlib import Path
from threading import Event
from types import TracebackType
from typing import Self

from nlos_calibration import Rig

from nlos_cam import reconstruct
from nlos_cam.bench import load_bench, load_serving
from nlos_cam.camera import Camera, OnProgress, full_uri, open_camera
from nlos_cam.errors import NlosCamError
from nlos_cam.live import BackgroundPhysicsCheck, RunStatistics
from nlos_cam.recording import with_telemetry


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
        """Mismatches between networks and bench, as `live` prints them: expect larger errors if
        there are any.
        """
        self._pipeline = pipeline
        self._lossless = lossless
        self._clock = clock
        self._statistics = RunStatistics()
        self._entered = ExitStack()
        self._reader: reconstruct.FrameReader | None = None

    @property
    def rig(self) -> Rig:
        """Rig of the wall record; without one, the camera's own, else the paper's."""
        return self._pipeline.bench.rig

    @property
    def dropped(self) -> int:
        """Frames without a result up to now, for any reason."""
        if self._reader is None:
            return 0
        return sum(self._statistics.lost(self.camera, self._reader).values())

    def __enter__(self) -> Self:
        if self._reader is not None:
            raise NlosCamError(
                "this stream was started before: start another by `nlos_cam.open(...)`"
            )
        with ExitStack() as entered:  # leaves the camera if a later step fails
            camera = entered.enter_context(self.camera)
            frames, telemetry = with_telemetry(camera)
            reader = reconstruct.FrameReader(
                frames,
                lossless=self._lossless,
                stop=Event(),
                clock=self._clock,
                abandon_source=lambda: camera.__exit__(None, None, None),
            )
            self._reader = entered.enter_context(reader)
            entered.enter_context(self._pipeline.checks)
            self._entered = entered.pop_all()
        self._results = reconstruct.iterate_results(
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

    def __next__(self) -> reconstruct.FrameResult:
        if self._reader is None:
            raise NlosCamError(
                "the camera has not been started: loop inside `with nlos_cam.open(...) as stream:`"
            )
        return next(self._results)


def open_stream(
    uri: str | Path,
    *,
    wall: str | Path | None = None,
    bench: str | Path | None = None,
    weights: str | Path | None = None,
    average: int = 1,
    on_progress: OnProgress | None = None,
    clock: reconstruct.Clock = time.time,
) -> Stream:
    """Open a camera and load the networks, without starting the camera yet; call it as
    `nlos_cam.open`.

    `uri` is `l515`, `l515:SERIAL`, `sim`, `sim:bare-wall`, `sim:scene.toml`, `sample`,
    `bag:run.bag` or the path of a recording;
    `wall` a record of `calibrate --wall`, or `bench` a bench folder of `calibrate --bench`, which
    brings its wall and its own weights; `weights` a folder of other weights than these or the
    shipped ones that serve its rig best; maps are the mean of the last `average` frames.
    `on_progress` is called while a simulated scene is pre-rendered, which takes time on its first
    run. Raises the errors of `nlos_cam.errors`; RecordFileError and CalibrationError for wall and bench, CheckpointError for
    the weights.
    """
    if wall and bench:
        raise NlosCamError(f"wall {wall} and bench {bench} each name a measured wall: give one")
    if not 1 <= average <= reconstruct.MAX_AVERAGE:
        raise NlosCamError(
            f"average is {average}: give a number of frames from 1 to {reconstruct.MAX_AVERAGE}"
        )
    # The bench's own weights may be lost or damaged where others are named.
    loaded = load_bench(bench, weights=weights is None) if bench else None
    camera = open_camera(uri, on_progress=on_progress)
    if loaded:
        calibrated = loaded.for_camera(camera)
    else:
        calibrated = reconstruct.open_bench(Path(wall) if wall else None, camera)
    own = loaded.weights if loaded else None
    found = load_serving(
        calibrated, Path(weights) if weights else own, loaded, Path(wall) if wall else None
    )
    is_recorded = full_uri(uri).startswith("bag:")
    # As `replay` and `live` check: some verdicts rest on it.
    checks = (
        reconstruct.PeriodicPhysicsCheck(calibrated.rig)
        if is_recorded
        else BackgroundPhysicsCheck(calibrated.rig)
    )
    pipeline = reconstruct.build_pipeline(
        calibrated,
        found.network,
        average,
        uncertainty_model=found.uncertainty_model,
        checks=checks,
    )
    reconstruct.warm_up(camera, pipeline)
    notes = (*calibrated.warnings, *found.mismatches)
    return Stream(camera, pipeline, lossless=is_recorded, notes=notes, clock=clock)
