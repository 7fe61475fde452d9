"""The streaming loop: each frame's way from a camera to a reconstruction and to a viewer, timed."""

import time
from collections.abc import Callable, Generator, Iterable, Iterator
from threading import Event

import numpy as np
from nlos_calibration.rig import Rig

from nlos_cam.camera.base import Camera
from nlos_cam.frame_reader import Arrival, FrameReader
from nlos_cam.frames import Frame, maps_from_frame
from nlos_cam.live_report import LiveReport, Step, Tally
from nlos_cam.reconstruct import Clock, Network, reconstruct
from nlos_cam.sightings import watched
from nlos_cam.view.viewer import Moment, Viewer

USUAL_DEPTH_M = 0.3


OnFailure = Callable[[Frame, Exception, int], None]
"""Called with a frame that came to no result, why, and how many have in a row; raises to end there."""


def _refuse(frame: Frame, error: Exception, in_a_row: int) -> None:
    del frame, in_a_row
    raise error


def steps(
    reader: FrameReader, rig: Rig, network: Network, clock: Clock = time.time, on_failure: OnFailure = _refuse
) -> Generator[Step]:
    """Reconstruct every frame that the reader gives, in order."""
    begun_s, in_a_row = clock(), 0
    for arrival in reader:
        try:
            step = _step(arrival, rig, network, clock, begun_s)
        except Exception as error:  # noqa: BLE001  whatever an odd frame leads to, who called decides
            in_a_row += 1
            on_failure(arrival.frame, error, in_a_row)
        else:
            in_a_row = 0
            yield step
        begun_s = clock()


def _step(arrival: Arrival, rig: Rig, network: Network, clock: Clock, begun_s: float) -> Step:
    got_s = clock()
    maps = maps_from_frame(arrival.frame)
    mapped_s = clock()
    reconstruction = reconstruct(maps, rig, network, clock)
    stages_s = {"wait": got_s - begun_s, "maps": mapped_s - got_s, **reconstruction.timings_s}
    return Step(arrival.frame, maps, reconstruction, clock(), stages_s)


def warm_up(camera: Camera, rig: Rig, network: Network) -> None:
    """Reconstruct a frame that is all the same, before the camera is entered.

    What is compiled or allocated on first use would otherwise hold up the first frame, and drop those after it.
    """
    shape = camera.intrinsics.height, camera.intrinsics.width
    dark, flat = np.zeros(shape, np.uint8), np.full(shape, USUAL_DEPTH_M, np.float32)
    frame = Frame(flat, dark, dark, timestamp_s=0.0, frame_number=0, intrinsics=camera.intrinsics)
    reconstruct(maps_from_frame(frame), rig, network)


def run_live(
    camera: Camera,
    rig: Rig,
    network: Network,
    viewer: Viewer,
    *,
    stop: Event,
    seconds: float | None = None,
    recorded: bool = False,
    clock: Clock = time.time,
    on_error: Callable[[LiveReport], None] = lambda _: None,
) -> LiveReport:
    """Reconstruct an entered camera's frames and show them, until it ends, `stop` is set, or `seconds` have passed.

    One that is `recorded` loses no frame and is shown at the speed it was recorded. A camera that keeps the loop's end
    waiting is left. A frame that comes to no result is counted. Raises what the camera raises, and NlosCamError where
    none comes to a result, once `on_error` has had the report.
    """
    tally = Tally()
    frames = watched(paced(camera, stop, clock) if recorded else camera, tally.seen)

    def enough() -> bool:
        return seconds is not None and tally.lasted_s(clock()) >= seconds

    def leave() -> None:
        camera.__exit__(None, None, None)

    reader = FrameReader(frames, keeps_all=recorded, stop=stop, clock=clock, enough=enough, let_go=leave)
    try:
        with reader:
            for step in steps(reader, rig, network, clock, tally.fail):
                latency_s = step.published_s - step.frame.timestamp_s - reader.offset_s
                viewer.show(Moment(step.frame, step.reconstruction, step.published_s, latency_s))
                tally.add(step, clock() - step.published_s)
    except Exception:
        on_error(tally.report(camera, reader))
        raise
    return tally.report(camera, reader)


def paced(frames: Iterable[Frame], stop: Event, clock: Clock) -> Iterator[Frame]:
    """Frames no sooner, after the first, than their timestamps say."""
    offset_s: float | None = None
    for frame in frames:
        offset_s = clock() - frame.timestamp_s if offset_s is None else offset_s
        if stop.wait(max(0.0, frame.timestamp_s + offset_s - clock())):
            return
        yield frame
