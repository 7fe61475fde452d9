"""Small recordings of noise: packed or not, closed or without their index, as a kill leaves
them.
"""

import re
from pathlib import Path

from noise_recordings import record


def without_index(content: bytes) -> bytes:
    """A recording as a kill leaves it: not closed, its last chunk begun and of no length yet."""
    last = content.rindex(b"\x00\x00\x00compression=") - 5
    size = content.index(b"size=", last) + len(b"size=")
    data = size + 8
    end = content.index(b"\x2f\x00\x00\x00\x09\x00\x00\x00conn=", data)  # where its index begins
    unfinished = content[last:size] + bytes(8) + content[data : (data + end) // 2]
    return re.sub(rb"(?s)(index_pos=).{8}", rb"\1" + bytes(8), content[:last], count=1) + unfinished


def make_all(folder: Path) -> dict[str, Path]:
    """One of each kind, by name."""
    made = {
        name: record(folder / f"{name}.bag", packed=name == "packed")
        for name in ("packed", "plain")
    }
    for name, path in list(made.items()):
        unindexed = folder / f"{name}-unindexed.bag"
        unindexed.write_bytes(without_index(path.read_bytes()))
        made[unindexed.stem] = unindexed
    return made
