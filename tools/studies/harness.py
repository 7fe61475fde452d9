"""Harness of the studies: a grid of settings times seeds gives records, and from them tables, a
figure and a JSON.

A study names its settings and a function that measures one of them; `collect` runs the grid with a
progress bar and resumes where an interrupted run stopped. `write` and `save` put the results into
docs/, `table` prints Markdown.
"""

import hashlib
import json
import re
import sys
from argparse import ArgumentParser, ArgumentTypeError, RawDescriptionHelpFormatter
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from nlos_calibration.errors import CalibrationError
from nlos_models.errors import ModelError
from PIL import Image

from nlos_cam.cli.common import tracked
from nlos_cam.cli.main import main as nlos_cam
from nlos_cam.errors import NlosCamError
from nlos_cam.evaluate import format_interval
from nlos_cam.files import cache_folder

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "tools" / "robustness"))
from program_state import program_digest  # noqa: E402  a study's own folder is all that Python looks in

DOCS = ROOT / "docs"
DIGITS = 5
COLORS = 64
STUDIES = "tools/studies"
CLAIM = "results-of.json"
"""File that says what the results in a folder are of."""

Record = dict[str, Any]


def options(doc: str | None) -> ArgumentParser:
    """Return a parser whose help is a tool's docstring."""
    return ArgumentParser(description=doc, formatter_class=RawDescriptionHelpFormatter)


def run_command(*words: object) -> None:
    """Run a command of the program in this process. Raises NlosCamError where it fails."""
    arguments = [str(word) for word in words]
    if code := nlos_cam(arguments):
        raise NlosCamError(
            f"nlos-cam {' '.join(arguments)} ended with {code}: see above; run this again to go on"
        )


def collect(
    name: str,
    settings: Sequence[Any],
    measure: Callable[[Any, np.random.Generator], Mapping[str, Any]],
    seeds: int = 1,
    key: str = "",
) -> list[Record]:
    """Measure every setting (dataclass instances) with every seed; return one record each, settings
    outermost.

    Every record holds the setting's fields, `seed` and the measured values. Finished records are
    appended to a file in the cache until all are there; a second call of the same study, key and
    state of the code resumes from it.
    """
    store = cache_folder() / "studies" / f"{name}-{fingerprint(settings, seeds, key)}.jsonl"
    store.parent.mkdir(parents=True, exist_ok=True)
    done = [json.loads(line) for line in whole_lines(store)]
    grid = [(i, seed) for i in range(len(settings)) for seed in range(seeds)]
    with tracked(name) as on_progress, store.open("a", encoding="utf-8") as file:
        for i, seed in grid[len(done) :]:
            measured = measure(settings[i], np.random.default_rng([i, seed]))
            line = json.dumps(asdict(settings[i]) | {"seed": seed} | dict(measured))
            file.write(line + "\n")
            file.flush()
            done.append(json.loads(line))
            on_progress(len(done), len(grid))
    store.unlink()
    return done


def whole_lines(path: Path) -> list[str]:
    """Return the lines of a file of results, none where it is not there. A last line that a kill cut
    short is taken away, so that the next one does not go on in it.
    """
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    if lines and not lines[-1].endswith("\n"):
        lines.pop()
        path.write_text("".join(lines), encoding="utf-8")
    return lines


def fingerprint(settings: Sequence[Any], seeds: int, key: str = "") -> str:
    """Return a checksum of a grid, a key and the program."""
    grid = repr([program_digest(STUDIES), list(settings), seeds, key])
    return hashlib.sha256(grid.encode()).hexdigest()[:16]


def claim(work: Path, **of: object) -> None:
    """Tie a folder to this program and to what its results are of (names and values), so that a
    later call does not mix them with others. Ends the program where the folder is tied to others.
    """
    work.mkdir(parents=True, exist_ok=True)
    mark = work / CLAIM
    own = {"program": program_digest(STUDIES)} | {name: str(value) for name, value in of.items()}
    if not mark.exists():
        mark.write_text(json.dumps(own, indent=1) + "\n", encoding="utf-8")
        return
    found = json.loads(mark.read_text(encoding="utf-8"))
    if other := [name for name in {**found, **own} if found.get(name) != own.get(name)]:
        raise SystemExit(
            f"error: the results in {work} are of another {', '.join(other)}: name an empty folder,"
            f" or remove {mark} to go on with them all the same"
        )


def wilson(count: int, of: int) -> dict[str, Any]:
    """Return a share and its 95 % interval by Wilson's score."""
    z = 1.96
    share = count / of
    middle = (share + z * z / (2 * of)) / (1 + z * z / of)
    half = z / (1 + z * z / of) * np.sqrt(share * (1 - share) / of + z * z / (4 * of * of))
    return {
        "count": count,
        "of": of,
        "share": share,
        "low": max(0.0, middle - half),
        "high": min(1.0, middle + half),
    }


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in [head, ["---"] * len(head), *rows])


def difference(figure: Mapping[str, float | None]) -> str:
    """Format a difference with its interval, in bold where the interval excludes 0."""
    low = figure["low"]
    high = figure["high"]
    apart = low is not None and high is not None and not low <= 0 <= high
    return f"**{format_interval(figure)}**" if apart else format_interval(figure)


def write(name: str, facts: Any, folder: Path | None = None) -> None:
    """Write docs/figures/NAME.json, or the same in another folder, with DIGITS of each number."""
    path = (folder or DOCS) / "figures" / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(with_records_on_one_line(rounded(facts)), encoding="utf-8")


def with_records_on_one_line(facts: Any) -> str:
    """Return facts as indented JSON whose innermost lists and records take one line each."""
    text = json.dumps(facts, indent=1)
    return re.sub(r"[\[{][^\[\]{}]+[\]}]", _on_one_line, text) + "\n"


def _on_one_line(innermost: re.Match[str]) -> str:
    """Join the lines of a list or record that holds no other."""
    return re.sub(r"\n\s*", " ", innermost[0])


def rounded(facts: Any) -> Any:
    """Return facts whose fractions have DIGITS significant digits: no figure is known better."""
    if isinstance(facts, float) and not facts.is_integer() and abs(facts) < 10**DIGITS:
        return float(f"{facts:.{DIGITS}g}")
    if isinstance(facts, dict):
        return {name: rounded(value) for name, value in facts.items()}
    if isinstance(facts, list | tuple):
        return [rounded(value) for value in facts]
    return facts


def save(name: str, figure: Figure, folder: Path | None = None, dpi: int = 100) -> None:
    """Write docs/images/NAME.png, or the same in another folder, with a palette: a third of the
    bytes.
    """
    path = (folder or DOCS) / "images" / f"{name}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=dpi)
    with Image.open(path) as picture:
        small = picture.convert("RGB").quantize(COLORS, dither=Image.Dither.NONE)
    small.save(path, optimize=True)


def named(text: str) -> tuple[str, Path]:
    """Parse DIR or NAME=DIR, a folder of weights, as an argument's `type`."""
    name, equals, folder = text.partition("=")
    path = Path(folder if equals else text)
    if not (path / "checkpoint.json").is_file():
        raise ArgumentTypeError(f"no weights in {path}: name a folder that `nlos-cam train` wrote")
    return name if equals else path.resolve().name, path


def by_name(weights: Sequence[tuple[str, Path]]) -> dict[str, Path]:
    """Return folders by name. Ends the program where two have the same name."""
    names = [name for name, _ in weights]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise SystemExit(f"two weights are called {twice[0]!r}: give them names with NAME=DIR")
    return dict(weights)


def weights_key(folders: Mapping[str, Path]) -> str:
    """Return a checksum of weights by their names, which records bear, and by their contents."""
    digest = hashlib.sha256()
    for name, folder in folders.items():
        digest.update(f"{name}\n".encode())
        for path in sorted(folder.iterdir()):
            if path.is_file():
                digest.update(f"{path.name}\n".encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()


@contextmanager
def one_line_errors() -> Generator[None]:
    """End the program with one line on an error of the project's own kinds."""
    try:
        yield
    except (NlosCamError, CalibrationError, ModelError) as error:
        raise SystemExit(f"error: {error}") from error
