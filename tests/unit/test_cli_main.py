"""The command line's frame: one call, an exit code, one line for an error, one object for a machine."""

import errno
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress

import pytest
import typer
from nlos_calibration.errors import CalibrationError, RecordFileError, WallRefusedError
from nlos_models.errors import CheckpointError, ModelError, RecipeError

from nlos_cam import errors
from nlos_cam.cli import main as module
from nlos_cam.cli.common import Json, finish
from nlos_cam.cli.main import COMMANDS, build_app, main, run

CODES = [
    (errors.SceneError, 1),
    (errors.OutputExistsError, 1),
    (WallRefusedError, 1),
    (CalibrationError, 1),
    (ModelError, 1),
    (errors.CameraNotFoundError, 3),
    (errors.CameraLostError, 3),
    (errors.RecordingError, 4),
    (errors.StreamMissingError, 4),
    (RecordFileError, 4),
    (CheckpointError, 4),
    (RecipeError, 4),
]
Act = Callable[[], None]


@pytest.fixture
def does(monkeypatch: pytest.MonkeyPatch) -> Callable[[Act], None]:
    """A command line of one command, `act`, that does what it is told."""

    def install(act: Act) -> None:
        app = typer.Typer()

        @app.callback()
        def root() -> None: ...

        @app.command("act")
        def command(count: int = 1, json: Json = False) -> None:
            act()
            finish({"count": count}, as_json=json, text=f"{count} done")

        monkeypatch.setattr(module, "build_app", lambda _: app)

    return install


def _raise(error: BaseException) -> Act:
    def act() -> None:
        raise error

    return act


def test_a_command_that_works_is_0_and_its_sentence_is_on_stdout(
    does: Callable[[Act], None], capsys: pytest.CaptureFixture[str]
) -> None:
    does(lambda: None)
    assert main(["act"]) == 0
    assert capsys.readouterr().out == "1 done\n"


def test_with_json_the_last_line_of_stdout_is_one_object(
    does: Callable[[Act], None], capsys: pytest.CaptureFixture[str]
) -> None:
    does(lambda: print("a line of the command's own"))  # noqa: T201
    assert main(["act", "--count", "3", "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == {"count": 3}


@pytest.mark.parametrize(("kind", "code"), CODES, ids=lambda value: getattr(value, "__name__", str(value)))
def test_a_foreseen_error_has_its_code_and_one_line(
    does: Callable[[Act], None], capsys: pytest.CaptureFixture[str], kind: type[Exception], code: int
) -> None:
    message = "a depth of [3] m\nin [red]"
    does(_raise(kind(message)))
    assert main(["act"]) == code
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err == "error: a depth of [3] m in [red]\n"
    assert main(["act", "--json"]) == code
    last = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert last == {"error": {"type": kind.__name__, "message": message}}


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS, errno.EIO])
def test_a_disk_that_does_not_take_it_is_one_line(
    does: Callable[[Act], None], capsys: pytest.CaptureFixture[str], code: int
) -> None:
    does(_raise(OSError(code, os.strerror(code), "out/F.npz")))
    assert main(["act", "--json"]) == 1
    last = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert last["error"]["type"] == "DiskFullError"
    assert f"out/F.npz cannot be written ({os.strerror(code)})" in last["error"]["message"]


@pytest.mark.parametrize("code", [errno.EACCES, errno.ENOENT, errno.EISDIR])
def test_what_the_system_says_about_a_file_is_one_line(
    does: Callable[[Act], None], capsys: pytest.CaptureFixture[str], code: int
) -> None:
    does(_raise(OSError(code, os.strerror(code), "out/F.npz")))
    assert main(["act", "--json"]) == 1
    last = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert last["error"]["type"] == "NlosCamError"
    assert last["error"]["message"].startswith(f"out/F.npz: {os.strerror(code)}: ")


def test_an_error_of_the_system_without_a_file_is_a_bug_of_ours(does: Callable[[Act], None]) -> None:
    does(_raise(OSError(errno.EINVAL, os.strerror(errno.EINVAL))))
    with pytest.raises(OSError, match=os.strerror(errno.EINVAL)):
        main(["act"])


def test_ctrl_c_is_130(does: Callable[[Act], None], capsys: pytest.CaptureFixture[str]) -> None:
    does(_raise(KeyboardInterrupt()))
    assert main(["act"]) == 130
    does(_raise(typer.Abort()))
    assert main(["act"]) == 130
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["act", "--cuont", "3"], ["act", "--count", "many"], ["nothing"], ["act", "3"]])
def test_wrong_usage_is_2_and_told_on_stderr(
    does: Callable[[Act], None], capsys: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    does(lambda: None)
    assert main(arguments) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err


def test_an_error_nobody_foresaw_is_not_hidden(does: Callable[[Act], None]) -> None:
    does(_raise(ZeroDivisionError("a bug")))
    with pytest.raises(ZeroDivisionError):
        main(["act"])


def test_the_console_script_exits_with_the_code(
    does: Callable[[Act], None], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    does(_raise(errors.CameraNotFoundError("no device")))
    monkeypatch.setattr(sys, "argv", ["nlos-cam", "act"])
    with pytest.raises(SystemExit) as caught:
        run()
    assert caught.value.code == 3
    assert "no device" in capsys.readouterr().err


def test_help_is_0_and_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    shown = capsys.readouterr().out
    for name in (
        "devices",
        "doctor",
        "capture",
        "calibrate",
        "live",
        "replay",
        "render",
        "dataset",
        "train",
        "evaluate",
    ):
        assert name in shown


def leaves(app: typer.Typer, path: str) -> list[tuple[str, object]]:
    found = [
        (f"{path} {c.name or getattr(c.callback, '__name__', None)}".strip(), c.callback)
        for c in app.registered_commands
    ]
    for group in app.registered_groups:
        assert group.typer_instance is not None
        found += leaves(group.typer_instance, f"{path} {group.name}".strip())
    return found


def test_every_command_takes_json() -> None:
    commands = leaves(build_app(), "")
    assert len(commands) >= 10
    for name, callback in commands:
        assert "json" in getattr(callback, "__annotations__", {}), name


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_is_in_the_file_that_the_table_names(command: str) -> None:
    names = {name for name, _ in leaves(build_app(command), "")}
    assert any(name.split()[0] == command for name in names)
    assert names <= {name for name, _ in leaves(build_app(), "")}


def test_listing_devices_does_not_wait_for_the_networks() -> None:
    program = "import sys; from nlos_cam.cli.main import build_app; build_app('devices'); print('torch' in sys.modules)"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120)
    assert ended.stdout == "False\n"


@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C is a signal here")
def test_ctrl_c_while_a_command_is_loaded_is_130(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(_: str) -> Callable[..., int]:
        os.kill(os.getpid(), signal.SIGINT)
        return lambda *_, **__: 0

    monkeypatch.setattr(module, "build_app", interrupted)
    assert main(["live"]) == 130


def _swallowed() -> None:
    with suppress(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def _made_an_error() -> None:
    try:
        signal.raise_signal(signal.SIGTERM)
    except KeyboardInterrupt:
        raise errors.CameraError("initialization failed") from None


@pytest.mark.parametrize("library", [_swallowed, _made_an_error])
def test_ctrl_c_that_a_library_makes_something_else_of_is_130(does: Callable[[Act], None], library: Act) -> None:
    does(library)
    assert main(["act"]) == 130
