"""Order of a stream's frames, where the recorder's time of one contradicts its number and stamp."""

from bisect import bisect_left
from collections.abc import Callable, Sequence
from itertools import pairwise
from statistics import median
from typing import Protocol, TypeVar

NEAR_SHARE = 0.3
FAR_SHARE = 1.7
"""Shares of the median time between frames: one that is nearer to its neighbour, or farther from
it, may be out of its place.
"""
AGREED_S = 0.5
"""Bound between the time since a neighbour by the stamps, and by the numbers."""
MAX_MOVED = 8
"""Frames that are put back into their place; more are not slips of a clock."""


class Recorded(Protocol):
    """Message with the recorder's time, and its place in the file."""

    @property
    def time_ns(self) -> int: ...
    @property
    def chunk_pos(self) -> int: ...
    @property
    def offset(self) -> int: ...


Message = TypeVar("Message", bound=Recorded)
Stamp = tuple[int, float]
"""Number of a frame, and its time in s on the device's clock."""


def corrected_times_ns(
    entries: Sequence[Message], stamp_of: Callable[[Message], Stamp]
) -> list[int]:
    """Return the recorder's times of frames given in order of them, with those replaced whose frame
    belongs elsewhere by its number and its stamp.

    Frames are read only where the times look odd. Numbers and stamps that fall back and stay there,
    as after a restart of the device, move nothing.
    """
    times_ns = [entry.time_ns for entry in entries]
    if not _is_odd(entries):
        return times_ns
    stamps = [stamp_of(entry) for entry in entries]
    out_of_place = _out_of_place(stamps)
    if not out_of_place or len(out_of_place) > MAX_MOVED:
        return times_ns
    in_place = [k for k in range(len(entries)) if k not in out_of_place]
    period_s = _period_s([stamps[k] for k in in_place])
    for k in out_of_place:
        found_ns = _time_ns(stamps[k], [(*stamps[j], times_ns[j]) for j in in_place], period_s)
        times_ns[k] = times_ns[k] if found_ns is None else found_ns
    return times_ns


def _is_odd(entries: Sequence[Recorded]) -> bool:
    """Return whether frames are not in the order of the file, or one is near to another while
    there is a gap.
    """
    places = [(entry.chunk_pos, entry.offset) for entry in entries]
    if any(before > after for before, after in pairwise(places)):
        return True
    steps_ns = [after.time_ns - before.time_ns for before, after in pairwise(entries)]
    if len(steps_ns) < 2:
        return False
    usual_ns = median(steps_ns)
    is_far = max(steps_ns) > FAR_SHARE * usual_ns
    is_near = min(steps_ns) < NEAR_SHARE * usual_ns
    at_an_end = max(steps_ns[0], steps_ns[-1]) > FAR_SHARE * usual_ns
    return is_far and (is_near or at_an_end)


def _out_of_place(stamps: Sequence[Stamp]) -> set[int]:
    """Return the frames without which numbers and stamps rise where they fall now."""
    found = set[int]()
    last = 0
    for k in range(1, len(stamps)):
        if _rises(stamps[last], stamps[k]):
            last = k
            continue
        before = max((j for j in range(last) if j not in found), default=None)
        if k + 1 == len(stamps) or _rises(stamps[last], stamps[k + 1]):
            found.add(k)  # it came too late; the one after it follows the one before it
        elif before is None or _rises(stamps[before], stamps[k]):
            found.add(last)  # it came too early
            last = k
        else:
            last = k  # the device counts from a new start
    return found


def _rises(before: Stamp, after: Stamp) -> bool:
    """Return whether number or stamp rises: a frame is out of place only where both fall."""
    return before[0] < after[0] or before[1] < after[1]


def _period_s(stamps: Sequence[Stamp]) -> float:
    """Return the usual time between two numbers."""
    steps = [
        (after[1] - before[1]) / (after[0] - before[0])
        for before, after in pairwise(stamps)
        if after[0] > before[0]
    ]
    return median(steps) if steps else 0.0


def _time_ns(stamp: Stamp, others: Sequence[tuple[int, float, int]], period_s: float) -> int | None:
    """Return the recorder's time at which a frame fits between others (number, stamp, time); None
    where it does not.
    """
    number, time_s = stamp
    after = bisect_left(others, number, key=lambda other: other[0])
    nearest = others[max(after - 1, 0)]
    since_s = time_s - nearest[1]
    if abs(since_s - (number - nearest[0]) * period_s) > AGREED_S:
        return None
    time_ns = nearest[2] + round(1e9 * since_s)
    if 0 < after < len(others):
        time_ns = min(max(time_ns, others[after - 1][2] + 1), others[after][2] - 1)
    return max(time_ns, 0)
