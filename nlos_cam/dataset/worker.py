"""Worker processes of a dataset: one thread, no reaction to Ctrl-C, and an end when their parent
ends.

Each has a pipe of its own, so that one can be ended at any time: the executors of the standard
library wait forever for the rest of an answer where a worker is ended while it sends one. Numpy
must not be imported here: BLAS reads the number of its threads once, when numpy is imported.
"""

import os
import signal
from collections import deque
from contextlib import suppress
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection
from threading import Thread
from traceback import format_exc
from typing import TYPE_CHECKING

from nlos_cam.errors import WorkersLostError
from nlos_cam.processes import safe_children

if TYPE_CHECKING:
    from nlos_cam.dataset.plan import DatasetPlan
    from nlos_cam.dataset.samples import Samples

CONTEXT = get_context("spawn")
AHEAD = 2
"""Pieces that a worker is asked for at a time: it makes the second while its parent stores the
first.
"""
END_S = 5.0
"""Time for a worker without work to end by itself."""


class Worker:
    """Process that makes pieces of a dataset, seen from its parent."""

    def __init__(self, plan: "DatasetPlan", left: deque[range]) -> None:
        """Start it with the first pieces that are left. Raises WorkersLostError where no process
        can be started.
        """
        self.pipe, other = CONTEXT.Pipe()
        self.asked = deque[range]()
        self._process = CONTEXT.Process(target=make_pieces, args=(other,), daemon=True)
        try:
            with safe_children():
                self._process.start()
        except OSError as error:
            raise WorkersLostError(
                f"no worker can be started ({error.strerror}): free memory or processes, or lower"
                " --workers"
            ) from error
        finally:
            other.close()  # the pipe ends with the process
        self._send(plan)
        self._ask(left)

    def take(self, left: deque[range]) -> "tuple[range, Samples] | None":
        """Return the oldest piece that it was asked for, and ask for one more.

        Returns None, and puts its pieces back, where the process has ended. Raises what making the
        piece raised.
        """
        try:
            made = self.pipe.recv()
        except (EOFError, OSError):
            left.extendleft(reversed(self.asked))
            self.asked.clear()
            return None
        if isinstance(made, Exception):
            raise made
        piece = self.asked.popleft()
        self._ask(left)
        return piece, made

    def dismiss(self) -> None:
        """Let the process end by itself, since it has nothing to do. `end` then waits for that, which
        takes a second, once the other processes are done.
        """
        self.pipe.close()

    def end(self) -> int | None:
        """End the process, whatever it does, and return its exit code."""
        if not self.asked:
            self.dismiss()
            self._process.join(END_S)
        self._process.terminate()
        self._process.join()
        self.pipe.close()
        return self._process.exitcode

    def _ask(self, left: deque[range]) -> None:
        while left and len(self.asked) < AHEAD:
            self.asked.append(left.popleft())
            self._send(self.asked[-1])

    def _send(self, message: object) -> None:
        with suppress(OSError):  # it has ended: `take` will tell
            self.pipe.send(message)


def make_pieces(pipe: Connection) -> None:
    """Make each piece that the parent asks for, as a worker, until the pipe is closed."""
    begin_worker()
    from nlos_cam.dataset.samples import make_samples

    with suppress(EOFError, OSError):
        plan = pipe.recv()
        while True:
            piece = pipe.recv()
            try:
                answer = make_samples(plan, piece)
            except Exception as error:  # noqa: BLE001  whatever it was, the parent raises it
                error.add_note(format_exc())
                answer = error
            pipe.send(answer)


def begin_worker() -> None:
    """Set up this process as a worker, until it ends."""
    os.environ["OPENBLAS_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"
    use_one_thread()
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C reaches the whole group: the parent ends its workers
    Thread(target=end_with_parent, daemon=True).start()


def use_one_thread() -> None:
    """Limit numba to one thread: a process per object is faster than several threads per object."""
    import numba

    numba.set_num_threads(1)


def end_with_parent() -> None:
    """Wait for the parent process to end, killed or not, then end this one, which would wait for
    work for ever.
    """
    if parent := parent_process():
        parent.join()
        os._exit(1)
