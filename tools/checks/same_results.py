"""Compare the results of two trees bit for bit: three scenes, a replay and an evaluation.

    python tools/checks/same_results.py REVISION_OR_FOLDER

The other tree is a folder, or a revision of this repository, which is checked out for the while.
Both run under this interpreter. Arrays must be equal to the last bit and figures to the last digit;
what belongs to the machine or the run (seconds, dates, paths, versions) is left out. It is for
changes that are not meant to change a result, such as a new layout of the code.
"""

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[2]
PACKAGES = ("", "calibration", "models")
PROGRAM = "from nlos_cam.cli import run; run()"
COMMANDS: dict[str, tuple[str, ...]] = {
    "render-cup": ("render", "cup", "--seed", "4", "--accuracy", "standard"),
    "render-retroreflective": (
        "render",
        "lamp",
        "--material",
        "retroreflective",
        "--specular",
        "0.5",
        "--exponent",
        "20",
    ),
    "render-lambertian": (
        "render",
        "bowl",
        "--radiometry",
        "lambertian",
        "--pulse-ns",
        "1",
        "--accuracy",
        "fine",
    ),
    "replay": ("replay", "sample"),
    "evaluate": ("evaluate", "--no-nearest"),
}
OF_THE_RUN = (
    "seconds",
    "_s",
    "_ms",
    "time",
    "date",
    "version",
    "path",
    "machine",
    "command",
    "program",
)


@contextmanager
def tree_of(other: str) -> Iterator[Path]:
    """Yield the folder of the other tree; a revision is checked out and taken away again."""
    if Path(other).is_dir():
        yield Path(other).resolve()
        return

    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--detach", "--quiet", str(tree), other], check=True)
        try:
            yield tree
        finally:
            subprocess.run([*git, "remove", "--force", str(tree)], check=True)


def run_in(tree: Path, arguments: tuple[str, ...], out: Path) -> None:
    """Run one command of the tree's own program, results in `out`."""
    imports = os.pathsep.join(str(tree / package) for package in PACKAGES)
    subprocess.run(
        [sys.executable, "-P", "-c", PROGRAM, *arguments, "--quiet", "--out", str(out)],
        env={**os.environ, "PYTHONPATH": imports},
        cwd=tree,
        check=True,
    )


def flatten(value: Any, name: str = "") -> Iterator[tuple[str, object]]:
    """Yield every figure of a JSON value with its name, but for those of the run."""
    if isinstance(value, dict):
        for key, inner in value.items():
            if not any(key == word or key.endswith(word) for word in OF_THE_RUN):
                yield from flatten(inner, f"{name}/{key}")
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from flatten(inner, f"{name}/{index}")
    else:
        yield name, value


def figures(out: Path) -> dict[str, object]:
    """Return everything that a command wrote and that must not change, by name."""
    files = [out] if out.is_file() else sorted(out.iterdir())
    found: dict[str, object] = {}
    for path in files:
        if path.suffix == ".npz":
            with np.load(path) as arrays:
                found |= {f"{path.name}/{key}": arrays[key] for key in arrays.files}
        elif path.suffix == ".json":
            found |= dict(flatten(json.loads(path.read_text(encoding="utf-8")), path.name))
        elif path.suffix == ".csv":
            rows = list(csv.DictReader(path.open(encoding="utf-8")))
            found |= dict(flatten(rows, path.name))
    return found


def same(one: object, other: object) -> bool:
    """Say whether two values hold the same bits (NaN equals NaN)."""
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
    return repr(one) == repr(other)


def differences(here: dict[str, object], there: dict[str, object]) -> list[str]:
    """Return the names that only one tree has or whose values differ."""
    missing = sorted(here.keys() ^ there.keys())
    unequal = [name for name in here if name in there and not same(here[name], there[name])]
    return missing + unequal


def main() -> int:
    """Run every command in both trees, say what differs, and exit with 1 if anything does."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("other", help="folder of the other tree, or a revision")
    other = parser.parse_args().other

    unequal = 0
    with tree_of(other) as tree, tempfile.TemporaryDirectory() as folder:
        for name, arguments in COMMANDS.items():
            results: list[dict[str, object]] = []
            for place, where in (("here", ROOT), ("there", tree)):
                suffix = ".npz" if arguments[0] == "render" else ""
                out = Path(folder) / place / f"{name}{suffix}"
                out.parent.mkdir(exist_ok=True)
                run_in(where, arguments, out)
                results.append(figures(out))
            here, there = results
            unlike = differences(here, there)
            if not here:
                raise SystemExit(f"{name}: nothing was written that could be compared")
            unequal += len(unlike)
            verdict = f"{len(unlike)} differ: {', '.join(unlike[:8])}" if unlike else "all equal"
            print(f"{name}: {len(here)} arrays and figures, {verdict}", flush=True)
    return 1 if unequal else 0


if __name__ == "__main__":
    sys.exit(main())
