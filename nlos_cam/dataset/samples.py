"""Seeds to samples: a hidden object, its rig, its rendering and its noise, each by the object's seed alone.

Torch is not imported here: every worker would wait for it, and has no use for it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration import ObjectBox, Rig
from nlos_calibration.arrays import Float32
from numpy.typing import NDArray

from nlos_cam.dataset.plan import DatasetPlan, Objects, scene_row
from nlos_cam.errors import SceneError
from nlos_cam.frames import LidarMaps, maps_from_frame
from nlos_cam.objects import (
    Coat,
    MeshFile,
    folder_objects,
    image_from_albedo,
    image_from_depth,
    mesh_depth,
    object_depth,
    object_depths,
    painted,
    read_mesh,
)
from nlos_cam.render import Radiometry, Scene, Sensor, SensorModel, Surface, render

Samples = Mapping[str, NDArray[Any]]
"""By name, one row for each object: depth_m and intensity (n, 64, 80), image and object_depth_m (n, 64, 64), seed (n,),
scene (n, 6), category (n,). In colour intensity is (n, 3, 64, 80), image (n, 3, 64, 64), and there is texture (n,)."""


def silent(*_: object) -> None:
    """Tell nobody how far it is."""


def procedural_images(
    first_seed: int,
    count: int,
    box: ObjectBox,
    categories: Sequence[str] | None = None,
    *,
    backgrounds: float = 0.0,
    textures: Sequence[str] = (),
) -> NDArray[np.float16]:
    """Images (count, 64, 64) of random objects, without rendering: all that a VAE needs; see `object_depth`.

    With textures, in colour: (count, 3, 64, 64).
    """
    seeds = range(first_seed, first_seed + count)
    depths = object_depths(seeds, box, categories, backgrounds=backgrounds)
    pairs = zip(seeds, depths, strict=True)
    return np.stack([_image(depth, box, _coat(seed, depth, textures)).astype(np.float16) for seed, depth in pairs])


def sense_object(scene: Scene, sensor: Sensor, seed: int, accuracy: str = "standard", exposure: int = 0) -> LidarMaps:
    """The maps of one hidden object, rendered, through the sensor's chain and the same reduction as live frames."""
    echoes = render(scene, accuracy).multi
    images = sensor.expose(echoes, np.random.default_rng([seed, 1, exposure]))  # numpy: [seed, 1, 0] is [seed, 1]
    return maps_from_frame(images.frame(sensor.rig.pinhole))


def sense_colour(scene: Scene, sensor: Sensor, seed: int, accuracy: str = "standard") -> LidarMaps:
    """The same of an object whose albedo has three channels: intensity is (3, 64, 80). Simulation only.

    The lidar that this simulates has three lasers and one detector: each instant is exposed once in white (every laser
    at a third of its power), which gives the depth, and once in red, green and blue, which give the intensities. Each
    exposure is the whole device, with the same gain and noise of its own.
    """
    albedo = np.asarray(scene.surface.albedo)
    lights = (albedo.mean(-1), *np.moveaxis(albedo, -1, 0))
    seen = (replace(scene, surface=Surface(light, scene.surface.brdf)) for light in lights)
    white, *colours = (sense_object(one, sensor, seed, accuracy, exposure) for exposure, one in enumerate(seen))
    return replace(white, intensity=np.stack([maps.intensity for maps in colours]))


def make_samples(plan: DatasetPlan, seeds: Sequence[int]) -> Samples:
    """The samples of some seeds: the same bits wherever and in whatever order they are made."""
    made = [hidden_object(plan.objects, seed, plan.box) for seed in seeds]
    seen = [plan.spread.drawn(plan.rig, plan.sensor, seed) for seed in seeds]
    coats = [_coat(seed, depth_m, plan.textures) for seed, (_, depth_m) in zip(seeds, made, strict=True)]
    maps = [
        _sensed(plan, depth_m, coat, rig, model, seed)
        for (_, depth_m), coat, (rig, model), seed in zip(made, coats, seen, seeds, strict=True)
    ]
    images = [_image(depth, plan.box, coat) for (_, depth), coat in zip(made, coats, strict=True)]
    textures = [coat.texture for coat in coats if coat]
    return {
        "depth_m": np.stack([m.depth_m for m in maps]),
        "intensity": np.stack([m.intensity for m in maps]),
        "image": np.stack(images).astype(np.float16),
        "object_depth_m": np.stack([depth for _, depth in made]),
        "seed": np.asarray(seeds, np.int64),
        "scene": np.array([scene_row(rig, model) for rig, model in seen]),
        "category": np.array([category for category, _ in made], object),
        **({"texture": np.array(textures, object)} if textures else {}),
    }


def _coat(seed: int, depth_m: Float32, textures: Sequence[str]) -> Coat | None:
    return painted(seed, depth_m, textures) if textures else None


def _image(depth_m: Float32, box: ObjectBox, coat: Coat | None) -> Float32:
    return image_from_albedo(coat.albedo, depth_m) if coat else image_from_depth(depth_m, box)


def _sensed(
    plan: DatasetPlan, depth_m: Float32, coat: Coat | None, rig: Rig, model: SensorModel, seed: int
) -> LidarMaps:
    scene, sensor = _scene(plan, depth_m, rig, model), _sensor_of(plan, rig, model)
    if coat is None:
        return sense_object(scene, sensor, seed, plan.accuracy)
    return sense_colour(replace(scene, surface=Surface(coat.albedo, plan.material.brdf)), sensor, seed, plan.accuracy)


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
