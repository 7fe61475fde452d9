"""How a worker process begins: with one thread, deaf to Ctrl-C, and set to end with its parent."""

import os
import signal
from multiprocessing import parent_process
from threading import Thread


def begin_worker() -> None:
    """Make this process a worker; what it prepares lasts as long as it does."""
    os.environ["OPENBLAS_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"  # numpy is still to be imported
    one_thread()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group: the parent ends its workers
    Thread(target=end_with_parent, daemon=True).start()


def one_thread() -> None:
    """One object per process is faster than several threads per object."""
    import numba

    numba.set_num_threads(1)


def end_with_parent() -> None:
    """Wait for the parent's end, and end: one that is killed tells nobody, and its workers would wait for ever."""
    if parent := parent_process():
        parent.join()
        os._exit(1)
