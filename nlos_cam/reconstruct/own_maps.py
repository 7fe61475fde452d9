"""Maps of a bench for weights that were trained for its own rig."""

from typing import NamedTuple

from nlos_cam.frames import LidarMaps
from nlos_cam.reconstruct.bench import CalibratedRig
from nlos_cam.reconstruct.edge import EdgeRepair
from nlos_cam.reconstruct.flat_field import FlatField


class CorrectedMaps(NamedTuple):
    """Maps (64, 80) after each step of their correction."""

    ranged: LidarMaps
    """Less the range offset, and its drift."""
    repaired: LidarMaps
    """With the cells at the occluder's edge as the record has it; `ranged` itself where they are."""
    exact: LidarMaps
    """As an exact lidar would give them on the bench's record, of a uniform wall."""

    @property
    def edge_is_repaired(self) -> bool:
        """Whether cells at the occluder's edge were not as the record has it."""
        return self.repaired is not self.ranged


class OwnMaps:
    """Correction of a frame's maps for the bench's own weights: range offset, cells at the
    occluder's edge, reflectance of the wall and ripples of the lidar.
    """

    def __init__(self, bench: CalibratedRig) -> None:
        self._bench = bench
        self._edge = EdgeRepair(bench)
        self._flat_field = FlatField(bench)

    def steps(self, maps: LidarMaps, drift_m: float = 0.0) -> CorrectedMaps:
        """Return maps after each step; `drift_m` is that of the range since the wall was
        measured.
        """
        ranged = self._bench.correct_range(maps, drift_m)
        repaired = self._edge.repair(ranged)
        return CorrectedMaps(ranged, repaired, self._flat_field.correct(repaired))

    def correct(self, maps: LidarMaps, drift_m: float = 0.0) -> LidarMaps:
        """Return maps after the last step."""
        return self.steps(maps, drift_m).exact

    def as_rendered(self, exact: LidarMaps) -> LidarMaps:
        """Return maps after the last step as the renderer computes them."""
        return self._flat_field.as_rendered(exact)
