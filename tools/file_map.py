"""Keep the README's map of files: each file's line is the first of its docstring. `--check` only compares."""

import ast
import re
import sys
from pathlib import Path

from kept_page import keep

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
PARTS = {
    "nlos_cam": "the product",
    "calibration/nlos_calibration": "scene geometry",
    "models/nlos_models": "neural networks",
    "tools": "run from the repository, not installed",
}
MAP = re.compile(r"(?<=<!-- map -->\n).*(?=<!-- end of map -->)", re.DOTALL)


def lines_of(folder: str) -> list[str]:
    """One table row per file that says something of itself."""
    rows: list[str] = []
    for path in sorted((ROOT / folder).rglob("*.py")):
        told = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
        if told and path.name != "__init__.py":
            first = told.splitlines()[0].replace("|", "\\|")
            rows.append(f"| `{path.relative_to(ROOT / folder).as_posix()}` | {first} |")
    return rows


def drawn_map() -> str:
    """The map as Markdown."""
    parts = [
        "\n".join([f"| `{folder}/` | {what} |", "| --- | --- |", *lines_of(folder), ""])
        for folder, what in PARTS.items()
    ]
    return "\n".join(parts)


def main() -> int:
    """Write the map, or say that it is out of date."""
    return keep(README, MAP.sub(lambda _: drawn_map(), README.read_text(encoding="utf-8")))


if __name__ == "__main__":
    sys.exit(main())
