"""The command `nlos-cam`: arguments in, one call, an exit code out."""

import errno
import importlib
import json
import sys
from importlib.metadata import version
from typing import Annotated, NamedTuple

import typer
from nlos_calibration.errors import CalibrationError
from nlos_models.errors import ModelError
from typer.main import get_command

from nlos_cam.cli.common import INTERRUPTED, interrupted_by_signals, stderr, stop_on_signals
from nlos_cam.cli.plain_help import plain_help
from nlos_cam.errors import DiskFullError, NlosCamError


class Command(NamedTuple):
    """Row of the help page: the module of this package that registers the command, its group and its summary."""

    module: str
    group: str
    summary: str


START, BENCH, RECORDINGS, SIMULATION = "Start here", "Bench", "Recordings", "Simulation and training"
COMMANDS = {
    "live": Command("live", START, "Reconstruct a camera's frames live and show them in a browser."),
    "doctor": Command("devices", START, "Explain why a camera is not found, and how to fix it."),
    "devices": Command("devices", START, "List cameras, real and simulated."),
    "calibrate": Command("calibrate", BENCH, "Measure a bare wall, a printed board or the occluder."),
    "board": Command("calibrate", BENCH, "Write the calibration board as a PDF to print."),
    "capture": Command("capture", RECORDINGS, "Record a camera to a .bag file and check the recording."),
    "replay": Command("live", RECORDINGS, "Reconstruct every frame of a recording, and write results and pictures."),
    "view": Command("view", RECORDINGS, "Open a saved view in a browser."),
    "export": Command("recordings", RECORDINGS, "Export a recording as images, timestamps and point clouds."),
    "repair": Command("recordings", RECORDINGS, "Recover the whole frames of a cut or damaged recording."),
    "render": Command("render", SIMULATION, "Render the lidar's report of a hidden object."),
    "dataset": Command("dataset", SIMULATION, "Build training data, or label recordings."),
    "train": Command("train", SIMULATION, "Train networks from a recipe."),
    "evaluate": Command("evaluate", SIMULATION, "Measure weights on held-out objects, beside trivial baselines."),
    "tradeoff": Command("tradeoff", SIMULATION, "Measure accuracy against time, of rendering or reconstruction."),
}
"""Every command in the order of the help page."""

SETTINGS = {"help_option_names": ["-h", "--help"]}
DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO}
"""Errors of the disk, not of the program: full, over its quota, read-only, broken."""


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"nlos-cam {version('nlos-cam')}")  # noqa: T201  the answer
        raise typer.Exit


def _root(
    *,
    version: Annotated[
        bool, typer.Option("--version", "-V", help="Print the version.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """See around a corner with a consumer lidar."""


def build_app(command: str | None = None) -> typer.Typer:
    """Return the command tree: with one command, with all, or (for any other word) with the summaries of all.

    Only the modules of its commands are imported, so that one command does not wait for the imports of others, and the
    help page waits for none.
    """
    app = _empty_app()
    if command is None or command in COMMANDS:
        rows = COMMANDS.values() if command is None else [COMMANDS[command]]
        for module in dict.fromkeys(row.module for row in rows):
            importlib.import_module(f"nlos_cam.cli.{module}").register(app)
        return app
    for name, row in COMMANDS.items():
        app.command(name, help=row.summary, rich_help_panel=row.group)(lambda: None)
    return app


def _empty_app() -> typer.Typer:
    app = typer.Typer(name="nlos-cam", context_settings=SETTINGS, pretty_exceptions_enable=False, add_completion=False)
    app.callback()(_root)
    return app


def main(arguments: list[str]) -> int:
    """Run one command and return its exit code (see docs/reference.md: 0, 1, 2, 3, 4, 130)."""
    command = next((argument for argument in arguments if not argument.startswith("-")), "")
    try:
        with interrupted_by_signals():
            with stop_on_signals() as stop:  # an interrupted import can end in any error of any library
                app = build_app(command)
                tree = get_command(app)
                plain_help(tree)
            return INTERRUPTED if stop.is_set() else tree(arguments or ["--help"], standalone_mode=False) or 0
    except (typer.Abort, KeyboardInterrupt):
        return INTERRUPTED
    except typer.TyperException as error:
        stderr.print(error.format_message(), soft_wrap=True, markup=False)
        return error.exit_code
    except (NlosCamError, CalibrationError, ModelError) as error:
        return _report(error, as_json="--json" in arguments)
    except OSError as error:
        if error.errno not in DISK_ERRORS and error.filename is None:
            raise
        return _report(_file_error(error), as_json="--json" in arguments)


def _file_error(error: OSError) -> NlosCamError:
    """Return the system's error about a file as one of ours."""
    if error.errno not in DISK_ERRORS:
        return NlosCamError(
            f"{error.filename}: {error.strerror}: check that the file exists and that you have permission"
        )
    name = error.filename or "the output"
    return DiskFullError(f"{name} cannot be written ({error.strerror}): free some space or choose another folder")


def _report(error: NlosCamError | CalibrationError | ModelError, *, as_json: bool) -> int:
    text = str(error).replace("[", "\\[").replace("\n", " ")
    stderr.print(f"[bold red]error:[/] {text}", soft_wrap=True)
    if as_json:
        print(json.dumps({"error": {"type": type(error).__name__, "message": str(error)}}))  # noqa: T201
    return error.exit_code


def run() -> None:
    """Run the console script."""
    raise SystemExit(main(sys.argv[1:]))
