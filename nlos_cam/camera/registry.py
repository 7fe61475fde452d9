"""Cameras by name, from backends that are imported when used; simulation is never a silent
fallback.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from nlos_calibration import WallRecord

from nlos_cam.camera.protocol import SIMULATED_SERIAL, Camera, OnProgress
from nlos_cam.errors import NlosCamError, UnknownCameraError, did_you_mean

if TYPE_CHECKING:
    from nlos_cam.camera.recorder import Recording

SIMULATED = {
    "sim": "simulated: the paper's rig with a moving hidden object",
    "sim:bare-wall": "simulated: the same wall with nothing hidden",
}
"""Packaged simulated worlds and their descriptions."""
PLAYBACK = "nlos_cam.recording.playback"
"""Module of `ReplayCamera`, by name: it stands in a layer above this one."""
SCHEMES = ("bag", "sim", "l515")
"""Beginnings of cameras' names, before a colon."""
PLAIN_NAMES = frozenset({"l515", "sim"})
"""Names of cameras that a folder may happen to have too."""
PACKAGED_RECORDING = "sample"
"""Name of the recording that comes with the package."""
BENCH_RECORD = "bench.toml"
"""File by which a folder is known as a bench, which is no camera."""
NAMES = "l515, l515:SERIAL, sim, sim:bare-wall, sim:SCENE.toml or FILE.bag"


def open_camera(
    uri: str | Path,
    *,
    on_progress: OnProgress | None = None,
    recording: "Recording | None" = None,
) -> Camera:
    """Find and check the camera of that name without starting it; a live one can be recorded.

    Raises CameraNotFoundError, RecordingError, SceneError; NlosCamError for a recording of a
    recording; UnknownCameraError for a mistyped name.
    """
    uri = full_uri(uri)
    scheme, colon, rest = uri.partition(":")
    if colon and not rest:
        raise UnknownCameraError(f"no camera {uri!r}: leave out the colon, or use {NAMES}")
    if scheme == "bag" and rest:
        if recording:
            raise NlosCamError(
                f"{uri} is already a recording: copy the file, or give a live camera (l515, sim)"
            )
        return import_module(PLAYBACK).ReplayCamera(Path(rest))
    if scheme == "sim":
        from nlos_cam.camera.simulated import SimulatedCamera
        from nlos_cam.camera.simulated_world import open_world
        from nlos_cam.render import packaged_scenes

        if rest and not Path(rest).suffix and uri not in SIMULATED and not Path(rest).exists():
            known = [*SIMULATED, *(f"sim:{name}" for name in packaged_scenes())]
            if uri not in known:
                raise UnknownCameraError(
                    f"no camera {uri!r}.{did_you_mean(uri, known)} Use {NAMES}"
                )
        world = open_world(rest, on_progress)
        return SimulatedCamera(uri, world, recording=recording, faults=world.scene.faults)
    if scheme == "l515":
        from nlos_cam.camera.l515 import L515Camera

        return L515Camera(uri, rest, recording=recording)
    if (Path(uri) / BENCH_RECORD).is_file():
        raise UnknownCameraError(
            f"{uri} is a bench folder, no camera: give it as --bench {uri} (in Python bench=...)"
        )
    raise UnknownCameraError(
        f"no camera {uri!r}.{did_you_mean(uri, ['l515', *SIMULATED])} Use {NAMES}"
    )


def full_uri(uri: str | Path) -> str:
    """Return a camera's name; that of a recording, run.bag or sample, is bag:run.bag, bag:sample."""
    uri = str(uri)
    if uri == PACKAGED_RECORDING:
        return f"bag:{uri}"
    is_path = uri.endswith((".bag", ".db3", ".mcap")) or (Path(uri) / "metadata.yaml").is_file()
    has_scheme = uri.startswith(tuple(f"{scheme}:" for scheme in SCHEMES))
    return f"bag:{uri}" if is_path and not has_scheme else uri


def camera_to_name(wall: WallRecord) -> str:
    """Return the camera of a command to type next on a measured wall: the lidar that measured it,
    or a scene in capitals, since a simulated bench is another scene before and after the occluder.
    """
    is_simulated = wall.serial == SIMULATED_SERIAL or wall.camera.startswith("sim")
    if is_simulated:
        return "sim:SCENE.toml"
    return wall.camera if wall.camera.startswith("l515") else "l515"


def source_to_name(wall: WallRecord) -> str:
    """Return the option of a `calibrate` to type next on a measured wall: --camera with its lidar,
    or --bag for a recording of the simulated camera, which does not name its scene.
    """
    camera = camera_to_name(wall)
    if wall.camera.startswith("bag:") and camera.startswith("sim:"):
        return "--bag F.bag"
    return f"--camera {camera}"


def pictures_command(wall: WallRecord, rig_option: str) -> str:
    """Return the command to type next for pictures on a measured wall: `live`, or `replay` where
    only a recording shows the bench. `rig_option` names the bench, as in "--bench bench".
    """
    source = source_to_name(wall)
    if source.startswith("--bag "):
        return f"nlos-cam replay {source.removeprefix('--bag ')} {rig_option}"
    return f"nlos-cam live {source} {rig_option}"
