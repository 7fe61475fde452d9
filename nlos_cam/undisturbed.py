"""A process set up for a loop that must not be held up by its own runtime."""

import gc
import sys
from collections.abc import Generator
from contextlib import contextmanager

SWITCH_S = 0.001
"""How long a thread may keep the interpreter while others want it: at Python's 5 ms, three threads that each took their
turn could hold a frame up for half of its period."""


@contextmanager
def undisturbed() -> Generator[None]:
    """Meanwhile what is alive now is not looked through for garbage, and threads take shorter turns.

    A collection over the modules and networks of a live run takes 0.2 s: six frames. What comes later is still
    collected, so memory stays flat. Entering collects once: enter before the camera runs.
    """
    before_s = sys.getswitchinterval()
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before_s)
        gc.unfreeze()
