"""Shared parts of the commands: output paths, results on stdout, progress and messages on stderr,
signals.
"""

import errno
import json as json_module
import logging
import os
import re
import signal
import sys
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from datetime import datetime
from pathlib import Path
from threading import Event, Thread, Timer
from types import FrameType
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console
from rich.markup import escape
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
from rich.text import Text

from nlos_cam.errors import OutputExistsError, SceneError

Camera = Annotated[
    str,
    typer.Argument(
        metavar="CAMERA",
        help="l515, l515:SERIAL, sim, sim:bare-wall, sim:SCENE.toml or FILE.bag.",
        show_default="sim, or the configured one",
    ),
]
"""Also taken as the option --camera: `shared_options` makes one value of the two."""
Json = Annotated[
    bool, typer.Option("--json", help="Print one JSON object as the last line of stdout.")
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Overwrite the output if it exists.")]

PAPER_RIG = "paper-rig"
INTERRUPTED = 130
"""Exit code after Ctrl-C, SIGTERM or SIGHUP."""
LINE_PERIOD_S = 10.0
"""Seconds between two lines of progress where stderr is no terminal."""
MAX_S = 1e9
"""Longest time that an option takes: longer than any disk lasts, and infinity is no time to wait
for, nor a number of frames.
"""
NARROW_COLUMNS = 60
NOTICES = "nlos_cam.kernel_cache"
"""Logger of what every user is told, not with --verbose alone: that kernels are compiled."""

CONTROL_CHARACTER = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)
"""Characters of names that a terminal would obey (control, direction of writing), and bytes that
are no UTF-8; tabs and line ends are text."""


def printable(text: str) -> str:
    """Return a text with its control characters as Python's escapes."""
    return CONTROL_CHARACTER.sub(lambda found: ascii(found[0])[1:-1], text)


class PlainConsole(Console):
    """Console that changes nothing in the texts it prints, and obeys no control characters in
    them.
    """

    def __init__(self, *, stderr: bool = False) -> None:
        super().__init__(stderr=stderr, highlight=False, emoji=False)

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable(text), **options)


stderr = PlainConsole(stderr=True)
_outputs = ExitStack()
_interruptions: list[tuple[Event, str]] = []
"""Event and text of each `interrupted_by_signals` that runs, the outermost first."""
_reserved: list[Path] = []
"""Reserved output paths of the command that runs, and their reservations."""


class Detail:
    """Amount of messages of the command that runs: see `set_detail`."""

    verbose = False
    interruption = ""
    """Line printed about an interruption, once."""


class MessageHandler(logging.Handler):
    """Prints what the package logs as a message of the command."""

    def emit(self, record: logging.LogRecord) -> None:
        say(record.getMessage())


def set_detail(*, verbose: bool = False, quiet: bool = False) -> None:
    """Print details and the package's log too, or (`quiet`) no messages but errors, from the start
    of a command.
    """
    Detail.verbose = verbose
    stderr.quiet = quiet
    Detail.interruption = ""
    notices = logging.getLogger(NOTICES)
    notices.setLevel(logging.INFO)
    notices.handlers = [MessageHandler()]
    notices.propagate = False
    if verbose:
        logging.basicConfig(format="%(name)s: %(message)s")
        logging.getLogger("nlos_cam").setLevel(logging.DEBUG)


def say_error(text: str) -> None:
    """Print an error in one line, also if quiet."""
    stderr.quiet = False
    line = " ".join(text.split())
    try:
        stderr.print(f"[bold red]error:[/] {escape(line)}", soft_wrap=True)
    except (MemoryError, ImportError):  # too little memory is left for rich
        os.write(2, f"error: {printable(line)}\n".encode())


def say_interrupted(kept: str = "nothing was written") -> None:
    """Print that the command was interrupted and the results that it kept; the first call
    counts.
    """
    if not Detail.interruption:
        Detail.interruption = f"interrupted: {kept}"
        say(Detail.interruption)


def refuse_ignored(why: str, given: dict[str, bool], instead: str = "change the recipe") -> None:
    """Raise SceneError for the first given option that would be ignored."""
    for option in (option for option, is_given in given.items() if is_given):
        raise SceneError(f"{why}, so {option} would have no effect: drop it, or {instead}")


def exit_interrupted(kept: str) -> NoReturn:
    """End an interrupted command that has kept results."""
    say_interrupted(kept)
    raise typer.Exit(INTERRUPTED)


def say(text: str, *, marked: bool = False) -> None:
    """Print a message to stderr (stdout is for results); `marked`: with Rich's markup."""
    stderr.print(text, soft_wrap=True, markup=marked)


def ask(text: str, *, marked: bool = False) -> None:
    """Print what hands have to do before the command goes on, also if quiet."""
    quiet = stderr.quiet
    stderr.quiet = False
    try:
        say(text, marked=marked)
    finally:
        stderr.quiet = quiet


def finish(
    result: dict[str, Any], *, as_json: bool, text: str, note: str = "", marked: bool = False
) -> None:
    """Print a command's result to stdout: one JSON object or a text; a note is added to either.

    `marked`: the text has Rich's markup.
    """
    if note:
        result = {**result, "note": note}
        text = f"{text} ({note})"
    if as_json:
        print(json_module.dumps(result), flush=True)  # noqa: T201  stdout is the machine's
    else:
        PlainConsole().print(text, soft_wrap=True, markup=marked)


def show(table: Table, *, narrow_columns: int = NARROW_COLUMNS) -> None:
    """Print a table to stdout without its empty columns; on a terminal of fewer columns than
    `narrow_columns`, each row as a block of lines.
    """
    console = PlainConsole()
    table.columns = [column for column in table.columns if any(column.cells)]
    if console.width >= narrow_columns:
        console.print(table)
        return
    for cells in zip(*(column.cells for column in table.columns), strict=True):
        named = zip(table.columns, cells, strict=True)
        lines = [f"{column.header}: {cell}".removeprefix(": ") for column, cell in named if cell]
        console.print("\n".join([*lines, ""]), soft_wrap=True)


@contextmanager
def progress(*others: ProgressColumn, period_s: float = LINE_PERIOD_S) -> Generator[Progress]:
    """Show a progress bar with further columns on stderr; where that is no terminal, a line every
    `period_s`.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        *others,
        TimeElapsedColumn(),
    )
    off = not stderr.is_terminal
    bar = Progress(*columns, TimeRemainingColumn(), console=stderr, transient=True, disable=off)
    with bar, _progress_lines(bar, period_s) if off else nullcontext():
        yield bar


@contextmanager
def _progress_lines(bar: Progress, period_s: float) -> Generator[None]:
    """Print a line per running task every `period_s`, for a log."""
    ended = Event()

    def report() -> None:
        while not ended.wait(period_s):
            for task in bar.tasks:
                if task.visible and not task.finished:
                    amount = f"{task.completed:.0f}/{task.total:.0f}, " if task.total else ""
                    say(f"{task.description}: {amount}{task.elapsed or 0:.0f} s")

    thread = Thread(target=report, name="progress lines", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@contextmanager
def tracked(description: str, *, at_once: bool = True) -> Generator[Callable[[int, int], None]]:
    """Show a progress bar, `at_once` or from the first step; yield the function that takes (done,
    total).
    """
    with progress() as bar:
        task = bar.add_task(description, total=None, visible=at_once)

        def update(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total, visible=True)

        yield update


@contextmanager
def stop_on_signals(note: str = "", hurry: Event | None = None) -> Generator[Event]:
    """Yield an event that Ctrl-C, SIGTERM or SIGHUP sets within the block, so that the loop
    ends and results are printed.

    The first signal prints `note`, for loops whose end takes long; the next one sets `hurry`.
    """
    _raise_swallowed()
    stop = Event()

    def set_stop() -> None:
        if note and not stop.is_set():
            with suppress(RuntimeError):  # the signal came within a write to stderr
                say(note)
        if hurry and stop.is_set():
            hurry.set()
        stop.set()

    with _on_signals(set_stop):
        yield stop


@contextmanager
def interrupted_by_signals(kept: str = "nothing was written") -> Generator[None]:
    """Raise KeyboardInterrupt in the block on Ctrl-C, SIGTERM or SIGHUP; the first two also
    where a shell had them ignored.

    It is raised at the end of the block too, and where a block begins within: a library may have
    swallowed it or turned it into another error. `kept` completes the line "interrupted: ...",
    which the command line prints.
    """
    _raise_swallowed()
    interrupted = Event()

    def interrupt() -> None:
        interrupted.set()
        raise KeyboardInterrupt(kept)

    def raise_again(ignored: Any, before: Any = sys.unraisablehook) -> None:
        # Python ignores errors in destructors and weak references' callbacks, where a signal may
        # happen to arrive.
        if issubclass(ignored.exc_type, KeyboardInterrupt):
            Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()
        else:
            before(ignored)

    with _on_signals(interrupt), _unraisable_hook(raise_again):
        _interruptions.append((interrupted, kept))
        try:
            yield
        except Exception as error:
            if interrupted.is_set():
                raise KeyboardInterrupt(kept) from error
            raise
        finally:
            _interruptions.pop()
    if interrupted.is_set():
        raise KeyboardInterrupt(kept)


def _raise_swallowed() -> None:
    """Raise the interruption of a block around this place that a library has swallowed: the work
    to come may have no end.
    """
    for interrupted, kept in _interruptions:
        if interrupted.is_set():
            raise KeyboardInterrupt(kept)


@contextmanager
def _unraisable_hook(hook: Callable[[Any], None]) -> Generator[None]:
    before = sys.unraisablehook
    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = before


@contextmanager
def _on_signals(act: Callable[[], None]) -> Generator[None]:
    def on_signal(number: int, frame: FrameType | None) -> None:
        del frame
        if number not in (signal.SIGINT, signal.SIGTERM):
            _leave_closed_terminal()
        act()

    numbers = [signal.SIGINT, signal.SIGTERM]
    # A terminal that is closed sends SIGHUP, unless the command was started with nohup.
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    before = {number: signal.signal(number, on_signal) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _leave_closed_terminal() -> None:
    """Discard further output to a terminal that was closed: each write would fail."""
    import termios  # where there is SIGHUP

    for stream in (1, 2):
        try:
            termios.tcgetattr(stream)
        except termios.error as error:
            if error.args[0] == errno.EIO:
                with Path(os.devnull).open("wb") as nowhere:
                    os.dup2(nowhere.fileno(), stream)


def output_path(out: Path | None, stem: str, suffix: str, *, overwrite: bool) -> Path:
    """Return the output path: `out`, or a dated name in the current folder.

    It is reserved until `release_outputs`: raises FileBusyError, with the holder, where another
    process writes to it. Without a suffix the output is a folder, which may exist if it is empty.
    Missing folders above it are made; those still empty at the end of the command go again. Raises
    OutputExistsError if something would be replaced without `overwrite`, or if the path cannot be
    written.
    """
    path = out or Path(f"{stem}-{datetime.now().astimezone():%Y%m%d-%H%M%S}{suffix}")
    if suffix and path.is_dir():
        raise OutputExistsError(f"{path} is a folder: name a {suffix} file in it")
    if not suffix and os.path.lexists(path) and not path.is_dir():
        raise OutputExistsError(
            f"{path} is a file, but --out must be a folder: choose another name"
        )
    _refuse_existing(path, overwrite=overwrite)
    _make_parents(path)
    if not os.access(path.parent, os.W_OK):
        raise OutputExistsError(
            f"the folder of {path} cannot be written to: choose another, or change its permissions"
        )
    from nlos_cam.files import reservations

    _outputs.enter_context(reservations())(path)
    _reserved.append(path)
    _refuse_existing(path, overwrite=overwrite)  # it may have appeared before it was reserved
    return path


def _make_parents(path: Path) -> None:
    """Make the folders above an output. Raises OutputExistsError where one is a file or read-only."""
    missing = [folder for folder in path.parents if not folder.exists()]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise OutputExistsError(
            f"the folder of {path} cannot be made, because a part of its path is a file: choose"
            " another --out"
        ) from error
    except PermissionError as error:
        raise OutputExistsError(
            f"the folder of {path} cannot be made without permission to write above it: choose"
            " another --out"
        ) from error
    for folder in reversed(missing):  # they are taken away in the opposite order, the lowest first
        _outputs.callback(_remove_if_empty, folder)


def _remove_if_empty(folder: Path) -> None:
    with suppress(OSError):  # it holds the output
        folder.rmdir()


def _refuse_existing(path: Path, *, overwrite: bool) -> None:
    # A link that leads nowhere is something too.
    if os.path.lexists(path) and not overwrite and not (path.is_dir() and not any(path.iterdir())):
        raise OutputExistsError(
            f"{path} exists: choose another name, or add --overwrite to replace it"
        )


def release_outputs() -> None:
    """Let other processes write to the output paths of a command that has ended."""
    _outputs.close()
    _reserved.clear()


def reserved_outputs() -> list[Path]:
    """Return the output paths of the command that runs."""
    return _reserved
