"""What every command shares: where output goes, how a result or an error is told, what is never overwritten."""

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

Json = Annotated[bool, typer.Option("--json", help="End stdout with one JSON object; progress goes to stderr.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what --out names, if it exists.")]

PAPER_RIG = "paper-rig"
INTERRUPTED = 130
"""The exit code after Ctrl-C or a request to terminate."""

stderr = Console(stderr=True, highlight=False)


def say(text: str, *, marked: bool = False) -> None:
    """Tell the person at the terminal, never on stdout, which belongs to results; `marked` with Rich's markup."""
    stderr.print(text, soft_wrap=True, markup=marked)


def finish(result: dict[str, Any], *, as_json: bool, text: str, note: str = "", marked: bool = False) -> None:
    """End a command: one JSON object on stdout, or a sentence for a person, `marked` where it has Rich's markup.

    A note is in either.
    """
    if note:
        result, text = {**result, "note": note}, f"{text} ({note})"
    if as_json:
        print(json_module.dumps(result), flush=True)  # noqa: T201  stdout is the machine's
    else:
        Console(highlight=False).print(text, soft_wrap=True, markup=marked)


def show(table: Table) -> None:
    """A table on stdout, for a person."""
    Console(highlight=False).print(table)


@contextmanager
def progress(*others: ProgressColumn) -> Generator[Progress]:
    """A progress bar on stderr, with further columns."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), *others, TimeElapsedColumn()
    with Progress(*columns, TimeRemainingColumn(), console=stderr, transient=True) as bar:
        yield bar


@contextmanager
def tracked(description: str) -> Generator[Callable[[int, int], None]]:
    """A progress bar as a function of what is done and how much there is in all."""
    with progress() as bar:
        task = bar.add_task(description, total=None)

        def update(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        yield update


@contextmanager
def stop_on_signals() -> Generator[Event]:
    """An event that Ctrl-C or a request to terminate sets while the block lasts: the loop ends, results are told."""
    stop = Event()
    with _on_signals(stop.set):
        yield stop


@contextmanager
def interrupted_by_signals() -> Generator[None]:
    """Ctrl-C or a request to terminate raises KeyboardInterrupt in the block, also where a shell had them ignored.

    And where the block ends after one: a library may have swallowed it, or made another error of it.
    """
    came = Event()

    def interrupt() -> None:
        came.set()
        raise KeyboardInterrupt

    with _on_signals(interrupt):
        try:
            yield
        except Exception as error:
            if came.is_set():
                raise KeyboardInterrupt from error
            raise
    if came.is_set():
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
    """Where to write: `out`, or a dated name in the current folder; no suffix means a folder, which may be there empty.

    Raises OutputExistsError where that would replace something and `overwrite` was not given, or cannot be written.
    """
    path = out or Path(f"{stem}-{datetime.now().astimezone():%Y%m%d-%H%M%S}{suffix}")
    if suffix and path.is_dir():
        raise OutputExistsError(f"{path} is a folder: name a {suffix} file in it")
    if not suffix and path.exists() and not path.is_dir():
        raise OutputExistsError(f"{path} is a file, and a folder is what is written: choose another name")
    if path.exists() and not overwrite and not (path.is_dir() and not any(path.iterdir())):
        raise OutputExistsError(f"{path} exists: choose another name, or add --overwrite to replace it")
    if not path.parent.is_dir():
        raise OutputExistsError(f"the folder of {path} does not exist: create {path.parent} first")
    if not os.access(path.parent, os.W_OK):
        raise OutputExistsError(f"the folder of {path} cannot be written to: choose another, or change its permissions")
    return path
