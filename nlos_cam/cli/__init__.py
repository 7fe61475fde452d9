"""The command line, and its entry point."""

import sys

# Built in. The module `signal` first imports twenty others, and Ctrl-C may come in them.
from _signal import SIG_IGN, SIGINT, signal  # pyright: ignore[reportMissingImports]


def run() -> None:
    """Run the console script: its exit code is the command's, also where Ctrl-C comes while Python
    still imports.

    Until the command handles signals itself, Ctrl-C leaves at once, with one line: nothing is open
    yet, and an interrupted import would end in a traceback. After the command it does nothing:
    Python is ending anyway.
    """
    signal(SIGINT, _leave)
    sys.path[:] = [entry for entry in sys.path if entry]  # '' is the current folder
    from nlos_cam.cli.main import main

    code = main(sys.argv[1:])
    signal(SIGINT, SIG_IGN)
    raise SystemExit(code)


def _leave(*_: object) -> None:
    import os

    try:
        os.write(2, b"interrupted\n")
    finally:
        os._exit(130)
