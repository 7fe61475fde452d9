"""Physics checks in a separate process of low priority, which never delays the live loop.

`python -m nlos_cam.live.physics_check_process` is that process. It reads the accuracy from stdin,
then frames with their rig, each as a pickle, and answers each with a PhysicsCheckResult, or with a
text if the check failed. It exits as soon as stdin closes, even during a check, so it never outlives its
parent.
"""

import os
import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from queue import SimpleQueue
from threading import Lock, Thread
from typing import IO, Any, Self

from nlos_calibration import Rig
from nlos_calibration.arrays import Float32

from nlos_cam.frames import LidarMaps
from nlos_cam.live.realtime import drop_realtime_priority
from nlos_cam.processes import PYTHON, child_environment
from nlos_cam.reconstruct import Clock, PhysicsCheckResult, describe_failure, log_warning
from nlos_cam.render import Stop
from nlos_cam.threads import BoundedQueue

PERIOD_S = 1.0
WORKER = *PYTHON, "-m", "nlos_cam.live.physics_check_process"
END_WITHIN_S = 2.0
"""A process that has not ended by then is killed."""
LOWEST_PRIORITY = 19
"""`nice` of the process: it gets the processor time that the loop leaves."""


class BackgroundPhysicsCheck:
    """Physics check of the newest frame about once a period, in a process of its own while entered.

    `offer`, for one thread, returns at once: a frame that is due while another is checked waits,
    until a newer one replaces it. A thread talks to the process. `on_error` is called for the first
    failed check, and if the process ends; the loop continues without.
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
        """Due frames that a newer one replaced."""
        self._rig = rig
        self._of_one_rig = Lock()
        """Held while `newest` is made to fit the rig, or the rig to change."""
        self._accuracy: Stop = accuracy
        self._period_s = period_s
        self._clock = clock
        self._on_error = on_error
        self._has_failed = False
        """True once a failed check was reported."""
        self._command = command
        self._due_s = -float("inf")
        self._queue = BoundedQueue[tuple[int, LidarMaps, Float32, Rig]](1)
        self.process: subprocess.Popen[bytes] | None = None
        """None if it could not be started."""

    def __enter__(self) -> Self:
        try:
            self.process = _start(self._command)
        except OSError as error:
            self._give_up(f"cannot start their process ({error.strerror})")
        else:
            self._thread = Thread(
                target=self._run, args=(self.process,), name="physics check", daemon=True
            )
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._queue.close()
        if self.process:
            _end(self.process)
            self._thread.join(END_WITHIN_S)

    def use_rig(self, rig: Rig) -> None:
        """Compare the frames that are offered from now on with this rig."""
        with self._of_one_rig:
            if rig != self._rig:
                self.newest = None
            self._rig = rig

    def offer(self, frame_number: int, maps: LidarMaps, depth_m: Float32) -> None:
        """Have this frame checked if a check is due."""
        now_s = self._clock()
        if now_s < self._due_s:
            return
        self._due_s = now_s + self._period_s
        replaced = self._queue.put((frame_number, maps, depth_m, self._rig))
        if replaced is not None:
            self.dropped += 1

    @property
    def waits(self) -> bool:
        """True while a frame waits for its check."""
        return len(self._queue) > 0

    @property
    def ended(self) -> bool:
        """True once there will be no more checks."""
        return self._queue.closed

    def _run(self, process: subprocess.Popen[bytes]) -> None:
        with suppress(OSError), process:  # closing a broken pipe raises
            try:
                self._ask(process)
            except (OSError, EOFError, pickle.PickleError):
                _end(process)
                self._give_up(f"their process ended ({process.returncode})")

    def _ask(self, process: subprocess.Popen[bytes]) -> None:
        to_worker = process.stdin
        from_worker = process.stdout
        if to_worker is None or from_worker is None:
            return
        _send(to_worker, self._accuracy)
        while (frame := self._queue.take()) is not None:
            _send(to_worker, frame)
            answer = pickle.load(from_worker)  # noqa: S301  from our own process, through a private pipe
            if isinstance(answer, PhysicsCheckResult):
                with self._of_one_rig:
                    # one of a rig that is no longer used says nothing
                    self.newest = answer if frame[-1] == self._rig else self.newest
            else:
                self._report_failure(describe_failure(frame[0], str(answer)))

    def _give_up(self, reason: str) -> None:
        if not self.ended:
            self._on_error(f"no more physics checks: {reason}")
        self._queue.close()
        self.newest = None  # it would be shown for good

    def _report_failure(self, text: str) -> None:
        if not (self._has_failed or self.ended):
            self._has_failed = True
            self._on_error(text)


def _start(command: Sequence[str]) -> subprocess.Popen[bytes]:
    """Start the process with one thread and our import path, in a group that Ctrl-C at the terminal
    does not reach.
    """
    one_thread = {f"{name}_NUM_THREADS": "1" for name in ("NUMBA", "OMP", "OPENBLAS", "MKL")}
    group = 0
    flags = 0
    if sys.platform == "win32":
        group = None
        flags = subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.BELOW_NORMAL_PRIORITY_CLASS
    env = child_environment(**one_thread)
    pipe = subprocess.PIPE
    return subprocess.Popen(
        [*command], stdin=pipe, stdout=pipe, env=env, process_group=group, creationflags=flags
    )


def _send(pipe: IO[bytes], message: object) -> None:
    pickle.dump(message, pipe)
    pipe.flush()


def _end(process: subprocess.Popen[bytes]) -> None:
    """Terminate the process and wait for it; kill it after END_WITHIN_S."""
    process.terminate()
    try:
        process.wait(END_WITHIN_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def serve(from_parent: IO[bytes], to_parent: IO[bytes], leave: Callable[[], None]) -> None:
    """Answer every frame until there are no more; calls `leave` then, even during a check."""
    messages: SimpleQueue[Any] = SimpleQueue()
    Thread(target=_listen, args=(from_parent, messages, leave), daemon=True).start()
    accuracy = messages.get()
    # This import takes a second, in which the thread above already watches stdin.
    from nlos_cam.reconstruct import check_reconstruction

    while (message := messages.get()) is not None:
        frame_number, maps, depth_m, rig = message
        try:
            answer: object = check_reconstruction(
                maps, depth_m, rig, frame_number=frame_number, accuracy=accuracy
            )
        except Exception as error:  # noqa: BLE001  whatever it was, it is reported, and the next frame is checked
            answer = f"{type(error).__name__}: {error}"
        with suppress(BrokenPipeError):
            _send(to_parent, answer)


def _listen(from_parent: IO[bytes], messages: SimpleQueue[Any], leave: Callable[[], None]) -> None:
    try:
        while True:
            messages.put(pickle.load(from_parent))  # noqa: S301  from our own parent, through a private pipe
    except (EOFError, OSError, pickle.UnpicklingError):
        messages.put(None)
        leave()


def main() -> None:
    """Serve the parent at the lowest priority."""
    drop_realtime_priority()
    if hasattr(os, "nice"):
        os.nice(LOWEST_PRIORITY)
    answers = sys.stdout.buffer
    sys.stdout = sys.stderr  # keeps prints out of the answers
    serve(sys.stdin.buffer, answers, leave=lambda: os._exit(0))


if __name__ == "__main__":
    main()
