"""Files: atomic and exclusive writes, claims that name their holder, a cache with checksums, and
bounded reading.
"""

import errno
import glob
import hashlib
import logging
import math
import os
import platform
import re
import shutil
import tomllib
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import ExitStack, contextmanager, suppress
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from zipfile import ZipFile

from filelock import FileLock, Timeout

from nlos_models.errors import FileBusyError, OutputExistsError

if TYPE_CHECKING:
    from numpy.typing import NDArray

CLAIM = ".{}.part"
LOCK = "lock"
HOLDER = "holder"
DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO}
"""Errors of a disk that is full, beyond a quota or a limit, read-only or broken; their file is
named.
"""
TRIES = 5
"""Attempts at a claim that another process gives up at the same moment."""
DIGEST_DIGITS = 16
TEXT_LIMIT = 1 << 20
TENSOR_LIMIT = 4 << 30
ARRAYS_LIMIT = 2 << 30
"""Bounds in bytes of a text file (TOML, JSON), of a file of tensors, and of the arrays unpacked
from one .npz file.
"""
DEEP_KEY = re.compile(r"(?<![^\s.=,#{}\[\]])(?:[^\s.=,#{}\[\]]++[ \t]*+\.[ \t]*+){100}")
"""Key of a hundred parts in TOML: tomllib takes minutes for some thousands."""

T = TypeVar("T")
log = logging.getLogger(__name__)
_swept: set[Path] = set()
_reserved: set[Path] = set()
"""Paths that this process has claimed for its later writers."""


@contextmanager
def claim(path: Path, *, inside: bool = False) -> Generator[Path]:
    """Hold the right to write `path`, and yield an empty folder beside it (or `inside` it) for
    unfinished parts.

    The folder is removed at the end. The system releases the claim of a process that dies;
    leftovers of killed processes in the same folder go with the first claim in it. Raises
    FileBusyError, with the holder, while another process has the claim; OSError where the folder
    cannot be written to.
    """
    path = _place(path)
    folder = path / CLAIM.format("claim") if inside else path.with_name(CLAIM.format(path.name))
    try:
        if path in _reserved and not inside:
            _reserved.remove(path)
            try:
                yield folder
            finally:
                _empty(folder)
                _reserved.add(path)
        else:
            with _new_claim(path, folder):
                yield folder
    except OSError as error:
        if error.errno in DISK_ERRORS and folder.name in str(error.filename or folder.name):
            error.filename = str(path)
            error.filename2 = None
        raise


@contextmanager
def _new_claim(path: Path, folder: Path) -> Generator[None]:
    _sweep(folder.parent)
    for _ in range(TRIES):
        try:
            folder.mkdir(exist_ok=True)
        except FileExistsError:
            if folder.is_file():
                raise
            continue  # its last holder removed it between mkdir's two looks
        if lock := _acquire(folder):
            break
    else:
        raise FileBusyError(
            f"{path} is being written by {_holder(folder)}: wait for it, or choose another name"
        )
    try:
        _empty(folder)
        with suppress(OSError):  # a full disk is reported when a part is written
            (folder / HOLDER).write_text(
                f"process {os.getpid()} on {platform.node()}", encoding="utf-8"
            )
        yield
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        lock.release()
        if os.name == "nt":  # a locked file cannot be removed there
            with suppress(OSError):
                (folder / LOCK).unlink(missing_ok=True)
                folder.rmdir()


@contextmanager
def reservations() -> Generator[Callable[[Path], None]]:
    """Yield a function that claims paths until the end of the block; claims of this process within
    it share them.
    """
    with ExitStack() as held:

        def reserve(path: Path) -> None:
            if (place := _place(path)) not in _reserved:
                held.enter_context(claim(path))
                _reserved.add(place)
                held.callback(_reserved.discard, place)

        yield reserve


def _place(path: Path) -> Path:
    return path.resolve() if path.is_dir() else path.parent.resolve() / path.name


def _acquire(folder: Path) -> FileLock | None:
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except (Timeout, FileNotFoundError, FileExistsError):  # held, or its folder was just removed
        return None
    if (folder / LOCK).exists():
        return lock
    lock.release()  # its holder ended meanwhile, and took the file along
    return None


def _holder(folder: Path) -> str:
    try:
        return (folder / HOLDER).read_text(encoding="utf-8")[:200] or "another process"
    except (OSError, UnicodeDecodeError):  # the holder has just started, or just ended
        return "another process"


def _empty(folder: Path) -> None:
    for entry in folder.iterdir():
        if entry.name not in {LOCK, HOLDER}:
            shutil.rmtree(entry) if entry.is_dir() and not entry.is_symlink() else entry.unlink()


def _sweep(folder: Path) -> None:
    """Remove what killed processes left in a folder, once in a process."""
    if folder.absolute() in _swept:
        return
    _swept.add(folder.absolute())
    for left in folder.glob(CLAIM.format("*")):
        if (left / LOCK).is_file() and (lock := _acquire(left)):
            shutil.rmtree(left, ignore_errors=True)
            lock.release()


@contextmanager
def atomic_file(path: Path, *, exclusive: bool = False) -> Generator[Path]:
    """Yield a path to write to; on success flush that file to disk and rename it to `path`, else
    delete it.

    Readers see the old file or the whole new one, also after a power cut or a full disk. If
    `exclusive`, raises OutputExistsError where `path` exists by then. Raises FileBusyError while
    another process writes the same file.
    """
    with claim(path) as folder:
        part = folder / path.name
        yield part
        with part.open("r+b") as file:
            os.fsync(file.fileno())
        if exclusive:
            link_exclusively(part, path)
        else:
            part.replace(path)
        sync_folder(path.parent)


def link_exclusively(part: Path, path: Path) -> None:
    """Give a file a second name. Raises OutputExistsError where that exists, also if it appeared
    just now.
    """
    try:
        try:
            os.link(part, path)
        except FileExistsError:
            raise
        except OSError:  # a file system without links
            path.touch(exist_ok=False)
            part.replace(path)
    except FileExistsError as error:
        raise OutputExistsError(f"{path} exists: choose another name") from error


def sync_folder(folder: Path) -> None:
    """Flush a folder's entries to disk, where the system can."""
    with suppress(OSError):  # Windows cannot open a folder
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)


def load_cached(path: Path, read: Callable[[bytes], T], make: Callable[[], bytes]) -> T:
    """Return `read` of a cache entry's content; where the entry `path` is absent, make and store
    its content first.

    An entry's file has a checksum of its name and content before the suffix. A damaged or foreign
    one counts as absent and is replaced; a cache that cannot be used is a warning.
    """
    if (content := _read_entry(path)) is not None:
        try:
            return read(content)
        except Exception as error:  # noqa: BLE001  an entry of another version, say: it can be made again
            log.warning(
                "%s cannot be used (%s): making it again", path, " ".join(str(error).split())[:200]
            )
    content = make()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        store_entry(path, content)
    except FileBusyError:
        pass  # another process stores the same
    except OSError as error:
        log.warning(
            "%s cannot be written (%s): continuing without a cache; set NLOS_CAM_CACHE",
            path,
            error.strerror,
        )
    return read(content)


def store_entry(path: Path, content: bytes) -> None:
    """Store the content of a cache entry in place of any other of its name. Raises OSError,
    FileBusyError.
    """
    kept = path.with_name(_entry_name(path, content))
    with atomic_file(kept) as part:
        part.write_bytes(content)
    for other in (path, *path.parent.glob(_entry_pattern(path))):
        if other != kept:
            other.unlink(missing_ok=True)


def _read_entry(path: Path) -> bytes | None:
    with suppress(OSError, MemoryError):
        for found in path.parent.glob(_entry_pattern(path)):
            if found.is_file() and _entry_name(path, content := found.read_bytes()) == found.name:
                return content
    return None


def _entry_pattern(path: Path) -> str:
    return f"{glob.escape(path.stem)}.*{path.suffix}"


def _entry_name(path: Path, content: bytes) -> str:
    return f"{path.stem}.{hashlib.sha256(path.name.encode() + content).hexdigest()[:DIGEST_DIGITS]}{path.suffix}"


def read_bounded(path: Path, limit: int) -> bytes:
    """Return the bytes of a regular file. Raises OSError where it is none, or longer than `limit`
    bytes.
    """
    if (
        path.exists() and not path.is_file()
    ):  # opening a pipe would wait for a writer, a device may never end
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    with path.open("rb") as file:
        content = file.read(min(limit, path.stat().st_size) + 1)
    if len(content) > limit:
        raise OSError(errno.EFBIG, f"longer than the {limit >> 20} MiB allowed for it", str(path))
    return content


def read_toml(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file. Raises OSError, UnicodeDecodeError or TOMLDecodeError."""
    if DEEP_KEY.search(text := read_bounded(path, TEXT_LIMIT).decode()):
        raise tomllib.TOMLDecodeError("it is nested too deeply")
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise tomllib.TOMLDecodeError(describe(error)) from error


def read_arrays(
    path: Path, names: Iterable[str] | None = None, limit: int = ARRAYS_LIMIT
) -> "dict[str, NDArray[Any]]":
    """Return arrays of an .npz file by name (None: all of them), without pickles.

    Raises OSError, or ValueError where one is missing or damaged, where a header declares another
    size than the bytes that follow it, or where they unpack to more than `limit` bytes.
    """
    try:
        with ZipFile(path) as file:
            chosen = (
                [each.removesuffix(".npy") for each in file.namelist()] if names is None else names
            )
            infos = {name: file.getinfo(f"{name}.npy") for name in chosen}
            if sum(info.file_size for info in infos.values()) <= limit:
                return {name: _array(file.read(info)) for name, info in infos.items()}
    except (OSError, ValueError):
        raise
    except Exception as error:  # zipfile, zlib and numpy raise a dozen kinds
        raise ValueError(describe(error)) from error
    raise ValueError(f"it unpacks to more than {limit >> 20} MiB")


def _array(content: bytes) -> "NDArray[Any]":
    """Return the array of an .npy file, whose size is compared before it is allocated."""
    import numpy as np

    memory = BytesIO(content)
    old = np.lib.format.read_magic(memory) == (1, 0)
    read = np.lib.format.read_array_header_1_0 if old else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(memory)
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(content) - memory.tell():
        raise ValueError("an array's size contradicts its bytes")
    memory.seek(0)
    return np.lib.format.read_array(memory, allow_pickle=False)


CHECKSUMS = "SHA256SUMS"
"""File with the SHA-256 of the files of a folder, as `sha256sum` writes and checks it."""


def checksums_of(folder: Path) -> dict[str, str]:
    """Return the checksums in a folder's SHA256SUMS by file name; none where there is no such file.
    Raises OSError.
    """
    try:
        lines = read_bounded(folder / CHECKSUMS, TEXT_LIMIT).decode("utf-8", "replace").splitlines()
    except FileNotFoundError:
        return {}
    return {
        name.strip().lstrip("*"): digest
        for digest, _, name in (line.partition(" ") for line in lines)
    }


def read_checked(path: Path, limit: int) -> bytes:
    """Return a file's bytes. Raises OSError as `read_bounded` does, and ValueError against its
    folder's SHA256SUMS.
    """
    content = read_bounded(path, limit)
    if (
        checksums_of(path.parent).get(path.name, found := hashlib.sha256(content).hexdigest())
        != found
    ):
        raise ValueError(f"damaged: its checksum differs from {CHECKSUMS}")
    return content


def write_checked(folder: Path, contents: Mapping[str, bytes]) -> None:
    """Write files by name into a folder, each atomically, with their checksums. Raises OSError,
    FileBusyError.

    The checksums come first: a kill in between leaves files that do not match them, not a mixture
    that does.
    """
    folder.mkdir(parents=True, exist_ok=True)
    sums = {
        name: digest for name, digest in checksums_of(folder).items() if (folder / name).is_file()
    }
    sums |= {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
    text = "".join(f"{digest}  {name}\n" for name, digest in sorted(sums.items()))
    for name, content in {CHECKSUMS: text.encode(), **contents}.items():
        with atomic_file(folder / name) as part:
            part.write_bytes(content)


def describe(error: Exception) -> str:
    """Return the reason of an exception in one line: the system's words, or the library's without
    its lines.
    """
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    if isinstance(error, MemoryError):
        return "it needs more memory than there is"
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return " ".join(text.split())[:300] or "its parts contradict each other"
