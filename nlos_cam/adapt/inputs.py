"""Training maps of an adaptation, in each of its modes: the rig's own cells, those of the wall
grid, or locked differences.
"""

from dataclasses import dataclass
from typing import Any, Self

from nlos_calibration import Rig
from nlos_models import CheckpointRecord

from nlos_cam.adapt.locked import LockedNoise
from nlos_cam.adapt.plan import Locked
from nlos_cam.reconstruct import check_alignable, grid_of, recorded_counts
from nlos_cam.render import SensorModel


@dataclass(frozen=True)
class TrainingInputs:
    """Maps that a network is trained on, and the rig that its record names for them."""

    rig: tuple[str, str]
    """Name and checksum of the rig in the weights' record: of the wall grid's maps its checksum,
    and none of locked differences, by which no bench takes the weights for those of its maps."""
    bench: dict[str, Any] | None
    """Fields of the measured rig in that record; None for locked differences."""
    trained: CheckpointRecord | None
    """Record of the start weights, whose normalization serves maps of their own cells alone; None
    for a normalization that is fitted to the maps, and always taken."""
    frame: Rig | None = None
    """Wall grid that maps are aligned with; None where they stay in the rig's own cells."""
    bare_wall_counts: float | None = None
    """Counts of the brightest bare wall in maps of the rig's own cells; None for those of the
    simulated sensor, as all light on the wall grid is."""
    noise: LockedNoise | None = None
    """Noise of locked differences; None for maps, whose noise is the sensor's."""

    @classmethod
    def of_maps(cls, rig: Rig, sensor: SensorModel, trained: CheckpointRecord) -> Self:
        """Return the maps of a rig for start weights: on the wall grid where they were trained on
        it, else in the rig's own cells.

        Raises SceneError where the rig sees too little of the wall grid.
        """
        bench = rig.model_dump(mode="json")
        grid = grid_of(trained)
        if grid is None:
            counts = recorded_counts(sensor)
            return cls((rig.name, rig.checksum), bench, trained, bare_wall_counts=counts)
        check_alignable(rig, trained)
        return cls((rig.name, grid.checksum), bench, trained, frame=grid)

    @classmethod
    def of_locked(cls, rig: Rig, sensor: SensorModel, locked: Locked) -> Self:
        """Return the locked differences of a rig."""
        name = f"{rig.name} (locked differences)"
        return cls((name, ""), None, None, noise=LockedNoise.of(rig, sensor, locked))
