"""Atomic writes: readers see the old file or directory or the whole new one."""

import ctypes
import os
import shutil
from collections.abc import Collection, Generator
from contextlib import ExitStack, contextmanager, suppress
from fnmatch import fnmatch
from pathlib import Path

from nlos_cam.files.claims import claim
from nlos_cam.files.errors import OutputExistsError

AT_FDCWD = -100
RENAME_EXCHANGE = 2
"""Of Linux' renameat2."""


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
        _flush_file(part)
        if exclusive:
            _link_exclusively(part, path)
        else:
            part.replace(path)
        _flush_entries(path.parent)


@contextmanager
def atomic_files(*paths: Path) -> Generator[list[Path]]:
    """Yield a path to write to for each of several files that belong together; on success flush all
    of them to disk, then rename one right after the other, else delete them.

    Raises FileBusyError while another process writes one of them.
    """
    with ExitStack() as claims:
        parts = [claims.enter_context(claim(path)) / path.name for path in paths]
        yield parts
        for part in parts:
            _flush_file(part)
        for part, path in zip(parts, paths, strict=True):
            part.replace(path)
        for folder in {path.parent for path in paths}:
            _flush_entries(folder)


def _link_exclusively(part: Path, path: Path) -> None:
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


@contextmanager
def atomic_directory(out: Path, *, drop: Collection[str] = ()) -> Generator[Path]:
    """Yield an empty directory; on success flush it to disk and let it take the place of `out` in
    one rename.

    `out` keeps its owner and permissions. Entries of it with other names stay, but for files that
    match a pattern of `drop`, as in `fnmatch`, and folders that match one with a slash at its end:
    they go in the same step, or after the new entries where there is no such step.
    Raises OutputExistsError where `out` is a file, or appeared meanwhile, and FileBusyError while
    another process writes it.
    """
    if os.path.lexists(out) and not out.is_dir():
        raise OutputExistsError(
            f"{out} is a file, but --out must be a directory: choose another name"
        )
    out = out.resolve()
    existed = out.exists()
    with claim(out) as folder:
        part = folder / out.name
        part.mkdir()
        yield part
        _flush_directory(part)
        if existed:
            _replace_directory(part, out, folder, drop)
        else:
            _rename_new(part, out)
        _flush_entries(out.parent)


def _flush_file(path: Path) -> None:
    with path.open("r+b") as file:
        os.fsync(file.fileno())


def _flush_directory(folder: Path) -> None:
    for parent, _, names in os.walk(folder):
        for name in names:
            _flush_file(Path(parent, name))
        _flush_entries(Path(parent))


def _flush_entries(folder: Path) -> None:
    """Flush a folder's list of entries to disk, where the system can."""
    with suppress(OSError):  # Windows cannot open a folder
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)


def _rename_new(part: Path, out: Path) -> None:
    try:
        part.rename(out)  # fails unless `out` is missing or empty
    except OSError as error:
        if not out.exists():
            raise
        raise OutputExistsError(
            f"{out} appeared while it was being written: choose another name"
        ) from error


def _is_dropped(entry: Path, drop: Collection[str]) -> bool:
    is_folder = entry.is_dir()
    name = f"{entry.name}/" if is_folder else entry.name
    return any(fnmatch(name, pattern) for pattern in drop if pattern.endswith("/") == is_folder)


def _replace_directory(part: Path, out: Path, folder: Path, drop: Collection[str]) -> None:
    replaced = [entry.name for entry in part.iterdir()]
    others = [entry for entry in out.iterdir() if entry.name not in replaced]
    dropped = [entry for entry in others if _is_dropped(entry, drop)]
    others = [entry for entry in others if entry not in dropped]

    fixed = Path.cwd().is_relative_to(out) or any(entry.is_mount() for entry in (out, *others))
    if not fixed and _link_all(others, part):
        _keep_access(out, part)
        if _exchange(part, out):
            return

    # Entry by entry where the directory itself has to stay, or the system cannot exchange two.
    for name in replaced:
        if (out / name).is_dir():
            (out / name).rename(folder / f"old {name}")
        (part / name).replace(out / name)
    for entry in dropped:
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        else:
            entry.unlink()


def _keep_access(old: Path, new: Path) -> None:
    """Give a folder the owner, group and permissions of the one that it replaces, as far as this
    user may.
    """
    status = old.stat()
    with suppress(OSError, AttributeError):  # Windows has no owners
        os.chown(new, status.st_uid, status.st_gid)
    with suppress(OSError):
        shutil.copymode(old, new)  # after the owner: a change of owner clears the bit for the group


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
