"""The objects that weights are judged on, and the maps that a lidar with noise makes of them on any rig."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from nlos_calibration.arrays import Float32
from nlos_calibration.rig import ObjectBox, Rig
from nlos_models.data import MapSet
from nlos_models.inference import Reconstructor

from nlos_cam.camera.simulated_world import World
from nlos_cam.frames import LidarMaps, maps_from_frame
from nlos_cam.map_mean import MapMean
from nlos_cam.objects.depth_map import image_from_depth
from nlos_cam.objects.placement import object_depth
from nlos_cam.render.renderer import MultiBounce, render
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_file import SceneFile
from nlos_cam.render.sensor.model import SensorModel

OnProgress = Callable[[int, int], None]

QUIET = SensorModel(range_noise_m=0, range_noise_per_m=0, read_noise_counts=0, shot_noise=0, dead_share=0)
"""A sensor without noise or dead pixels; saturation and quantisation stay."""


class Subject(Protocol):
    """An object to judge on; those of the test set are such."""

    @property
    def name(self) -> str:
        """What tables and pictures call it."""
        ...

    @property
    def category(self) -> str:
        """Its kind."""
        ...

    @property
    def depth_m(self) -> Float32:
        """(64, 64); NaN for background."""
        ...


@dataclass(frozen=True)
class SeededObject:
    """A random object."""

    name: str
    category: str
    depth_m: Float32


def seeded_objects(first_seed: int, count: int, box: ObjectBox) -> list[SeededObject]:
    """Random objects by their seeds."""
    made = [object_depth(seed, box) for seed in range(first_seed, first_seed + count)]
    return [SeededObject(f"{category} {first_seed + k}", category, depth) for k, (category, depth) in enumerate(made)]


def truth_of(subjects: Sequence[Subject], box: ObjectBox) -> Float32:
    """The images (n, 64, 64) that a perfect reconstruction would be."""
    return np.stack([image_from_depth(subject.depth_m, box) for subject in subjects])


def echoes_of(subjects: Sequence[Subject], rig: Rig, on_progress: OnProgress) -> list[MultiBounce]:
    """What comes back from each object on a rig, before any sensor."""
    echoes: list[MultiBounce] = []
    for subject in subjects:
        echoes.append(render(Scene(rig, subject.depth_m)).multi)
        on_progress(len(echoes), len(subjects))
    return echoes


def sense(echoes: list[MultiBounce], rig: Rig, sensor: SensorModel | None = None, frames: int = 1) -> list[LidarMaps]:
    """The maps of each echo as `live` makes them: the sensor's chain, cells, and the mean of so many frames.

    The frames are the simulated camera's, bit for bit, without the pace of a device: the same call gives the same maps.
    """
    scene = SceneFile(name="test objects", rig=rig, sensor=sensor or SensorModel())
    world = World(scene, echoes, [None])
    return [_averaged(world, range(k, k + frames * len(echoes), len(echoes))) for k in range(len(echoes))]


def _averaged(world: World, numbers: Sequence[int]) -> LidarMaps:
    mean = MapMean(len(numbers))
    frames = (world.images(number).frame(world.rig.pinhole) for number in numbers)
    return [mean.add(maps_from_frame(frame)) for frame in frames][-1]


def as_map_set(maps: Sequence[LidarMaps], truth: Float32) -> MapSet:
    """Maps beside their truths (n, 64, 64)."""
    return MapSet(np.stack([m.depth_m for m in maps]), np.stack([m.intensity for m in maps]), truth)


def reconstruct_all(reconstructor: Reconstructor, maps: MapSet) -> Float32:
    """Images (n, 64, 64), one object at a time, as live does it."""
    pairs = zip(maps.depth_m, maps.intensity, strict=True)
    return np.concatenate([reconstructor(depth[None], intensity[None]) for depth, intensity in pairs])
