"""Some seconds of a camera's frames: whether they come, and whether each is another."""

import time
from threading import Event

from nlos_cam.camera import FRAMES_PER_S, Camera, open_camera
from nlos_cam.doctor.facts import Watched
from nlos_cam.errors import NlosCamError

WATCH_S = 5.0


def watch(uri: str, seconds: float = WATCH_S) -> Watched:
    """Stream from a camera and return what came; its errors are in the answer."""
    try:
        return watch_camera(open_camera(uri), uri, seconds)
    except NlosCamError as error:
        return Watched(uri, 0, seconds, error=str(error))


def watch_camera(camera: Camera, uri: str, seconds: float) -> Watched:
    """Return what a camera sends within some seconds, or until it ends. Raises its errors."""
    from nlos_cam.reconstruct import FrameReader, FrozenFrames

    frozen = FrozenFrames()
    is_frozen = False
    frames = 0
    with camera:
        start_s = time.monotonic()
        end_s = start_s + seconds
        reader = FrameReader(
            camera,
            lossless=True,  # every frame is compared with the one before it
            stop=Event(),
            should_stop=lambda: time.monotonic() > end_s,
            abandon_source=lambda: camera.__exit__(None, None, None),
        )
        with reader:
            for arrival in reader:
                frames += 1
                is_frozen = frozen.add(arrival.frame) or is_frozen
        watched_s = min(seconds, time.monotonic() - start_s)
    # A frame that comes again under its number makes no other one: the camera only counts it, and
    # some counts are complete when it has stopped.
    is_frozen = is_frozen or camera.counts["duplicate"] > frames
    return Watched(uri, frames, seconds, is_frozen, frames_expected=watched_s * FRAMES_PER_S)
