"""Every error that nlos-cam raises on purpose, as one tree.

    NlosCamError                     exit 1   root; one clear line: what, the value, what to do
    ├── SceneError (ValueError)      exit 1   a scene, object or accuracy that cannot be rendered
    ├── BudgetError (ValueError)     exit 1   a delay that no setting keeps on this machine
    ├── OutputExistsError (FileExistsError)  exit 1   --out is there and --overwrite was not given
    ├── DiskFullError (OSError)      exit 1   too little room for what is to be written, or none left
    ├── FolderBusyError (BlockingIOError)  exit 1   another process writes to the folder
    ├── WorkersLostError (ChildProcessError)  exit 1   workers that cannot be had, or that die again and again
    ├── CameraError (OSError)        exit 3   a device that is missing or does not do as asked
    │   ├── CameraNotFoundError      exit 3   no such device
    │   └── CameraLostError          exit 3   it was there, and vanished or fell silent
    └── RecordingError (OSError)     exit 4   a recording, dataset or record that cannot be read
        └── StreamMissingError       exit 4   it can be read, but a stream we need is not in it

`nlos_calibration.errors` and `nlos_models.errors` hold their packages' roots; the command line catches all three.
"""


class NlosCamError(Exception):
    """Root of the errors that nlos-cam foresaw."""

    exit_code = 1


class SceneError(NlosCamError, ValueError):
    """A scene, an object or an accuracy that cannot be rendered."""


class BudgetError(NlosCamError, ValueError):
    """A delay that no setting keeps on this machine."""


class OutputExistsError(NlosCamError, FileExistsError):
    """An output path that exists, and that nobody asked to overwrite."""


class DiskFullError(NlosCamError, OSError):
    """A disk with too little room for what is to be written, or with none left."""


class FolderBusyError(NlosCamError, BlockingIOError):
    """A folder that another process writes to."""


class WorkersLostError(NlosCamError, ChildProcessError):
    """Workers that cannot be had, or that die again and again."""


class CameraError(NlosCamError, OSError):
    """A camera that does not do what was asked of it."""

    exit_code = 3


class CameraNotFoundError(CameraError):
    """No camera answers to this name."""


class CameraLostError(CameraError):
    """A camera that was there and vanished, or fell silent."""


class RecordingError(NlosCamError, OSError):
    """A recording, dataset or record that cannot be read."""

    exit_code = 4


class StreamMissingError(RecordingError):
    """A recording that lacks a stream the reconstruction needs."""
