"""Description of one file or folder."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class Description:
    """Content of a file or folder in a few facts. A reader of a damaged one gives the facts that it could read."""

    kind: str
    facts: Mapping[str, str] = field(default_factory=dict[str, str])
    """Name and value with unit, in the order to print them."""
    created: str = ""
    """As the content says it; empty where it does not."""
    made_by: str = ""
    """Program, version and command, as far as the content says them."""
    problem: str = ""
    """Reason why it is not whole, with the remedy; empty where it is."""
    checked: str = ""
    """Extent of the check."""
    next: Sequence[str] = ()
    """Command lines to go on with."""
    bytes: int = 0
    """Size of the file, or of all files in the folder."""


def size_of(path: Path) -> int:
    """Return the bytes of a file, or of all files in a folder."""
    files = [path] if path.is_file() else [each for each in path.rglob("*") if each.is_file()]
    return sum(file.stat().st_size for file in files)


def count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
