"""`nlos-cam doctor`: why a camera is not found, and exactly what to do."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from nlos_cam.cli.common import Json, Overwrite, finish, output_path, say, show
from nlos_cam.doctor import Check, diagnose, gather
from nlos_cam.doctor.udev import install, rules
from nlos_cam.errors import NlosCamError

COLOURS = {"ok": "green", "warning": "yellow", "failed": "bold red", "skipped": "dim"}
WriteUdev = Annotated[Path | None, typer.Option("--write-udev", help="Write the udev rules for the L515 to this file.")]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(doctor)


def doctor(write_udev: WriteUdev = None, overwrite: Overwrite = False, json: Json = False) -> None:
    """Check everything between a camera and this program, and say what to do; exit code 0 whatever is found."""
    if write_udev is not None:
        _write(output_path(write_udev, "", ".rules", overwrite=overwrite))
    checks = diagnose(gather())
    if not json:
        show(_table(checks))
    failures = sum(check.status == "failed" for check in checks)
    result = {"checks": [asdict(check) for check in checks], "ok": not failures}
    finish(result, as_json=json, text=_told(checks, failures), marked=True)


def _write(path: Path) -> None:
    try:
        path.write_text(rules(), encoding="utf-8")
    except OSError as error:
        raise NlosCamError(f"{path} cannot be written ({error.strerror}): write it here, then install it") from error
    say(f"wrote {path!s}; to put it in force, run, and plug the camera in again:\n  {install(str(path))}")


def _table(checks: Sequence[Check]) -> Table:
    table = Table("", "check", "what was seen", box=None, pad_edge=False)
    for check in checks:
        table.add_row(f"[{COLOURS[check.status]}]{check.status}[/]", check.name, escape(check.detail))
    return table


def _told(checks: Sequence[Check], failures: int) -> str:
    """The fixes, each on a line that can be copied, and the sum."""
    fixes = [f"[bold]{check.name}[/]: {escape(check.fix)}" for check in checks if check.fix]
    told = f"{failures} of {len(checks)} checks failed" if failures else "nothing failed"
    return "\n".join(["", *(["what to do, from the top:", *fixes, ""] if fixes else []), told])
