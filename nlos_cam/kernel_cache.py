"""Folder of numba's compiled kernels, named by a checksum of all files that a kernel may depend on.

numba notices a change of a kernel's own file alone: after a change of a function that it calls, a
constant or a record's fields in another file, old machine code would stay in use. Here the folder's
name depends on the text of all of them.
"""

import hashlib
import logging
import os
import shutil
from functools import cache
from pathlib import Path
from typing import Any, Self

from numba.core import caching, event

PACKAGE = Path(__file__).parent
SOURCES = (
    "frames.py",
    "objects/*.py",
    "recording/*.py",
    "render/*.py",
    "render/sensor/*.py",
    "transients/*.py",
)
"""Files with kernels, and with the functions, constants and records that kernels use."""
PREFIX = "kernels-"
NOTICE = "Compiling the physics for this machine, once: up to a minute and a half"
log = logging.getLogger(__name__)


@cache
def checksum(package: Path = PACKAGE) -> str:
    """Return the SHA-256 of the SOURCES in a package's folder.

    Takes 1.5 to 2 ms (0.6 MB, files in the system's cache), once in a process.
    """
    found = hashlib.sha256()
    for pattern in SOURCES:
        for path in sorted(package.glob(pattern)):
            text = path.read_bytes()
            # With the length, so that no text can pass for the end of one file and the next one.
            found.update(f"{path.relative_to(package)} {len(text)}\n".encode())
            found.update(text)
    return found.hexdigest()


@cache
def folder() -> Path | None:
    """Return the folder beside the package's files, or in the user's cache if they are read-only.

    Folders of other checksums in the same place are removed. None if neither can be written.
    """
    user = os.environ.get("NLOS_CAM_CACHE")
    base = Path(user) if user else _user_cache() / "nlos-cam"
    # Several installations may share the user's cache: each has a place of its own.
    place = hashlib.sha256(str(PACKAGE).encode()).hexdigest()[:16]
    for parent in (PACKAGE / "__pycache__", base / "numba" / place):
        path = parent / f"{PREFIX}{checksum()[:16]}"
        if path.is_dir() and os.access(path, os.W_OK):
            return path
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        for other in parent.glob(f"{PREFIX}*"):
            if other != path:
                shutil.rmtree(other, ignore_errors=True)
        return path
    return None


def _user_cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


BaseLocator: Any = getattr(caching, "_CacheLocator")  # noqa: B009, numba has no public one


class KernelCacheLocator(BaseLocator):
    """Place of one kernel of this package in `folder`, for numba."""

    def __init__(self, function: Any, path: Path) -> None:
        self._line: int = function.__code__.co_firstlineno
        self._path = path

    def get_cache_path(self) -> str:
        """Return the folder of the kernel's module."""
        root = folder()
        module = self._path.relative_to(PACKAGE).with_suffix("")
        return str((root or PACKAGE / "__pycache__") / "-".join(module.parts))

    def get_source_stamp(self) -> str:
        """Return what the compiled code depends on."""
        return checksum()

    def get_disambiguator(self) -> str:
        """Return what tells functions of one name in a module apart."""
        return str(self._line)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Self | None:
        """Return the place of a kernel; None leaves functions of other packages to numba."""
        path = Path(py_file)
        if not path.is_relative_to(PACKAGE) or os.environ.get("NUMBA_CACHE_DIR"):
            return None
        place = cls(py_func, path)
        try:
            place.ensure_cache_path()
        except OSError:
            return None
        return place


class CompileNotice(event.Listener):
    """Logs NOTICE when a kernel is compiled that was not in the cache, once in a process."""

    def __init__(self) -> None:
        self._is_logged = False

    def on_start(self, event: Any) -> None:  # noqa: ARG002, numba names it
        if not self._is_logged:
            self._is_logged = True
            log.info(NOTICE)

    def on_end(self, event: Any) -> None:
        """Nothing to do: the result says that it is done."""


@cache
def install() -> None:
    """Let numba keep this package's kernels here, and log when it compiles any.

    A user's NUMBA_CACHE_DIR has precedence.
    """
    event.register("numba:compile", CompileNotice())
    locators: list[Any] = getattr(caching.CacheImpl, "_locator_classes")  # noqa: B009, numba has no public list
    if KernelCacheLocator not in locators:
        locators.insert(0, KernelCacheLocator)
