"""Tree of the errors that nlos-cam raises on purpose, with exit codes and an example of each.

    NlosCamError                     exit 1   root: what was wrong, the value, what to do
    ├── SceneError (ValueError)      exit 1   a scene, object or accuracy that cannot be rendered
    │   ├── SceneFileError           exit 4   a scene, mesh or depth map that cannot be read
    │   └── UnknownNameError         exit 2   no object, scene or setting of that name
    ├── OutputExistsError (FileExistsError)
    │                                exit 1   --out exists and --overwrite was not given
    ├── FileBusyError (BlockingIOError)
    │                                exit 1   another process writes to the file
    ├── DiskFullError (OSError)      exit 1   too little disk space for the output, or none left
    ├── FolderBusyError (BlockingIOError)
    │                                exit 1   another process writes to the folder
    ├── WorkersLostError (ChildProcessError)
    │                                exit 1   workers that cannot start, or that keep dying
    ├── CameraError (OSError)        exit 3   a device that is missing or does not respond
    │   ├── CameraNotFoundError      exit 3   no such device
    │   │   └── UnknownCameraError   exit 2   a mistyped name of a camera
    │   └── CameraLostError          exit 3   a device that vanished or went silent in use
    └── RecordingError (OSError)     exit 4   a recording, dataset or record that cannot be read
        └── StreamMissingError       exit 4   a recording without a stream that is needed

All packages raise OutputExistsError and FileBusyError, which `nlos_cam.files` defines.
`nlos_calibration.errors` and `nlos_models.errors` hold their packages' roots; the command line
catches all three.
"""

from collections.abc import Iterable

# Names of this module too: the base of the tree, which lies below the other two packages.
from nlos_cam.files.errors import FileBusyError as FileBusyError  # noqa: PLC0414
from nlos_cam.files.errors import NlosCamError as NlosCamError  # noqa: PLC0414
from nlos_cam.files.errors import OutputExistsError as OutputExistsError  # noqa: PLC0414


class SceneError(NlosCamError, ValueError):
    """Scene, object or accuracy that cannot be rendered: "no object 'cupp': did you mean
    'cup'?".
    """


class SceneFileError(SceneError):
    """Scene, mesh or depth-map file that is missing or unreadable: "a.toml is a wall record, not a
    scene".
    """

    exit_code = 4


class UnknownNameError(SceneError):
    """Name of nothing: "no object 'cupp'. Did you mean 'cup'?"."""

    exit_code = 2


class DiskFullError(NlosCamError, OSError):
    """Disk with too little free space: "run.json cannot be written (No space left on device): free
    some space".
    """


class FolderBusyError(NlosCamError, BlockingIOError):
    """Folder that another process writes to: "data is being written by another build: wait until it
    has ended".
    """


class WorkersLostError(NlosCamError, ChildProcessError):
    """Worker processes that cannot start, or keep dying: "a worker exited (code -9) before
    producing objects".
    """


class CameraError(NlosCamError, OSError):
    """Camera that does not respond as it should: "l515 does not start (busy): close other programs
    that use it".
    """

    exit_code = 3


class CameraNotFoundError(CameraError):
    """Camera that is not connected: "no L515 found (librealsense sees no device): check the USB 3
    cable and port".
    """


class UnknownCameraError(CameraNotFoundError):
    """Mistyped name of a camera: "no camera 'simm'. Did you mean 'sim'?"."""

    exit_code = 2


class CameraLostError(CameraError):
    """Camera that vanished or went silent while in use: "l515 did not stop within 5 s: replug
    it".
    """


class RecordingError(NlosCamError, OSError):
    """Recording, dataset or record that cannot be read: "run.bag is damaged (no index): run
    `nlos-cam repair`".
    """

    exit_code = 4


class StreamMissingError(RecordingError):
    """Recording without a stream that is needed: "run.bag has no infrared stream (it has color,
    depth)".
    """


def did_you_mean(name: str, names: Iterable[str]) -> str:
    """Return " Did you mean ...?" with the nearest of the names, empty where none is near."""
    from difflib import get_close_matches

    nearest = get_close_matches(name, list(names), 1)
    return f" Did you mean {nearest[0]!r}?" if nearest else ""
