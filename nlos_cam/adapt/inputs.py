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
    """Rig name and checksum for the record of the new weights. The checksum is the wall grid's
    where maps are aligned with it. It is empty for locked differences: by the rig's own checksum,
    `live` would take the weights for weights of the rig's maps."""
    bench: dict[str, Any] | None
    """Fields of the rig, for the same record; None for locked differences."""
    trained: CheckpointRecord | None
    """Record of the start weights. Their normalization is used if they were trained for the rig
    that the maps are aligned with, else one is fitted to the maps. None: the start network's
    normalization is used as it stands, since `LockedNoise.fitted` has set it."""
    maps_rig: Rig | None = None
    """Wall grid that the maps are aligned with; None where they stay in the rig's own cells."""
    bare_wall_counts: float | None = None
    """Counts of the brightest bare wall, for the same record; None for the simulated sensor's, to
    which all maps on the wall grid are scaled."""
    noise: LockedNoise | None = None
    """Noise of locked differences; None for maps, to which training adds the sensor's noise."""

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
        return cls((rig.name, grid.checksum), bench, trained, maps_rig=grid)

    @classmethod
    def of_locked(cls, rig: Rig, sensor: SensorModel, locked: Locked) -> Self:
        """Return the locked differences of a rig."""
        name = f"{rig.name} (locked differences)"
        return cls((name, ""), None, None, noise=LockedNoise.of(rig, sensor, locked))
