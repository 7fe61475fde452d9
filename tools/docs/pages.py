"""Generated parts of the docs: every command and option, our row of the comparison, and the
gallery's tables.

`python tools/docs/pages.py [reference] [comparison] [gallery] [--check]`: all without names;
`--check` only compares. Run it after `nlos-cam evaluate`, `nlos-cam tradeoff reconstruct` and
tools/studies/weights.py limits.
"""

import argparse
import json
import re
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, get_args, get_origin

import typer

from nlos_cam.camera import FRAMES_PER_S
from nlos_cam.cli.main import build_app
from nlos_cam.evaluate import TARGETS, format_interval

DOCS = Path(__file__).parents[2] / "docs"
HEAD = Path(__file__).parent / "reference_head.md"
ANSWERS = Path(__file__).parent / "answers.toml"
"""Fields of each command's JSON object, by command."""
EVERYWHERE = {
    "--json": "ends stdout with one JSON object",
    "--overwrite": "replaces the output, if it exists",
    "--quiet": "no messages and no progress, only results and errors",
    "--verbose": "details too, such as the time of each stage",
}
"""Options that mean the same wherever they are."""
KINDS = {str: "text", Path: "path", int: "whole number", float: "number", bool: "switch"}


def commands(command: Any, name: str = "nlos-cam") -> Iterator[tuple[str, Any]]:
    """Yield every leaf command with its full name."""
    if not (below := getattr(command, "commands", {})):
        yield name, command
    for word, each in below.items():
        yield from commands(each, f"{name} {word}")


def kind_of(parameter: Any) -> str:
    """Describe the values of a parameter."""
    annotation = parameter.type_descriptor.annotation
    annotation = get_args(annotation)[0] if get_origin(annotation) is list else annotation
    choices = get_args(annotation)
    kind = " or ".join(f"`{choice}`" for choice in choices) if choices else KINDS[annotation]
    if parameter.min is not None:
        kind += f", at least {parameter.min:.6g}"
    if parameter.max is not None:
        kind += f", at most {parameter.max:.6g}"
    return kind + (", more than once" if parameter.multiple else "")


def default_of(parameter: Any) -> str:
    """Describe the default of a parameter."""
    if parameter.required:
        return "**must be given**"
    shown = parameter.show_default if isinstance(parameter.show_default, str) else parameter.default
    # not `in`: 0 equals False, and is a default to be shown
    return "" if shown is None or shown is False or shown == "" else f"`{shown}`"


def option_row(parameter: Any) -> str:
    """Return a line of a command's table."""
    is_argument = not parameter.opts[0].startswith("-")
    # the second name of a pair, as --upside-down of --upright
    options = [*parameter.opts, *parameter.secondary_opts]
    name = parameter.metavar or parameter.name.upper() if is_argument else ", ".join(options)
    text = (parameter.help or "").replace("|", "\\|")
    return f"| `{name}` | {kind_of(parameter)} | {default_of(parameter)} | {text} |"


def section(name: str, command: Any, answer: str) -> str:
    """Return a command's purpose, its answer and its options."""
    shared = [
        option for parameter in command.params for option in parameter.opts if option in EVERYWHERE
    ]
    rows = [
        option_row(parameter)
        for parameter in command.params
        if not set(parameter.opts) & EVERYWHERE.keys()
    ]
    table = ["| option | takes | default | |", "| --- | --- | --- | --- |", *rows] if rows else []
    also = (
        f"Also: {', '.join(f'`{option}` ({EVERYWHERE[option]})' for option in sorted(shared))}."
        if shared
        else ""
    )
    answers = f"Answers: {answer}."
    parts = f"## {name}", " ".join(command.help.split()), answers, "\n".join(table), also
    return "\n\n".join(part for part in parts if part)


def reference_page() -> str:
    """Return docs/reference.md."""
    app = typer.main.get_command(build_app())
    answers = tomllib.loads(ANSWERS.read_text(encoding="utf-8"))
    sections = [
        section(name, command, answers[name.removeprefix("nlos-cam ")])
        for name, command in commands(app)
    ]
    return "\n\n".join([HEAD.read_text(encoding="utf-8").rstrip(), *sections]) + "\n"


def comparison_row(figures: Mapping[str, Any], cost: Mapping[str, Any]) -> str:
    """Return our measured row of Table S3, with the figures behind it."""
    pick = next(one for one in cost["settings"] if cost["recommended"].items() <= one.items())
    metrics = "; ".join(f"{name} {format_interval(figures[name])}" for name in TARGETS)
    cells = (
        "nlos-cam, measured",
        "simulated consumer lidar (L515): depth and intensity maps",
        f"{1000 / FRAMES_PER_S:.0f} ms (one frame)",
        f"{pick['milliseconds']:.0f} ms ({pick['name']}; {cost['machine']})",
        "depth map 64 x 64 of one object",
    )
    head = (
        "| system | light and detector | collection | computation | what comes out |\n"
        + "| --- " * 5
        + "|"
    )
    behind = f"On {figures['objects']} objects never trained on, mean and 95 % interval: {metrics}."
    return f"{head}\n| {' | '.join(cells)} |\n\n{behind}\n"


def by_kind(figures: Mapping[str, Any]) -> str:
    """Return the table of figures for every kind of object, the worst first."""
    kinds: dict[str, Any] = figures["per_category"]
    worst_first = sorted(kinds, key=lambda kind: kinds[kind]["silhouette_iou"]["value"])
    cells = {
        kind: " | ".join(format_interval(kinds[kind][name]) for name in TARGETS)
        for kind in worst_first
    }
    rows = [f"| {kind} | {values} |" for kind, values in cells.items()]
    targets = f"| **target** | {' | '.join(f'{bar:g}' for bar in TARGETS.values())} |"
    mean = f"| **all 54** | {' | '.join(format_interval(figures[name]) for name in TARGETS)} |"
    head = f"| kind | {' | '.join(TARGETS)} |", "| --- " * (1 + len(TARGETS)) + "|"
    return "\n".join([*head, *rows, mean, targets]) + "\n"


def by_limit(limits: Mapping[str, Any]) -> str:
    """Return the table of figures with one possible limit removed at a time."""
    names = "silhouette_iou", "foreground_rmse_mm"
    rows = [
        f"| {row['name']} | {row['tells']} |"
        f" {' | '.join(format_interval(row['figures'][name]) for name in names)} |"
        for row in limits["rows"]
    ]
    return "\n".join([f"| what | how | {' | '.join(names)} |", "| --- " * 4 + "|", *rows]) + "\n"


def filled(text: str, tables: Mapping[str, str]) -> str:
    """Return a page with its tables, each between `<!-- name -->` and the next `<!-- end`. Raises
    ValueError where a table has no place.
    """
    for name, table in tables.items():
        place = re.compile(rf"(?<=<!-- {name} -->\n).*?(?=<!-- end)", re.DOTALL)
        # once: an empty place would match twice
        text, places = place.subn(lambda _, new=table: new, text, count=1)
        if not places:
            raise ValueError(f"the page has no place <!-- {name} --> for its table: put one back")
    return text


def read(name: str) -> Any:
    """Return the figures of a JSON in docs/figures."""
    return json.loads((DOCS / "figures" / f"{name}.json").read_text(encoding="utf-8"))


def comparison_page() -> str:
    """Return docs/comparison.md with our row."""
    text = (DOCS / "comparison.md").read_text(encoding="utf-8")
    return filled(text, {"measured": comparison_row(read("figures"), read("tradeoff_reconstruct"))})


def gallery_page() -> str:
    """Return docs/gallery.md with its tables."""
    tables = {"by kind": by_kind(read("figures")), "by limit": by_limit(read("limits"))}
    return filled((DOCS / "gallery.md").read_text(encoding="utf-8"), tables)


PAGES: dict[str, Callable[[], str]]
PAGES = {"reference": reference_page, "comparison": comparison_page, "gallery": gallery_page}


def main() -> int:
    """Write the pages, or with `--check` name those that are out of date and return 1."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "names", nargs="*", metavar="PAGE", help=f"some of {', '.join(PAGES)} (default: all)"
    )
    parser.add_argument("--check", action="store_true", help="compare only")
    asked = parser.parse_args()
    stale = list[str]()
    for name in asked.names or PAGES:
        path = DOCS / f"{name}.md"
        current = PAGES[name]()
        if not path.exists() or path.read_text(encoding="utf-8") != current:
            stale.append(name)
            if not asked.check:
                path.write_text(current, encoding="utf-8")
    if asked.check and stale:
        print(f"out of date: run `python tools/docs/pages.py {' '.join(stale)}`")
    return int(asked.check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
