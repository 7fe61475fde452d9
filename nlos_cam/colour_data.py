"""Objects in colour and renderer to HDF5 shards, resumable (simulation only: the L515's laser is infrared, 860 nm).

The lidar that this simulates has three lasers and one detector: each instant is exposed once in white (every laser at a
third of its power), which gives the depth, and once in red, green and blue, which give the intensities. Each exposure
is the whole device, with the same gain and noise of its own.
"""

import json
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
from nlos_calibration.rig import Rig
from nlos_models.data import MapSet
from numpy.typing import NDArray

from nlos_cam.colour_objects import TEXTURES, colour_object
from nlos_cam.dataset import SHARD, DatasetPlan, OnProgress
from nlos_cam.dataset_shards import opened
from nlos_cam.dataset_worker import one_thread
from nlos_cam.errors import RecordingError
from nlos_cam.frames import Float32, LidarMaps, maps_from_frame
from nlos_cam.render.renderer import render
from nlos_cam.render.scene import Scene
from nlos_cam.render.sensor import Sensor
from nlos_cam.render.surface import Surface

PATTERN = "colour-*.h5"


class ColourMaps(NamedTuple):
    """What the four exposures of one instant are reduced to."""

    depth_m: Float32
    """(64, 80); of the white exposure, NaN where there is no return."""
    intensity: Float32
    """(3, 64, 80); of the red, green and blue exposures, in IR counts."""


def sense_colour(
    depth_m: Float32, albedo: NDArray[np.floating], sensor: Sensor, seed: int, accuracy: str = "standard"
) -> ColourMaps:
    """The maps of a hidden object of albedo (n, n, 3); the white exposure of a grey object is `sense_object`'s."""
    white, *colours = (
        _expose(depth_m, light, sensor, np.random.default_rng([seed, 1 + k]), accuracy)
        for k, light in enumerate((albedo.mean(-1), *np.moveaxis(albedo, -1, 0)))
    )
    return ColourMaps(white.depth_m, np.stack([maps.intensity for maps in colours]))


def _expose(
    depth_m: Float32, albedo: NDArray[np.floating], sensor: Sensor, generator: np.random.Generator, accuracy: str
) -> LidarMaps:
    echoes = render(Scene(sensor.rig, depth_m, Surface(albedo)), accuracy).multi
    return maps_from_frame(sensor.expose(echoes, generator).frame(sensor.rig.pinhole))


def build_colour(plan: DatasetPlan, count: int, folder: Path, *, workers: int, on_progress: OnProgress) -> None:
    """Bring a folder up to `count` objects. Raises RecordingError where it holds another plan's shards."""
    _ = plan.box  # refuse a rig that cannot hide anything before anything is made
    folder.mkdir(parents=True, exist_ok=True)
    _agree(folder, plan)
    end = plan.first_seed + count
    starts = range(plan.first_seed, end, SHARD)
    jobs = {folder / f"colour-{start:09d}.h5": range(start, min(start + SHARD, end)) for start in starts}
    missing = {path: seeds for path, seeds in jobs.items() if not _holds(path, seeds)}
    done = count - sum(len(seeds) for seeds in missing.values())
    on_progress(done, count)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=one_thread) as pool:
        futures = {pool.submit(build_shard, plan, path, seeds): len(seeds) for path, seeds in missing.items()}
        try:
            for future in as_completed(futures):
                future.result()
                done += futures[future]
                on_progress(done, count)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def build_shard(plan: DatasetPlan, path: Path, seeds: Sequence[int]) -> None:
    """Write one shard whole, or not at all."""
    sensor = Sensor(plan.rig, plan.sensor)
    made = [colour_object(seed, plan.box) for seed in seeds]
    maps = [
        sense_colour(one.depth_m, one.albedo, sensor, seed, plan.accuracy)
        for one, seed in zip(made, seeds, strict=True)
    ]
    stacks = {
        "depth_m": np.stack([m.depth_m for m in maps]),
        "intensity": np.stack([m.intensity for m in maps]),
        "image": np.stack([one.image for one in made]).astype(np.float16),
        "object_depth_m": np.stack([one.depth_m for one in made]),
        "seed": np.asarray(seeds),
    }
    part = path.with_suffix(".part")
    with h5py.File(part, "w") as file:
        file.attrs["plan"] = _provenance(plan)
        for name, stack in stacks.items():
            file.create_dataset(name, data=stack, compression="gzip", compression_opts=1)
        for name in ("category", "texture"):
            file.create_dataset(name, data=[getattr(one, name) for one in made], dtype=h5py.string_dtype())
    part.replace(path)


def read_colour(folder: Path) -> tuple[MapSet, Rig]:
    """All maps of a colour dataset, intensity (n, 3, 64, 80) and image (n, 3, 64, 64), in the order of the seeds."""
    shards = sorted(folder.glob(PATTERN))
    if not shards:
        raise RecordingError(f"no dataset in colour in {folder}: it holds no {PATTERN}; make one first")
    parts: list[list[Float32]] = []
    for shard in shards:
        with opened(shard) as file:
            parts.append([np.asarray(file[name]) for name in ("depth_m", "intensity", "image")])
    rig = Rig.model_validate(json.loads(_plan_of(shards[0]))["rig"])
    return MapSet(*(np.concatenate(stack) for stack in zip(*parts, strict=True))), rig


def _provenance(plan: DatasetPlan) -> str:
    return json.dumps({**json.loads(plan.provenance), "textures": list(TEXTURES)})


def _holds(shard: Path, seeds: Sequence[int]) -> bool:
    """Whether a shard is there with all of these objects: the last one of a smaller dataset has too few."""
    if not shard.exists():
        return False
    with opened(shard) as file:
        return len(file["seed"]) >= len(seeds)  # pyright: ignore[reportArgumentType] (a data set, by our own hand)


def _agree(folder: Path, plan: DatasetPlan) -> None:
    shards = sorted(folder.glob(PATTERN))
    if shards and _plan_of(shards[0]) != _provenance(plan):
        raise RecordingError(f"{folder} holds a dataset of another rig, seed or accuracy: choose another --out")


def _plan_of(shard: Path) -> str:
    with opened(shard) as file:
        return str(file.attrs["plan"])
