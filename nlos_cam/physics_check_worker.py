"""The process of physics checks, `python -m nlos_cam.physics_check_worker`: asked by stdin, told by stdout.

It takes rig and accuracy first, then one frame after another, each as a pickle, and answers each with a Check, or with
a text where that failed. It ends with its stdin, in the midst of a check too: however its parent ends, it does.
"""

import os
import pickle
import sys
from collections.abc import Callable
from contextlib import suppress
from queue import SimpleQueue
from threading import Thread
from typing import IO, Any

from nlos_cam.precedence import as_any_other

LEAST_URGENT = 19
"""`nice` of the process: it gets what the loop leaves."""


def serve(asked: IO[bytes], told: IO[bytes], leave: Callable[[], None]) -> None:
    """Answer every question until there are no more; then `leave` is called, while one may be worked on."""
    questions: SimpleQueue[Any] = SimpleQueue()
    Thread(target=_listen, args=(asked, questions, leave), daemon=True).start()
    rig, accuracy = questions.get()
    from nlos_cam.physics_check_render import check  # takes a second to import: stdin is listened to meanwhile

    while (question := questions.get()) is not None:
        frame_number, maps, depth_m = question
        try:
            answer: object = check(maps, depth_m, rig, frame_number=frame_number, accuracy=accuracy)
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
    as_any_other()
    if hasattr(os, "nice"):
        os.nice(LEAST_URGENT)
    told, sys.stdout = sys.stdout.buffer, sys.stderr  # what anybody prints is no answer
    serve(sys.stdin.buffer, told, leave=lambda: os._exit(0))


if __name__ == "__main__":
    main()
