"""`nlos-cam`: arguments in, one call, an exit code out."""

import errno
import importlib
import json
import sys

import typer
from nlos_calibration.errors import CalibrationError
from nlos_models.errors import ModelError

from nlos_cam.cli.common import INTERRUPTED, interrupted_by_signals, stderr, stop_on_signals
from nlos_cam.errors import DiskFullError, NlosCamError

COMMANDS = {
    "devices": "devices",
    "doctor": "devices",
    "capture": "capture",
    "repair": "recordings",
    "export": "recordings",
    "calibrate": "calibrate",
    "board": "calibrate",
    "live": "live",
    "replay": "live",
    "view": "view",
    "render": "render",
    "tradeoff": "tradeoff",
    "dataset": "dataset",
    "train": "train",
    "evaluate": "evaluate",
}
"""Each command, and the file of this package that holds it, which adds its own through `register(app)`."""

DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO}
"""The disk's, not ours: full, over its quota, read-only, broken."""


def build_app(asked: str = "") -> typer.Typer:
    """The command tree: of the file that holds the command `asked` for, or, if there is none, of all of them.

    One command need not wait for what others import.
    """
    app = typer.Typer(
        name="nlos-cam",
        help="See around a corner with a consumer lidar.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        add_completion=False,
    )
    app.callback()(lambda: None)  # else typer leaves out the name of an only command
    for name in [COMMANDS[asked]] if asked in COMMANDS else dict.fromkeys(COMMANDS.values()):
        importlib.import_module(f"nlos_cam.cli.{name}").register(app)
    return app


def main(arguments: list[str]) -> int:
    """Run one command and return its exit code (see docs/reference: 0, 1, 2, 3, 4, 130)."""
    try:
        asked = next((argument for argument in arguments if not argument.startswith("-")), "")
        with interrupted_by_signals():
            with stop_on_signals() as stop:  # an interrupted import can end in any error of any library
                app = build_app(asked)
            return INTERRUPTED if stop.is_set() else app(arguments, standalone_mode=False) or 0
    except (typer.Abort, KeyboardInterrupt):
        return INTERRUPTED
    except typer.TyperException as error:
        stderr.print(error.format_message(), soft_wrap=True, markup=False)
        return error.exit_code
    except (NlosCamError, CalibrationError, ModelError) as error:
        return _told(error, as_json="--json" in arguments)
    except OSError as error:
        if error.errno not in DISK_ERRORS and error.filename is None:
            raise
        return _told(_of_a_file(error), as_json="--json" in arguments)


def _of_a_file(error: OSError) -> NlosCamError:
    """What the system said about a file, in a line."""
    if error.errno not in DISK_ERRORS:
        return NlosCamError(
            f"{error.filename}: {error.strerror}: look whether it is there, and who may read and write it"
        )
    what = f"{error.filename or 'a file'} cannot be written ({error.strerror}): free some space or choose another"
    return DiskFullError(f"{what} folder")


def _told(error: NlosCamError | CalibrationError | ModelError, *, as_json: bool) -> int:
    stderr.print(f"[bold red]error:[/] {_escaped(error)}", soft_wrap=True)
    if as_json:
        print(json.dumps({"error": {"type": type(error).__name__, "message": str(error)}}))  # noqa: T201
    return error.exit_code


def _escaped(error: Exception) -> str:
    return str(error).replace("[", "\\[").replace("\n", " ")


def run() -> None:
    """The console script."""
    raise SystemExit(main(sys.argv[1:]))
