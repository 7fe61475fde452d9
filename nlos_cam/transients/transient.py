"""Transient: light at points of a relay wall over path length, with the geometry of its capture."""

import json
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from nlos_calibration.arrays import Float32, Float64


class Layout(IntEnum):
    """Axes of the histograms, in tal's numbers: T is time, S a point of the detector, L one of the
    laser.
    """

    T_Sx_Sy = 1
    T_Lx_Ly_Sx_Sy = 2
    T_Si = 3
    T_Li_Si = 4

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes in order."""
        return tuple(self.name.split("_"))


@dataclass(frozen=True)
class Transient:
    """Histograms over path length with the points of the wall that they belong to, in meters.

    A layout without a laser's axis has one laser point for all, or one for each detector's point.
    """

    histograms: Float32
    """(T, ...); as the layout says."""
    layout: Layout
    laser_grid_m: Float64
    """(n, 3) or (x, y, 3); points that the laser lights."""
    detector_grid_m: Float64
    """(n, 3) or (x, y, 3); points that the detector looks at."""
    bin_m: float
    """Path length of a bin: 1 cm is 33 ps."""
    start_m: float = 0.0
    """Path length at which the first bin begins."""
    first_and_last: bool = True
    """True if path lengths include the legs from the laser to the wall and from it to the
    detector.
    """
    laser_m: Float64 | None = None
    """(3,); the laser itself. None if not known, like `detector_m`."""
    detector_m: Float64 | None = None
    laser_normals: Float64 | None = None
    """As laser_grid_m; normals of the wall. None if not known, like `detector_normals`."""
    detector_normals: Float64 | None = None
    scene: str = ""
    """Description of the scene, as YAML or JSON."""

    @property
    def bins(self) -> int:
        """Number of bins."""
        return len(self.histograms)

    @property
    def end_m(self) -> float:
        """Path length at which the last bin ends."""
        return self.start_m + self.bins * self.bin_m

    @property
    def paired(self) -> bool:
        """True if each detector's point has a laser point of its own, as in confocal captures."""
        # A list of points may stand for a grid, so that only their numbers are compared.
        one_axis = self.layout in {Layout.T_Sx_Sy, Layout.T_Si}
        return one_axis and self.laser_grid_m.size == self.detector_grid_m.size

    @property
    def kind(self) -> str:
        """Kind of capture in words."""
        lasers, detectors = self.points
        if self.paired and np.allclose(lasers, detectors):
            return "confocal"
        if self.paired:
            return "pairs of points"
        if len(detectors) == 1:
            return "scanned laser, one detector"
        return "one laser point, scanned detector" if len(lasers) == 1 else "exhaustive"

    @property
    def points(self) -> tuple[Float64, Float64]:
        """Laser points (l, 3) and detector's points (s, 3)."""
        return self.laser_grid_m.reshape(-1, 3), self.detector_grid_m.reshape(-1, 3)

    @property
    def matrix(self) -> Float32:
        """(T, l, s); histograms of each pair, or (T, 1, s) if paired."""
        lasers = 1 if self.paired else len(self.points[0])
        return self.histograms.reshape(self.bins, lasers, -1)

    @property
    def curve(self) -> Float64:
        """(T,); sum over all points."""
        return self.histograms.reshape(self.bins, -1).sum(1, dtype=np.float64)

    def facts(self) -> dict[str, Any]:
        """Return the description of the scene if nlos-cam wrote it, else an empty one."""
        try:
            found = json.loads(self.scene)
        except (ValueError, RecursionError):
            return {}
        return found if isinstance(found, dict) else {}
