"""Objects and renderer to HDF5 shards of lidar maps and hidden images, resumable at any moment.

A shard is written under another name and renamed when whole; building again makes only the shards that are missing. An
object, its rendering and its noise depend on its seed alone, so the shards are equal for any number of workers.
"""

import json
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path

import h5py
import numpy as np
from nlos_calibration.rig import ObjectBox, Rig
from nlos_models.data import Half, MapSet

from nlos_cam.errors import RecordingError
from nlos_cam.frames import Float32, LidarMaps, maps_from_frame
from nlos_cam.objects.depth_image import image_from_depth, object_box
from nlos_cam.objects.hidden import object_depth, object_depths
from nlos_cam.render.renderer import render
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_file import RENDERING_VERSION
from nlos_cam.render.sensor import Sensor
from nlos_cam.render.sensor_model import SensorModel

TRAINING_SEED, HELD_OUT_SEED, TEST_SEED = 0, 10_000_000, 20_000_000
"""Objects that judge come from seeds that no training run reaches."""
SHARD = 100
"""Objects in a shard: what a kill can cost."""
MAP_CHANNELS = ("depth_m", "intensity", "image")

OnProgress = Callable[[int, int], None]


@dataclass(frozen=True)
class DatasetPlan:
    """What a dataset holds, apart from how many."""

    rig: Rig
    first_seed: int
    sensor: SensorModel = field(default_factory=SensorModel)
    accuracy: str = "standard"

    @property
    def box(self) -> ObjectBox:
        """The rig's object box; SceneError where it has none."""
        return object_box(self.rig)

    @property
    def provenance(self) -> str:
        """Everything that decides the bits, as JSON: a folder's shards must agree on it."""
        rig, sensor = self.rig.model_dump(mode="json"), self.sensor.model_dump(mode="json")
        facts = {"rig": rig, "sensor": sensor, "first_seed": self.first_seed, "accuracy": self.accuracy}
        return json.dumps({**facts, "rig_checksum": self.rig.checksum, "rendering_version": RENDERING_VERSION})


def procedural_images(first_seed: int, count: int, box: ObjectBox) -> Half:
    """Images (count, 64, 64) of random objects, without rendering: all that a VAE needs."""
    seeds = range(first_seed, first_seed + count)
    return np.stack([image_from_depth(depth, box).astype(np.float16) for depth in object_depths(seeds, box)])


def sense_object(depth_m: Float32, sensor: Sensor, seed: int, accuracy: str = "standard") -> LidarMaps:
    """The maps of one hidden object, rendered, through the sensor's chain and the same reduction as live frames."""
    echoes = render(Scene(sensor.rig, depth_m), accuracy).multi
    images = sensor.expose(echoes, np.random.default_rng([seed, 1]))
    return maps_from_frame(images.frame(sensor.rig.pinhole))


def build(plan: DatasetPlan, count: int, folder: Path, *, workers: int, on_progress: OnProgress) -> None:
    """Bring a folder up to `count` objects. Raises RecordingError where it holds another plan's shards."""
    _ = plan.box  # refuse a rig that cannot hide anything before anything is made
    folder.mkdir(parents=True, exist_ok=True)
    _agree(folder, plan)
    starts = range(plan.first_seed, plan.first_seed + count, SHARD)
    end = plan.first_seed + count
    jobs = {_shard(folder, start): range(start, min(start + SHARD, end)) for start in starts}
    missing = {path: seeds for path, seeds in jobs.items() if not _holds(path, seeds)}
    done = count - sum(len(seeds) for seeds in missing.values())
    on_progress(done, count)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_one_thread) as pool:
        futures = {pool.submit(_build_shard, plan, path, seeds): len(seeds) for path, seeds in missing.items()}
        try:
            for future in as_completed(futures):
                future.result()
                done += futures[future]
                on_progress(done, count)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def read(folder: Path) -> tuple[MapSet, DatasetPlan]:
    """All maps and images of a dataset, in the order of the seeds, and the plan they were built by."""
    shards = sorted(folder.glob("shard-*.h5"))
    if not shards:
        raise RecordingError(f"no dataset in {folder}: it holds no shard-*.h5; make one with `nlos-cam dataset build`")
    parts: dict[str, list[Float32]] = {name: [] for name in MAP_CHANNELS}
    for shard in shards:
        with _opened(shard) as file:
            for name, part in parts.items():
                part.append(np.asarray(file[name]))
    return MapSet(*(np.concatenate(parts[name]) for name in MAP_CHANNELS)), _plan_of(shards[0])


def _one_thread() -> None:
    import numba

    numba.set_num_threads(1)  # one object per process is faster than several threads per object


def _shard(folder: Path, start: int) -> Path:
    return folder / f"shard-{start:09d}.h5"


@contextmanager
def _opened(shard: Path) -> Generator[h5py.File]:
    """A shard to read from. Raises RecordingError where it, or what is asked of it inside, cannot be read."""
    try:
        with h5py.File(shard) as file:
            yield file
    except (OSError, KeyError) as error:
        raise RecordingError(f"{shard} cannot be read as a shard: {error}; delete it and build again") from error


def _holds(shard: Path, seeds: Sequence[int]) -> bool:
    """Whether a shard is there with all of these objects: the last one of a smaller dataset has too few."""
    if not shard.exists():
        return False
    with _opened(shard) as file:
        return len(file["seed"]) >= len(seeds)  # pyright: ignore[reportArgumentType] (a data set, by our own hand)


def _build_shard(plan: DatasetPlan, path: Path, seeds: Sequence[int]) -> None:
    sensor = Sensor(plan.rig, plan.sensor)
    made = [object_depth(seed, plan.box) for seed in seeds]
    maps = [sense_object(depth, sensor, seed, plan.accuracy) for (_, depth), seed in zip(made, seeds, strict=True)]
    part = path.with_suffix(".part")
    with h5py.File(part, "w") as file:
        file.attrs["plan"] = plan.provenance
        stacks = {
            "depth_m": np.stack([m.depth_m for m in maps]),
            "intensity": np.stack([m.intensity for m in maps]),
            "image": np.stack([image_from_depth(depth, plan.box) for _, depth in made]).astype(np.float16),
            "object_depth_m": np.stack([depth for _, depth in made]),
            "seed": np.asarray(seeds),
        }
        for name, stack in stacks.items():
            file.create_dataset(name, data=stack, compression="gzip", compression_opts=1)
        file.create_dataset("category", data=[category for category, _ in made], dtype=h5py.string_dtype())
    part.replace(path)


def _agree(folder: Path, plan: DatasetPlan) -> None:
    shards = sorted(folder.glob("shard-*.h5"))
    if shards and _provenance(shards[0]) != plan.provenance:
        raise RecordingError(f"{folder} holds a dataset of another rig, seed or accuracy: choose another --out")


def _provenance(shard: Path) -> str:
    with _opened(shard) as file:
        return str(file.attrs["plan"])


def _plan_of(shard: Path) -> DatasetPlan:
    facts = json.loads(_provenance(shard))
    sensor = SensorModel.model_validate(facts["sensor"])
    return DatasetPlan(Rig.model_validate(facts["rig"]), facts["first_seed"], sensor, facts["accuracy"])
