"""Frame numbers that mean the same instant on every stream of a recording, from its timestamps."""

from collections import deque
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field, replace

from nlos_cam.camera import SAME_INSTANT_S, Sample
from nlos_cam.errors import RecordingError

CONSISTENT_INSTANTS = 3
"""Instants in a row at which the streams' numbers differ by the same, before they are corrected."""
AHEAD = 24
"""Samples that are read ahead: more than those instants of three streams."""


@dataclass
class _Instant:
    """Frames that were exposed together."""

    time_s: float
    """Of the first of them."""
    numbers: dict[str, int] = field(default_factory=dict[str, int])


def renumbered(
    samples: Iterable[tuple[int, Sample]], streams: Collection[str]
) -> Iterator[tuple[int, Sample]]:
    """Yield a recording's samples, with the recorder's time in ns of each, under common numbers.

    Cameras whose metadata the kernel does not pass on count each stream apart: a stream that loses
    a frame is behind the others from then on. A live camera can correct that only for later frames;
    a recording is read ahead, so that no frame is lost. Where the numbers agree, nothing changes.
    """
    numbering = _Numbering(streams)
    damage: RecordingError | None = None
    source = iter(samples)
    while True:
        try:
            time_ns, sample = next(source)
        except StopIteration:
            break
        except RecordingError as error:  # the samples before it come first
            damage = error
            break
        numbering.add(time_ns, sample)
        if len(numbering.ahead) > AHEAD:
            yield numbering.ahead.popleft()
    yield from numbering.ahead
    if damage:
        raise damage


class _Numbering:
    """Samples read ahead, and what is added to the numbers of each stream from now on."""

    def __init__(self, streams: Collection[str]) -> None:
        self.ahead: deque[tuple[int, Sample]] = deque()
        self._streams = streams
        self._added = dict.fromkeys(streams, 0)
        self._instants: deque[_Instant] = deque(maxlen=AHEAD)
        """Those of which not all streams have come."""
        self._behind: dict[str, int] = {}
        self._since_s: list[float] = []
        """Times of the instants in a row at which the streams are behind by that."""

    def add(self, time_ns: int, sample: Sample) -> None:
        """Take a sample, and correct the numbers of those ahead where they prove to differ."""
        if added := self._added[sample.stream]:
            sample = replace(sample, number=sample.number + added)
        self.ahead.append((time_ns, sample))
        instant = self._instant(sample)
        instant.numbers[sample.stream] = sample.number
        if len(instant.numbers) == len(self._streams):
            self._instants.remove(instant)
            self._note(instant)

    def _instant(self, sample: Sample) -> _Instant:
        for instant in self._instants:
            is_near = abs(instant.time_s - sample.timestamp_s) <= SAME_INSTANT_S
            if is_near and sample.stream not in instant.numbers:
                return instant
        self._instants.append(_Instant(sample.timestamp_s))
        return self._instants[-1]

    def _note(self, instant: _Instant) -> None:
        # Numbers only rise: a stream that lost k frames is k behind the one that lost none.
        highest = max(instant.numbers.values())
        behind = {stream: highest - number for stream, number in instant.numbers.items()}
        if behind != self._behind:
            self._behind = behind
            self._since_s = []
        if not any(behind.values()):
            return
        self._since_s.append(instant.time_s)
        if len(self._since_s) == CONSISTENT_INSTANTS:
            self._correct(self._since_s[0] - SAME_INSTANT_S)

    def _correct(self, from_s: float) -> None:
        """Add to the numbers of each stream what it is behind, from a time on."""
        for k, (time_ns, sample) in enumerate(self.ahead):
            if sample.timestamp_s >= from_s and (behind := self._behind[sample.stream]):
                self.ahead[k] = time_ns, replace(sample, number=sample.number + behind)
        for stream, behind in self._behind.items():
            self._added[stream] += behind
        self._behind = {}
        self._since_s = []
        self._instants.clear()
