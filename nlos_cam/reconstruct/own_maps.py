"""Maps of a bench for weights that were trained for its own rig."""

from nlos_cam.frames import LidarMaps
from nlos_cam.reconstruct.bench import CalibratedRig
from nlos_cam.reconstruct.edge import EdgeRepair
from nlos_cam.reconstruct.flat_field import FlatField


class OwnMaps:
    """Correction of a frame's maps as a `Pipeline` makes it for the bench's own weights: range
    offset, cells at the occluder's edge, reflectance of the wall and ripples of the lidar.
    """

    def __init__(self, bench: CalibratedRig) -> None:
        self._bench = bench
        self._edge = EdgeRepair(bench)
        self._flat_field = FlatField(bench)

    def correct(self, maps: LidarMaps, drift_m: float = 0.0) -> LidarMaps:
        """Return maps (64, 80) as an exact lidar would give them on the bench's record; `drift_m`
        is that of the range since.
        """
        ranged = self._bench.correct_range(maps, drift_m)
        return self._flat_field.correct(self._edge.repair(ranged))
