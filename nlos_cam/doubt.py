"""How far a reconstruction may be believed, by a small network that sees the maps and what was made of them."""

from dataclasses import dataclass

from nlos_calibration.arrays import Float32
from nlos_calibration.rig import ObjectBox
from nlos_models.doubt_inference import Doubter
from nlos_models.metrics import LEAST_V

from nlos_cam.frames import LidarMaps


@dataclass(frozen=True)
class Doubt:
    """What is known of a reconstruction beside itself."""

    nothing: float
    """Probability that nothing is hidden."""
    outside: float
    """Probability that what is hidden is unlike anything that the networks were trained on."""
    error_m: Float32
    """(64, 64): expected absolute error of the hidden depth, were there a surface; finite everywhere."""
    surface: Float32
    """(64, 64): probability that there is a surface."""


def doubt_of(doubter: Doubter, maps: LidarMaps, image: Float32, box: ObjectBox) -> Doubt:
    """The doubt of an image (64, 64) in v that networks made of maps."""
    said = doubter(*(array[None] for array in (maps.depth_m, maps.intensity, image)))
    error_m = said.error_v[0] * ((box.z_far_m - box.z_near_m) / (1 - LEAST_V))
    return Doubt(float(said.nothing[0]), float(said.outside[0]), error_m, said.surface[0])
