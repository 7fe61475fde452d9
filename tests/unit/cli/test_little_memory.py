"""Commands where memory is short: one line, and never the blame of a file that is whole."""

import resource

import pytest
from nlos_models import inference

from nlos_cam.cli.common import say_error, stderr
from nlos_cam.cli.main import MIN_ADDRESS_BYTES, TORCH_ADDRESS_BYTES, main

Capsys = pytest.CaptureFixture[str]


@pytest.mark.parametrize(("command", "needed"), [("rigs", MIN_ADDRESS_BYTES), ("train", TORCH_ADDRESS_BYTES)])
def test_too_little_address_space_is_one_line_before_libraries_load(
    monkeypatch: pytest.MonkeyPatch, capsys: Capsys, command: str, needed: int
) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (needed - 1, needed))
    assert main([command, "--help"]) == 1
    assert f"is {(needed >> 20) - 1} MiB" in capsys.readouterr().err
    monkeypatch.setattr(resource, "getrlimit", lambda _: (needed, needed))
    assert main([command, "--help"]) == 0


@pytest.mark.parametrize("error", [MemoryError(), ImportError("no room")])
def test_error_is_printed_without_rich_where_memory_is_short(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], error: Exception
) -> None:
    def lack(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(stderr, "print", lack)
    say_error("out of\nmemory")
    assert capfd.readouterr().err == "error: out of memory\n"


def test_error_keeps_colons_of_its_text(capsys: Capsys) -> None:
    say_error("a:smile:b")
    assert capsys.readouterr().err == "error: a:smile:b\n"


NO_MAP = ImportError("a.so: failed to map segment from shared object")
FAILED = [RuntimeError(f"export failed\n{reason}") for reason in ("std::bad_alloc", "cannot allocate memory")]


@pytest.mark.parametrize("error", [*FAILED, NO_MAP, MemoryError(), RuntimeError("of one")], ids=str)
def test_lack_of_memory_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: Capsys, error: Exception) -> None:
    def lack(_: object) -> None:
        raise error from (MemoryError() if str(error) == "of one" else None)

    monkeypatch.setattr("nlos_cam.cli.main.build_app", lack)
    assert main(["rigs"]) == 1
    assert capsys.readouterr().err.startswith("error: out of memory: close")


def test_open_session_without_memory_does_not_blame_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    def lack(*_: object, **__: object) -> None:
        raise RuntimeError("Exception during initialization: std::bad_alloc")

    monkeypatch.setattr("onnxruntime.InferenceSession", lack)
    with pytest.raises(MemoryError, match="bad_alloc"):
        inference.open_session(b"")
