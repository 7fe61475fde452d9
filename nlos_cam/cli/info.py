"""The command `info`: kind, origin, content and damage of a file or folder, and the commands to go
on with.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from nlos_cam import info as inspect
from nlos_cam.cli.common import Json, Overwrite, finish, interrupted_by_signals, output_path
from nlos_cam.errors import RecordingError

UNITS = (1e9, "GB"), (1e6, "MB"), (1e3, "kB")


def info(
    path: Annotated[
        Path | None,
        typer.Argument(
            metavar="FILE",
            help="File or folder that nlos-cam wrote or reads.",
            show_default="the program itself",
        ),
    ] = None,
    verify: Annotated[
        bool, typer.Option("--verify", help="Read all of it, not its index or heads alone.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Of a transient (.hdf5): write a slice and its back-projection, .html or .png.",
        ),
    ] = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Describe a file or folder: kind, origin, content, whether it is whole, next commands; without
    one the program: version, commit, rendering version, weights.
    """
    if out is not None and out.suffix not in {".html", ".png"}:
        raise typer.BadParameter(f"--out {out}: choose a name that ends in .html or .png")
    if path is None:
        if verify or out is not None:
            option = "--verify" if verify else "--out"
            raise typer.BadParameter(f"{option} is about a file: name it, or drop {option}")
        facts = inspect.describe_program()
        finish({**facts}, as_json=json, text=_format_program(facts))
        return
    text_of_picture = ""
    with interrupted_by_signals():
        found = inspect.describe(path, verify=verify)
        if out is not None and not found.problem:
            picture = output_path(out, "", out.suffix, overwrite=overwrite)
            inspect.write_picture(path, found, picture)
            text_of_picture = f"\nWrote {picture}"
    result = {"path": str(path), "whole": not found.problem, **asdict(found)}
    finish(result, as_json=json, text=_format(path, found) + text_of_picture)
    if found.problem:
        raise typer.Exit(RecordingError.exit_code)


def _format_program(facts: inspect.ProgramFacts) -> str:
    weights = {f"weights {name}": checksum for name, checksum in facts["weights"].items()}
    rows = {
        "commit": facts["commit"] or "not known",
        "rendering version": str(facts["rendering_version"]),
        **weights,
        "python": facts["python"],
    }
    width = max(map(len, rows))
    return "\n".join(
        [facts["program"], *(f"  {name:{width}}  {row}" for name, row in rows.items())]
    )


def _format(path: Path, found: inspect.Description) -> str:
    facts = {"created": found.created, "made by": found.made_by, **found.facts}
    whole = f"no: {found.problem}" if found.problem else "yes"
    facts["whole"] = f"{whole} (checked: {found.checked})" if found.checked else whole
    width = max(map(len, facts))
    lines = [f"{path}: {found.kind}, {_format_size(found.bytes)}"]
    lines += [f"  {name:{width}}  {value}" for name, value in facts.items() if value]
    if found.next:
        lines += ["Next:", *(f"  {line}" for line in found.next)]
    return "\n".join(lines)


def _format_size(size: int) -> str:
    unit, name = next(((unit, name) for unit, name in UNITS if size >= unit), (1, "bytes"))
    return f"{size / unit:.3g} {name}"
