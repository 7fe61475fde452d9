"""What a physics check costs the loop, beside it in a thread or in a process: docs/physics_check_latency.json.

The simulated camera's frames at its own pace, three ways one after another, `--rounds` times in turn: no checks, checks
in a thread of the loop's process, and checks in a process of their own as `live` makes them. A line for each run, and
the process's memory and how long it takes to its first check. Run it on an idle machine.
"""

import json
import time
from argparse import ArgumentParser
from collections.abc import Callable
from pathlib import Path
from threading import Condition, Event, Thread
from typing import Any, Self

from nlos_calibration.arrays import Float32
from nlos_models.inference import load_reconstructor

from nlos_cam.camera import open_camera
from nlos_cam.camera.protocol import WallClock
from nlos_cam.cli.common import say
from nlos_cam.evaluate.render_tradeoff import machine
from nlos_cam.files import cache_folder
from nlos_cam.frames import LidarMaps
from nlos_cam.live.loop import run_live, warm_up
from nlos_cam.live.physics_check_process import BackgroundChecks
from nlos_cam.reconstruct.bench import Bench, open_bench
from nlos_cam.reconstruct.physics_check import Check, Checks, NoChecks, check
from nlos_cam.reconstruct.pipeline import Processing
from nlos_cam.view.viewer import NullViewer

DOCS = Path(__file__).parents[1] / "docs"


class ThreadChecks:
    """The same checks as `BackgroundChecks`, in a thread of this process."""

    def __init__(self, bench: Bench, period_s: float) -> None:
        self.newest: Check | None = None
        self._bench, self._period_s, self._due_s = bench, period_s, 0.0
        self._next: tuple[int, LidarMaps, Float32] | None = None
        self._changed, self._ended = Condition(), False
        self._thread = Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._thread.join()

    def offer(self, frame_number: int, maps: LidarMaps, depth_m: Float32) -> None:
        """Have this frame checked if one is due."""
        if (now_s := time.monotonic()) < self._due_s:
            return
        self._due_s = now_s + self._period_s
        with self._changed:
            self._next = frame_number, maps, depth_m
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                while self._next is None and not self._ended:
                    self._changed.wait()
                if self._ended or self._next is None:
                    return
                (number, maps, depth_m), self._next = self._next, None
            self.newest = check(maps, depth_m, self._bench.rig, frame_number=number)


def memory_mib(pid: int) -> float | None:
    """What a process has in memory; None where the system does not tell."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS")), None)


class Watched(NullViewer):
    """Shows nothing; notes when the first check came, how long checks took, and the process's memory then."""

    def __init__(self, checks: Checks) -> None:
        self._checks, self._begun_s = checks, time.monotonic()
        self.first_check_s: float | None = None
        self.checks_s: dict[int, float] = {}
        self.memory_mib: float | None = None

    def show(self, moment: Any) -> None:
        """Note it."""
        if (made := moment.check) is None or made.frame_number in self.checks_s:
            return
        self.checks_s[made.frame_number] = made.seconds
        self.first_check_s = self.first_check_s or time.monotonic() - self._begun_s
        if isinstance(self._checks, BackgroundChecks) and self._checks.process:
            self.memory_mib = memory_mib(self._checks.process.pid)


def run(camera: str, seconds: float, make: Callable[[Bench], Checks]) -> dict[str, Any]:
    """One run of the loop."""
    opened = open_camera(camera)
    bench = open_bench(None, opened)
    checks = make(bench)
    processing = Processing(bench, load_reconstructor(None, cache_folder() / "onnx"), checks=checks)
    warm_up(opened, processing)
    viewer = Watched(checks)
    with opened as source:
        report = run_live(source, processing, viewer, stop=Event(), seconds=seconds, clock=WallClock().now)
    took_ms = sorted(1000 * seconds for seconds in viewer.checks_s.values())
    return {
        "frames": report.frames,
        "fps": report.fps,
        "dropped": report.dropped,
        "latency_ms": dict(report.latency_ms),
        "checks": len(took_ms),
        "check_median_ms": took_ms[len(took_ms) // 2] if took_ms else None,
        "first_check_s": viewer.first_check_s,
        "process_mib": viewer.memory_mib,
    }


def main() -> None:
    """Run it."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--camera", default="sim")
    parser.add_argument("--seconds", type=float, default=60.0, help="of each run")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--period", type=float, default=1.0, help="seconds from one check to the next")
    parser.add_argument("--out", type=Path, default=DOCS / "physics_check_latency.json")
    given = parser.parse_args()
    ways: dict[str, Callable[[Bench], Checks]] = {
        "none": lambda _: NoChecks(),
        "thread": lambda bench: ThreadChecks(bench, given.period),
        "process": lambda bench: BackgroundChecks(bench.rig, period_s=given.period),
    }
    runs: dict[str, list[dict[str, Any]]] = {name: [] for name in ways}
    for _ in range(given.rounds):
        for name, make in ways.items():
            runs[name].append(made := run(given.camera, given.seconds, make))
            told = ", ".join(f"{share} {value:.1f} ms" for share, value in made["latency_ms"].items())
            say(f"{name:8} {told}, {made['dropped']} dropped, {made['checks']} checks")
    table = {"machine": machine(), "seconds": given.seconds, "period_s": given.period, "runs": runs}
    given.out.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
