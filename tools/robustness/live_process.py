"""Live run in a process of its own, as a person starts it; and processes on Linux as /proc lists
them.
"""

import os
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from threading import Event, Thread
from typing import Self

PROGRAM = (
    "import sys; from nlos_cam.cli import run; print('begun', file=sys.stderr, flush=True); run()"
)
ADDRESS = re.compile(r"http://127\.0\.0\.1:\d+/")


class LiveProcess:
    """`nlos-cam live` in a session of its own, whose output is read as it comes. Leaving kills its
    processes.
    """

    def __init__(self, arguments: Sequence[str]) -> None:
        command = [sys.executable, "-P", "-c", PROGRAM, "live", *arguments]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(
            command, stdout=pipe, stderr=pipe, text=True, start_new_session=True
        )
        self.said: list[str] = []
        """Lines of stderr."""
        self.address = ""
        self.stdout = ""
        self._begun = Event()
        self._addressed = Event()
        self._readers = [Thread(target=self._read_stderr), Thread(target=self._read_stdout)]
        for reader in self._readers:
            reader.start()

    def _read_stderr(self) -> None:
        for line in self.process.stderr or ():
            self._begun.set()
            self.said.append(line.rstrip())
            if found := ADDRESS.search(line):
                self.address = found[0]
                self._addressed.set()
        self._begun.set()
        self._addressed.set()

    def _read_stdout(self) -> None:
        self.stdout = self.process.stdout.read() if self.process.stdout else ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for pid in self.left():
            os.kill(pid, 9)
        self.process.wait()
        for reader in self._readers:
            reader.join()
        for stream in (self.process.stdout, self.process.stderr):
            if stream:
                stream.close()

    def wait_until_begun(self, timeout_s: float) -> None:
        """Wait until Python has started and the program's own code runs. Raises TimeoutError."""
        if not self._begun.wait(timeout_s):
            raise TimeoutError(f"the program did not begin within {timeout_s:.0f} s")

    def wait_for_address(self, timeout_s: float) -> str:
        """Return the address of the view; empty where the program ended first. Raises
        TimeoutError.
        """
        if not self._addressed.wait(timeout_s):
            raise TimeoutError(f"no address was printed within {timeout_s:.0f} s")
        return self.address

    def ended_within(self, timeout_s: float) -> float | None:
        """Return the seconds until the program ended and its output was read; None if it did not
        end.
        """
        start_s = time.monotonic()
        try:
            self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None
        ended_s = time.monotonic() - start_s
        for reader in self._readers:
            reader.join(timeout_s)
        return ended_s

    def left(self) -> list[int]:
        """Return the running processes of its session, itself included."""
        pids = [int(each.name) for each in Path("/proc").iterdir() if each.name.isdigit()]
        return [pid for pid in pids if session_of(pid) == self.process.pid]


def children_of(pid: int) -> list[int]:
    """Return the children of a process."""
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for task in tasks for child in task.read_text(encoding="utf-8").split()]


def session_of(pid: int) -> int | None:
    """Return the session of a process; None for one that has ended."""
    try:
        state, _, _, session = (
            Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[:4]
        )
    except OSError:
        return None
    return None if state == "Z" else int(session)
