"""One frame's result as files: arrays, picture and mesh."""

import glob
import socket
from datetime import datetime
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from nlos_cam.files import atomic_file
from nlos_cam.view.video import Still
from nlos_cam.view.viewer import Moment

MAX_LISTED = 12
"""Last files that a page lists for download."""


class WrittenFiles(dict[str, Path]):
    """Whole files that the commands of a page wrote, by name; the page offers them for download."""

    @property
    def newest(self) -> list[str]:
        """Names of the last files, as the page lists them; earlier ones can still be had."""
        return list(self)[-MAX_LISTED:]

    def note(self, path: Path) -> str:
        """Note a file, and those beside it of the same stem; return where they are, for a person
        whose browser may run on another machine.
        """
        for each in sorted(path.parent.glob(f"{glob.escape(path.stem)}.*")):
            self[each.name] = each
        return f"in {path.parent.resolve()} on {socket.gethostname()}"


def dated_file(folder: Path, stem: str, suffix: str) -> Path:
    """Return a path in a folder with the present date, to a millisecond, so that it replaces
    nothing.
    """
    date = f"{datetime.now().astimezone():%Y%m%d-%H%M%S-%f}"[:-3]
    return folder / f"{stem}-{date}{suffix}"


def prepare_saving() -> None:
    """Import what `save_moment` needs, which takes seconds beside a run on one processor."""
    for module in ("PIL.PngImagePlugin", "nlos_cam.objects.surface_mesh", "trimesh"):
        import_module(module)


def save_moment(path: Path, moment: Moment) -> str:
    """Write a moment's arrays to `path` (.npz), its picture and mesh beside it; return what was
    written.
    """
    result = moment.result
    arrays: dict[str, Any] = {
        "depth_m": result.depth_m,
        "lidar_depth_m": result.frame.depth_m,
        "infrared": result.frame.ir,
        "uncertainty_m": result.uncertainty_m,
        "truth_depth_m": result.truth_depth_m,
        "frame_number": result.frame_number,
        "timestamp_s": result.timestamp_s,
        "verdict": result.verdict or "",
    }
    known = {name: array for name, array in arrays.items() if array is not None}
    with atomic_file(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **known)
    Still(moment).save(path.with_suffix(".png"), moment)

    if not result.reconstruction.has_surface:
        return f"wrote {path}, .png; no surface, so no .ply"
    result.to_mesh().save(path.with_suffix(".ply"))
    return f"wrote {path}, .png and .ply"
