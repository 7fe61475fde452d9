from collections.abc import Callable, Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, HTTPServer
from threading import Thread
from types import ModuleType
from typing import Any

import pytest

GOOD_RUN = {
    "frames": 18_000,
    "dropped": 18,
    "fps": 29.99,
    "name": "alone",
    "latency_ms": {"p50": 12.0, "p99": 15.0},
    "memory": {"mib_per_minute": 0.1},
}


@pytest.fixture
def interrupting(tool: Callable[[str], ModuleType]) -> ModuleType:
    return tool("interrupt_live")


@pytest.fixture
def endurance(tool: Callable[[str], ModuleType]) -> ModuleType:
    return tool("live_endurance")


def test_what_is_left_or_half_written_or_ends_otherwise_is_not_good(interrupting: ModuleType) -> None:
    plan = interrupting.Plan(0, "ctrl-c", 1.0, 5, view=True)
    good = interrupting.Outcome(plan, 130, 1.0, 0, [], 10, 10, "")
    assert good.good
    worse: list[dict[str, Any]] = [
        {"exit_code": 0},
        {"exit_code": None},
        {"processes_left": 1},
        {"half_written": ["run.bag: cut"]},
        {"missing": "no object ends stdout"},
        {"plan": replace(plan, kind="unplugged for good")},
    ]
    assert not any(replace(good, **change).good for change in worse)


@pytest.mark.parametrize(
    ("change", "missed"),
    [
        ({}, []),
        ({"dropped": 19}, ["0.11% dropped"]),
        ({"fps": 29.8}, ["29.80 frames/s"]),
        ({"latency_ms": {"p50": 14.0, "p99": 15.1}}, ["p99 15.1 ms"]),
        ({"latency_ms": {"p50": 9.0, "p99": 14.0}}, ["p99 1.56 p50"]),
        ({"name": "watched", "latency_ms": {"p50": 14.0, "p99": 17.9}}, []),
        ({"memory": {"mib_per_minute": 0.6}}, ["+0.60 MiB a minute"]),
    ],
)
def test_a_run_misses_what_it_does_not_keep(endurance: ModuleType, change: dict[str, Any], missed: list[str]) -> None:
    assert endurance.misses({**GOOD_RUN, **change}) == missed


@pytest.fixture
def stream() -> Iterator[str]:
    """The address of a server whose stream has 100,000 bytes."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()
            self.wfile.write(bytes(100_000))

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002  the name http.server uses
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}/"
        server.shutdown()
        thread.join()
