"""Cameras by name, from a table of backends that are imported when used; simulation has to be asked for."""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from nlos_cam.camera.protocol import Camera
from nlos_cam.errors import CameraNotFoundError, NlosCamError

if TYPE_CHECKING:
    from nlos_cam.camera.recorder import Recording

OnProgress = Callable[[int, int], None]
"""Called with poses rendered and poses in all, while a simulated world is rendered ahead."""

Reader = Literal["plain", "sdk"]

SIMULATED = {
    "sim": "simulated: the paper's rig with a moving hidden object",
    "sim:bare-wall": "simulated: the same wall with nothing hidden",
}
"""The packaged worlds; they are there for the asking."""
REPLAY_BACKENDS = {
    "plain": ("nlos_cam.recording.playback", "ReplayCamera"),
    "sdk": ("nlos_cam.recording.sdk_playback", "SdkReplayCamera"),
}
"""Module and class of each reader of recordings: they stand in layers above this one."""
NAMES = "l515, l515:SERIAL, sim, sim:bare-wall, sim:SCENE.toml or bag:FILE.bag"


def open_camera(
    uri: str,
    *,
    on_progress: OnProgress | None = None,
    recording: "Recording | None" = None,
    reader: Reader = "plain",
) -> Camera:
    """The camera of that name, found and checked but not started; a live one is recorded if asked for.

    `reader` says who reads a recording: we ourselves, or librealsense. Raises CameraNotFoundError, RecordingError,
    SceneError; NlosCamError for a recording of a recording.
    """
    scheme, _, rest = uri.partition(":")
    if scheme == "bag" and rest:
        return _replay(uri, Path(rest), recording, reader)
    if scheme == "sim":
        return _simulated(uri, rest, on_progress, recording)
    if scheme == "l515":
        return _l515(uri, rest, recording)
    raise CameraNotFoundError(f"no camera is called {uri!r}: use {NAMES}")


def _replay(uri: str, path: Path, recording: "Recording | None", reader: Reader) -> Camera:
    if recording:
        raise NlosCamError(f"{uri} is a recording already: copy the file, or give a live camera (l515, sim)")
    module, name = REPLAY_BACKENDS[reader]
    return getattr(import_module(module), name)(path)


def _simulated(uri: str, name: str, on_progress: OnProgress | None, recording: "Recording | None") -> Camera:
    from nlos_cam.camera.simulated import SimulatedCamera
    from nlos_cam.camera.simulated_world import open_world

    world = open_world(name, on_progress)
    return SimulatedCamera(uri, world, recording=recording, faults=world.scene.faults)


def _l515(uri: str, serial: str, recording: "Recording | None") -> Camera:
    from nlos_cam.camera.l515 import L515Camera

    return L515Camera(uri, serial, recording=recording)
