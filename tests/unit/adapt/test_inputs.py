"""Training maps of an adaptation, in each of its modes."""

import pytest
from nlos_calibration import Rig, load_rig
from nlos_models import load_record, shipped_folder

from nlos_cam.adapt import Locked
from nlos_cam.adapt.inputs import TrainingInputs
from nlos_cam.errors import SceneError
from nlos_cam.reconstruct import WALL_GRID
from nlos_cam.render import SensorModel

RIG = load_rig("paper-rig")
SENSOR = SensorModel(bare_wall_counts=60.0)
TRAINED = load_record(shipped_folder("direct"))
ON_GRID = TRAINED.model_copy(update={"rig_checksum": WALL_GRID.checksum})


def test_maps_stay_in_the_cells_of_the_bench() -> None:
    inputs = TrainingInputs.of_maps(RIG, SENSOR, TRAINED)

    assert inputs.maps_rig is None
    assert inputs.noise is None
    assert inputs.trained is TRAINED
    assert inputs.rig == (RIG.name, RIG.checksum)
    assert inputs.bare_wall_counts == 60.0
    assert Rig.model_validate(inputs.bench) == RIG


def test_maps_are_on_the_grid_that_start_weights_know() -> None:
    inputs = TrainingInputs.of_maps(RIG, SENSOR, ON_GRID)

    assert inputs.maps_rig is WALL_GRID
    assert inputs.trained is ON_GRID
    assert inputs.rig == (RIG.name, WALL_GRID.checksum)
    assert inputs.bare_wall_counts is None
    assert Rig.model_validate(inputs.bench) == RIG


def test_rig_that_does_not_see_the_grid_is_refused() -> None:
    bare = RIG.model_copy(update={"occluder": None})

    with pytest.raises(SceneError, match="--weights"):
        TrainingInputs.of_maps(bare, SENSOR, ON_GRID)


def test_weights_of_locked_differences_name_no_rig() -> None:
    inputs = TrainingInputs.of_locked(RIG, SensorModel(pulse_ns=1.0), Locked(frames=9000))

    assert inputs.noise is not None
    assert inputs.rig[1] == ""
    assert inputs.bench is None
    assert inputs.maps_rig is None
    assert inputs.trained is None
