"""Room on the disk that a recording is written to: what it may need, what is free, whether a file can still grow."""

import os
import shutil
from pathlib import Path

from nlos_calibration.projection import Intrinsics

from nlos_cam.camera.streams import BYTES_PER_PIXEL, FRAMES_PER_S
from nlos_cam.errors import DiskFullError

RESERVE_BYTES = 200_000_000
"""A recording stops before less than this is free: five seconds of 640 x 480, and what its index takes."""
CHUNK_BYTES = 4_000_000
"""More than a recording keeps back before it writes: librealsense writes in pieces of 0.75 MB."""
INDEX_SHARE = 1e-3
"""Of a recording's size: more than its index at the end takes."""


def bytes_per_frame(intrinsics: Intrinsics) -> int:
    """The most that a frame of three streams takes: librealsense compresses, but by how much is not known ahead."""
    return intrinsics.width * intrinsics.height * sum(BYTES_PER_PIXEL.values())


def free_bytes(path: Path) -> int:
    """What is free on the disk of `path`, a file that may not exist yet in a folder that does."""
    return shutil.disk_usage(path.absolute().parent).free


def recording_s(intrinsics: Intrinsics, free: int) -> float:
    """How long a recording lasts, at least, until only the reserve is left."""
    return max(0, free - RESERVE_BYTES) / (bytes_per_frame(intrinsics) * FRAMES_PER_S)


def check_room(path: Path, intrinsics: Intrinsics, frames: int, free: int) -> None:
    """Raise DiskFullError where so many frames may not fit, and leave the reserve."""
    needed = frames * bytes_per_frame(intrinsics)
    if free < needed + RESERVE_BYTES:
        size = f"{intrinsics.width} x {intrinsics.height}"
        raise DiskFullError(
            f"{path}: {frames} frames of {size} may need {needed / 1e9:.2f} GB (uncompressed; how far they compress is "
            f"not known ahead) beside {RESERVE_BYTES / 1e9:.1f} GB that stay free, and {free / 1e9:.2f} GB are free: "
            "make room, record less, or name a --out on another disk"
        )


def closing_bytes(path: Path) -> int:
    """More than closing a recording adds to it."""
    return CHUNK_BYTES + int(path.stat().st_size * INDEX_SHARE)


def can_grow(path: Path, by_bytes: int) -> bool:
    """Whether a file can, tried on the file itself: a quota or a size limit shows nowhere else.

    It has its old length afterwards. Nobody may write to it meanwhile.
    """
    length = path.stat().st_size
    try:
        with path.open("r+b", buffering=0) as file:
            file.seek(length)
            wrote = file.write(bytes(by_bytes))
            os.fsync(file.fileno())
    except OSError:
        return False
    else:
        return wrote == by_bytes
    finally:
        os.truncate(path, length)
