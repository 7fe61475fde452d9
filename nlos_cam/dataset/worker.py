"""Start of a worker process: one thread, no reaction to Ctrl-C, and an end when its parent ends.

Numpy must not be imported here: BLAS reads the number of its threads once, when numpy is imported.
"""

import os
import signal
from multiprocessing import parent_process
from threading import Thread


def begin_worker() -> None:
    """Set up this process as a worker, until it ends."""
    os.environ["OPENBLAS_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"
    use_one_thread()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group: the parent ends its workers
    Thread(target=end_with_parent, daemon=True).start()


def use_one_thread() -> None:
    """Limit numba to one thread: a process per object is faster than several threads per object."""
    import numba

    numba.set_num_threads(1)


def end_with_parent() -> None:
    """Wait for the parent process to end, killed or not, then end this one, which would wait for work for ever."""
    if parent := parent_process():
        parent.join()
        os._exit(1)
