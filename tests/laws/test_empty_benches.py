"""Empty benches: on any rig that the paper allows, neither check finds anything in them."""

from functools import lru_cache

import numpy as np
import pytest
from nlos_calibration import Rig, load_rig

from nlos_cam.dataset import RigRange
from nlos_cam.frames import LidarMaps, maps_from_frame
from nlos_cam.reconstruct import CalibratedRig
from nlos_cam.reconstruct.consistency import MapConsistency
from nlos_cam.reconstruct.physics_check import UNEXPLAINED_EMPTY, check_reconstruction
from nlos_cam.render import Scene, Sensor, SensorModel, render

FIRST_SEED = 71_000_000


@lru_cache(maxsize=1)
def rigs() -> dict[str, Rig]:
    """The packaged rigs with an object, and some out of all that the paper allows; of the fourth
    and the twelfth the far cells return a count or two.
    """
    home = load_rig("paper-rig")
    drawn = {f"rig {k}": RigRange().draw(home, FIRST_SEED + k) for k in (0, 2, 3, 8, 10)}
    return {"paper-rig": home, "wide-rig": load_rig("wide-rig"), **drawn}


def empty_maps(rig: Rig, seed: int, counts: float = 48.0) -> LidarMaps:
    echoes = render(Scene(rig)).multi
    sensor = Sensor(rig, SensorModel(bare_wall_counts=counts))
    images = sensor.expose(echoes, np.random.default_rng(seed))
    return maps_from_frame(images.frame(rig.pinhole))


@pytest.mark.parametrize("name", ["paper-rig", "wide-rig", *(f"rig {k}" for k in (0, 2, 3, 8, 10))])
def test_an_empty_bench_shows_nothing(name: str) -> None:
    rig = rigs()[name]
    consistency = MapConsistency(CalibratedRig(rig))

    for seed in range(1, 4):
        maps = empty_maps(rig, seed)
        assert consistency.examine(maps).problems == ()
        assert check_reconstruction(maps, None, rig).score < UNEXPLAINED_EMPTY / 5


@pytest.mark.parametrize("counts", [12.0, 24.0, 160.0])
@pytest.mark.parametrize("name", ["paper-rig", "wide-rig", "rig 0"])
def test_a_dark_or_bright_wall_is_no_object(name: str, counts: float) -> None:
    rig = rigs()[name]
    maps = empty_maps(rig, 1, counts)

    assert check_reconstruction(maps, None, rig).score < UNEXPLAINED_EMPTY / 2
