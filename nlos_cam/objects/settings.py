"""The settings of a category's generator: what training draws, and what only the test set has.

Each setting is a proportion with a range. Some have an interval held out of it (or beside it): no seed draws a value in
there, and the test set takes all of its values for that setting from there.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from nlos_cam.objects.solids import Triangles


@dataclass(frozen=True)
class Setting:
    """One proportion of a thing, in units of the thing's own size, degrees or a count (its whole part)."""

    low: float
    high: float
    held_out: tuple[float, float] | None = None
    """An open interval within the range, or beside it, that training never draws from."""

    @property
    def trained(self) -> list[tuple[float, float]]:
        """The closed intervals that training draws from."""
        if self.held_out is None:
            return [(self.low, self.high)]
        gap_low, gap_high = self.held_out
        pieces = (self.low, min(self.high, gap_low)), (max(self.low, gap_high), self.high)
        return [(low, high) for low, high in pieces if low < high]

    def drawn(self, unit: float) -> float:
        """The value at a share `unit` in [0, 1] of all that training draws from."""
        pieces = self.trained
        value = pieces[0][0] + sum(high - low for low, high in pieces) * unit
        if len(pieces) == 1 or value <= pieces[0][1]:
            return value
        return max(pieces[1][0], value + (pieces[1][0] - pieces[0][1]))

    def kept(self, unit: float) -> float:
        """The value at a share `unit` in ]0, 1[ of what the test set has: the held-out interval, if there is one."""
        if self.held_out is None:
            return self.drawn(unit)
        low, high = self.held_out
        return low + (high - low) * unit


@dataclass(frozen=True)
class Category:
    """A kind of thing: how it is made of its settings, in the order in which a seed decides them."""

    make: Callable[..., Triangles]
    settings: Mapping[str, Setting]

    @property
    def name(self) -> str:
        """What a person calls it."""
        return self.make.__name__

    def drawn(self, units: Iterable[float]) -> dict[str, float]:
        """Settings for training from numbers in [0, 1], one for each."""
        return {name: s.drawn(unit) for (name, s), unit in zip(self.settings.items(), units, strict=True)}

    def kept(self, units: Iterable[float]) -> dict[str, float]:
        """Settings for the test set from numbers in ]0, 1[, one for each."""
        return {name: s.kept(unit) for (name, s), unit in zip(self.settings.items(), units, strict=True)}


def category(**settings: Setting) -> Callable[[Callable[..., Triangles]], Category]:
    """A decorator that makes a category of a function of its settings; the category has the function's name."""
    return lambda make: Category(make, settings)
