"""What a doubt network learns from and is judged by: seeds to ordinary objects, empty benches and outliers, on disk."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from zlib import crc32

import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Float32
from nlos_models import DoubtSet, MapSet, Recipe, Reconstructor, first_of, parts_of
from numpy.typing import NDArray

from nlos_cam.dataset import build
from nlos_cam.dataset.outliers import SLIGHT, TO_JUDGE, TO_LEARN, Stimulus, ordinary, outlier, varied, varied_empty
from nlos_cam.errors import SceneError
from nlos_cam.files import atomic_file
from nlos_cam.frames import OBJECT_PIXELS, LidarMaps, maps_from_frame
from nlos_cam.objects import image_from_depth, object_box
from nlos_cam.render import Rendering, Sensor, SensorModel, render

EMPTY, ORDINARY = "empty", "ordinary"
PIECE = 100
"""Samples in a file: what a kill can cost."""
BESIDE_M = 0.01
"""Depth this far from the bare wall's is that of what is hidden: the width of a path-length bin."""
BENCH = 10
"""Samples in a row that are of one bench, whose sensor is worked out once."""
VERSION = 2
"""Raised with any change of what a seed makes."""
_STREAM = 5
"""Keeps these random numbers apart from those of datasets."""

OnProgress = Callable[[int, int], None]


@dataclass(frozen=True)
class DoubtSamples:
    """Maps, and what was hidden."""

    depth_m: Float32
    """(n, 64, 80); NaN where there is no return."""
    intensity: Float32
    """(n, 64, 80)."""
    image: NDArray[np.float16]
    """(n, 64, 64); the truth, 0 for background."""
    cells: NDArray[np.int32]
    """(n,); in how many cells of the maps what is hidden is the strongest return: in none it cannot be seen."""
    kind: NDArray[np.str_]
    """(n,); EMPTY, ORDINARY, or an outlier's."""

    def __len__(self) -> int:
        return len(self.kind)

    def where(self, chosen: NDArray[np.bool_]) -> "DoubtSamples":
        """Those that are chosen (n,)."""
        return DoubtSamples(**{name: values[chosen] for name, values in vars(self).items()})


def make_samples(
    kind: str, seeds: Sequence[int], rig: Rig, sensor: SensorModel, accuracy: str = "draft"
) -> DoubtSamples:
    """Samples of one kind, the same bits for the same seeds: BENCH in a row are of one bench.

    Ordinary objects, of which datasets have those on the given bench, are on benches that lie slightly off, outliers
    on every second such; empty benches may lie widely off.
    """
    sights = [_sight(kind, seed, rig, sensor) for seed in seeds]
    rendered = [render(sight.scene, accuracy) for sight in sights]
    noises = [_generator(kind, seed, 2) for seed in seeds]
    maps = [_sensed(*each) for each in zip(sights, rendered, noises, strict=True)]
    return DoubtSamples(
        np.stack([one.depth_m for one in maps]),
        np.stack([one.intensity for one in maps]),
        np.stack([_truth(sight) for sight in sights]),
        np.array([_cells(*each) for each in zip(sights, rendered, strict=True)], np.int32),
        np.array([kind] * len(seeds)),
    )


def _generator(kind: str, seed: int, of: int) -> np.random.Generator:
    """Other numbers for each kind: benches or noise that kinds share would tell outliers from ordinary objects."""
    return np.random.default_rng([crc32(kind.encode()), seed, _STREAM, of])


def _sensed(sight: Stimulus, rendered: Rendering, noise: np.random.Generator) -> LidarMaps:
    sensor = _sensor(sight)
    images = sensor.expose(rendered.multi, noise)
    return maps_from_frame(images.frame(sensor.rig.pinhole))


def _truth(sight: Stimulus) -> NDArray[np.float16]:
    nothing = np.full((OBJECT_PIXELS, OBJECT_PIXELS), np.nan, np.float32)
    hidden_m = nothing if sight.depth_m is None else sight.depth_m
    return image_from_depth(hidden_m, object_box(sight.rig)).astype(np.float16)


def _cells(sight: Stimulus, rendered: Rendering) -> int:
    """In how many cells the depth is not the bare wall's."""
    bare_m = render(replace(sight.scene, object_depth_m=None)).depth_m
    return int(np.count_nonzero(np.abs(rendered.depth_m - bare_m) > BESIDE_M))


def _sight(kind: str, seed: int, rig: Rig, sensor: SensorModel) -> Stimulus:
    of_bench = _generator(kind, seed // BENCH, 0)
    if kind == EMPTY:
        return Stimulus(*varied_empty(rig, sensor, of_bench))
    slight = kind == ORDINARY or seed // BENCH % 2
    bench = varied(rig, sensor, SLIGHT, of_bench) if slight else (rig, sensor)
    return outlier(KINDS[kind], _generator(kind, seed, 1), Stimulus(*bench))


KINDS = {ORDINARY: ordinary, **TO_LEARN, **TO_JUDGE}


class _Last:
    """The sensor that was made last: benches come in rows."""

    key: tuple[Rig, SensorModel] | None = None
    sensor: Sensor | None = None


def _sensor(sight: Stimulus) -> Sensor:
    key = sight.rig, sight.sensor
    if _Last.sensor is None or _Last.key != key:
        _Last.key, _Last.sensor = key, Sensor(*key)
    return _Last.sensor


def samples_on_disk(
    folder: Path,
    counts: Mapping[str, int],
    first_seed: int,
    rig: Rig,
    sensor: SensorModel,
    *,
    accuracy: str = "draft",
    on_progress: OnProgress = lambda _done, _total: None,
) -> DoubtSamples:
    """So many samples of each kind; what the folder has of them is read, what it lacks is made and kept there."""
    folder.mkdir(parents=True, exist_ok=True)
    about = f"v{VERSION}-{rig.checksum}-{accuracy}"
    done, total, parts = 0, sum(counts.values()), list[DoubtSamples]()
    for kind, seeds in _pieces(counts, first_seed):
        path = folder / f"{about}-{kind.replace(' ', '_')}-{seeds.start}-{len(seeds)}.npz"
        if (part := _read(path)) is None:
            part = make_samples(kind, seeds, rig, sensor, accuracy)
            _write(path, part)
        parts.append(part)
        on_progress(done := done + len(seeds), total)
    return joined(parts)


def joined(parts: Sequence[DoubtSamples]) -> DoubtSamples:
    """Samples one after the other."""
    names = [one.name for one in fields(DoubtSamples)]
    return DoubtSamples(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def _pieces(counts: Mapping[str, int], first_seed: int) -> Iterator[tuple[str, range]]:
    for kind, count in counts.items():
        for start in range(first_seed, first_seed + count, PIECE):
            yield kind, range(start, min(start + PIECE, first_seed + count))


def _read(path: Path) -> DoubtSamples | None:
    """The samples of a file; None where there is none."""
    if not path.exists():
        return None
    with np.load(path) as file:
        return DoubtSamples(**file)


def _write(path: Path, samples: DoubtSamples) -> None:
    with atomic_file(path) as part, part.open("wb") as file:
        np.savez(file, **vars(samples))


MIN_CELLS = 8
"""An outlier that shows in fewer cells of the maps is not learnt from: it can hardly be told from nothing at all."""


HELD_OUT_SHARE = 0.15
"""Of outliers and empty benches, beside those that are learnt from."""


def counts_of(recipe: Recipe) -> dict[str, int]:
    """How many samples are rendered of each kind.

    On benches that lie slightly off, as many ordinary objects as outliers: else what lies off would itself be a sign.
    """
    of_each = dict.fromkeys(TO_LEARN, recipe.outliers)
    return {EMPTY: recipe.empties, ORDINARY: sum(of_each.values()) // 2, **of_each}


def doubt_set(pipeline: Reconstructor, samples: DoubtSamples) -> DoubtSet:
    """Samples beside what a pipeline makes of them."""
    outside = (samples.kind != EMPTY) & (samples.kind != ORDINARY)
    made = _images(pipeline, MapSet(samples.depth_m, samples.intensity, samples.image))
    return DoubtSet(samples.depth_m, samples.intensity, made, samples.image, samples.kind == EMPTY, outside)


def _whole_set(pipeline: Reconstructor, usual: MapSet, samples: DoubtSamples) -> DoubtSet:
    """Ordinary maps of a dataset, and the samples that can be seen."""
    made = doubt_set(pipeline, samples)
    made = made.where((samples.cells >= MIN_CELLS) | made.nothing)
    of_dataset, no = _images(pipeline, usual), np.zeros(len(usual.image), np.bool_)
    ordinary = DoubtSet(usual.depth_m, usual.intensity, of_dataset, usual.image.astype(np.float16), no, no)
    pairs = {name: (values, vars(made)[name]) for name, values in vars(ordinary).items()}
    return DoubtSet(**{name: np.concatenate(pair) for name, pair in pairs.items()})


def _images(pipeline: Reconstructor, maps: MapSet) -> np.ndarray:
    pairs = zip(parts_of(maps.depth_m), parts_of(maps.intensity), strict=True)
    return np.concatenate([pipeline(*pair) for pair in pairs]).astype(np.float16)


def doubt_sets(
    recipe: Recipe,
    pipeline: Reconstructor,
    datasets: tuple[build.Dataset, build.Dataset],
    folder: Path,
    on_progress: OnProgress = lambda _done, _total: None,
) -> list[DoubtSet]:
    """Return the training set and the held-out set of an uncertainty network; rendered samples are kept in `folder`."""
    counts = counts_of(recipe)
    fewer = {kind: round(HELD_OUT_SHARE * count) for kind, count in counts.items()}
    sets: list[DoubtSet] = []
    for dataset, most, some, seed in zip(
        datasets,
        (recipe.objects, recipe.held_out),
        (counts, fewer),
        (build.TRAINING_SEED, build.HELD_OUT_SEED),
        strict=True,
    ):
        plan = dataset.plan
        samples = samples_on_disk(
            folder, some, seed, plan.rig, plan.sensor, accuracy=plan.accuracy, on_progress=on_progress
        )
        sets.append(_whole_set(pipeline, first_of(dataset.arrays(), most), samples))
    return sets


def check_doubt_data(recipe: Recipe, pipeline: Reconstructor, training: build.Dataset, judging: build.Dataset) -> None:
    if pipeline.record.input != "raw maps":
        raise SceneError(f"these weights eat {pipeline.record.input}, and doubt is learnt of raw maps: name others")
    if not training.plan.rig.checksum == judging.plan.rig.checksum == pipeline.record.rig_checksum:
        raise SceneError("maps, held-out maps and weights are not all of one rig: name others, or build the maps again")
    if len(training) < recipe.objects:
        told = f"the dataset holds {len(training)} objects, the recipe asks for {recipe.objects}"
        raise SceneError(f"{told}: build that many, or give --objects")
