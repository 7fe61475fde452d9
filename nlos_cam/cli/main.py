"""The command `nlos-cam`: arguments in, one call, an exit code out."""

import importlib
import json
import os
import re
import sys
from contextlib import suppress
from io import TextIOWrapper
from itertools import dropwhile
from typing import Annotated, NamedTuple

import typer
from nlos_calibration.errors import CalibrationError
from nlos_models.errors import ModelError, lacks_memory, missing_extra
from typer.main import get_command

from nlos_cam.cli import common
from nlos_cam.cli.config import shared_options
from nlos_cam.cli.plain_help import plain_help
from nlos_cam.cli.usage import usage_lines, usage_reason
from nlos_cam.errors import DiskFullError, NlosCamError, RecordingError
from nlos_cam.files import DISK_ERRORS

MIN_ADDRESS_BYTES = 1 << 30
TORCH_ADDRESS_BYTES = 3 << 29
"""Least limit of address space, also of `train`: below it, the libraries of OpenCV or torch may end
the process by a signal while they are loaded."""


class Command(NamedTuple):
    """Row of the help page: the module of this package with the command's function, its group and
    its summary.
    """

    module: str
    group: str
    summary: str


START = "Start here"
BENCH = "Bench"
RECORDINGS = "Recordings"
SIMULATION = "Simulation and training"
COMMANDS = {
    "demo": Command("live", START, "Show the live view of a simulated bench; no camera is needed."),
    "live": Command(
        "live", START, "Reconstruct a camera's frames live and show them in a browser."
    ),
    "doctor": Command("devices", START, "Explain why a camera is not found, and how to fix it."),
    "devices": Command("devices", START, "List cameras, real and simulated."),
    "config": Command("config", START, "Show the settings of nlos-cam.toml and the environment."),
    "predict": Command("predict", BENCH, "Forecast what a bench can see, and what to change."),
    "calibrate": Command(
        "calibrate", BENCH, "Measure a bare wall, a printed board or the occluder."
    ),
    "adapt": Command("adapt", BENCH, "Make weights for one bench, from its calibration."),
    "detect": Command(
        "detect", BENCH, "Test whether a hidden object changes anything: in and out, in turns."
    ),
    "board": Command("calibrate", BENCH, "Write the calibration board as a PDF to print."),
    "capture": Command(
        "capture", RECORDINGS, "Record a camera to a .bag file and check the recording."
    ),
    "replay": Command(
        "live",
        RECORDINGS,
        "Reconstruct every frame of a recording, and write results and pictures.",
    ),
    "info": Command(
        "info", RECORDINGS, "Describe a file or folder: kind, origin, content, whether it is whole."
    ),
    "view": Command("view", RECORDINGS, "Open a saved view in a browser."),
    "export": Command(
        "recordings", RECORDINGS, "Export a recording as images, timestamps and point clouds."
    ),
    "repair": Command(
        "recordings", RECORDINGS, "Recover the whole frames of a cut or damaged recording."
    ),
    "render": Command("render", SIMULATION, "Render the lidar's report of a hidden object."),
    "scenes": Command("lists", SIMULATION, "List the packaged scenes: simulated benches."),
    "objects": Command("lists", SIMULATION, "List the kinds of hidden objects."),
    "rigs": Command("lists", SIMULATION, "List the packaged rigs."),
    "recipes": Command("lists", SIMULATION, "List the packaged training recipes."),
    "dataset": Command("dataset", SIMULATION, "Build training data, or label recordings."),
    "train": Command("train", SIMULATION, "Train networks from a recipe."),
    "evaluate": Command(
        "evaluate", SIMULATION, "Measure weights on held-out objects, beside trivial baselines."
    ),
    "tradeoff": Command(
        "tradeoff", SIMULATION, "Measure accuracy against time, of rendering or reconstruction."
    ),
}
"""Every command in the order of the help page."""

SETTINGS = {"help_option_names": ["-h", "--help"]}
EVERYWHERE = {"--json", "--verbose", "-v", "--quiet", "-q"}
"""Options that may also stand before the command."""
GROUPS = {"dataset", "train", "tradeoff"}
"""Commands with commands of their own, which their modules register."""
COMPLETION = "_NLOS_CAM_COMPLETE"
"""Environment variable that a shell sets when it asks for completions."""


def _print_version(wanted: bool) -> None:
    if wanted:
        from nlos_cam.files import program_name

        print(program_name())  # noqa: T201  the answer
        raise typer.Exit


def _root(
    *,
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            "-V",
            help="Print the version and the commit.",
            callback=_print_version,
            is_eager=True,
        ),
    ] = False,
) -> None:
    """See around a corner with a consumer lidar."""


def build_app(command: str | None = None) -> typer.Typer:
    """Return the command tree: with one command, with all, or (for any other word) with the
    summaries of all.

    Only the modules of its commands are imported, so that one command does not wait for the imports
    of others, and the help page waits for none.
    """
    app = _empty_app()
    if command is None or command in COMMANDS:
        for name, row in COMMANDS.items():
            if command is None or row.module == COMMANDS[command].module:
                module = importlib.import_module(f"nlos_cam.cli.{row.module}")
                if name in GROUPS:
                    module.register(app)
                else:
                    app.command(name)(getattr(module, name))
        _share_options(app)
        return app
    for name, row in COMMANDS.items():
        app.command(name, help=row.summary, rich_help_panel=row.group)(lambda: None)
    return app


def _empty_app() -> typer.Typer:
    app = typer.Typer(name="nlos-cam", context_settings=SETTINGS, pretty_exceptions_enable=False)
    app.callback()(_root)
    return app


def _share_options(app: typer.Typer, group: str = "") -> None:
    for info in app.registered_commands:
        if command := info.callback:
            name = info.name or command.__name__
            info.name = name
            info.callback = shared_options(f"{group} {name}".strip(), command)
    for group_info in app.registered_groups:
        if group_info.typer_instance:
            _share_options(group_info.typer_instance, str(group_info.name))


def main(arguments: list[str]) -> int:
    """Run one command and return its exit code (see docs/files.md: 0, 1, 2, 3, 4, 130)."""
    as_json = "--json" in arguments
    _escape_foreign_characters()
    command, arguments = _split(arguments)
    common.set_detail()
    try:
        return _run(command, arguments)
    except (typer.Abort, KeyboardInterrupt):
        common.say_interrupted()
        return common.INTERRUPTED
    except typer.TyperException as error:
        return _report_usage(error, as_json=as_json)
    except (NlosCamError, CalibrationError, ModelError) as error:
        return _report(error, as_json=as_json)
    except Exception as error:
        if (known := _known_error(error, command)) is None:
            raise
        return _report(known, as_json=as_json)
    finally:
        common.release_outputs()


def _escape_foreign_characters() -> None:
    """Print characters that the locale does not have as escapes, not as an encoding error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _run(command: str, arguments: list[str]) -> int:
    with common.interrupted_by_signals():
        if command in COMMANDS:
            _check_address_space(TORCH_ADDRESS_BYTES if command == "train" else MIN_ADDRESS_BYTES)
        # an interrupted import can end in any error of any library
        with common.stop_on_signals() as stop:
            app = build_app(None if COMPLETION in os.environ else command)
            tree = get_command(app)
            plain_help(tree)
        if stop.is_set():
            raise KeyboardInterrupt
        code = tree(arguments or ["--help"], prog_name="nlos-cam", standalone_mode=False) or 0
    if code == common.INTERRUPTED:
        common.say_interrupted()
    return code


def _split(arguments: list[str]) -> tuple[str, list[str]]:
    """Return the command, and the arguments with the options for all commands moved behind it."""
    rest = list(dropwhile(lambda argument: argument.startswith("-"), arguments))
    before = arguments[: len(arguments) - len(rest)]
    own = [argument for argument in before if argument not in EVERYWHERE]
    early = [argument for argument in before if argument in EVERYWHERE]

    command = rest[0] if rest else ""
    words = 2 if command in GROUPS else 1
    if len(rest) < words:  # no command: the options for all commands have no place
        return command, own + rest
    return command, own + rest[:words] + early + rest[words:]


def _check_address_space(needed: int) -> None:
    """Raise NlosCamError where the system's limit of address space is below `needed` bytes."""
    with suppress(ImportError):  # Windows has no such limits
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY and limit < needed:
            raise NlosCamError(
                f"out of memory: the limit of address space is {limit >> 20} MiB, but"
                f" {needed >> 20} MiB are needed: raise it (ulimit -v)"
            )


def _known_error(error: Exception, command: str) -> NlosCamError | ModelError | None:
    """Return a lack of memory, a missing extra or an error about a file as one of our errors; None
    for others.
    """
    if lacks_memory(error):  # also of a library while it is imported or works
        return NlosCamError("out of memory: close other programs, or raise the limit of this one")
    if isinstance(error, ModuleNotFoundError):
        return missing_extra(error, f"nlos-cam {command}")
    if isinstance(error, UnicodeEncodeError) and re.search("[\udc80-\udcff]", error.object):
        return NlosCamError(f"a name is not UTF-8 ({error.object!a:.200}): rename the file")
    if isinstance(error, OSError) and (error.errno in DISK_ERRORS or error.filename is not None):
        return _file_error(error)
    return None


def _file_error(error: OSError) -> NlosCamError:
    """Return the system's error about a file as one of ours."""
    if error.errno not in DISK_ERRORS:
        return RecordingError(
            f"{error.filename}: {error.strerror}: check that the file exists and that you have"
            " permission"
        )
    name = error.filename or " and ".join(map(str, common.reserved_outputs())) or "standard output"
    return DiskFullError(
        f"{name} cannot be written ({error.strerror}): free some space or choose another folder"
    )


def _report(error: NlosCamError | CalibrationError | ModelError, *, as_json: bool) -> int:
    common.say_error(str(error))
    if as_json:
        _print_error(type(error).__name__, str(error))
    return error.exit_code


def _report_usage(error: typer.TyperException, *, as_json: bool) -> int:
    usage, hint = usage_lines(error)
    reason = usage_reason(error)
    common.stderr.quiet = False
    if usage:
        common.stderr.print(usage, soft_wrap=True, markup=False)
    common.say_error(reason)
    if hint:
        common.stderr.print(hint, soft_wrap=True, markup=False)
    if as_json:
        _print_error("UsageError", reason)
    return error.exit_code


def _print_error(kind: str, message: str) -> None:
    with suppress(OSError):  # stdout may be full or closed: the line on stderr stands
        print(json.dumps({"error": {"type": kind, "message": message}}), flush=True)  # noqa: T201
