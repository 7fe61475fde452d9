"""Ways in which a recording goes bad, at random places."""

import re
from collections.abc import Callable

import numpy as np

Random = np.random.Generator
LENGTH = re.compile(rb"(?s)....(?=(?:compression|conn|count|index_pos|op|size|topic|time)=)")
"""The length of a record's field; what is 4 bytes before it may be the length of the record's header."""
ABSURD = (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0xFFFFFFF0)
MAX_AT_ONCE = 3


def _span(content: bytearray, random: Random, most: int = 1 << 18) -> slice:
    start = int(random.integers(len(content)))
    return slice(start, start + int(random.integers(1, most)))


def cut(content: bytearray, random: Random) -> None:
    """Lose the end."""
    del content[int(random.integers(len(content))) :]


def flip(content: bytearray, random: Random) -> None:
    """Change some bytes."""
    for at in random.integers(len(content), size=int(random.integers(1, 64))):
        content[at] ^= int(random.integers(1, 256))


def set_lengths(content: bytearray, random: Random) -> None:
    """Put another number where a length is, or just before or after."""
    places = [match.start() for match in LENGTH.finditer(content)]
    for _ in range(int(random.integers(1, 4)) if places else 0):
        at = int(random.choice(places)) + int(random.choice([-4, 0, 4, 8, 13]))
        absurd = random.random() < 0.5
        value = int(random.choice(ABSURD)) if absurd else int(random.integers(1 << 20))
        content[at : at + 4] = value.to_bytes(4, "little")


def zero(content: bytearray, random: Random) -> None:
    """Blank a range."""
    span = _span(content, random)
    content[span] = bytes(len(content[span]))


def remove(content: bytearray, random: Random) -> None:
    """Lose a range."""
    del content[_span(content, random)]


def repeat(content: bytearray, random: Random) -> None:
    """Write a range twice, the second time somewhere."""
    at = int(random.integers(len(content)))
    content[at:at] = content[_span(content, random, 1 << 21)]


def swap(content: bytearray, random: Random) -> None:
    """Exchange two ranges."""
    first, second, third = sorted(int(at) for at in random.integers(len(content), size=3))
    content[first:] = content[second:third] + content[first:second] + content[third:]


WAYS: tuple[Callable[[bytearray, Random], None], ...] = (cut, flip, set_lengths, zero, remove, repeat, swap)


def corrupt(content: bytes, random: Random) -> tuple[str, bytes]:
    """A recording gone bad in one to three ways, and which."""
    bad, names = bytearray(content), list[str]()
    for _ in range(int(random.integers(1, MAX_AT_ONCE + 1))):
        way = WAYS[int(random.integers(len(WAYS)))]
        if bad:
            way(bad, random)
            names.append(way.__name__)
    return "+".join(names), bytes(bad)
