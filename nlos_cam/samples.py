"""Some steps of a run, spread evenly over it, however long it gets."""

import numpy as np

from nlos_cam.processing import Step


class Samples:
    """Steps spread evenly over a run of unknown length: every n-th is kept, and n doubles as the run goes on."""

    def __init__(self, most: int) -> None:
        self._most, self._stride, self._seen = most, 1, 0
        self._kept: list[Step] = []

    def add(self, step: Step) -> None:
        if self._seen % self._stride == 0:
            self._kept.append(step)
        self._seen += 1
        if len(self._kept) > 2 * self._most:
            self._kept, self._stride = self._kept[::2], self._stride * 2

    def chosen(self) -> list[Step]:
        """At most `most` steps, first and last kept one included."""
        count = min(self._most, len(self._kept))
        return [self._kept[i] for i in np.linspace(0, len(self._kept) - 1, count).round().astype(int)]
