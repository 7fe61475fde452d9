"""`nlos-cam`: arguments in, one call, an exit code out."""

import importlib
import json
import sys

import typer
from nlos_calibration.errors import CalibrationError
from nlos_models.errors import ModelError

from nlos_cam.cli.common import stderr
from nlos_cam.errors import NlosCamError

INTERRUPTED = 130
COMMAND_FILES = ("devices", "capture", "calibrate", "board", "live", "render", "tradeoff", "learn")
"""Files of this package that hold commands; each adds its own through `register(app)`."""


def build_app() -> typer.Typer:
    """The command tree, from the files that hold the commands."""
    app = typer.Typer(
        name="nlos-cam",
        help="See around a corner with a consumer lidar.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        add_completion=False,
    )
    for name in COMMAND_FILES:
        importlib.import_module(f"nlos_cam.cli.{name}").register(app)
    return app


def main(arguments: list[str]) -> int:
    """Run one command and return its exit code (see docs/reference: 0, 1, 2, 3, 4, 130)."""
    try:
        return build_app()(arguments, standalone_mode=False) or 0
    except (typer.Abort, KeyboardInterrupt):
        return INTERRUPTED
    except typer.TyperException as error:
        stderr.print(error.format_message(), soft_wrap=True, markup=False)
        return error.exit_code
    except (NlosCamError, CalibrationError, ModelError) as error:
        stderr.print(f"[bold red]error:[/] {_escaped(error)}", soft_wrap=True)
        if "--json" in arguments:
            print(json.dumps({"error": {"type": type(error).__name__, "message": str(error)}}))  # noqa: T201
        return error.exit_code


def _escaped(error: Exception) -> str:
    return str(error).replace("[", "\\[").replace("\n", " ")


def run() -> None:
    """The console script."""
    raise SystemExit(main(sys.argv[1:]))
