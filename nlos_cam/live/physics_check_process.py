"""Physics checks beside a streaming loop, in a process of little urgency that never holds the loop up.

The process of physics checks, `python -m nlos_cam.physics_check_worker`: asked by stdin, told by stdout.

It takes rig and accuracy first, then one frame after another, each as a pickle, and answers each with a Check, or with
a text where that failed. It ends with its stdin, in the midst of a check too: however its parent ends, it does.
"""

import os
import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from queue import SimpleQueue
from threading import Thread
from typing import IO, Any, Self

from nlos_calibration import Rig
from nlos_calibration.arrays import Float32

from nlos_cam.frames import LidarMaps
from nlos_cam.live.realtime import drop_realtime_priority
from nlos_cam.reconstruct import Clock, PhysicsCheckResult, describe_failure, log_warning
from nlos_cam.render import Stop
from nlos_cam.threads import BoundedQueue

PERIOD_S = 1.0
WORKER = sys.executable, "-m", "nlos_cam.live.physics_check_process"
END_WITHIN_S = 2.0
"""What has not ended by then is killed."""


class BackgroundPhysicsCheck:
    """Checks the newest frame about once a period, in a process of its own while entered.

    `offer` returns at once. What is due while another is worked on waits, one frame at most: a newer one takes its
    place. Where checks fail, or the process ends, `on_error` hears of the first time, and the loop goes on.
    """

    def __init__(
        self,
        rig: Rig,
        *,
        period_s: float = PERIOD_S,
        accuracy: Stop = "standard",
        clock: Clock = time.monotonic,
        on_error: Callable[[str], None] = log_warning,
        command: Sequence[str] = WORKER,
    ) -> None:
        self.newest: PhysicsCheckResult | None = None
        self.dropped = 0
        """Frames that were due, and that a newer one took the place of."""
        self._about, self._period_s, self._clock = (rig, accuracy), period_s, clock
        self._on_error, self._said, self._command = on_error, False, command
        self._due_s = -float("inf")
        self._queue = BoundedQueue[tuple[int, LidarMaps, Float32]](1)
        self.process: subprocess.Popen[bytes] | None = None
        """None where it could not be started."""
        self._thread = Thread(target=self._run, name="physics check", daemon=True)

    def __enter__(self) -> Self:
        try:
            self.process = _started(self._command)
        except OSError as error:
            self._over(f"their process cannot be started ({error.strerror})")
        else:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._queue.close()
        if self.process:
            _end(self.process)
            self._thread.join(END_WITHIN_S)

    def offer(self, frame_number: int, maps: LidarMaps, depth_m: Float32) -> None:
        """Have this frame checked if one is due."""
        if (now_s := self._clock()) < self._due_s:
            return
        self._due_s = now_s + self._period_s
        self.dropped += self._queue.put((frame_number, maps, depth_m)) is not None

    @property
    def waits(self) -> bool:
        """Whether a frame waits to be checked."""
        return len(self._queue) > 0

    @property
    def over(self) -> bool:
        """Whether nothing will be checked any more."""
        return self._queue.closed

    def _run(self) -> None:
        if (process := self.process) is None:
            return
        with suppress(OSError), process:  # closing a pipe that nobody reads any more is one
            try:
                self._ask(process)
            except (OSError, EOFError, pickle.PickleError):
                _end(process)
                self._over(f"their process ended ({process.returncode})")

    def _over(self, why: str) -> None:
        """There are no more checks, and never again a frame that waits for one."""
        self._say(f"no more physics checks: {why}")
        self._queue.close()

    def _ask(self, process: subprocess.Popen[bytes]) -> None:
        asked, told = process.stdin, process.stdout
        if asked is None or told is None:
            return
        _send(asked, self._about)
        while (frame := self._queue.take()) is not None:
            _send(asked, frame)
            answer = pickle.load(told)  # noqa: S301  of our own process, through a pipe that nobody else has
            if isinstance(answer, PhysicsCheckResult):
                self.newest = answer
            else:
                self._say(describe_failure(frame[0], str(answer)))

    def _say(self, text: str) -> None:
        if not (self._said or self._queue.closed):
            self._said = True
            self._on_error(text)


def _started(command: Sequence[str]) -> subprocess.Popen[bytes]:
    """The process, on one core, where a Ctrl-C at the terminal does not reach it, with the modules that we see."""
    one_thread = {f"{name}_NUM_THREADS": "1" for name in ("NUMBA", "OMP", "OPENBLAS", "MKL")}
    path = os.pathsep.join(entry for entry in sys.path if entry)
    group, flags = 0, 0
    if sys.platform == "win32":
        group, flags = None, subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.BELOW_NORMAL_PRIORITY_CLASS
    env, pipe = {**os.environ, **one_thread, "PYTHONPATH": path}, subprocess.PIPE
    return subprocess.Popen([*command], stdin=pipe, stdout=pipe, env=env, process_group=group, creationflags=flags)


def _send(to: IO[bytes], what: object) -> None:
    pickle.dump(what, to)
    to.flush()


def _end(process: subprocess.Popen[bytes]) -> None:
    """Have it end, and wait until it has."""
    process.terminate()
    try:
        process.wait(END_WITHIN_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


LOWEST_PRIORITY = 19
"""`nice` of the process: it gets what the loop leaves."""


def serve(asked: IO[bytes], told: IO[bytes], leave: Callable[[], None]) -> None:
    """Answer every question until there are no more; then `leave` is called, while one may be worked on."""
    questions: SimpleQueue[Any] = SimpleQueue()
    Thread(target=_listen, args=(asked, questions, leave), daemon=True).start()
    rig, accuracy = questions.get()
    from nlos_cam.reconstruct import check_reconstruction  # takes a second to import: stdin is listened to meanwhile

    while (question := questions.get()) is not None:
        frame_number, maps, depth_m = question
        try:
            answer: object = check_reconstruction(maps, depth_m, rig, frame_number=frame_number, accuracy=accuracy)
        except Exception as error:  # noqa: BLE001  whatever it was, it is told, and the next frame is looked at
            answer = f"{type(error).__name__}: {error}"
        with suppress(BrokenPipeError):
            pickle.dump(answer, told)
            told.flush()


def _listen(asked: IO[bytes], questions: SimpleQueue[Any], leave: Callable[[], None]) -> None:
    try:
        while True:
            questions.put(pickle.load(asked))  # noqa: S301  of our own parent, through a pipe that nobody else has
    except (EOFError, OSError, pickle.UnpicklingError):
        questions.put(None)
        leave()


def main() -> None:
    """Work for the parent, as little urgent as can be."""
    drop_realtime_priority()
    if hasattr(os, "nice"):
        os.nice(LOWEST_PRIORITY)
    told, sys.stdout = sys.stdout.buffer, sys.stderr  # what anybody prints is no answer
    serve(sys.stdin.buffer, told, leave=lambda: os._exit(0))


if __name__ == "__main__":
    main()
