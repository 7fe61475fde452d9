"""The accuracy dial: named stops, each a documented setting."""

from dataclasses import dataclass
from typing import Literal

from nlos_cam.errors import SceneError

Stop = Literal["draft", "standard", "fine", "reference"]


@dataclass(frozen=True)
class Accuracy:
    """What a stop of the dial sets."""

    name: str
    relay_columns: int
    relay_rows: int
    sub_bins: int
    """Table bins per bin of path length; 0 is the brute-force reference."""
    tolerance: float
    """What the effects that a plan leaves out may change together, as relative L1 of the transient."""


STOPS = {
    "draft": Accuracy("draft", 40, 32, 1, 3e-2),
    "standard": Accuracy("standard", 80, 64, 1, 1e-3),
    "fine": Accuracy("fine", 80, 64, 4, 1e-4),
    "reference": Accuracy("reference", 80, 64, 0, 0.0),
}


def accuracy_named(name: str) -> Accuracy:
    """The setting behind a stop's name. Raises SceneError where there is no such stop."""
    if name not in STOPS:
        raise SceneError(f"no accuracy {name!r}: choose one of {', '.join(STOPS)}")
    return STOPS[name]
