"""One builder to a folder: a lock that the system lets go of when its holder dies, and a note of who holds it."""

import os
import platform
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from nlos_cam.errors import FolderBusyError, OutputExistsError

LOCK, NOTE = ".build.lock", ".builder"


@contextmanager
def only_builder(folder: Path) -> Generator[None]:
    """Hold a folder's lock. Raises FolderBusyError, with the holder's process id, where another process has it.

    Raises OutputExistsError where nothing may be written there.
    """
    lock, note = FileLock(folder / LOCK), folder / NOTE
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise FolderBusyError(
            f"{folder} is being built by {_holder(note)}: wait for it, or choose another --out"
        ) from error
    except PermissionError as error:
        raise OutputExistsError(
            f"{folder} cannot be written to: choose another --out, or change its permissions"
        ) from error
    try:
        with suppress(OSError):  # a full disk is told where it matters
            note.write_text(f"process {os.getpid()} on {platform.node()}", encoding="utf-8")
        yield
    finally:
        note.unlink(missing_ok=True)
        lock.release()


def _holder(note: Path) -> str:
    try:
        return note.read_text(encoding="utf-8") or "another process"
    except OSError:  # it is just beginning, or ending
        return "another process"
