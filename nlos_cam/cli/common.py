"""Shared parts of the commands: output paths, results on stdout, progress and messages on stderr, signals."""

import json as json_module
import os
import signal
from collections.abc import Callable, Generator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from threading import Event
from types import FrameType
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from nlos_cam.errors import OutputExistsError

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line of stdout.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Overwrite the output if it exists.")]

PAPER_RIG = "paper-rig"
INTERRUPTED = 130
"""Exit code after Ctrl-C or SIGTERM."""

stderr = Console(stderr=True, highlight=False)


def say(text: str, *, marked: bool = False) -> None:
    """Print a message to stderr (stdout is for results); `marked`: with Rich's markup."""
    stderr.print(text, soft_wrap=True, markup=marked)


def finish(result: dict[str, Any], *, as_json: bool, text: str, note: str = "", marked: bool = False) -> None:
    """Print a command's result to stdout: one JSON object or a text; a note is added to either.

    `marked`: the text has Rich's markup.
    """
    if note:
        result, text = {**result, "note": note}, f"{text} ({note})"
    if as_json:
        print(json_module.dumps(result), flush=True)  # noqa: T201  stdout is the machine's
    else:
        Console(highlight=False).print(text, soft_wrap=True, markup=marked)


def show(table: Table) -> None:
    """Print a table to stdout."""
    Console(highlight=False).print(table)


@contextmanager
def progress(*others: ProgressColumn) -> Generator[Progress]:
    """Show a progress bar on stderr, with further columns."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), *others, TimeElapsedColumn()
    with Progress(*columns, TimeRemainingColumn(), console=stderr, transient=True) as bar:
        yield bar


@contextmanager
def tracked(description: str, *, at_once: bool = True) -> Generator[Callable[[int, int], None]]:
    """Show a progress bar, `at_once` or from the first step; yield the function that takes (done, total)."""
    with progress() as bar:
        task = bar.add_task(description, total=None, visible=at_once)

        def update(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total, visible=True)

        yield update


@contextmanager
def stop_on_signals() -> Generator[Event]:
    """Yield an event that Ctrl-C or SIGTERM sets within the block, so that the loop ends and results are printed."""
    stop = Event()
    with _on_signals(stop.set):
        yield stop


@contextmanager
def interrupted_by_signals() -> Generator[None]:
    """Raise KeyboardInterrupt in the block on Ctrl-C or SIGTERM, also where a shell had them ignored.

    It is raised at the end of the block too: a library may have swallowed it or turned it into another error.
    """
    interrupted = Event()

    def interrupt() -> None:
        interrupted.set()
        raise KeyboardInterrupt

    with _on_signals(interrupt):
        try:
            yield
        except Exception as error:
            if interrupted.is_set():
                raise KeyboardInterrupt from error
            raise
    if interrupted.is_set():
        raise KeyboardInterrupt


@contextmanager
def _on_signals(act: Callable[[], None]) -> Generator[None]:
    def on_signal(number: int, frame: FrameType | None) -> None:
        del number, frame
        act()

    before = {number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def output_path(out: Path | None, stem: str, suffix: str, *, overwrite: bool) -> Path:
    """Return the output path: `out`, or a dated name in the current folder.

    Without a suffix the output is a folder, which may exist if it is empty. Raises OutputExistsError if something would
    be replaced without `overwrite`, or if the path cannot be written.
    """
    path = out or Path(f"{stem}-{datetime.now().astimezone():%Y%m%d-%H%M%S}{suffix}")
    if suffix and path.is_dir():
        raise OutputExistsError(f"{path} is a folder: name a {suffix} file in it")
    if not suffix and path.exists() and not path.is_dir():
        raise OutputExistsError(f"{path} is a file, but --out must be a folder: choose another name")
    if path.exists() and not overwrite and not (path.is_dir() and not any(path.iterdir())):
        raise OutputExistsError(f"{path} exists: choose another name, or add --overwrite to replace it")
    if not path.parent.is_dir():
        raise OutputExistsError(f"the folder of {path} does not exist: create {path.parent} first")
    if not os.access(path.parent, os.W_OK):
        raise OutputExistsError(f"the folder of {path} cannot be written to: choose another, or change its permissions")
    return path
