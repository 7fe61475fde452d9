"""Some seconds of a camera's frames: whether they come, and whether each is another."""

import time
from threading import Event

from nlos_cam.camera import Camera, open_camera
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
        end_s = time.monotonic() + seconds
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
    return Watched(uri, frames, seconds, is_frozen)
