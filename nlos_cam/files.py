"""Atomic writes of results (see also nlos_models.files), and the location of the cache
directory.
"""

import ctypes
import os
import shutil
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from nlos_models import FileBusyError, atomic_file, claim, load_cached, reservations, sync_folder

from nlos_cam.errors import OutputExistsError

__all__ = [
    "FileBusyError",
    "atomic_directory",
    "atomic_file",
    "cache_folder",
    "claim",
    "load_cached",
    "reservations",
]
AT_FDCWD = -100
RENAME_EXCHANGE = 2
"""Of Linux' renameat2."""


@contextmanager
def atomic_directory(out: Path) -> Generator[Path]:
    """Yield an empty directory; on success flush it to disk and let it take the place of `out` in
    one rename.

    Entries of `out` with other names stay. Raises OutputExistsError where `out` is a file, or
    appeared meanwhile, and FileBusyError while another process writes it.
    """
    if out.exists() and not out.is_dir():
        raise OutputExistsError(
            f"{out} is a file, but --out must be a directory: choose another name"
        )
    out, existed = out.resolve(), out.exists()
    with claim(out) as folder:
        part = folder / out.name
        part.mkdir()
        yield part
        _flush(part)
        if existed:
            _replace_directory(part, out, folder)
        else:
            _rename_new(part, out)
        sync_folder(out.parent)


def _flush(folder: Path) -> None:
    for parent, _, names in os.walk(folder):
        for name in names:
            with Path(parent, name).open("r+b") as file:
                os.fsync(file.fileno())
        sync_folder(Path(parent))


def _rename_new(part: Path, out: Path) -> None:
    try:
        part.rename(out)  # fails unless `out` is missing or empty
    except OSError as error:
        if not out.exists():
            raise
        raise OutputExistsError(
            f"{out} appeared while it was being written: choose another name"
        ) from error


def _replace_directory(part: Path, out: Path, folder: Path) -> None:
    replaced = [entry.name for entry in part.iterdir()]
    others = [entry for entry in out.iterdir() if entry.name not in replaced]
    fixed = Path.cwd().is_relative_to(out) or any(entry.is_mount() for entry in (out, *others))
    if not fixed and _link_all(others, part) and _exchange(part, out):
        return
    for name in (
        replaced
    ):  # entry by entry where the directory itself has to stay, or the system cannot exchange two
        if (out / name).is_dir():
            (out / name).rename(folder / f"old {name}")
        (part / name).replace(out / name)


def _link_all(entries: list[Path], target: Path) -> bool:
    """Link entries into a second directory, so that either is whole; return False where the file
    system cannot.
    """
    try:
        for entry in entries:
            if entry.is_dir() and not entry.is_symlink():
                shutil.copytree(entry, target / entry.name, symlinks=True, copy_function=os.link)
            else:
                os.link(entry, target / entry.name, follow_symlinks=False)
    except (OSError, shutil.Error, NotImplementedError):
        return False
    return True


def _exchange(one: Path, other: Path) -> bool:
    """Exchange two directories in one step; return False where the system cannot."""
    try:
        call = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError, TypeError):
        return False
    return call(AT_FDCWD, os.fsencode(one), AT_FDCWD, os.fsencode(other), RENAME_EXCHANGE) == 0


def cache_folder() -> Path:
    """Return NLOS_CAM_CACHE, or "nlos-cam" in the user's cache directory."""
    if chosen := os.environ.get("NLOS_CAM_CACHE"):
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "nlos-cam"
