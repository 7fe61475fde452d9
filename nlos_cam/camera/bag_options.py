"""The options of a recorded sensor: which values were in force when."""

from bisect import bisect_right
from collections.abc import Mapping

from nlos_cam.camera.bag_container import BagContainer, Entry
from nlos_cam.camera.bag_messages import sdk_name


class RecordedOptions:
    """The options of one sensor, from the messages that told of them."""

    def __init__(self, container: BagContainer, topics: Mapping[str, str]) -> None:
        """`topics`: of each option's value, with the option's name."""
        self._container = container
        self._names = {topic: sdk_name(name) for topic, name in topics.items()}
        self._changes: list[tuple[Entry, str]] = sorted(
            (entry, topic) for topic in topics for entry in container.entries[topic]
        )
        self._done = 0
        """Changes that are in `_values`."""
        self._values: dict[str, float] = {}

    def at(self, time_ns: int) -> Mapping[str, float]:
        """The values in force, by the SDK's names; the same object until one changes."""
        done = bisect_right(self._changes, time_ns, key=lambda change: change[0].time_ns)
        if done != self._done:
            ahead = done > self._done
            latest = {topic: entry for entry, topic in self._changes[self._done if ahead else 0 : done]}
            read = {self._names[topic]: self._value(topic, entry) for topic, entry in latest.items()}
            self._values, self._done = self._values | read if ahead else read, done
        return self._values

    def _value(self, topic: str, entry: Entry) -> float:
        return float(self._container.read(topic, entry).data)
