from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread
from types import ModuleType
from typing import Any

import pytest

GOOD_RUN = {
    "frames": 18_000,
    "dropped": 18,
    "fps": 29.99,
    "latency_ms": {"p99": 15.0},
    "memory": {"mib_per_minute": 0.1},
}


@pytest.fixture
def interrupting(tool: Callable[[str], ModuleType]) -> ModuleType:
    return tool("interrupt_live")


@pytest.fixture
def endurance(tool: Callable[[str], ModuleType]) -> ModuleType:
    return tool("live_endurance")


def test_plans_are_the_same_for_a_seed_and_of_every_kind(interrupting: ModuleType) -> None:
    plans = [interrupting.plan_of(number, 0) for number in range(200)]
    assert plans == [interrupting.plan_of(number, 0) for number in range(200)]
    assert plans != [interrupting.plan_of(number, 1) for number in range(200)]
    assert set(Counter(plan.kind for plan in plans)) == set(interrupting.KINDS)
    assert all(plan.view for plan in plans if plan.kind == "viewer killed")


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


@pytest.mark.slow
def test_files_that_are_cut_or_left_over_are_found(
    interrupting: ModuleType, noise_bags: dict[str, Path], tmp_path: Path
) -> None:
    assert interrupting.files_of(tmp_path) == (0, [])
    (tmp_path / "run.csv").write_text("a,b\n1,2\n")
    for name, least in (("plain", 40), ("plain-unindexed", 1)):  # the second as a kill leaves it, to be repaired
        (tmp_path / "run.bag").write_bytes(noise_bags[name].read_bytes())
        frames, half_written = interrupting.files_of(tmp_path)
        assert half_written == []
        assert least <= frames <= 40
    (tmp_path / "run.bag").write_bytes(b"nothing of the kind")
    (tmp_path / "run.csv").write_text("a,b\n1,")
    (tmp_path / "frames.123.part.npz").touch()
    told = [line.partition(":")[0] for line in interrupting.files_of(tmp_path)[1]]
    assert told == ["frames.123.part.npz", "run.csv", "run.bag"]


@pytest.mark.parametrize(
    ("change", "missed"),
    [
        ({}, []),
        ({"dropped": 19}, ["0.11% dropped"]),
        ({"fps": 29.8}, ["29.80 frames/s"]),
        ({"latency_ms": {"p99": 20.1}}, ["p99 20.1 ms"]),
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


def test_a_client_reads_the_whole_stream(endurance: ModuleType, stream: str) -> None:
    with endurance.client(stream) as seen:
        pass
    assert seen == {"stream_bytes": 100_000}


@pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="lists processes as Linux does")
def test_what_a_process_leaves_running_is_found_and_ended(
    tool: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch
) -> None:
    lasting = "import subprocess, sys; subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])"
    monkeypatch.setattr(tool("live_process"), "PROGRAM", f"{lasting}; print('begun', file=sys.stderr, flush=True)")
    with tool("live_process").LiveProcess([]) as run:
        run.wait_until_begun(60.0)
        assert run.process.wait(60.0) == 0
        assert len(run.left()) == 1
    assert run.left() == []


@pytest.mark.slow
def test_its_address_and_what_it_told_are_read(
    tool: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch
) -> None:
    told = "print('live view: http://127.0.0.1:4711/  (Ctrl-C ends it)', file=sys.stderr); print('{}')"
    monkeypatch.setattr(tool("live_process"), "PROGRAM", f"import sys; {told}")
    with tool("live_process").LiveProcess([]) as run:
        assert run.wait_for_address(60.0) == "http://127.0.0.1:4711/"
        assert run.ended_within(60.0) is not None
        assert run.stdout == "{}\n"
