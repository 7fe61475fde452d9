"""Accuracy of a rendering: named stops, each a documented setting."""

from dataclasses import dataclass
from typing import Literal

from nlos_cam.errors import SceneError, UnknownNameError, did_you_mean

Stop = Literal["draft", "standard", "fine", "reference"]
MAX_RELAY_CELLS = 512
"""Limit along each side of the relay wall."""
MAX_BEAMS_PER_CELL = 8


@dataclass(frozen=True)
class Accuracy:
    """Setting of a stop. Raises SceneError for a value that no renderer supports."""

    name: str
    relay_columns: int = 80
    relay_rows: int = 64
    sub_bins: int = 8
    """Table bins per bin of path length, a power of two; 0 is the brute-force reference."""
    object_stride: int = 1
    """Cells of the depth map, along each axis, that form one patch."""
    finest_cells: int = 0
    """Cells along a side of a depth map; finer maps join cells so that patches keep their size, and
    0 joins none.
    """
    sectors: int = 16
    """Sectors per face of the horizon tables: affects time, not the result."""
    beams_per_cell: int = 1
    """Beams along each axis of a map cell."""
    scatter_error: float = 5e-3
    """Error (relative L1) of a BRDF's values, for which its lattice has as many nodes as it takes."""
    tolerance: float = 1e-3
    """Largest change (relative L1 of the transient) by all effects that a plan leaves out
    together.
    """

    def __post_init__(self) -> None:
        ranges = {
            "relay_columns": (1, MAX_RELAY_CELLS),
            "relay_rows": (1, MAX_RELAY_CELLS),
            "object_stride": (1, 16),
            "finest_cells": (0, 4096),
            "sectors": (1, 256),
            "beams_per_cell": (1, MAX_BEAMS_PER_CELL),
            "scatter_error": (1e-4, 1),
            "tolerance": (0, 1),
        }
        for field, (least, most) in ranges.items():
            if not least <= (value := getattr(self, field)) <= most:
                raise SceneError(f"{field} is {value}: it must be from {least} to {most}")
        if self.sub_bins not in {0, 1, 2, 4, 8, 16, 32, 64}:
            raise SceneError(
                f"sub_bins is {self.sub_bins}: it must be a power of two up to 64, or 0 for brute"
                " force"
            )


STOPS = {
    "draft": Accuracy(
        "draft",
        40,
        32,
        sub_bins=4,
        object_stride=2,
        finest_cells=64,
        scatter_error=3e-2,
        tolerance=3e-2,
    ),
    "standard": Accuracy("standard", finest_cells=96, scatter_error=1.5e-2),
    "fine": Accuracy("fine", sub_bins=64, scatter_error=1e-3, tolerance=1e-4),
    "reference": Accuracy("reference", sub_bins=0, tolerance=0.0),
}


def accuracy_named(name: str | Accuracy) -> Accuracy:
    """Return the setting of a stop's name. Raises UnknownNameError if there is no such stop."""
    if isinstance(name, Accuracy):
        return name
    if name not in STOPS:
        raise UnknownNameError(
            f"no accuracy {name!r}.{did_you_mean(name, STOPS)} Choose one of {', '.join(STOPS)}"
        )
    return STOPS[name]
