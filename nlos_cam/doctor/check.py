"""What a check finds: a status, what was seen, and what to do about it."""

from dataclasses import dataclass
from typing import Literal

Status = Literal["ok", "warning", "failed", "skipped"]


@dataclass(frozen=True)
class Finding:
    """The outcome of one question; a warning or a failure always says what to do."""

    status: Status
    detail: str
    fix: str = ""


@dataclass(frozen=True)
class Check:
    """A finding under the name of its question; names and fields are fixed: scripts depend on them."""

    name: str
    status: Status
    detail: str
    fix: str


def ok(detail: str) -> Finding:
    """All is well: what was seen."""
    return Finding("ok", detail)


def skipped(reason: str) -> Finding:
    """The question does not arise here: why."""
    return Finding("skipped", reason)


def warning(detail: str, fix: str) -> Finding:
    """It works, but not as well as it could."""
    return Finding("warning", detail, fix)


def failed(detail: str, fix: str) -> Finding:
    """A camera will not work like this."""
    return Finding("failed", detail, fix)
