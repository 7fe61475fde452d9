"""Check that docstrings and docs use the field's words: rates of five prose patterns per package.

The texts below fields and constants count as docstrings.

Prints one line per package and exits with 1 where a rate is above its limit, naming the lines to
rewrite. Options set the limits: `--begin` in percent of docstrings, the others per 1,000 words.
"""

import argparse
import ast
import re
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = {
    "nlos_cam": "nlos_cam",
    "nlos_calibration": "calibration/nlos_calibration",
    "nlos_models": "models/nlos_models",
    "tools": "tools",
    "examples": "examples",
}
PAGES = "README.md", "CHANGELOG.md", "docs/*.md", "models/cards/*.md"
PATTERNS = {
    "what": r"\bwhat\s+(is|was|it|the)\b",
    "tell": r"\b(tells?|told)\b",
    "so": r"\bso\s+(many|long|much)\b",
    "rare": r"\b(anew|whoever|meanwhile|nobody|lacks)\b",
}
LIMITS = {"begin": 1.0, "what": 1.0, "tell": 0.2, "so": 0.2, "rare": 0.2, "names": 0.0}
OPENING = re.compile(r"(What|How|Where|Which|Whether)\b")
NAME = re.compile(r"(MOST|LEAST|SOME)_")
FENCE = re.compile(r"```.*?```|`[^`\n]*`", re.DOTALL)
SHOWN = 8

Text = tuple[str, int, str]
"""File, number of its first line, and text."""


def of_fields(body: list[ast.stmt]) -> Iterator[tuple[int, str]]:
    """Yield first line and text of the docs that follow the fields or constants of a body."""
    for before, after in pairwise(body):
        follows = isinstance(before, ast.Assign | ast.AnnAssign) and isinstance(after, ast.Expr)
        text = after.value.value if follows and isinstance(after.value, ast.Constant) else None
        if isinstance(text, str):
            yield after.lineno, text


def scan(folder: Path) -> tuple[list[Text], list[str]]:
    """Return the docstrings below a folder, and the lines that define a MOST_, LEAST_ or SOME_
    name.
    """
    docs = list[Text]()
    names = list[str]()
    for path in sorted(folder.rglob("*.py")):
        file = str(path.relative_to(ROOT))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                if doc := ast.get_docstring(node, clean=False):
                    docs.append((file, node.body[0].lineno, doc))
                docs += [(file, line, text) for line, text in of_fields(node.body)]
            elif (
                isinstance(node, ast.Name)
                and isinstance(node.ctx, ast.Store)
                and NAME.match(node.id)
            ):
                names.append(f"{file}:{node.lineno}: {node.id}")
    return docs, names


def matches(pattern: str, texts: list[Text]) -> Iterator[str]:
    """Yield "file:line: words around" for every match of a pattern."""
    for file, first, text in texts:
        for found in re.finditer(pattern, text, re.IGNORECASE):
            line = first + text.count("\n", 0, found.start())
            around = text[max(found.start() - 30, 0) : found.end() + 30]
            yield f"{file}:{line}: {' '.join(around.split())}"


def findings(
    texts: list[Text], names: list[str], *, docstrings: bool
) -> dict[str, tuple[float, list[str]]]:
    """Return rate and lines of each pattern; `begin` and `names` only of code."""
    words = max(1, sum(len(text.split()) for *_, text in texts))
    found = {key: list(matches(pattern, texts)) for key, pattern in PATTERNS.items()}
    rates = {key: (1000 * len(lines) / words, lines) for key, lines in found.items()}
    if not docstrings:
        return rates
    begin = [f"{file}:{line}: {text[:60]}" for file, line, text in texts if OPENING.match(text)]
    return {
        "begin": (100 * len(begin) / max(1, len(texts)), begin),
        **rates,
        "names": (float(len(names)), names),
    }


def pages() -> list[Text]:
    """Return the Markdown pages without their code."""
    texts = list[Text]()
    for pattern in PAGES:
        for path in sorted(ROOT.glob(pattern)):
            # lines of code become empty ones, so that line numbers stay
            prose = FENCE.sub(lambda code: "\n" * code[0].count("\n"), path.read_text("utf-8"))
            texts.append((str(path.relative_to(ROOT)), 1, prose))
    return texts


def main() -> int:
    """Print the rates of every package; return 1 where one is above its limit."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for key, limit in LIMITS.items():
        parser.add_argument(
            f"--{key}",
            type=float,
            default=limit,
            help="highest rate allowed (default: %(default)s)",
        )
    limits = vars(parser.parse_args())
    every = {
        name: findings(*scan(ROOT / folder), docstrings=True) for name, folder in PACKAGES.items()
    }
    every["docs"] = findings(pages(), [], docstrings=False)

    failed = False
    for name, found in every.items():
        print(f"{name:17}" + "  ".join(f"{key} {rate:.1f}" for key, (rate, _) in found.items()))
        for key, (rate, lines) in found.items():
            if rate > limits[key]:
                failed = True
                print(f"  {key}: {rate:.1f} is above {limits[key]:g}", *lines[:SHOWN], sep="\n    ")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
