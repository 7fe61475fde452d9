"""The measurement of starting times: what it starts, and the ratios that it prints."""

from collections.abc import Callable
from types import ModuleType

import pytest


@pytest.fixture
def start(tool: Callable[[str], ModuleType]) -> ModuleType:
    return tool("start")


def test_every_command_and_subcommand_is_started(start: ModuleType) -> None:
    names = [*start.programs()]
    assert {"--version", "doctor", "live --help", "train --help", "train compressor --help"} <= {*names}
    assert names[:2] == [start.BARE, start.NUMPY]


def test_ratios_are_to_the_bare_interpreter_and_to_numpy(start: ModuleType) -> None:
    times = {start.BARE: start.Times(0.02, 0.01), start.NUMPY: start.Times(0.1, 0.1), "live": start.Times(0.4, 0.3)}
    assert start.table(times).splitlines()[-1] == "| `live` | 0.40 | 0.30 | 20.0 | 4.0 |"


def test_program_that_fails_is_reported(start: ModuleType) -> None:
    assert start.timed(["-c", "print('x')"]).wall_s > 0
    with pytest.raises(RuntimeError, match="exit code 7"):
        start.timed(["-c", "raise SystemExit(7)"])
