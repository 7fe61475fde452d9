"""Cache: entries that carry their checksum in the file's name."""

import glob
import hashlib
import logging
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from nlos_cam.files.atomic import atomic_file
from nlos_cam.files.errors import FileBusyError

DIGEST_DIGITS = 16

T = TypeVar("T")
log = logging.getLogger(__name__)


def cache_folder() -> Path:
    """Return NLOS_CAM_CACHE, or "nlos-cam" in the user's cache directory."""
    if chosen := os.environ.get("NLOS_CAM_CACHE"):
        return Path(chosen)
    # An empty variable counts as none, by the XDG specification: it would name the current folder.
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "nlos-cam"


def load_cached(path: Path, read: Callable[[bytes], T], make: Callable[[], bytes]) -> T:
    """Return `read` of a cache entry's content; where the entry `path` is absent, make and store
    its content first.

    An entry's file has a checksum of its name and content before the suffix. A damaged or foreign
    one counts as absent and is replaced; a cache that cannot be used is a warning.
    """
    if (content := _read_entry(path)) is not None:
        try:
            return read(content)
        except Exception as error:  # noqa: BLE001  of another version, say: it can be made again
            log.warning(
                "%s cannot be used (%s): making it again", path, " ".join(str(error).split())[:200]
            )
    content = make()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _store_entry(path, content)
    except FileBusyError:
        pass  # another process stores the same
    except OSError as error:
        log.warning(
            "%s cannot be written (%s): continuing without a cache; set NLOS_CAM_CACHE",
            path,
            error.strerror,
        )
    return read(content)


def _store_entry(path: Path, content: bytes) -> None:
    """Store the content of a cache entry in place of any other of its name."""
    stored = path.with_name(_entry_name(path, content))
    with atomic_file(stored) as part:
        part.write_bytes(content)
    for other in (path, *path.parent.glob(_entry_pattern(path))):
        if other != stored:
            other.unlink(missing_ok=True)


def _read_entry(path: Path) -> bytes | None:
    with suppress(OSError, MemoryError):
        for found in path.parent.glob(_entry_pattern(path)):
            if not found.is_file():
                continue
            content = found.read_bytes()
            if _entry_name(path, content) == found.name:
                return content
    return None


def _entry_pattern(path: Path) -> str:
    return f"{glob.escape(path.stem)}.*{path.suffix}"


def _entry_name(path: Path, content: bytes) -> str:
    digest = hashlib.sha256(path.name.encode() + content).hexdigest()
    return f"{path.stem}.{digest[:DIGEST_DIGITS]}{path.suffix}"
