"""Checksums of the files of a folder, as `sha256sum` writes and checks them."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

from nlos_cam.files.atomic import atomic_file
from nlos_cam.files.reading import TENSOR_LIMIT, TEXT_LIMIT, read_bounded

CHECKSUMS = "SHA256SUMS"


def checksums_of(folder: Path) -> dict[str, str]:
    """Return the checksums in a folder's SHA256SUMS by file name; none where there is no such file.
    Raises OSError.
    """
    try:
        text = read_bounded(folder / CHECKSUMS, TEXT_LIMIT).decode("utf-8", "replace")
    except FileNotFoundError:
        return {}
    found = dict[str, str]()
    for line in text.splitlines():
        digest, _, name = line.partition(" ")
        found[name.strip().lstrip("*")] = digest
    return found


def read_checked(path: Path, limit: int) -> bytes:
    """Return a file's bytes. Raises OSError as `read_bounded` does, and ValueError against its
    folder's SHA256SUMS.
    """
    content = read_bounded(path, limit)
    expected = checksums_of(path.parent).get(path.name)
    if expected not in {None, hashlib.sha256(content).hexdigest()}:
        raise ValueError(f"damaged: its checksum differs from {CHECKSUMS}")
    return content


def damaged_files(folder: Path) -> list[str]:
    """Return the names of the files that a folder's SHA256SUMS lists and that are missing,
    unreadable or different; none where there is no such list.
    """
    damaged: list[str] = []
    for name in checksums_of(folder):
        try:
            read_checked(folder / name, TENSOR_LIMIT)
        except (OSError, ValueError):
            damaged.append(name)
    return damaged


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
