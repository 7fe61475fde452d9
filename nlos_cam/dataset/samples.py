"""Samples by seed: a hidden object, its rig, its rendering and its noise depend on the object's
seed alone.

Torch must not be imported here: workers do not need it, and its import takes seconds.
"""

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration import ObjectBox, Rig
from nlos_calibration.arrays import Float32
from numpy.typing import NDArray

from nlos_cam import objects as shapes
from nlos_cam.dataset.locked import LOCKED, locked_difference
from nlos_cam.dataset.plan import DatasetPlan, Objects, scene_row
from nlos_cam.errors import SceneError, SceneFileError
from nlos_cam.frames import LidarMaps
from nlos_cam.render import Radiometry, Scene, Sensor, SensorModel, Surface, render, render_all

Samples = Mapping[str, NDArray[Any]]
"""Arrays with one row per object: depth_m and intensity (n, 64, 80), image and object_depth_m (n,
64, 64), seed (n,), scene (n, 6), category (n,). In color intensity is (n, 3, 64, 80), image (n, 3,
64, 64), and there is texture (n,)."""

_SHARE_STREAM = 3
"""Stream of an object's random numbers that decides whether it is generic; see
`plan._RIG_STREAM`.
"""

OnProgress = Callable[[int, int], None]
"""Callback with the count of finished items, and of all."""


def ignore(*_: object) -> None:
    """Do nothing: the default of callbacks."""


Tracked = Callable[[str], AbstractContextManager[OnProgress]]
"""Opens a progress bar with a description; yields the function that takes (done, total)."""


@contextmanager
def untracked(description: str) -> Generator[OnProgress]:
    """Show no progress."""
    del description
    yield ignore


def procedural_images(
    first_seed: int,
    count: int,
    box: ObjectBox,
    categories: Sequence[str] | None = None,
    *,
    backgrounds: float = 0.0,
    textures: Sequence[str] = (),
) -> NDArray[np.float16]:
    """Return images (count, 64, 64) of random objects without rendering, as a VAE needs them; see
    `object_depth`.

    With textures, they are in color: (count, 3, 64, 64).
    """
    images = list[NDArray[np.float16]]()
    for seed in range(first_seed, first_seed + count):
        depth_m = shapes.object_depth(seed, box, categories, backgrounds=backgrounds)[1]
        images.append(_image(depth_m, box, coat_of(seed, depth_m, textures)).astype(np.float16))
    return np.stack(images)


def sense_object(
    scene: Scene,
    sensor: Sensor,
    seed: int,
    accuracy: str = "standard",
    exposure: int = 0,
    *,
    expected: bool = False,
) -> LidarMaps:
    """Return the maps of one rendered scene, by the sensor model and the reduction of live frames,
    or expected ones.
    """
    return sensor.maps(render(scene, accuracy).multi, _noise(seed, exposure, expected=expected))


def _noise(seed: int, exposure: int = 0, *, expected: bool) -> np.random.Generator | None:
    """Return the generator of an exposure's noise; None for expected maps."""
    return None if expected else np.random.default_rng([seed, 1, exposure])


def sense_color(
    scene: Scene, sensor: Sensor, seed: int, accuracy: str = "standard", *, expected: bool = False
) -> LidarMaps:
    """Return the maps of a scene whose albedo has three channels; intensity is (3, 64, 80).
    Simulation only.

    The simulated lidar has three lasers and one detector. It exposes each instant four times, each
    time with the same gain and new noise: in white (each laser at a third of its power) for the
    depth, and in red, green and blue.
    """
    albedo = np.asarray(scene.surface.albedo)
    surfaces = [
        Surface(light, scene.surface.brdf)
        for light in (albedo.mean(-1), *np.moveaxis(albedo, -1, 0))
    ]
    if scene.radiometry == "lambertian":
        # Light between parts of the object is that of each color, not that of the mean albedo.
        surfaces[0] = scene.surface
    scenes = (replace(scene, surface=surface) for surface in surfaces)
    white, *colors = (
        sense_object(one, sensor, seed, accuracy, exposure, expected=expected)
        for exposure, one in enumerate(scenes)
    )
    return replace(white, intensity=np.stack([maps.intensity for maps in colors]))


def make_samples(plan: DatasetPlan, seeds: Sequence[int], backend: str = "cpu") -> Samples:
    """Return the samples of some seeds, with the same bits on any machine and in any order.

    By another backend of the renderer, which takes them in batches, the last digits differ.
    """
    objects = [hidden_object(plan.objects, seed, plan.box) for seed in seeds]
    rigs = [plan.bench_of(seed) for seed in seeds]
    coats = [
        coat_of(seed, depth_m, plan.textures)
        for seed, (_, depth_m) in zip(seeds, objects, strict=True)
    ]
    if backend == "cpu":
        maps = [
            _sense(plan, depth_m, coat, rig, model, seed)
            for (_, depth_m), coat, (rig, model), seed in zip(
                objects, coats, rigs, seeds, strict=True
            )
        ]
    else:
        depths_m = [depth_m for _, depth_m in objects]
        maps = _sense_in_batches(plan, depths_m, rigs, seeds, backend)
    images = [
        _image(depth, plan.box, coat) for (_, depth), coat in zip(objects, coats, strict=True)
    ]
    textures = [coat.texture for coat in coats if coat]
    return {
        "depth_m": np.stack([m.depth_m for m in maps]),
        "intensity": np.stack([m.intensity for m in maps]),
        "image": np.stack(images).astype(np.float16),
        "object_depth_m": np.stack([depth for _, depth in objects]),
        "seed": np.asarray(seeds, np.int64),
        "scene": np.array([scene_row(rig, model) for rig, model in rigs]),
        "category": np.array([category for category, _ in objects], object),
        **({"texture": np.array(textures, object)} if textures else {}),
    }


def coat_of(seed: int, depth_m: Float32, textures: Sequence[str]) -> shapes.Coat | None:
    """Return the paint of an object; None without textures."""
    return shapes.paint(seed, depth_m, textures) if textures else None


def _image(depth_m: Float32, box: ObjectBox, coat: shapes.Coat | None) -> Float32:
    return (
        shapes.image_from_albedo(coat.albedo, depth_m)
        if coat
        else shapes.image_from_depth(depth_m, box)
    )


def scene_of(
    plan: DatasetPlan,
    depth_m: Float32,
    rig: Rig,
    model: SensorModel,
    coat: shapes.Coat | None = None,
) -> Scene:
    """Return the scene of one object, unpainted or with its coat, on its rig."""
    surface = Surface(coat.albedo, plan.material.brdf) if coat else plan.material.surface
    return Scene(rig, depth_m, surface, plan.radiometry, plan.jump_m, model.pulse_ns)


def _sense(
    plan: DatasetPlan,
    depth_m: Float32,
    coat: shapes.Coat | None,
    rig: Rig,
    model: SensorModel,
    seed: int,
) -> LidarMaps:
    scene = scene_of(plan, depth_m, rig, model, coat)
    if plan.accuracy == LOCKED:
        return locked_difference(scene, model)
    # The records are frozen, so hashable, which pyright does not see.
    sensor = cached_sensor(rig, model, plan.radiometry)  # pyright: ignore[reportArgumentType]
    if coat is None:
        return sense_object(scene, sensor, seed, plan.accuracy, expected=plan.expected)
    return sense_color(scene, sensor, seed, plan.accuracy, expected=plan.expected)


def _sense_in_batches(
    plan: DatasetPlan,
    depths_m: Sequence[Float32],
    rigs: Sequence[tuple[Rig, SensorModel]],
    seeds: Sequence[int],
    backend: str,
) -> list[LidarMaps]:
    """Return the maps of unpainted objects, rendered in batches. Raises SceneError for plans that
    only the CPU renders.
    """
    if plan.textures or plan.accuracy == LOCKED:
        what = "colors" if plan.textures else LOCKED
        raise SceneError(f"backend {backend} renders no {what}: drop --backend")
    scenes = [
        scene_of(plan, depth_m, rig, model)
        for depth_m, (rig, model) in zip(depths_m, rigs, strict=True)
    ]
    rendered = render_all(scenes, plan.accuracy, backend=backend)
    maps: list[LidarMaps] = []
    for rendering, (rig, model), seed in zip(rendered, rigs, seeds, strict=True):
        sensor = cached_sensor(rig, model, plan.radiometry)  # pyright: ignore[reportArgumentType]
        maps.append(sensor.maps(rendering.multi, _noise(seed, expected=plan.expected)))
    return maps


@lru_cache(maxsize=1)
def cached_sensor(rig: Rig, model: SensorModel, radiometry: Radiometry = "paper") -> Sensor:
    """Return a sensor, kept until one of another rig, model or radiometry is requested."""
    return Sensor(rig, model, radiometry)


def join_samples(parts: Sequence[Samples]) -> Samples:
    """Return several sets of samples as one."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def hidden_object(objects: Objects, seed: int, box: ObjectBox) -> tuple[str, Float32]:
    """Return one random object: its category, family or mesh, and its depth map (64, 64) in metres,
    NaN background.
    """
    if (
        objects.share_generic
        and np.random.default_rng([seed, _SHARE_STREAM]).random() < objects.share_generic
    ):
        return shapes.generic_depth(seed, box)
    if not objects.meshes:
        return shapes.object_depth(seed, box, objects.categories, backgrounds=objects.backgrounds)
    if (folder := objects.folder) is None:
        raise SceneError("this dataset hides meshes: name their folder with --objects")
    (name, _), depth_m = shapes.mesh_depth(
        seed,
        objects.meshes,
        box,
        objects.up,
        read=lambda mesh: _unchanged(folder / mesh[0], mesh[1]),
    )
    return name, depth_m


MAX_NAMED = 10
"""Broken meshes that one error names."""


def objects_from_folder(
    folder: Path, box: ObjectBox, up: shapes.Up = "y", on_progress: OnProgress = ignore
) -> Objects:
    """Read the meshes of a folder and its subfolders, with the axis `up` upwards. Raises SceneError
    for none, or one that shows nothing in a box or cannot be used: once shards are written, the
    folder must stay as it is.
    """
    paths = shapes.folder_objects(folder)
    meshes = list[tuple[str, str]]()
    problems = list[SceneError]()
    for number, path in enumerate(paths, start=1):
        name = path.relative_to(folder).as_posix()
        try:
            name.encode()
        except UnicodeEncodeError as error:  # a shard stores names as UTF-8
            raise SceneError(f"the name of the mesh {name!a} is not UTF-8: rename it") from error
        try:
            mesh = shapes.read_mesh(path)
            shapes.check_visible(mesh, box, up)
            meshes.append((name, mesh.sha256))
        except SceneError as error:
            problems.append(error)
        on_progress(number, len(paths))
    if len(problems) == 1:
        raise problems[0]
    if problems:
        named = "; ".join(map(str, problems[:MAX_NAMED]))
        more = f"; and {len(problems) - MAX_NAMED} more" if len(problems) > MAX_NAMED else ""
        raise SceneFileError(
            f"{len(problems)} of {len(paths)} meshes in {folder} cannot be used: {named}{more}"
        )
    return Objects((), tuple(meshes), up=up, folder=folder.resolve())


@lru_cache(maxsize=16)
def _unchanged(path: Path, sha256: str) -> shapes.MeshFile:
    mesh = shapes.read_mesh(path)
    if mesh.sha256 != sha256:
        raise SceneError(
            f"{path} changed since the dataset was started: restore it, or choose another --out"
        )
    return mesh
