"""What `nlos-cam capture` tells of its takes: JSON, a sentence, and the error that ended them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nlos_cam.errors import NlosCamError
from nlos_cam.recording.capture import Job, Take
from nlos_cam.recording.sidecar import State, Summary, sidecar_path

FIGURES = ("saturated_share", "invalid_share", "temporal_noise_mm")


def result(takes: Sequence[Take], *, several: bool) -> dict[str, Any]:
    """One take as it is, several as {"takes": [...]} with totals; with the error that ended them, if one did."""
    made = _all([_one(take) for take in takes], several=several)
    if error := ending(takes[-1]):
        made["error"] = {"type": type(error).__name__, "message": str(error)}
    return made


def nothing(jobs: Sequence[Job], *, several: bool) -> dict[str, Any]:
    """The same where it was interrupted before the camera ran."""
    none = Summary(frames=0, dropped=0, seconds=0.0, streams={}, events={})
    return _all([_told_of(job, "interrupted", none, sidecar_path(job.path)) for job in jobs[:1]], several=several)


def _all(each: list[dict[str, Any]], *, several: bool) -> dict[str, Any]:
    totals = {key: sum(one[key] or 0 for one in each) for key in ("frames", "dropped", "seconds")}
    return {"takes": each} | totals if several else each[0]


def _one(take: Take) -> dict[str, Any]:
    return _told_of(take.job, take.state, take.summary, take.sidecar.path)


def _told_of(job: Job, state: State, summary: Summary, sidecar: Path) -> dict[str, Any]:
    made: dict[str, Any] = {
        "frames": summary.frames,
        "dropped": summary.dropped,
        "seconds": None if summary.seconds is None else round(summary.seconds, 3),
        "out": str(job.path),
        "state": state,
        "streams": summary.streams,
        **{key: getattr(summary, key) for key in FIGURES},
        "sidecar": str(sidecar),
    }
    return made if job.label is None else made | {"label": job.label}


def ending(take: Take) -> NlosCamError | None:
    """What ended a take and is no one's wish, and how much of it is kept."""
    if take.error is None:
        return None
    kept = f"{take.found.frames} frames are kept in {take.job.path}" if take.found else "nothing is kept"
    return take.error if take.sets and not take.found else type(take.error)(f"{take.error}; {kept}")


def told(take: Take) -> str:
    """A take for a person."""
    if take.sets == 0:
        return f"{take.state} before the first frame: nothing is kept"
    if take.found is None:
        return f"{take.state}: {take.sets} frames came, not read back\nwrote {take.job.path}"
    size_mb, state = take.job.path.stat().st_size / 1e6, "" if take.state == "complete" else f"{take.state}: "
    return (
        f"{state}{take.found.frames} frames, {take.found.seconds:.1f} s, {size_mb:.0f} MB, read back whole\n"
        f"{_figures(take.summary)}\nwrote {take.job.path}"
    )


def _figures(summary: Summary) -> str:
    noise = "unknown" if summary.temporal_noise_mm is None else f"{summary.temporal_noise_mm:.2f} mm"
    saturated, invalid = summary.saturated_share or 0.0, summary.invalid_share or 0.0
    return f"saturated {saturated:.2%}, without depth {invalid:.1%}, noise in time {noise}"
