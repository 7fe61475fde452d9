"""Atomic writes of results, and the location of the cache directory."""

import os
import secrets
import shutil
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from nlos_cam.errors import OutputExistsError


def _unfinished(path: Path) -> Path:
    """Return a name beside `path` that no other process or container uses, unlike a process id."""
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")


@contextmanager
def atomic_file(path: Path) -> Generator[Path]:
    """Yield a path to write to; on success flush that file to disk and rename it to `path`, else delete it.

    Readers see the old file or the whole new one, also after a power cut or a full disk.
    """
    part = _unfinished(path)
    try:
        yield part
        with part.open("r+b") as file:
            os.fsync(file.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def atomic_directory(out: Path) -> Generator[Path]:
    """Yield an empty directory beside `out`; on success move its entries into `out`, and delete it in any case.

    Entries of `out` with the same names are replaced, others stay. Raises OutputExistsError where `out` is a file.
    """
    if out.exists() and not out.is_dir():
        raise OutputExistsError(f"{out} is a file, but --out must be a directory: choose another name")
    part = _unfinished(out)
    part.mkdir()
    try:
        yield part
        out.mkdir(exist_ok=True)
        for entry in part.iterdir():
            if entry.is_dir():
                shutil.rmtree(out / entry.name, ignore_errors=True)
            entry.replace(out / entry.name)
    finally:
        shutil.rmtree(part)


def cache_folder() -> Path:
    """Return NLOS_CAM_CACHE, or "nlos-cam" in the user's cache directory."""
    if chosen := os.environ.get("NLOS_CAM_CACHE"):
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "nlos-cam"
