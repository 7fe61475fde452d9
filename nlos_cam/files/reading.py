"""Bounded reading: files from outside cannot ask for more memory or time than their kind needs."""

import errno
import math
import re
import tomllib
from collections.abc import Iterable
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import ZipFile

if TYPE_CHECKING:
    from numpy.typing import NDArray

TEXT_LIMIT = 1 << 20
TENSOR_LIMIT = 4 << 30
ARRAYS_LIMIT = 2 << 30
"""Bounds in bytes of a text file (TOML, JSON), of a file of tensors, and of the arrays unpacked
from one .npz file.
"""
DEEP_KEY = re.compile(r"(?<![^\s.=,#{}\[\]])(?:[^\s.=,#{}\[\]]++[ \t]*+\.[ \t]*+){100}")
"""Key of a hundred parts in TOML: tomllib takes minutes for some thousands."""


def read_bounded(path: Path, limit: int) -> bytes:
    """Return the bytes of a regular file. Raises OSError where it is none, or longer than `limit`
    bytes.
    """
    # Opening a pipe would wait for a writer, and a device may never end.
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    with path.open("rb") as file:
        content = file.read(min(limit, path.stat().st_size) + 1)
    if len(content) > limit:
        raise OSError(errno.EFBIG, f"longer than the {limit >> 20} MiB allowed for it", str(path))
    return content


def read_toml(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file. Raises OSError, UnicodeDecodeError or TOMLDecodeError."""
    text = read_bounded(path, TEXT_LIMIT).decode()
    if DEEP_KEY.search(text):
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
            if names is None:
                names = [each.removesuffix(".npy") for each in file.namelist()]
            infos = {name: file.getinfo(f"{name}.npy") for name in names}
            if sum(info.file_size for info in infos.values()) <= limit:
                return {name: _read_array(file.read(info)) for name, info in infos.items()}
    except (OSError, ValueError):
        raise
    except Exception as error:  # zipfile, zlib and numpy raise a dozen kinds
        raise ValueError(describe(error)) from error
    raise ValueError(f"it unpacks to more than {limit >> 20} MiB")


def _read_array(content: bytes) -> "NDArray[Any]":
    """Return the array of an .npy file, whose size is compared before it is allocated."""
    import numpy as np

    memory = BytesIO(content)
    if np.lib.format.read_magic(memory) == (1, 0):
        header = np.lib.format.read_array_header_1_0(memory)
    else:
        header = np.lib.format.read_array_header_2_0(memory)
    shape, _, dtype = header
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(content) - memory.tell():
        raise ValueError("an array's size contradicts its bytes")
    memory.seek(0)
    return np.lib.format.read_array(memory, allow_pickle=False)


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
