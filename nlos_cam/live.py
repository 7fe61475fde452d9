"""The streaming loop: each frame's way from a camera to a reconstruction and to a viewer, timed."""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from threading import Event

import numpy as np

from nlos_cam.camera.base import Camera
from nlos_cam.frame_reader import FrameReader
from nlos_cam.frames import Frame, maps_from_frame
from nlos_cam.live_report import LiveReport, OnWarning, Tally, say_nothing
from nlos_cam.moments import Moments
from nlos_cam.processing import Processing, read_along, steps
from nlos_cam.reconstruct import Clock, reconstruct
from nlos_cam.sightings import watched
from nlos_cam.view.viewer import Moment, Viewer

USUAL_DEPTH_M = 0.3


def warm_up(camera: Camera, processing: Processing, clock: Clock = time.perf_counter) -> Mapping[str, float]:
    """Reconstruct a frame that is all the same, before the camera is entered; seconds by stage.

    What is compiled or allocated on first use would otherwise hold up the first frame, and drop those after it.
    """
    shape = camera.intrinsics.height, camera.intrinsics.width
    dark, flat = np.zeros(shape, np.uint8), np.full(shape, USUAL_DEPTH_M, np.float32)
    frame = Frame(flat, dark, dark, timestamp_s=0.0, frame_number=0, intrinsics=camera.intrinsics)
    return reconstruct(maps_from_frame(frame), processing.bench.rig, processing.network, clock).timings_s


def run_live(
    camera: Camera,
    processing: Processing,
    viewer: Viewer,
    *,
    stop: Event,
    seconds: float | None = None,
    recorded: bool = False,
    clock: Clock = time.time,
    on_error: Callable[[LiveReport], None] = lambda _: None,
    on_warning: OnWarning = say_nothing,
    on_moment: Callable[[Moment], None] = lambda _: None,
) -> LiveReport:
    """Reconstruct an entered camera's frames and show them, until it ends, `stop` is set, or `seconds` have passed.

    One that is `recorded` loses no frame and is shown at the speed it was recorded. A camera that keeps the loop's end
    waiting is left. A frame that comes to no result is counted. While none comes, the last is shown again, as stalled.
    `on_warning` hears when a warning begins and ends, `on_moment` of each frame's result once it is shown.
    Raises what the camera raises, and NlosCamError where none comes to a result, once `on_error` has had the report.
    """
    tally = Tally(on_warning)
    frames, thermometer = read_along(camera, camera)
    frames = watched(paced(frames, stop, clock) if recorded else frames, tally.seen)

    def enough() -> bool:
        return seconds is not None and tally.lasted_s(clock()) >= seconds

    def leave() -> None:
        camera.__exit__(None, None, None)

    def look_up() -> None:
        if tally.stall.look(clock(), reader.newest_s):
            moments.stalled()

    def report() -> LiveReport:
        tally.stall.close(clock())
        return tally.report(camera, reader)

    reader = FrameReader(
        frames, keeps_all=recorded, stop=stop, clock=clock, enough=enough, let_go=leave, on_wait=look_up
    )
    moments = Moments(viewer, lambda: sum(tally.lost(camera, reader).values()), reader, thermometer, clock)
    try:
        with reader:
            for step in steps(reader, processing, clock, tally.fail, thermometer):
                moment = moments.show(step)
                tally.add(step, clock() - step.published_s)
                on_moment(moment)
    except Exception:
        on_error(report())
        raise
    return report()


def paced(frames: Iterable[Frame], stop: Event, clock: Clock) -> Iterator[Frame]:
    """Frames no sooner, after the first, than their timestamps say."""
    offset_s: float | None = None
    for frame in frames:
        offset_s = clock() - frame.timestamp_s if offset_s is None else offset_s
        if stop.wait(max(0.0, frame.timestamp_s + offset_s - clock())):
            return
        yield frame
