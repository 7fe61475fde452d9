"""Frame of the command line: exit codes, one line for an error, one JSON object for a machine,
outputs kept safe.
"""

import errno
import inspect
import os
import resource
import signal
import subprocess
import sys
import time
import weakref
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from threading import Event
from typing import Any
from unittest.mock import Mock

import pytest
import typer
from nlos_calibration.errors import CalibrationError, RecordFileError, WallRefusedError
from nlos_models import inference
from nlos_models.errors import CheckpointError, ModelError, RecipeError
from rich.table import Table
from typer.main import get_command

from nlos_cam import errors
from nlos_cam.cli import common
from nlos_cam.cli import main as module
from nlos_cam.cli import run as run_script
from nlos_cam.cli.common import Json, finish, say, say_error
from nlos_cam.cli.main import (
    COMMANDS,
    MIN_ADDRESS_BYTES,
    TORCH_ADDRESS_BYTES,
    _share_options,
    build_app,
    main,
)
from nlos_cam.cli.plain_help import plain_help, range_text
from nlos_cam.files import program_name

CODES = {
    1: (
        errors.SceneError,
        errors.OutputExistsError,
        WallRefusedError,
        CalibrationError,
        ModelError,
    ),
    3: (errors.CameraNotFoundError, errors.CameraLostError),
    4: (
        errors.RecordingError,
        errors.StreamMissingError,
        RecordFileError,
        CheckpointError,
        RecipeError,
    ),
}
Act = Callable[[], object]
Run = Callable[..., Any]
Does = Callable[[Act | BaseException], None]
Capsys = pytest.CaptureFixture[str]
Patch = pytest.MonkeyPatch


@pytest.fixture
def does(monkeypatch: Patch) -> Does:
    """A command line whose only command, `act`, calls a function or raises an error."""

    def install(act: Act | BaseException) -> None:
        def command(count: int = 1, json: Json = False) -> None:
            if isinstance(act, BaseException):
                raise act
            act()
            finish({"count": count}, as_json=json, text=f"{count} done")

        app = typer.Typer()
        app.callback()(lambda: None)
        app.command("act")(command)
        _share_options(app)
        monkeypatch.setattr(module, "build_app", lambda _: app)

    return install


def test_command_prints_its_sentence_or_one_json_object(does: Does, shown: Run, run: Run) -> None:
    does(lambda: None)

    assert shown("act").out == "1 done\n"

    does(lambda: sys.stdout.write("a line of the command's own\n"))

    assert run("act", "--count", "3") == {"count": 3}


@pytest.mark.parametrize(
    ("kind", "code"), [(kind, code) for code, kinds in CODES.items() for kind in kinds]
)
def test_foreseen_error_has_code_and_line(
    does: Does, shown: Run, run: Run, kind: type[Exception], code: int
) -> None:
    does(kind(message := "a depth of [3] m\nin [red]"))

    assert shown("act", code=code) == ("", "error: a depth of [3] m in [red]\n")
    assert run("act", code=code) == {"error": {"type": kind.__name__, "message": message}}


DISK = (errno.ENOSPC, errno.EROFS, errno.EIO)
FILE = (errno.EACCES, errno.ENOENT, errno.EISDIR)


@pytest.mark.parametrize(
    ("code", "kind"),
    [*((c, "DiskFullError") for c in DISK), *((c, "RecordingError") for c in FILE)],
)
def test_system_error_names_file_and_reason(does: Does, run: Run, code: int, kind: str) -> None:
    does(OSError(code, os.strerror(code), "out/F.npz"))
    error = run("act", code=1 if code in DISK else 4)["error"]

    assert error["type"] == kind
    assert "out/F.npz" in error["message"]
    assert os.strerror(code) in error["message"]


@pytest.mark.parametrize(
    "bug", [OSError(errno.EINVAL, "without a file"), ZeroDivisionError("a bug")]
)
def test_unforeseen_error_is_not_hidden(does: Does, bug: Exception) -> None:
    does(bug)
    with pytest.raises(type(bug)):
        main(["act"])


def _swallowed() -> None:
    with suppress(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def _made_an_error() -> None:
    try:
        signal.raise_signal(signal.SIGTERM)
    except KeyboardInterrupt:
        raise errors.CameraError("initialization failed") from None


def _inner_block() -> None:
    with common.interrupted_by_signals("two rows are kept"):
        signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize(
    "act", [_inner_block, lambda: common.exit_interrupted("two rows are kept")]
)
def test_interrupted_command_says_once_what_it_kept(does: Does, shown: Run, act: Act) -> None:
    does(act)
    assert shown("act", code=130).err == "interrupted: two rows are kept\n"


def test_progress_prints_lines_where_stderr_is_no_terminal(capsys: Capsys) -> None:
    with common.progress(period_s=0.001) as bar:
        bar.add_task("hidden", visible=False)
        bar.update(bar.add_task("rendering", total=4), completed=3)
        while "rendering" not in (shown := capsys.readouterr().err):
            time.sleep(0.001)

    assert set(shown.splitlines()) == {"rendering: 3/4, 0 s"}

    with common.progress() as bar:
        bar.add_task("short")

    assert capsys.readouterr().err == ""


def test_quiet_prints_results_and_errors_only(does: Does, shown: Run) -> None:
    does(lambda: say("a note"))

    assert shown("-q", "act") == ("1 done\n", "")

    does(errors.SceneError("no light"))

    assert shown("act", "--quiet", code=1) == ("", "error: no light\n")


@pytest.mark.parametrize("act", [KeyboardInterrupt(), typer.Abort(), _swallowed, _made_an_error])
def test_ctrl_c_exits_with_130_even_if_a_library_catches_it(
    does: Does, shown: Run, act: Any
) -> None:
    does(act)
    assert "Traceback" not in shown("act", code=130).err


@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C is a signal here")
def test_ctrl_c_while_loading_exits_with_130(monkeypatch: Patch) -> None:
    def interrupted(_: str) -> typer.Typer:
        os.kill(os.getpid(), signal.SIGINT)
        return build_app("devices")

    monkeypatch.setattr(module, "build_app", interrupted)

    assert main(["live"]) == 130


@pytest.mark.parametrize("arguments", ["act --cuont 3", "act --count many", "nothing", "act 3"])
def test_wrong_usage_exits_with_2(does: Does, shown: Run, arguments: str) -> None:
    does(lambda: None)
    out, err = shown(*arguments.split(), code=2)

    assert (out, bool(err)) == ("", True)


def test_console_script_exits_with_the_code(does: Does, monkeypatch: Patch, capsys: Capsys) -> None:
    does(errors.CameraNotFoundError("no device"))
    monkeypatch.setattr(sys, "argv", ["nlos-cam", "act"])
    before = signal.getsignal(signal.SIGINT)
    try:
        with pytest.raises(SystemExit) as caught:
            run_script()
    finally:
        signal.signal(signal.SIGINT, before)

    assert caught.value.code == 3
    assert "no device" in capsys.readouterr().err


@pytest.mark.parametrize(
    "module_name", ["nlos_cam.cli.main", "typing", "typer", "rich.console", "rich.table"]
)
def test_interruption_while_python_imports_is_one_line(module_name: str) -> None:
    """The signal comes at the import of a module: before, between and after those of the command
    line itself.
    """
    interrupt = (
        f"lambda event, found: event == 'import' and found[0] == {module_name!r} and"
        " signal.raise_signal(2)"
    )
    program = (
        f"import signal, sys; sys.addaudithook({interrupt}); from nlos_cam.cli import run; run()"
    )
    line = [sys.executable, "-c", program, "scenes"]
    ended = subprocess.run(line, check=False, capture_output=True, text=True, timeout=120)

    assert ended.returncode == 130
    assert ended.stdout == ""
    assert len(ended.stderr.splitlines()) == 1
    assert ended.stderr.startswith("interrupted")


def leaves(app: typer.Typer, path: str = "") -> list[tuple[str, object]]:
    commands = app.registered_commands
    found = [
        (f"{path} {c.name or getattr(c.callback, '__name__', None)}".strip(), c.callback)
        for c in commands
    ]
    for group in app.registered_groups:
        found += leaves(group.typer_instance, f"{path} {group.name}".strip())
    return found


def test_help_names_every_command_with_json_and_version(shown: Run) -> None:
    page = shown("--help").out
    named = "devices doctor capture calibrate live replay render dataset train evaluate tradeoff"

    assert not [name for name in {*named.split(), *COMMANDS} if name not in page]

    commands = leaves(build_app())

    assert len(commands) >= 10

    for name, callback in commands:
        assert "json" in getattr(callback, "__annotations__", {}), name

    assert shown("--version").out == shown("-V").out == f"{program_name()}\n"


@pytest.mark.parametrize("command", COMMANDS)
def test_command_table_names_the_right_module(command: str) -> None:
    names = {name for name, _ in leaves(build_app(command))}

    assert any(name.split()[0] == command for name in names)
    assert names <= {name for name, _ in leaves(build_app())}


def test_option_help_has_placeholders_and_ranges_in_words(shown: Run) -> None:
    tree = get_command(build_app("capture"))
    plain_help(tree)
    parameters = tree.commands["capture"].params  # type: ignore[attr-defined]
    options = {parameter.name: parameter for parameter in parameters}

    assert options["seconds"].metavar == "SECONDS"
    kinds = {"takes": "N", "overwrite": "", "label": "TEXT", "pause_s": "SECONDS"}
    assert {name: options[name].metavar for name in kinds} == kinds
    assert options["takes"].help.endswith("F-02.bag, ... (1 to 9999).")
    assert not {"<bool>", "<=", ">="} & {*shown("capture", "--help").out.replace("[", " ").split()}

    texts = {(1, 65535): "1 to 65535", (0.1, None): "at least 0.1", (None, 5): "at most 5"}
    texts |= dict.fromkeys([(1 / 30, 1e9), (0, None)], "")  # bounds against nonsense are left out

    assert {bounds: range_text(*bounds) for bounds in texts} == texts


def test_output_path_refuses_read_only_folder(tmp_path: Path, monkeypatch: Patch) -> None:
    """The system's answer is replaced, since the tests may run as a user who may write anywhere."""
    out = tmp_path / "wall.toml"

    assert common.output_path(out, "wall", ".toml", overwrite=False) == out

    monkeypatch.setattr(os, "access", lambda path, mode: not (path == tmp_path and mode == os.W_OK))
    with pytest.raises(errors.OutputExistsError, match=r"wall\.toml"):
        common.output_path(out, "wall", ".toml", overwrite=True)


def test_output_path_makes_the_folders_above_it(tmp_path: Path) -> None:
    used = common.output_path(tmp_path / "a" / "b" / "wall.toml", "", ".toml", overwrite=False)
    used.touch()
    unused = common.output_path(tmp_path / "c" / "d" / "wall.toml", "", ".toml", overwrite=False)

    assert unused.parent.is_dir()

    common.release_outputs()

    assert used.exists()
    assert not (tmp_path / "c").exists()

    with pytest.raises(errors.OutputExistsError, match="is a file"):
        common.output_path(used / "x.toml", "", ".toml", overwrite=False)


def test_table_on_a_narrow_terminal_is_blocks_of_lines(monkeypatch: Patch, capsys: Capsys) -> None:
    table = Table("camera", "serial", "name")
    table.add_row("sim", "", "simulated: the paper's rig")
    monkeypatch.setenv("COLUMNS", "30")
    common.show(table)

    assert capsys.readouterr().out == "camera: sim\nname: simulated: the paper's rig\n\n"

    monkeypatch.setenv("COLUMNS", "80")
    common.show(table)

    assert "serial" not in capsys.readouterr().out


def test_printed_text_is_literal_unless_marked(capsys: Capsys) -> None:
    finish({}, as_json=False, text="wrote runs/[bold]x")
    finish({}, as_json=False, text="[bold]good[/]", marked=True)
    say("kept in [red]")
    say_error("a:smile:b")

    assert capsys.readouterr() == (
        "wrote runs/[bold]x\ngood\n",
        "kept in [red]\nerror: a:smile:b\n",
    )


HEAVY = {"torch", "numba", "cv2", "onnxruntime", "rerun", "matplotlib", "h5py", "numpy"}


def test_help_groups_commands_and_imports_nothing_heavy() -> None:
    """The page of the groups, which needs no command's module, and the page of every command."""
    tree = get_command(build_app())
    commands = tree.commands  # type: ignore[attr-defined]
    groups = {name: [*getattr(each, "commands", {})] for name, each in commands.items()}
    lines = [
        [name, *below]
        for name, parts in groups.items()
        for below in [[]] + [[part] for part in parts]
    ]

    assert len(lines) > len(COMMANDS)

    program = (
        "import sys; from nlos_cam.cli.main import main; "
        "print([main(line) for line in ([], ['-h'], ['--help'])], *sys.modules); "
        f"print([main([*line, '--help']) for line in {lines}], *sys.modules)"
    )
    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120
    )
    pages, separator, rest = ended.stdout.partition("[0, 0, 0] ")

    assert separator
    assert all(pages.count(row.group) >= 3 for row in COMMANDS.values())

    first = rest.partition("\n")[0]
    last = rest.rstrip().rpartition("\n")[2]

    assert not {f"nlos_cam.cli.{name}" for name in ("capture", "live", "train")} & {*first.split()}
    assert last.count("0, ") + 1 == len(lines)
    assert not HEAVY & {*first.split(), *last.split()}


def test_defaults_written_in_help_are_those_of_the_library() -> None:
    from nlos_cam.cli.dataset import label
    from nlos_cam.cli.render import DEFAULTS
    from nlos_cam.dataset import FRAMES_PER_RECORDING
    from nlos_cam.render import HiddenObject

    assert {name: HiddenObject.model_fields[name].default for name in DEFAULTS} == DEFAULTS
    assert inspect.signature(label).parameters["frames"].default == FRAMES_PER_RECORDING


def test_interruption_that_python_ignores_is_raised_again() -> None:
    """In a weak reference's callback an error only reaches sys.unraisablehook."""

    class Gone:
        pass

    def lose_a_signal() -> None:
        gone = Gone()
        reference = weakref.ref(gone, lambda _: signal.raise_signal(signal.SIGINT))
        with common.interrupted_by_signals("kept"):
            del gone
            assert reference() is None
            Event().wait(20)
            pytest.fail("the interruption was lost")

    hook = sys.unraisablehook
    with pytest.raises(KeyboardInterrupt, match="kept"):
        lose_a_signal()

    assert sys.unraisablehook is hook


@pytest.mark.parametrize("block", [common.interrupted_by_signals, common.stop_on_signals])
def test_interruption_a_library_swallows_ends_the_next_block(
    block: Callable[[], AbstractContextManager[object]],
) -> None:
    """Such as an import in which any error means that something is not installed. The next block
    may be a live run without an end.
    """

    def swallow_and_go_on() -> None:
        with common.interrupted_by_signals("kept"):
            with suppress(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
            with block():
                pytest.fail("the interruption was lost")

    with pytest.raises(KeyboardInterrupt, match="kept"):
        swallow_and_go_on()
    with block():
        pass  # it is over


@pytest.mark.parametrize(
    ("command", "needed"), [("rigs", MIN_ADDRESS_BYTES), ("train", TORCH_ADDRESS_BYTES)]
)
def test_little_address_space_is_one_line_at_once(
    monkeypatch: Patch, shown: Run, command: str, needed: int
) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (needed - 1, needed))

    assert f"is {(needed >> 20) - 1} MiB" in shown(command, "--help", code=1).err

    monkeypatch.setattr(resource, "getrlimit", lambda _: (needed, needed))
    shown(command, "--help")


@pytest.mark.parametrize("error", [MemoryError(), ImportError("no room")])
def test_error_is_printed_without_rich_where_memory_is_short(
    monkeypatch: Patch, capfd: pytest.CaptureFixture[str], error: Exception
) -> None:
    monkeypatch.setattr(common.stderr, "print", Mock(side_effect=error))
    say_error("out of\nmemory")

    assert capfd.readouterr().err == "error: out of memory\n"


NO_MAP = ImportError("a.so: failed to map segment from shared object")
FAILED = [
    RuntimeError(f"export failed\n{reason}")
    for reason in ("std::bad_alloc", "cannot allocate memory")
]


@pytest.mark.parametrize("error", [*FAILED, NO_MAP, MemoryError(), RuntimeError("of one")], ids=str)
def test_lack_of_memory_is_one_line(monkeypatch: Patch, shown: Run, error: Exception) -> None:
    def lack(_: object) -> None:
        raise error from (MemoryError() if str(error) == "of one" else None)

    monkeypatch.setattr("nlos_cam.cli.main.build_app", lack)

    assert shown("rigs", code=1).err.startswith("error: out of memory: close")


def test_open_session_without_memory_does_not_blame_the_file(monkeypatch: Patch) -> None:
    lack = Mock(side_effect=RuntimeError("Exception during initialization: std::bad_alloc"))
    monkeypatch.setattr("onnxruntime.InferenceSession", lack)
    with pytest.raises(MemoryError, match="bad_alloc"):
        inference.open_session(b"")
