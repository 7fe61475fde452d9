"""Bounded reading of HDF5: every size that a file declares is compared with the bytes it holds,
before memory is taken.

HDF5 itself takes memory for each declared chunk, also for those that are not stored. Its own
reading of a chunk has no bound either (measured with HDF5 2.0): one that unpacks to 256 MiB takes
256 MiB, whatever the array declares; one with more bytes than declared is cut silently; and one
with fewer is read beyond its end, so that other memory of the process appears in the array.
Therefore chunks are taken packed, and unpacked here with zlib's limit on the length: the only step
that is not h5py's.
"""

import zlib
from math import ceil, prod
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

MAX_ARRAY_BYTES = 1 << 30
MAX_CHUNK_BYTES = 1 << 26
MAX_RATIO = 1100
"""Bounds on what an array may declare, in bytes and as a multiple of the bytes stored for it: gzip
packs at most 1032 to 1."""
GZIP = 1
"""Number of HDF5's filter for gzip."""
MAX_CHUNKS = 1 << 16
ENTRY_BYTES = 16
"""Bounds on the number of chunks: as such, and by the bytes of a chunk's address and size in the
file's index.
"""


def read_hdf5(file: h5py.File, name: str) -> NDArray[Any]:
    """Return an array of numbers, truth values or texts that lies in the file itself.

    Raises ValueError where it is none, or declares more than the file holds; h5py raises many kinds
    for damage.
    """
    stored = file[name] if isinstance(file.get(name, getlink=True), h5py.HardLink) else None
    if not isinstance(stored, h5py.Dataset) or stored.external or stored.is_virtual:
        raise ValueError(f"{name} is not an array of this file")
    file_bytes = Path(file.filename).stat().st_size
    is_text = h5py.check_string_dtype(stored.dtype)
    if not is_text and stored.dtype.kind not in "fiub":
        raise ValueError(f"{name} does not hold numbers")
    if is_text and stored.chunks:
        raise ValueError(f"{name} holds texts in chunks")
    if stored.chunks:
        return _unpacked(stored, name, stored.chunks, file_bytes)
    if stored.nbytes > min(MAX_ARRAY_BYTES, file_bytes, stored.id.get_storage_size()):
        raise ValueError(f"{name} declares {stored.nbytes} bytes in a file of {file_bytes}")
    return _texts(stored, name, file_bytes) if is_text else np.asarray(stored[()])


def read_hdf5_text(holder: h5py.HLObject, name: str, default: str | None = None) -> str:
    """Return a single text among an object's attributes, or the default where there is none of the
    name.

    Raises KeyError without a default, and ValueError for an attribute of another kind: each element
    of an array of texts may be the same text of the file's whole length.
    """
    if default is not None and name not in holder.attrs:
        return default
    stored = holder.attrs.get_id(name)
    if stored.shape != () or not h5py.check_string_dtype(stored.dtype):
        raise ValueError(f"its attribute {name} is not a text")
    return str(holder.attrs[name])


def _texts(stored: h5py.Dataset, name: str, file_bytes: int) -> NDArray[Any]:
    """Return texts, read one by one: a file may name one long text a million times."""
    found = list[str]()
    left = file_bytes
    for row in np.ndindex(stored.shape):
        found.append(str(stored.asstr()[row]))
        left -= len(found[-1].encode())
        if left < 0:
            raise ValueError(f"{name} unpacks to more than the {file_bytes} bytes of its file")
    texts = np.empty(len(found), object)
    texts[:] = found
    return texts.reshape(stored.shape)


def _unpacked(
    stored: h5py.Dataset, name: str, chunk_shape: tuple[int, ...], file_bytes: int
) -> NDArray[Any]:
    """Return an array whose chunks are packed by gzip or not at all; each of them has to be in the
    file.
    """
    chunk_bytes = prod(chunk_shape) * stored.dtype.itemsize
    chunks = _checked_chunks(stored, name, chunk_shape, file_bytes)
    values = np.empty(stored.shape, stored.dtype)
    for chunk in chunks:
        content = _chunk_content(stored, chunk, chunk_bytes)
        if len(content) != chunk_bytes:
            raise ValueError(f"a chunk of {name} does not unpack to its {chunk_bytes} bytes")
        place = tuple(
            slice(start, start + size)
            for start, size in zip(chunk.chunk_offset, chunk_shape, strict=True)
        )
        target = values[place]
        # The last chunk of an axis is stored whole, also where it reaches beyond the array.
        inside = tuple(map(slice, target.shape))
        target[...] = np.frombuffer(content, stored.dtype).reshape(chunk_shape)[inside]
    return values


def _checked_chunks(
    stored: h5py.Dataset, name: str, chunk_shape: tuple[int, ...], file_bytes: int
) -> list[Any]:
    """Return address and size of all chunks. Raises ValueError where they declare too much, or are
    not in the file.
    """
    chunk_bytes = prod(chunk_shape) * stored.dtype.itemsize
    count = prod(ceil(size / chunk) for size, chunk in zip(stored.shape, chunk_shape, strict=True))
    declared = f"{name} declares {stored.nbytes} bytes, in {count} chunks of {chunk_bytes}"
    if max(stored.nbytes, count * chunk_bytes) > min(MAX_ARRAY_BYTES, MAX_RATIO * file_bytes):
        raise ValueError(declared)
    if chunk_bytes > MAX_CHUNK_BYTES or count > min(MAX_CHUNKS, file_bytes // ENTRY_BYTES):
        raise ValueError(declared)
    if _filters(stored) not in ([], [GZIP]):
        raise ValueError(f"{name} is packed in another way than by gzip")

    chunks = _chunks(stored, count)
    packed_bytes = sum(chunk.size for chunk in chunks)
    is_whole = len(chunks) == count and packed_bytes <= file_bytes
    if not is_whole or count * chunk_bytes > MAX_RATIO * packed_bytes:
        raise ValueError(f"{declared}, and holds {len(chunks)} of {packed_bytes} bytes")
    return chunks


def _filters(stored: h5py.Dataset) -> list[int]:
    storage = stored.id.get_create_plist()
    return [storage.get_filter(k)[0] for k in range(storage.get_nfilters())]


def _chunk_content(stored: h5py.Dataset, chunk: Any, chunk_bytes: int) -> bytes:
    """Return the content of a chunk, at most one byte more than it should have."""
    mask, packed = stored.id.read_direct_chunk(chunk.chunk_offset)
    # A bit of the mask is set where the writer left the filter out for this chunk.
    if not _filters(stored) or mask & 1:
        return packed
    return zlib.decompressobj().decompress(packed, chunk_bytes + 1)


def _chunks(stored: h5py.Dataset, count: int) -> list[Any]:
    """Return address and size of the chunks in the file, at most one more than `count`."""
    found = list[Any]()

    def take(chunk: Any) -> bool | None:
        found.append(chunk)
        return True if len(found) > count else None

    stored.id.chunk_iter(take)
    return found
