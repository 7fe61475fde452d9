"""Hidden objects of a replay as files of other programs: a mesh or a point cloud per frame."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float32

from nlos_cam.errors import RecordingError
from nlos_cam.files import atomic_directory, read_arrays
from nlos_cam.objects import mesh_from_depth
from nlos_cam.reconstruct import ignore
from nlos_cam.recording import FRAME_STEM, FrameNames, require_frames

OBJECT_FORMATS = ("ply", "glb", "obj", "csv", "npz", "points")
"""Suffixes of `SurfaceMesh.save`, and "points" for a .ply without faces."""
ENDINGS = {name: "-points.ply" if name == "points" else f".{name}" for name in OBJECT_FORMATS}
OBJECT_FILE = re.compile(rf"{FRAME_STEM}({'|'.join(map(re.escape, ENDINGS.values()))})")
"""Names that ObjectFiles gives."""


@dataclass
class ObjectFiles:
    """Writer of each frame's hidden surface, named by its number, in every format; skips frames
    without one. A number that comes again, as after a restart of the device, gets a suffix.
    """

    folder: Path
    box: ObjectBox
    formats: Sequence[str]
    """Some of OBJECT_FORMATS."""
    every: int = 1
    """Only the first of each so many frames, counted."""
    written: int = 0
    """Frames with a surface so far."""
    came: int = 0
    """Frames so far."""
    _names: FrameNames = field(default_factory=FrameNames)

    def add(self, number: int, depth_m: Float32, uncertainty_m: Float32 | None) -> None:
        """Write a frame's depth map (64, 64), if it is due and has a surface."""
        is_due = self.came % self.every == 0
        self.came += 1
        if not is_due or not np.isfinite(depth_m).any():
            return
        mesh = mesh_from_depth(depth_m, self.box, uncertainty_m)
        self.folder.mkdir(exist_ok=True)
        stem = self._names.stem(number)
        for name in self.formats:
            path = self.folder / f"{stem}{ENDINGS[name]}"
            surface = mesh.points_only if name == "points" else mesh
            path.write_bytes(surface.as_bytes(path.suffix))
        self.written += 1


def export_objects(
    result: Path,
    out: Path,
    formats: Sequence[str],
    every: int = 1,
    *,
    stop: Event,
    on_frame: Callable[[int, int], None] = ignore,
) -> int:
    """Write the hidden surfaces of a replay's reconstruction.npz into the folder `out`; return
    their number.

    Setting `stop` ends it early and keeps the files so far; before the first one it raises
    KeyboardInterrupt and writes nothing. Raises RecordingError for any other file, and where no
    frame has a surface.
    """
    arrays, box = _read(result)
    numbers = arrays["frame_number"]
    earlier = [path.name for path in out.glob("*") if OBJECT_FILE.fullmatch(path.name)]
    with atomic_directory(out, drop=earlier) as part:
        files = ObjectFiles(part, box, formats, every)
        for k, number in enumerate(numbers):
            if stop.is_set():
                break
            uncertainty_m = arrays["uncertainty_m"][k]
            is_known = np.isfinite(uncertainty_m).any()
            files.add(int(number), arrays["depth_m"][k], uncertainty_m if is_known else None)
            on_frame(k + 1, len(numbers))
        frames = _frames(len(numbers), every)
        problem = f"{result} has no hidden surface in {frames}: nothing was written"
        require_frames(files.written, stop, problem)
    return files.written


def _frames(count: int, every: int) -> str:
    frames = f"its {count} frame{'' if count == 1 else 's'}"
    return frames if every == 1 else f"one in {every} of {frames}"


DIMENSIONS = {
    "depth_m": 3,
    "uncertainty_m": 3,
    "frame_number": 1,
    "origin_m": 1,
    "pitch_m": 1,
    "z_near_m": 0,
    "z_far_m": 0,
}


def _read(path: Path) -> tuple[dict[str, Any], ObjectBox]:
    """Return a replay's arrays and their object box."""
    try:
        arrays = read_arrays(path, DIMENSIONS)
        _check(arrays)
        return arrays, _box(arrays, arrays["depth_m"].shape[1:])
    except FileNotFoundError as error:
        raise RecordingError(
            f"{path} does not exist: give the reconstruction.npz of a replay"
        ) from error
    except (OSError, ValueError) as error:
        raise RecordingError(
            f"{path} is not the reconstruction.npz of a replay: make one with `nlos-cam replay"
            " F.bag`"
        ) from error


def _check(arrays: dict[str, Any]) -> None:
    """Raise ValueError for arrays that are not numbers, or whose shapes contradict each other."""
    kinds = {arrays[name].dtype.kind for name in DIMENSIONS}
    if kinds - set("fiu") or any(arrays[name].ndim != count for name, count in DIMENSIONS.items()):
        raise ValueError("arrays of other types or dimensions")
    shape = arrays["depth_m"].shape
    shapes = {"uncertainty_m": shape, "frame_number": shape[:1], "origin_m": (2,), "pitch_m": (2,)}
    if 0 in shape[1:] or any(arrays[name].shape != wanted for name, wanted in shapes.items()):
        raise ValueError("arrays of other shapes")


def _box(arrays: dict[str, Any], shape: tuple[int, ...]) -> ObjectBox:
    """Return the box of a depth map from the centre of its first pixel and the steps to the next
    column and row.
    """
    x_m, y_m = arrays["origin_m"]
    right_m, down_m = arrays["pitch_m"]
    rows, columns = shape
    return ObjectBox(
        x_min_m=x_m - right_m / 2,
        x_max_m=x_m + (columns - 0.5) * right_m,
        y_min_m=y_m + (rows - 0.5) * down_m,
        y_max_m=y_m - down_m / 2,
        z_near_m=float(arrays["z_near_m"]),
        z_far_m=float(arrays["z_far_m"]),
    )
