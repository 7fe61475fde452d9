"""Lidar maps in, hidden depth out: pure, no input or output.

How far a reconstruction may be believed, by a small network that sees the maps and what was made of them.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from nlos_calibration import ObjectBox, Rig
from nlos_calibration.arrays import Float32
from nlos_models import MIN_V, UncertaintyModel
from numpy.typing import NDArray

from nlos_cam.frames import OBJECT_PIXELS, LidarMaps
from nlos_cam.objects import depth_from_image, object_box


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


def doubt_of(doubter: UncertaintyModel, maps: LidarMaps, image: Float32, box: ObjectBox) -> Doubt:
    """The doubt of an image (64, 64) in v that networks made of maps."""
    said = doubter(*(array[None] for array in (maps.depth_m, maps.intensity, image)))
    error_m = said.error_v[0] * ((box.z_far_m - box.z_near_m) / (1 - MIN_V))
    return Doubt(float(said.nothing[0]), float(said.outside[0]), error_m, said.surface[0])


Clock = Callable[[], float]
Network = Callable[[Float32, Float32], Float32]
"""depth_m (n, 64, 80) with NaN and intensity (n, 64, 80) to images v (n, 64, 64) in [0, 1]."""


@dataclass(frozen=True)
class Reconstruction:
    """The hidden object as the networks see it."""

    depth_m: Float32
    """(64, 64) over the object box: distance from the wall, NaN where there is no surface."""
    wall_from_object: NDArray[np.float64]
    """(4, 4); the object frame has the wall's axes and its origin on the wall, before the middle of the box."""
    uncertainty_m: Float32 | None
    """(64, 64), finite everywhere: the expected absolute error of `depth_m`, were there a surface; None from networks
    that do not tell."""
    timings_s: Mapping[str, float]
    """Seconds by stage."""
    doubt: Doubt | None = None
    """None from networks that do not tell."""

    @property
    def shows(self) -> bool:
        """Whether there is any surface."""
        return bool(np.isfinite(self.depth_m).any())

    @property
    def hidden(self) -> "Reconstruction":
        """The same without its surface: nothing is shown."""
        return replace(self, depth_m=np.full_like(self.depth_m, np.nan))


def pose_of(box: ObjectBox) -> NDArray[np.float64]:
    """wall_from_object (4, 4) of a box."""
    pose = np.eye(4)
    pose[:2, 3] = (box.x_min_m + box.x_max_m) / 2, (box.y_min_m + box.y_max_m) / 2
    return pose


def reconstruct(
    maps: LidarMaps,
    rig: Rig,
    network: Network,
    clock: Clock = time.perf_counter,
    doubter: UncertaintyModel | None = None,
) -> Reconstruction:
    """The hidden depth behind one frame's maps, and its doubt. Raises SceneError for a rig without an object box."""
    return reconstruct_all([maps], rig, network, clock, doubter)[0]


def reconstruct_all(
    several: Sequence[LidarMaps],
    rig: Rig,
    network: Network,
    clock: Clock = time.perf_counter,
    doubter: UncertaintyModel | None = None,
) -> list[Reconstruction]:
    """The hidden depth behind each of several frames' maps, and its doubt; an equal share of the networks' time each.

    Raises SceneError for a rig without an object box.
    """
    box = object_box(rig)
    start_s = clock()
    images = _images(several, network)
    each_s = (clock() - start_s) / len(several)
    made = zip(several, images, strict=True)
    return [_doubted(_found(image, box, each_s), maps, image, doubter, box, clock) for maps, image in made]


def _images(several: Sequence[LidarMaps], network: Network) -> Float32:
    """(n, 64, 64), in v.

    Maps without any return tell nothing, so nothing is made of them: the networks, which take a cell without a return
    for an average one, would show an average object.
    """
    images = np.zeros((len(several), OBJECT_PIXELS, OBJECT_PIXELS), np.float32)
    if telling := [index for index, maps in enumerate(several) if maps.valid.any()]:
        depth_m = np.stack([several[index].depth_m for index in telling])
        images[telling] = network(depth_m, np.stack([several[index].intensity for index in telling]))
    return images


def _found(image: Float32, box: ObjectBox, network_s: float) -> Reconstruction:
    return Reconstruction(depth_from_image(image, box), pose_of(box), None, {"network": network_s})


def _doubted(
    found: Reconstruction,
    maps: LidarMaps,
    image: Float32,
    doubter: UncertaintyModel | None,
    box: ObjectBox,
    clock: Clock,
) -> Reconstruction:
    if doubter is None:
        return found
    start_s = clock()
    doubt = doubt_of(doubter, maps, image, box)
    timings_s = {**found.timings_s, "doubt": clock() - start_s}
    return replace(found, uncertainty_m=doubt.error_m, timings_s=timings_s, doubt=doubt)
