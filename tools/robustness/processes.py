"""Processes on Linux as /proc lists them, and their memory over time."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

PROGRAM = [sys.executable, "-c", "from nlos_cam.cli import run; run()"]
"""Starts `nlos-cam` with this Python."""
WARM_UP = 0.2
"""Share of a run in which buffers fill; memory is judged after it."""


@dataclass(frozen=True)
class Look:
    """Memory of a process, and size of the file that it writes, at one time."""

    time_s: float
    memory_mib: float
    """Anonymous, that is without mapped files."""
    written_bytes: int = 0


@dataclass(frozen=True)
class Memory:
    """Memory of a process after its warm-up: median, maximum and slope of a straight line."""

    median_mib: float
    most_mib: float
    mib_per_minute: float


def memory_mib(pid: int) -> float | None:
    """Return the anonymous memory of a process; None when it has ended."""
    try:
        status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    except OSError:
        return None
    kib = [int(line.split()[1]) for line in status.splitlines() if line.startswith("RssAnon:")]
    return kib[0] / 1024 if kib else None


def memory(looks: Sequence[Look]) -> Memory:
    """Summarize the looks after the warm-up."""
    warm = [look for look in looks if look.time_s >= WARM_UP * looks[-1].time_s]
    mib, minutes = np.array([look.memory_mib for look in warm]), np.array([look.time_s / 60 for look in warm])
    return Memory(float(np.median(mib)), float(mib.max()), float(np.polyfit(minutes, mib, 1)[0]))


def children_of(pid: int) -> list[int]:
    """Return the children of a process."""
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for task in tasks for child in task.read_text(encoding="utf-8").split()]


def session_of(pid: int) -> int | None:
    """Return the session of a process; None for one that has ended."""
    try:
        state, _, _, session = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[:4]
    except OSError:
        return None
    return None if state == "Z" else int(session)
