"""A worker has one thread, leaves Ctrl-C to its parent, and ends with it."""

import os
import signal
import subprocess
import sys
from types import SimpleNamespace

import numba
import pytest

from nlos_cam.dataset import build

BLAS = "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"
PARENT = """
import multiprocessing, time
from threading import Thread
from nlos_cam.dataset_worker import end_with_parent
def wait(connection):
    Thread(target=end_with_parent, daemon=True).start()
    connection.send("ready")
    time.sleep(60)
if __name__ == "__main__":
    mine, other = multiprocessing.get_context("fork").Pipe()
    child = multiprocessing.get_context("fork").Process(target=wait, args=(other,))
    child.start()
    mine.recv()
    print(child.pid, flush=True)
    time.sleep(60)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_worker_ends_with_a_parent_that_is_killed() -> None:
    with subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline().strip().isdigit()
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        assert parent.stdout.read() == ""  # to its end: the worker held this pipe, and let go of it


def test_a_worker_without_a_parent_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build, "parent_process", lambda: None)
    monkeypatch.setattr(build, "os", SimpleNamespace(_exit=lambda _: pytest.fail("ended")))
    build.end_with_parent()


def test_a_worker_has_one_thread_and_is_deaf_to_interrupts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build, "parent_process", lambda: None)
    for name in BLAS:
        monkeypatch.setenv(name, "2")
    threads, handler = numba.get_num_threads(), signal.getsignal(signal.SIGINT)
    try:
        build.begin_worker()
        assert numba.get_num_threads() == 1
        assert {os.environ[name] for name in BLAS} == {"1"}
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        numba.set_num_threads(threads)
        signal.signal(signal.SIGINT, handler)


def test_when_a_worker_begins_no_library_has_counted_the_processors_yet() -> None:
    """BLAS counts them when numpy is imported, which is when its first piece comes."""
    program = "import sys, nlos_cam.cli.main, nlos_cam.dataset_worker; raise SystemExit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
