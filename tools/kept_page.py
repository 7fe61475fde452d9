"""A page that is made from something else: written, or with `--check` only held against what it should be."""

import sys
from pathlib import Path


def keep(path: Path, current: str) -> int:
    """Write what a page should be, or say that it is out of date; the exit status."""
    if "--check" not in sys.argv:
        path.write_text(current, encoding="utf-8")
        return 0
    stale = not path.exists() or path.read_text(encoding="utf-8") != current
    if stale:
        print(f"{path.name} is out of date: run `python tools/{Path(sys.argv[0]).name}`")
    return int(stale)
