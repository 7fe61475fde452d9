"""Seeds to samples: a hidden object, its rig, its rendering and its noise, each by the object's seed alone.

Torch is not imported here: every worker would wait for it, and has no use for it.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration.rig import ObjectBox, Rig
from numpy.typing import NDArray

from nlos_cam.dataset_plan import DatasetPlan, Objects, scene_row
from nlos_cam.errors import SceneError
from nlos_cam.frames import Float32, LidarMaps, maps_from_frame
from nlos_cam.objects.depth_image import image_from_depth
from nlos_cam.objects.files import MeshFile, read_mesh
from nlos_cam.objects.hidden import object_depth, object_depths
from nlos_cam.objects.mesh_folder import folder_objects, mesh_depth
from nlos_cam.render.renderer import render
from nlos_cam.render.scene import Radiometry, Scene
from nlos_cam.render.sensor import Sensor
from nlos_cam.render.sensor_model import SensorModel

Samples = Mapping[str, NDArray[Any]]
"""By name, one row for each object: depth_m and intensity (n, 64, 80), image and object_depth_m (n, 64, 64), seed (n,),
scene (n, 6), category (n,)."""


def silent(*_: object) -> None:
    """Tell nobody how far it is."""


def procedural_images(
    first_seed: int,
    count: int,
    box: ObjectBox,
    categories: Sequence[str] | None = None,
    *,
    backgrounds: float = 0.0,
) -> NDArray[np.float16]:
    """Images (count, 64, 64) of random objects, without rendering: all that a VAE needs; see `object_depth`."""
    depths = object_depths(range(first_seed, first_seed + count), box, categories, backgrounds=backgrounds)
    return np.stack([image_from_depth(depth, box).astype(np.float16) for depth in depths])


def sense_object(scene: Scene, sensor: Sensor, seed: int, accuracy: str = "standard") -> LidarMaps:
    """The maps of one hidden object, rendered, through the sensor's chain and the same reduction as live frames."""
    echoes = render(scene, accuracy).multi
    images = sensor.expose(echoes, np.random.default_rng([seed, 1]))
    return maps_from_frame(images.frame(sensor.rig.pinhole))


def make_samples(plan: DatasetPlan, seeds: Sequence[int]) -> Samples:
    """The samples of some seeds: the same bits wherever and in whatever order they are made."""
    made = [hidden_object(plan.objects, seed, plan.box) for seed in seeds]
    seen = [plan.spread.drawn(plan.rig, plan.sensor, seed) for seed in seeds]
    maps = [
        sense_object(_scene(plan, depth_m, rig, model), _sensor_of(plan, rig, model), seed, plan.accuracy)
        for (_, depth_m), (rig, model), seed in zip(made, seen, seeds, strict=True)
    ]
    return {
        "depth_m": np.stack([m.depth_m for m in maps]),
        "intensity": np.stack([m.intensity for m in maps]),
        "image": np.stack([image_from_depth(depth, plan.box) for _, depth in made]).astype(np.float16),
        "object_depth_m": np.stack([depth for _, depth in made]),
        "seed": np.asarray(seeds, np.int64),
        "scene": np.array([scene_row(rig, model) for rig, model in seen]),
        "category": np.array([category for category, _ in made], object),
    }


def joined(parts: Sequence[Samples]) -> Samples:
    """Samples one after the other."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def hidden_object(objects: Objects, seed: int, box: ObjectBox) -> tuple[str, Float32]:
    """One random object: its category or its mesh's path, and its depth map (64, 64) in metres, NaN background."""
    if not objects.meshes:
        return object_depth(seed, box, objects.categories, backgrounds=objects.backgrounds)
    if (folder := objects.folder) is None:
        raise SceneError("this dataset hides meshes: name their folder with --objects")
    (name, _), depth_m = mesh_depth(seed, objects.meshes, box, read=lambda mesh: _unchanged(folder / mesh[0], mesh[1]))
    return name, depth_m


def objects_of(folder: Path, on_progress: Callable[[int, int], None] = silent) -> Objects:
    """The meshes of a folder and its subfolders. Raises SceneError where there is none, or one that cannot be used.

    It reads them all: `on_progress` hears how many are done, and how many there are.
    """
    found, meshes = folder_objects(folder), list[tuple[str, str]]()
    for path in found:
        meshes.append((_told(path.relative_to(folder)), read_mesh(path).sha256))
        on_progress(len(meshes), len(found))
    return Objects((), tuple(meshes), folder=folder.resolve())


def _told(path: Path) -> str:
    """A mesh as shards tell it. Raises SceneError for a name that no shard can hold."""
    try:
        return path.as_posix().encode().decode()
    except UnicodeEncodeError as error:
        raise SceneError(f"the name of the mesh {path.as_posix()!a} is not UTF-8: rename it") from error


@lru_cache(maxsize=16)
def _unchanged(path: Path, sha256: str) -> MeshFile:
    mesh = read_mesh(path)
    if mesh.sha256 != sha256:
        raise SceneError(f"{path} changed since the dataset was begun: put it back, or choose another --out")
    return mesh


@lru_cache(maxsize=1)
def _sensor(rig: Rig, model: SensorModel, radiometry: Radiometry) -> Sensor:
    return Sensor(rig, model, radiometry)


def _sensor_of(plan: DatasetPlan, rig: Rig, model: SensorModel) -> Sensor:
    return _sensor(rig, model, plan.radiometry)  # pyright: ignore[reportArgumentType]  frozen, so hashable


def _scene(plan: DatasetPlan, depth_m: Float32, rig: Rig, sensor: SensorModel) -> Scene:
    return Scene(rig, depth_m, plan.material.surface, plan.radiometry, plan.jump_m, sensor.pulse_ns)
