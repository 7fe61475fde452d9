"""Claims: the right of one process to write a path, which ends with the process."""

import errno
import os
import platform
import shutil
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from nlos_cam.files.errors import FileBusyError

CLAIM = ".{}.part"
LOCK = "lock"
HOLDER = "holder"
REPLACED = "replaced"
"""Folder of a claim for what the new file replaces until it stands: `replaced_folder`."""
DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO}
"""Errors of a disk that is full, beyond a quota or a limit, read-only or broken."""
TRIES = 5
"""Attempts at a claim that another process gives up at the same moment."""

_swept: set[Path] = set()
"""Folders in which this process has removed the leftovers of killed ones."""
_reserved: set[Path] = set()
"""Paths that this process has claimed for its later writers."""


@contextmanager
def claim(path: Path, *, inside: bool = False) -> Generator[Path]:
    """Hold the right to write `path`, and yield an empty folder beside it (or `inside` it) for
    unfinished parts.

    The folder is removed at the end. The system releases the claim of a process that dies;
    leftovers of killed processes in the same folder go with the first claim in it, but for what is
    in `replaced_folder`: that is put back. Raises FileBusyError, with the holder, while another
    process has the claim; OSError where the folder cannot be written to.
    """
    path = _resolve(path)
    folder = path / CLAIM.format("claim") if inside else path.with_name(CLAIM.format(path.name))
    take = _share_reservation if path in _reserved and not inside else _new_claim
    try:
        with take(path, folder):
            yield folder
    except OSError as error:
        # The user knows the output, not the hidden folder beside it.
        if error.errno in DISK_ERRORS and folder.name in str(error.filename or folder.name):
            error.filename = str(path)
            error.filename2 = None
        raise


@contextmanager
def _share_reservation(path: Path, folder: Path) -> Generator[None]:
    """Use this process's reservation of a path, for one writer at a time."""
    _reserved.remove(path)
    try:
        yield
    finally:
        _empty(folder)
        _reserved.add(path)


@contextmanager
def _new_claim(path: Path, folder: Path) -> Generator[None]:
    _sweep(folder.parent)
    lock = _lock_new_folder(path, folder)
    try:
        _empty(folder)
        with suppress(OSError):  # a full disk is reported when a part is written
            (folder / HOLDER).write_text(_this_process(), encoding="utf-8")
        yield
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        lock.release()
        if os.name == "nt":  # a locked file cannot be removed there
            with suppress(OSError):
                (folder / LOCK).unlink(missing_ok=True)
                folder.rmdir()


def _lock_new_folder(path: Path, folder: Path) -> FileLock:
    for _ in range(TRIES):
        try:
            folder.mkdir(exist_ok=True)
        except FileExistsError:
            if folder.is_file():
                raise
            continue  # its last holder removed it between mkdir's two looks
        if lock := _acquire(folder):
            return lock
    raise FileBusyError(
        f"{path} is being written by {_holder(folder)}: wait for it, or choose another name"
    )


def replaced_folder(claimed: Path) -> Path:
    """Return a new folder in a claim's folder, for the files that a new one replaces before it is
    whole. If the process is killed meanwhile, the next claim puts them back, in place of the new
    one. Raises OSError.
    """
    folder = claimed / REPLACED
    folder.mkdir(exist_ok=True)
    return folder


def is_claimed(path: Path) -> bool:
    """Return whether another process writes `path`, as far as its claim says."""
    place = _resolve(path)
    folder = place.with_name(CLAIM.format(place.name))
    if not (folder / LOCK).is_file() or _holder(folder) == _this_process():
        return False
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        return True
    except OSError:  # its holder ended just now, or another user's folder
        return False
    lock.release()
    return False


@contextmanager
def reservations() -> Generator[Callable[[Path], None]]:
    """Yield a function that claims paths until the end of the block; claims of this process within
    it share them.
    """
    with ExitStack() as held:

        def reserve(path: Path) -> None:
            place = _resolve(path)
            if place not in _reserved:
                held.enter_context(claim(path))
                _reserved.add(place)
                held.callback(_reserved.discard, place)

        yield reserve


def _resolve(path: Path) -> Path:
    return path.resolve() if path.is_dir() else path.parent.resolve() / path.name


def _acquire(folder: Path) -> FileLock | None:
    """Return the lock of a claim's folder; None where another process holds it, or removed the
    folder.
    """
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except (Timeout, FileNotFoundError, FileExistsError):
        return None
    if (folder / LOCK).exists():
        return lock
    # Its holder ended between the two lines and took the file along: the lock is on a file that
    # nobody else can open.
    lock.release()
    return None


def _this_process() -> str:
    return f"process {os.getpid()} on {platform.node()}"


def _holder(folder: Path) -> str:
    try:
        return (folder / HOLDER).read_text(encoding="utf-8")[:200] or "another process"
    except (OSError, UnicodeDecodeError):  # the holder has just started, or just ended
        return "another process"


def _put_back(folder: Path) -> None:
    """Put back the files that a killed process had taken away."""
    for kept in (folder / REPLACED).glob("*"):
        kept.replace(folder.parent / kept.name)


def _empty(folder: Path) -> None:
    _put_back(folder)
    for entry in folder.iterdir():
        if entry.name in {LOCK, HOLDER}:
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        else:
            entry.unlink()


def _sweep(folder: Path) -> None:
    """Remove what killed processes left in a folder, once in a process."""
    if folder.absolute() in _swept:
        return
    _swept.add(folder.absolute())
    for left in folder.glob(CLAIM.format("*")):
        if (left / LOCK).is_file() and (lock := _acquire(left)):
            with suppress(OSError):  # what cannot be put back now stays for a later claim
                _put_back(left)
                shutil.rmtree(left, ignore_errors=True)
            lock.release()
