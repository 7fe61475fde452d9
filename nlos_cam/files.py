"""Results, a file or a folder: written under another name, and renamed when whole.

Where what can be made again is kept.
"""

import os
import shutil
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from nlos_cam.errors import OutputExistsError


@contextmanager
def atomic_directory(out: Path) -> Generator[Path]:
    """A folder to write in, beside `out`; its contents replace those of the same names in `out` at the end.

    After an error it is removed. Raises OutputExistsError where `out` is a file.
    """
    if out.exists() and not out.is_dir():
        raise OutputExistsError(f"{out} is a file: choose a folder's name for --out")
    part = Path(tempfile.mkdtemp(".part", f".{out.name}.", out.parent))  # a process that died may have had our number
    try:
        yield part
        out.mkdir(exist_ok=True)
        for made in part.iterdir():
            if made.is_dir():
                shutil.rmtree(out / made.name, ignore_errors=True)
            made.replace(out / made.name)
    finally:
        shutil.rmtree(part)


@contextmanager
def atomic_file(path: Path) -> Generator[Path]:
    """A file to write beside `path`, which it replaces at the end; after an error it is removed."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def cache_folder() -> Path:
    """NLOS_CAM_CACHE, or nlos-cam's place in the user's cache folder."""
    if chosen := os.environ.get("NLOS_CAM_CACHE"):
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "nlos-cam"
