"""Commit that this program was made from. Without other imports: the build reads it too."""

from __future__ import annotations

from pathlib import Path

BUILT = "COMMIT"
"""File in the built package that holds the commit; a checkout has none."""
DIGITS = 7


def commit_of(package: Path) -> str:
    """Return the commit, 40 hexadecimal digits, of a package's folder: of a checkout the present
    one, else the one it was built from; empty where neither is known.
    """
    built = package / BUILT
    # Site-packages may lie in a repository of somebody else's: only our own checkout counts.
    if (package.parent / "pyproject.toml").is_file():
        return _head(package.parent / ".git") or _line(built)
    return _line(built)


def _head(git: Path) -> str:
    """Return the commit that a repository, or a worktree of one, is at; empty where it is not
    known.
    """
    if git.is_file():  # a worktree's names the folder with its state
        git = git.parent / _line(git).removeprefix("gitdir: ")
    head = _line(git / "HEAD")
    if not head.startswith("ref: "):
        return _checked(head)

    name = head.removeprefix("ref: ")
    shared = git / (_line(git / "commondir") or ".")
    for folder in (git, shared):
        if found := _checked(_line(folder / name)):
            return found
    # Many references lie in one file, as lines "COMMIT NAME".
    packed = _text(shared / "packed-refs").splitlines()
    return next((_checked(line.split()[0]) for line in packed if line.endswith(f" {name}")), "")


def _checked(text: str) -> str:
    return text if len(text) >= 40 and set(text) <= set("0123456789abcdef") else ""


def _line(path: Path) -> str:
    return _text(path).partition("\n")[0].strip()


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""
