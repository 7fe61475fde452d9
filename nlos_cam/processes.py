"""Python processes that this one starts: they import from its import path, and run no code that
lies in the current folder.

Python searches the current folder first for `python -m` and `python -c`, which is how helper
processes start: a file `multiprocessing.py` beside a recording would run in each of them.
"""

import os
import sys
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path

SAFE_PATH = "PYTHONSAFEPATH"
"""Environment variable, as the option -P: Python does not search the current folder by itself."""
PYTHON = sys.executable, "-P"
"""Command line of a Python process, without its program."""


def package_folder() -> Path:
    """Return the folder that this package is imported from."""
    return Path(__file__).resolve().parents[1]


def import_path() -> list[str]:
    """Return the folders and archives that this process imports from, without the current folder.

    The folder of this package is among them, last if it was the current one.
    """
    entries = [entry for entry in sys.path if entry]
    root = str(package_folder())
    return entries if root in entries else [*entries, root]


def child_environment(**variables: str) -> Mapping[str, str]:
    """Return this process's environment for a Python process that it starts, with more variables.

    It sets the import path.
    """
    path = os.pathsep.join(import_path())
    return {**os.environ, **variables, "PYTHONPATH": path, SAFE_PATH: "1"}


@contextmanager
def safe_children() -> Generator[None]:
    """Protect the processes that libraries start within the block: of multiprocessing (with its
    resource tracker), torch and Ray.

    They copy environment and import path of this process, which has both back at the end.
    """
    before = os.environ.get(SAFE_PATH)
    path = sys.path[:]
    os.environ[SAFE_PATH] = "1"
    sys.path[:] = import_path()
    try:
        yield
    finally:
        sys.path[:] = path
        if before is None:
            del os.environ[SAFE_PATH]
        else:
            os.environ[SAFE_PATH] = before
