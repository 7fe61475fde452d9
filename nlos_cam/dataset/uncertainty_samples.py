"""Samples of the uncertainty network: ordinary objects, empty benches and outliers by seed, cached
on disk.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from hashlib import sha256
from itertools import compress, islice
from pathlib import Path
from typing import Self
from zlib import crc32

import nlos_models as models
import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Float32, Mask
from nlos_models.training import (
    MapSet,
    QualitySet,
    UncertaintyRecipe,
    UncertaintySet,
    can_leave_out,
    first_of,
    parts_of,
)
from numpy.typing import NDArray

from nlos_cam.dataset import outliers
from nlos_cam.dataset.build import HELD_OUT_SEED, TRAINING_SEED
from nlos_cam.dataset.packed import map_noise
from nlos_cam.dataset.packing import aligned_with, kept_of
from nlos_cam.dataset.plan import RECORDED, DatasetPlan
from nlos_cam.dataset.reader import Dataset, check_held_out
from nlos_cam.dataset.rig_range import RigRange
from nlos_cam.dataset.samples import OnProgress, cached_sensor, ignore
from nlos_cam.errors import SceneError
from nlos_cam.files import atomic_file, read_arrays
from nlos_cam.frames import OBJECT_PIXELS, LidarMaps, maps_from_frame
from nlos_cam.objects import CATEGORIES, image_from_depth
from nlos_cam.reconstruct import grid_of, own_rig
from nlos_cam.render import (
    RENDERING_VERSION,
    Material,
    Rendering,
    Scene,
    Sensor,
    SensorModel,
    render,
)

EMPTY = "empty"
ORDINARY = "ordinary"
GENERIC = "generic"
USUAL = ORDINARY, GENERIC
PIECE = 100
"""Samples in a file; a killed build loses at most as many."""
BESIDE_M = 0.01
"""Depth differing from the bare wall's by more than this belongs to the object: the width of a
path-length bin.
"""
SEEDS_PER_BENCH = 10
"""Consecutive seeds on the same bench around one rig, whose sensor is computed once."""
VERSION = 3
"""Raise it when a seed makes another sample."""
_STREAM = 5
"""Seeds these random numbers apart from those of datasets."""
KINDS = {
    ORDINARY: outliers.ordinary,
    GENERIC: outliers.generic,
    **outliers.TRAINING_OUTLIERS,
    **outliers.HELD_OUT_OUTLIERS,
}
MIN_CELLS = 8
"""Training leaves out objects that change fewer cells of the maps: they hardly differ from an empty
bench, and called "not nothing" they would teach that an empty bench is not empty.
"""
MIN_VISIBLE = 16
"""Fewest visible objects of a dataset that stand for all: on a bench that hides more, none is left
out.
"""
HELD_OUT_SHARE = 0.15
"""Held-out outliers and empty benches, relative to the number of training ones."""


@dataclass(frozen=True)
class UncertaintySamples:
    """Maps of hidden objects, with the truth."""

    depth_m: Float32
    """(n, 64, 80); NaN where there is no return."""
    intensity: Float32
    """(n, 64, 80)."""
    image: NDArray[np.float16]
    """(n, 64, 64); image v of the truth, 0 for background."""
    cells: NDArray[np.int32]
    """(n,); number of map cells whose strongest return is the object's: with none it is
    invisible.
    """
    kind: NDArray[np.str_]
    """(n,); EMPTY, ORDINARY, GENERIC, or a kind of outlier."""

    def __len__(self) -> int:
        return len(self.kind)

    def where(self, chosen: NDArray[np.bool_]) -> "UncertaintySamples":
        """Return the samples of a mask (n,)."""
        return UncertaintySamples(**{name: values[chosen] for name, values in vars(self).items()})


@dataclass(frozen=True)
class Benches:
    """Benches of samples: around one rig, or around rigs of a range, with their sensor."""

    rig: Rig
    sensor: SensorModel
    rigs: RigRange | None = None
    """Range of the benches' rigs in place of `rig`."""
    maps_rig: Rig | None = None
    """Rig that maps are aligned with, by the benches' records; None where they stay as they are."""
    accuracy: str = "draft"

    @classmethod
    def of(cls, plan: DatasetPlan, trained: models.CheckpointRecord) -> Self:
        """Return the benches of a dataset, as weights see them; beside recordings they are
        rendered in draft accuracy.
        """
        # on the weights' own rig there is nothing to align
        maps_rig = _maps_rig_of(plan, trained) if plan.rigs or grid_of(trained) else None
        accuracy = "draft" if plan.accuracy == RECORDED else plan.accuracy
        return cls(plan.rig, plan.sensor, plan.rigs, maps_rig, accuracy)

    @property
    def name(self) -> str:
        """Name that files of samples bear: it differs where the samples would."""
        maps_rig = self.maps_rig.checksum if self.maps_rig else ""
        text = (self.rigs.model_dump_json() if self.rigs else "") + maps_rig
        if self.sensor != SensorModel():
            text += self.sensor.model_dump_json()
        beside = f"-{sha256(text.encode()).hexdigest()[:12]}" if text else ""
        return f"v{VERSION}.{RENDERING_VERSION}-{self.rig.checksum}-{self.accuracy}{beside}"

    def number(self, seed: int) -> int:
        """Return the number of the bench of a seed: around one rig SEEDS_PER_BENCH consecutive ones
        share it.

        Of many rigs each sample has its own: outliers on few rigs, ordinary objects on others, and
        a network learns the rigs in place of the outliers.
        """
        return seed if self.rigs else seed // SEEDS_PER_BENCH

    def record(self, kind: str, seed: int) -> Rig:
        """Return the rig of the bench of a sample, by its record."""
        if self.rigs is None:
            return self.rig
        return self.rigs.draw(self.rig, (crc32(kind.encode()) << 32) + self.number(seed))


def make_samples(kind: str, seeds: Sequence[int], benches: Benches) -> UncertaintySamples:
    """Return samples of one kind, the same bits for the same seeds.

    Datasets hold ordinary objects on the given benches. Here these are on benches that deviate
    slightly, outliers on such benches and the given one in turn, and empty benches may deviate
    widely.
    """
    stimuli = [_stimulus(kind, seed, benches) for seed in seeds]
    renderings = [render(stimulus.scene, benches.accuracy) for stimulus in stimuli]
    noises = [_generator(kind, seed, 2) for seed in seeds]
    maps = [_sense(*each) for each in zip(stimuli, renderings, noises, strict=True)]
    samples = UncertaintySamples(
        np.stack([one.depth_m for one in maps]),
        np.stack([one.intensity for one in maps]),
        np.stack([_truth(stimulus) for stimulus in stimuli]),
        np.array(
            [_visible_cells(*each) for each in zip(stimuli, renderings, strict=True)], np.int32
        ),
        np.array([kind] * len(seeds)),
    )
    if benches.maps_rig is None:
        return samples
    sensed = MapSet(samples.depth_m, samples.intensity, samples.image)
    records = [benches.record(kind, seed) for seed in seeds]
    aligned, seen, _ = aligned_with(sensed, records, benches.maps_rig)
    return replace(samples.where(seen), depth_m=aligned.depth_m, intensity=aligned.intensity)


def _generator(kind: str, seed: int, stream: int) -> np.random.Generator:
    """Return a generator that differs between kinds: shared benches or noise would give outliers
    away.
    """
    return np.random.default_rng([crc32(kind.encode()), seed, _STREAM, stream])


def _stimulus(kind: str, seed: int, benches: Benches) -> outliers.Stimulus:
    rig = benches.record(kind, seed)
    sensor = benches.sensor
    number = benches.number(seed)
    bench_generator = _generator(kind, number, 0)
    if kind == EMPTY:
        return outliers.Stimulus(*outliers.vary_empty_bench(rig, sensor, bench_generator))
    slight = kind in USUAL or number % 2
    bench = (
        outliers.vary_bench(rig, sensor, outliers.SLIGHT, bench_generator)
        if slight
        else (rig, sensor)
    )
    return outliers.draw_outlier(KINDS[kind], _generator(kind, seed, 1), outliers.Stimulus(*bench))


def _sense(
    stimulus: outliers.Stimulus, rendering: Rendering, noise: np.random.Generator
) -> LidarMaps:
    # The records are frozen, so hashable, which pyright does not see.
    sensor = cached_sensor(stimulus.rig, stimulus.sensor)  # pyright: ignore[reportArgumentType]
    images = sensor.expose(rendering.multi, noise)
    return maps_from_frame(images.frame(stimulus.rig.pinhole))


def _truth(stimulus: outliers.Stimulus) -> NDArray[np.float16]:
    empty = np.full((OBJECT_PIXELS, OBJECT_PIXELS), np.nan, np.float32)
    depth_m = empty if stimulus.depth_m is None else stimulus.depth_m
    return image_from_depth(depth_m, stimulus.box).astype(np.float16)


def _visible_cells(stimulus: outliers.Stimulus, rendering: Rendering) -> int:
    """Return the number of cells whose depth differs from the bare wall's."""
    bare_m = render(replace(stimulus.scene, object_depth_m=None)).depth_m
    return int(np.count_nonzero(np.abs(rendering.depth_m - bare_m) > BESIDE_M))


def samples_on_disk(
    folder: Path,
    counts: Mapping[str, int],
    first_seed: int,
    benches: Benches,
    *,
    on_progress: OnProgress = ignore,
) -> UncertaintySamples:
    """Return `counts` samples of each kind; those missing in the folder are made and stored
    there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    about = benches.name
    done = 0
    total = sum(counts.values())
    parts = list[UncertaintySamples]()
    for kind, seeds in _pieces(counts, first_seed):
        path = folder / f"{about}-{kind.replace(' ', '_')}-{seeds.start}-{len(seeds)}.npz"
        try:
            part = UncertaintySamples(**read_arrays(path))
        except (OSError, ValueError, TypeError):  # absent, or damaged: it is made again
            part = make_samples(kind, seeds, benches)
            with atomic_file(path) as unfinished, unfinished.open("wb") as file:
                np.savez(file, **vars(part))
        parts.append(part)
        on_progress(done := done + len(seeds), total)
    return UncertaintySamples(
        **{name: np.concatenate([vars(part)[name] for part in parts]) for name in vars(parts[0])}
    )


def _pieces(counts: Mapping[str, int], first_seed: int) -> Iterator[tuple[str, range]]:
    for kind, count in counts.items():
        for start in range(first_seed, first_seed + count, PIECE):
            yield kind, range(start, min(start + PIECE, first_seed + count))


def counts_of(recipe: UncertaintyRecipe, share_generic: float = 0.0) -> dict[str, int]:
    """Return the number of samples to render of each kind, for training objects with a share of
    generic shapes.

    Benches that deviate slightly have as many usual objects as outliers, so that the deviation does
    not give outliers away.
    """
    per_kind = dict.fromkeys(outliers.outliers_beside(share_generic), recipe.outliers)
    usual = sum(per_kind.values()) // 2
    shapes = {GENERIC: round(share_generic * usual)} if share_generic else {}
    return {EMPTY: recipe.empties, ORDINARY: usual - sum(shapes.values()), **shapes, **per_kind}


def held_out_of(counts: Mapping[str, int]) -> dict[str, int]:
    """Return the number of held-out samples of each kind: at least one of each that training has,
    since the calibration needs them all.
    """
    return {
        kind: max(1, round(HELD_OUT_SHARE * count)) if count else 0
        for kind, count in counts.items()
    }


def _uncertainty_set(
    pipeline: models.Reconstructor, ordinary_maps: MapSet, samples: UncertaintySamples
) -> UncertaintySet:
    """Return a dataset's maps of ordinary objects and the visible samples, with the pipeline's
    images of both.
    """
    nothing = samples.kind == EMPTY
    outside = ~nothing & ~np.isin(samples.kind, USUAL)
    images = _images(pipeline, MapSet(samples.depth_m, samples.intensity, samples.image))
    drawn = UncertaintySet(
        samples.depth_m, samples.intensity, images, samples.image, nothing, outside
    )
    drawn = drawn.where((samples.cells >= MIN_CELLS) | nothing)
    depth_m = ordinary_maps.depth_m
    intensity = ordinary_maps.intensity
    truth = ordinary_maps.image.astype(np.float16)
    no = np.zeros(len(truth), np.bool_)
    usual = UncertaintySet(depth_m, intensity, _images(pipeline, ordinary_maps), truth, no, no)
    return UncertaintySet(
        **{
            name: np.concatenate([values, vars(drawn)[name]])
            for name, values in vars(usual).items()
        }
    )


def _images(pipeline: models.Reconstructor, maps: MapSet) -> NDArray[np.float16]:
    pairs = zip(parts_of(maps.depth_m), parts_of(maps.intensity), strict=True)
    return np.concatenate([pipeline(*pair) for pair in pairs]).astype(np.float16)


def uncertainty_sets(
    recipe: UncertaintyRecipe,
    pipeline: models.Reconstructor,
    datasets: tuple[Dataset, Dataset],
    folder: Path,
    on_progress: OnProgress = ignore,
) -> list[UncertaintySet]:
    """Return the training set and the held-out set of an uncertainty network; rendered samples are
    kept in `folder`.
    """
    counts = counts_of(recipe, datasets[0].plan.objects.share_generic)
    held_out_counts = held_out_of(counts)
    sets: list[UncertaintySet] = []
    for dataset, objects, kinds, seed in (
        (datasets[0], recipe.objects, counts, TRAINING_SEED),
        (datasets[1], recipe.held_out, held_out_counts, HELD_OUT_SEED),
    ):
        plan = dataset.plan
        samples = samples_on_disk(
            folder,
            kinds,
            seed,
            Benches.of(plan, pipeline.record),
            on_progress=on_progress,
        )
        ordinary = dataset.first(objects)
        visible = visible_objects(ordinary, dataset, on_progress)
        benches = compress(dataset.benches(), visible)
        maps_rig = _maps_rig_of(plan, pipeline.record)
        ordinary, _, _ = aligned_with(kept_of(ordinary, visible), benches, maps_rig)
        sets.append(_uncertainty_set(pipeline, ordinary, samples))
    return sets


def visible_objects(maps: MapSet, dataset: Dataset, on_progress: OnProgress = ignore) -> Mask:
    """Return which objects (n,) of a dataset, of which these are the first maps, change MIN_CELLS
    cells or more against their bench with nothing hidden; all where fewer than MIN_VISIBLE do.
    """
    cells: list[int] = []
    for depth_m, rig in zip(maps.depth_m, islice(dataset.benches(), len(maps.image)), strict=True):
        # The records are frozen, so hashable, which pyright does not see.
        bare_m = _bare_depth_m(rig, dataset.plan.sensor)  # pyright: ignore[reportArgumentType]
        cells.append(int(np.count_nonzero(np.abs(depth_m - bare_m) > BESIDE_M)))
        # Of many rigs, each has its empty bench rendered: minutes, like the samples before.
        on_progress(len(cells), len(maps.image))
    visible = np.array(cells) >= MIN_CELLS
    return visible if visible.sum() >= MIN_VISIBLE else np.ones(len(visible), np.bool_)


@lru_cache(maxsize=1)
def _bare_depth_m(rig: Rig, sensor: SensorModel) -> Float32:
    # the wall's texture changes no depth, and has no expected maps
    even = sensor.model_copy(update={"wall_texture": 0.0})
    bare = render(Scene(rig, pulse_ns=sensor.pulse_ns))
    return Sensor(rig, even).maps(bare.multi, None).depth_m


def quality_set(
    pipeline: models.Reconstructor,
    uncertainty_model: models.UncertaintyModel,
    dataset: Dataset,
    objects: int,
    on_progress: OnProgress,
) -> QualitySet:
    """Return figures and true quality of the reconstructions of a dataset's first objects; expected
    maps get noise.

    Raises SceneError where weights and dataset do not fit together, or the dataset has too few
    objects or kinds.
    """
    if len(dataset) < objects:
        raise SceneError(
            f"{dataset.folder} holds {len(dataset)} objects, and {objects} are wanted: build more,"
            " or lower --objects"
        )
    if pipeline.record.input != "raw maps" or not _fit(dataset.plan, pipeline.record):
        raise SceneError(
            "the quality model needs raw maps of the weights' own rig: use another --dataset or"
            " --weights"
        )
    figures = list[Float32]()
    iou = list[Float32]()
    error_v = list[Float32]()
    kinds = dataset.column("category").astype(np.str_)[:objects]
    if not can_leave_out(kinds.tolist()):
        raise SceneError(
            f"the quality model is judged on kinds left out of its fit, but {dataset.folder} has"
            f" too few ({', '.join(np.unique(kinds)[:3])}): use a --dataset of more kinds"
        )
    noise = map_noise(dataset.plan) if dataset.plan.expected else None
    maps_rig = _maps_rig_of(dataset.plan, pipeline.record)
    benches = dataset.benches()
    seen = np.ones(len(kinds), np.bool_)
    start = 0
    for expected in dataset.chunks():
        if start == len(kinds):
            break
        maps = noise.expose(expected, start) if noise else expected
        end = min(start + len(maps.image), len(kinds))
        count = end - start
        maps, kept, _ = aligned_with(first_of(maps, count), islice(benches, count), maps_rig)
        seen[start:end] = kept
        done = start
        for part in parts_of(np.arange(len(maps.image))):
            depth_m = maps.depth_m[part]
            intensity = maps.intensity[part]
            truth = maps.image[part].astype(np.float32)
            image, surface = models.ask(pipeline, depth_m, intensity)
            figures.append(
                models.quality_features(
                    image, uncertainty_model(depth_m, intensity, image), surface
                )
            )
            iou.append(models.silhouette_iou(image, truth).astype(np.float32))
            error_v.append(shared_error_v(image, truth))
            done += len(part)
            on_progress(done, len(kinds))
        start = end
    kinds = kinds[seen]
    found = np.concatenate(iou), np.concatenate(error_v)
    return QualitySet(np.concatenate(figures), *found, kinds, ~np.isin(kinds, tuple(CATEGORIES)))


def shared_error_v(image: Float32, truth: Float32) -> Float32:
    """Return the mean absolute error of v where images (n, 64, 64) and truths have a surface; NaN
    where none is.
    """
    shared = (image > 0) & (truth > 0)
    total = (np.abs(image - truth) * shared).sum((1, 2))
    count = shared.sum((1, 2))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)


def _maps_rig_of(plan: DatasetPlan, trained: models.CheckpointRecord) -> Rig:
    """Return the rig that a dataset's maps are aligned with for weights, each from its known rig:
    the wall grid, or the weights' own rig, which is the dataset's (`_fit`).
    """
    return grid_of(trained) or plan.rig


def _fit(plan: DatasetPlan, trained: models.CheckpointRecord) -> bool:
    """Return whether a dataset is of the weights' own rig, or of many where they are for any."""
    if grid_of(trained) is None:
        return plan.rig.checksum == trained.rig_checksum
    if trained.rig is None:
        return plan.rigs is not None
    own = own_rig(trained)
    return plan.rigs is None and own is not None and plan.rig.checksum == own.checksum


def check_uncertainty_data(
    recipe: UncertaintyRecipe, pipeline: models.Reconstructor, training: Dataset, held_out: Dataset
) -> None:
    """Raise SceneError where datasets, weights and recipe do not fit together."""
    if pipeline.record.input != "raw maps":
        raise SceneError(
            f"weights expect {pipeline.record.input}, but the uncertainty network needs raw maps:"
            " use others"
        )
    both = training, held_out
    if not all(_fit(data.plan, pipeline.record) for data in both):
        raise SceneError(
            "--dataset, --held-out and --weights are not all of one rig: use others, or build the"
            " maps again"
        )
    if any(data.plan.radiometry != "paper" or data.plan.material != Material() for data in both):
        raise SceneError(
            "--dataset or --held-out is of another radiometry or material, but empty benches and"
            " outliers are rendered matt, in the paper's: build the maps again without them"
        )
    if any(data.plan.off_record for data in both):
        raise SceneError(
            "--dataset or --held-out is of benches off their record, but half of the outliers are on"
            " benches as recorded, and would be known by that: build the maps without --off-record"
        )
    check_held_out(training, held_out)
    if len(training) < recipe.objects:
        count = f"--dataset holds {len(training)} objects, the recipe needs {recipe.objects}"
        raise SceneError(f"{count}: build more, or lower --objects")
