"""Write docs/commands.md, every command with all of its options, from the program itself. `--check` only compares."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_origin

import typer
from kept_page import keep

from nlos_cam.cli.main import build_app

PAGE = Path(__file__).parents[1] / "docs" / "commands.md"
HEAD = """# Every command and option

Written by `python tools/commands.py` from the program itself, and held against it by a test. What the commands are for,
what they answer with `--json`, exit codes and files: [commands and files](reference.md).
"""
EVERYWHERE = {"--json": "ends stdout with one JSON object", "--overwrite": "replaces what `--out` names, if it exists"}
"""Options that mean the same wherever they are."""
KINDS = {str: "text", Path: "path", int: "whole number", float: "number", bool: "switch"}


def commands(command: Any, name: str = "nlos-cam") -> Iterator[tuple[str, Any]]:
    """Every command that does something, and what it is called by."""
    if not (below := getattr(command, "commands", {})):
        yield name, command
    for word, each in below.items():
        yield from commands(each, f"{name} {word}")


def kind_of(parameter: Any) -> str:
    """What a parameter takes, in words."""
    annotation = parameter.type_descriptor.annotation
    annotation = get_args(annotation)[0] if get_origin(annotation) is list else annotation
    choices = get_args(annotation)
    told = " or ".join(f"`{choice}`" for choice in choices) if choices else KINDS[annotation]
    if parameter.min is not None:
        told += f", at least {parameter.min:.6g}"
    if parameter.max is not None:
        told += f", at most {parameter.max:.6g}"
    return told + (", more than once" if parameter.multiple else "")


def default_of(parameter: Any) -> str:
    """What holds where a parameter is left out."""
    if parameter.required:
        return "**must be given**"
    shown = parameter.show_default if isinstance(parameter.show_default, str) else parameter.default
    return "" if shown in {None, False, ""} else f"`{shown}`"


def row(parameter: Any) -> str:
    """A line of a command's table."""
    is_argument = not parameter.opts[0].startswith("-")
    name = parameter.metavar or parameter.name.upper() if is_argument else ", ".join(parameter.opts)
    told = (parameter.help or "").replace("|", "\\|")
    return f"| `{name}` | {kind_of(parameter)} | {default_of(parameter)} | {told} |"


def section(name: str, command: Any) -> str:
    """A command: what it does, and its options."""
    shared = [option for parameter in command.params for option in parameter.opts if option in EVERYWHERE]
    rows = [row(parameter) for parameter in command.params if not set(parameter.opts) & EVERYWHERE.keys()]
    table = ["| option | takes | default | |", "| --- | --- | --- | --- |", *rows] if rows else []
    also = f"Also: {', '.join(f'`{option}` ({EVERYWHERE[option]})' for option in sorted(shared))}." if shared else ""
    parts = f"## {name}", " ".join(command.help.split()), "\n".join(table), also
    return "\n\n".join(part for part in parts if part)


def page() -> str:
    """The page as it should be."""
    app = typer.main.get_command(build_app())
    return "\n\n".join([HEAD.rstrip(), *(section(name, command) for name, command in commands(app))]) + "\n"


def main() -> int:
    """Write the page, or say that it is out of date."""
    return keep(PAGE, page())


if __name__ == "__main__":
    sys.exit(main())
