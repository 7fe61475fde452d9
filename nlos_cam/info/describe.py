"""Dispatch of files and folders to the description of their kind."""

import csv
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from nlos_calibration.errors import CalibrationError
from nlos_models.errors import ModelError

from nlos_cam.errors import NlosCamError, RecordingError
from nlos_cam.info import files, transients
from nlos_cam.info.folders import FOLDERS
from nlos_cam.recording import SAMPLE

Describe = Callable[[Path, bool], files.Description | None]
FILES: dict[str, tuple[str, Describe]] = {
    ".bag": ("recording", files.describe_bag),
    ".db3": ("recording", files.describe_bag),
    ".mcap": ("recording", files.describe_bag),
    ".npz": ("arrays", files.describe_npz),
    ".toml": ("record", files.describe_toml),
    ".json": ("record", files.describe_json),
    ".html": ("page", files.describe_page),
    ".h5": ("dataset shard", transients.describe_hdf5),
    ".hdf5": ("transient", transients.describe_transient),
    ".obj": ("mesh", files.describe_mesh),
    ".ply": ("mesh", files.describe_mesh),
    ".stl": ("mesh", files.describe_mesh),
    ".csv": ("log", files.describe_log),
    ".jsonl": ("log", files.describe_log),
}
"""Word for a damaged file, and reader, by suffix."""
KINDS = (
    "recordings (.bag) and their sidecars (.json), .npz files, saved views and reports (.html),"
    " wall, scene, rig and recipe files (.toml), dataset shards (.h5), transients (.hdf5), meshes"
    " and point clouds (.obj, .ply, .stl), logs of live runs (.csv, .jsonl), and the folders of"
    " benches, recordings, datasets, training runs, weights, the work of adapt, replays, exports,"
    " files of frames, evaluations, detections and trade-offs"
)


def describe(path: Path, *, verify: bool = False) -> files.Description:
    """Return the description of a file or folder; `verify` reads all of it instead of its heads.

    The name "sample" stands for the packaged recording. A damaged one has a `problem`. Raises
    RecordingError where there is none, or it is of no known kind.
    """
    if not path.exists() and str(path) == SAMPLE.stem:
        path = SAMPLE
    if not path.exists():
        raise RecordingError(f"{path} does not exist: check the name")
    if not path.is_dir() and not path.is_file():  # opening a pipe would wait for a writer
        raise RecordingError(f"{path} is neither a file nor a folder: check the name")
    if path.is_dir():
        readers = [(kind, reader) for mark, kind, reader in FOLDERS if any(path.glob(mark))]
    else:
        readers = [FILES[path.suffix]] if path.suffix in FILES else []
    for kind, reader in readers:
        try:
            found = reader(path, verify)
        except (NlosCamError, CalibrationError, ModelError) as error:
            found = files.Description(kind, problem=" ".join(str(error).split()))
        except (
            LookupError,
            TypeError,
            ValueError,
            AttributeError,
            csv.Error,
        ) as error:  # fields that the program never wrote
            found = files.Description(
                kind,
                problem=f"{path} is damaged ({type(error).__name__} in its fields): make it again",
            )
        except OSError as error:
            raise RecordingError(f"{path} cannot be read: {error.strerror or error}") from error
        if found:
            file_date = (
                f"{datetime.fromtimestamp(path.stat().st_mtime, UTC):%Y-%m-%d %H:%M:%S} UTC (file's"
                " date)"
            )
            return replace(found, bytes=files.size_of(path), created=found.created or file_date)
    raise RecordingError(f"{path} is of no known kind. Known are {KINDS}")
