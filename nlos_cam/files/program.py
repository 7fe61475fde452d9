"""Version and commit of this program, as its files record them."""

from functools import cache
from pathlib import Path

from nlos_cam import __version__
from nlos_cam.commit import DIGITS, commit_of


@cache
def program_commit() -> str:
    """Return the commit in full; empty where it is not known."""
    return commit_of(Path(__file__).parents[1])


@cache
def program_name() -> str:
    """Return the program with its version and commit: nlos-cam 0.2.0 (commit abc1234)."""
    return with_commit(f"nlos-cam {__version__}", program_commit())


def with_commit(version: str, commit: str) -> str:
    """Return a version with the first digits of its commit, where that is known."""
    return f"{version} (commit {commit[:DIGITS]})" if commit else version
