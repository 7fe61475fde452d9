"""How densely the code is written: the figures that decide how fast a page is read (`make check`).

    python tools/checks/density.py

Ceilings are on density, never on length: a packed page is slower to read than a longer one.
"""

import ast
import io
import sys
import tokenize
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path

ROOT = Path(__file__).parents[2]
PRODUCT = "nlos_cam", "calibration", "models"
NUMERIC = "nlos_cam/render", "models", "calibration"
"""Rooms where comments carry the physics and the learning."""
MAX_COLUMNS = 100
MAX_PACKED = 3.0
MAX_WIDE = 10.0
"""Per 1,000 lines, like MAX_PACKED."""
MAX_TOKENS_A_LINE = {"product": 6.0, "tests": 7.5}
COMMENTS = 5.0, 12.0
"""Lines of comment alone in 100 lines of a numeric room."""
MAX_UNFORMATTED = 5
MAX_TEST_NAME = 60
MAX_ASSERTS = 8
LAYOUT = {
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.COMMENT,
    tokenize.ENDMARKER,
}


@dataclass
class Density:
    """Counts over some files."""

    lines: int = 0
    tokens: int = 0
    wide: int = 0
    """Lines of more than MAX_COLUMNS."""
    packed: int = 0
    """Assignments of a tuple to a tuple; one value that is unpacked is none."""
    comments: int = 0
    """Lines that hold a comment alone."""
    unformatted: int = 0
    """Places that the formatter has to leave as they are."""

    def __add__(self, other: "Density") -> "Density":
        names = [field.name for field in fields(self)]
        return Density(*(getattr(self, name) + getattr(other, name) for name in names))

    @property
    def tokens_a_line(self) -> float:
        """Tokens that are not layout, in a line on average."""
        return self.tokens / max(self.lines, 1)

    def per_thousand(self, count: int) -> float:
        """Return a count in 1,000 lines."""
        return 1000 * count / max(self.lines, 1)


def density_of(text: str) -> Density:
    """Count one file's text."""
    rows = text.splitlines()
    found = Density(lines=len(rows), wide=sum(len(row) > MAX_COLUMNS for row in rows))
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        found.tokens += token.type not in LAYOUT
        if token.type == tokenize.COMMENT:
            found.comments += rows[token.start[0] - 1].lstrip().startswith("#")
            found.unformatted += "fmt: skip" in token.string or "fmt: off" in token.string
    found.packed = sum(is_packed(node) for node in ast.walk(ast.parse(text)))
    return found


def is_packed(node: ast.AST) -> bool:
    """Return True for an assignment of several values to several names."""
    return (
        isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Tuple)
        and isinstance(node.value, ast.Tuple)
    )


def files_of(*folders: str) -> Iterator[Path]:
    """Yield the source files below some folders."""
    for folder in folders:
        yield from sorted((ROOT / folder).rglob("*.py"))


def density(*folders: str) -> Density:
    """Count all files below some folders."""
    total = Density()
    for path in files_of(*folders):
        total += density_of(path.read_text(encoding="utf-8"))
    return total


def joined_tests(paths: Iterable[Path]) -> Iterator[str]:
    """Yield one line for every test with a long name or with many asserts."""
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.FunctionDef) or not node.name.startswith("test_"):
                continue
            place = f"{path.relative_to(ROOT)}:{node.lineno}"
            asserts = sum(isinstance(inner, ast.Assert) for inner in ast.walk(node))
            if len(node.name) > MAX_TEST_NAME:
                yield f"{place}: a name of {len(node.name)} characters, at most {MAX_TEST_NAME}"
            if asserts > MAX_ASSERTS:
                yield f"{place}: {asserts} asserts, at most {MAX_ASSERTS}: split the test"


def problems() -> Iterator[str]:
    """Yield one line for every figure out of its bounds."""
    for name, folders in {"product": PRODUCT, "tests": ("tests",)}.items():
        found = density(*folders)
        packed = found.per_thousand(found.packed)
        wide = found.per_thousand(found.wide)
        if packed > MAX_PACKED:
            yield f"{name}: {packed:.1f} packed assignments in 1,000 lines, at most {MAX_PACKED:g}"
        if wide > MAX_WIDE:
            yield f"{name}: {wide:.0f} wide lines in 1,000, at most {MAX_WIDE:g}"
        if found.tokens_a_line > MAX_TOKENS_A_LINE[name]:
            limit = MAX_TOKENS_A_LINE[name]
            yield f"{name}: {found.tokens_a_line:.2f} tokens a line, at most {limit:g}"

    unformatted = density(*PRODUCT, "tests", "tools", "examples").unformatted
    if unformatted > MAX_UNFORMATTED:
        yield f"{unformatted} places are kept from the formatter, at most {MAX_UNFORMATTED}"

    low, high = COMMENTS
    for room in NUMERIC:
        found = density(room)
        comments = found.per_thousand(found.comments) / 10
        if not low <= comments <= high:
            yield f"{room}: {comments:.1f} lines of comment in 100, {low:g} to {high:g} wanted"

    yield from joined_tests(files_of("tests"))


def main() -> int:
    """Print the figures and those out of bounds, and exit with 1 for any."""
    for name, folders in {"product": PRODUCT, "tests": ("tests",), "tools": ("tools",)}.items():
        found = density(*folders)
        print(
            f"{name}: {found.lines} lines, {found.tokens} tokens, {found.tokens_a_line:.1f} a line;"
            f" in 1,000 lines {found.per_thousand(found.packed):.1f} packed,"
            f" {found.per_thousand(found.wide):.1f} wide"
        )
    wrong = list(problems())
    print("\n".join(wrong))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
