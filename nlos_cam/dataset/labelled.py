"""Labelled recordings of known objects as a dataset: maps of their frames with the truth of each
label.
"""

import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration import ObjectBox, Rig, first_problem, load_rig
from nlos_calibration.arrays import Float16, Float32
from nlos_models.training import MapSet
from pydantic import ValidationError

from nlos_cam import objects as shapes
from nlos_cam.dataset.build import SHARD
from nlos_cam.dataset.plan import RECORDED, DatasetPlan, scene_row
from nlos_cam.dataset.reader import MAP_CHANNELS
from nlos_cam.dataset.samples import OnProgress, Samples, ignore
from nlos_cam.dataset.shards import SHARD_PATTERN, shard_path, store
from nlos_cam.errors import DiskFullError, RecordingError
from nlos_cam.files import atomic_directory, read_toml
from nlos_cam.frames import OBJECT_PIXELS, Frame, LidarMaps, maps_from_frame
from nlos_cam.reconstruct import CalibratedRig, OwnMaps, open_bench
from nlos_cam.recording import ReplayCamera, Sidecar, load_sidecar, open_lidar_bag, sidecar_path
from nlos_cam.render import HiddenObject, SceneFile

FRAMES_PER_RECORDING = 8
"""Frames of a recording differ by their noise alone: more of them add little."""

KnownObjects = Callable[[ObjectBox], Mapping[str, Float32]]
"""Returns the depths (64, 64) over a box of the objects that need no file of their own, by
label.
"""

OpenBench = Callable[[ReplayCamera], CalibratedRig]
"""Opens a bench for a recording's camera, or raises where they do not fit."""


def benchmark_depths(box: ObjectBox) -> Mapping[str, Float32]:
    """Return the depths (64, 64) over a box of the benchmark objects, by name."""
    return {one.name: one.depth_m for one in shapes.benchmark_objects(box)}


def truth_depth_m(recording: Path, label: str, rig: Rig, known: Mapping[str, Float32]) -> Float32:
    """Return the hidden depth (64, 64) of a labelled recording over the rig's object box, NaN for
    background.

    It comes from a file beside the recording, NAME.truth.toml or NAME.npy, where NAME is the
    recording's or its label; else from the `known` objects. Raises RecordingError for no truth or
    two, SceneError for an invalid one.
    """
    names = dict.fromkeys((recording.stem, Path(label).name))
    for name in names:
        if (file := _truth_file(recording.parent, name)) is not None:
            return (
                _depth_map(file, shapes.object_box(rig))
                if file.suffix == shapes.DEPTH_MAP_SUFFIX
                else _placed(file, [name, *names], rig)
            )
    if label in known:
        return known[label]
    raise RecordingError(
        f"{recording} has the label {label!r}, which is not a benchmark object (such as"
        f" {next(iter(known), 'cup-1')}), and no file describes it: add"
        f" {label}{shapes.TRUTH_SUFFIX} (object, pose) or a depth map {label}{shapes.DEPTH_MAP_SUFFIX}"
    )


def check_truths(by_label: Mapping[str, Sequence[Path]], rig: Rig) -> None:
    """Raise the errors of `truth_depth_m` that reading these recordings would end with, at once."""
    known = benchmark_depths(shapes.object_box(rig))
    for label, paths in by_label.items():
        for path in paths:
            truth_depth_m(path, label, rig, known)


def _truth_file(folder: Path, name: str) -> Path | None:
    """Return the truth file of a name, if any. Raises RecordingError for two, or for a mesh without
    a pose.
    """
    found = [
        path
        for end in (shapes.TRUTH_SUFFIX, shapes.DEPTH_MAP_SUFFIX)
        if (path := folder / f"{name}{end}").is_file()
    ]
    if len(found) > 1:
        raise RecordingError(
            f"{found[0]} and {found[1].name} both describe {name!r}: remove one of them"
        )
    if not found and (meshes := _meshes(folder, name)):
        raise RecordingError(
            f"{meshes[0]} has no pose in the object box: write {name}{shapes.TRUTH_SUFFIX} beside"
            " it, with size_m, x_m, y_m, front_m and its angles"
        )
    return found[0] if found else None


def _meshes(folder: Path, name: str) -> list[Path]:
    return [path for end in shapes.MESH_SUFFIXES if (path := folder / f"{name}{end}").is_file()]


def _depth_map(path: Path, box: ObjectBox) -> Float32:
    depth_m, _ = shapes.without_absent(shapes.read_depth_map(path), str(path), box)
    if depth_m.shape != (OBJECT_PIXELS, OBJECT_PIXELS):
        raise RecordingError(
            f"{path} has shape {depth_m.shape}: the depth map of a label needs {OBJECT_PIXELS} x"
            f" {OBJECT_PIXELS} cells"
        )
    if behind := int((depth_m > np.float32(box.z_far_m)).sum()):
        raise RecordingError(
            f"{path} has {behind} of {depth_m.size} cells behind the object box ({box.z_far_m:g} m"
            " from the wall): the depth map of a label lies within it, with NaN for background"
        )
    return depth_m


def _placed(path: Path, names: Sequence[str], rig: Rig) -> Float32:
    """Return the depth of a truth file's object; without `category` or `file` it is the mesh beside
    the truth file that has the first of the names.
    """
    hidden = _hidden(path, names)
    depth_m = SceneFile(name=hidden.label, rig=rig, object=hidden).scene_at(0).object_depth_m
    if depth_m is None or np.isnan(depth_m).all():
        raise shapes.invisible_object_error(hidden.label, shapes.object_box(rig))
    return depth_m


def _hidden(path: Path, names: Sequence[str]) -> HiddenObject:
    try:
        fields: dict[str, Any] = read_toml(path)
        meshes = [mesh for name in names for mesh in _meshes(path.parent, name)]
        if not fields.keys() & {"category", "file"} and meshes:
            fields["file"] = meshes[0].name
        if isinstance(file := fields.get("file"), str):
            fields["file"] = str((path.parent / file).resolve())
        return HiddenObject.model_validate(fields)
    except ValidationError as error:
        raise RecordingError(
            f"{path} does not describe a hidden object: {first_problem(error)}"
        ) from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise RecordingError(f"{path} cannot be read as TOML: {error}") from error


@dataclass(frozen=True)
class Labelled:
    """Samples (n) of labelled recordings, one recording after another."""

    maps: MapSet
    """Maps as `live` gives them to networks of the bench's own rig, with the images of the
    truth.
    """
    recorded: MapSet
    """The same frames' maps as the lidar measured them, from which difference maps are made."""
    object_depth_m: Float32
    """(n, 64, 64); NaN for background."""
    label: tuple[str, ...]
    """Label of each sample."""
    recording: tuple[str, ...]
    """File name of each sample's recording."""
    rig: Rig
    """Rig of the bench that all were recorded on."""


def list_recordings(folder: Path) -> list[Path]:
    """Return the recordings of a folder, sorted by name. Raises RecordingError where there is
    none.
    """
    if paths := sorted(folder.glob("*.bag")):
        return paths
    raise RecordingError(
        f"no recordings in {folder}: make some with `nlos-cam capture --label NAME --out F.bag`"
    )


def read_labelled(
    recordings: Sequence[Path],
    *,
    known: KnownObjects = benchmark_depths,
    wall: OpenBench | Path | None = None,
    frames: int = FRAMES_PER_RECORDING,
    on_progress: OnProgress = ignore,
) -> Labelled:
    """Return maps of `frames` frames spread evenly over each recording, with the truth of their
    labels.

    Maps are of single frames, as in `live`, so that each has noise of its own. They are corrected
    as `live` does it, by `wall`, a wall record or what opens the bench for a camera: range and its
    drift, cells at the occluder's edge, reflectance of the wall and ripples of the lidar. Without
    `wall` the rig is the sidecars', or the paper's. Frames without any return are left out. Raises
    RecordingError for a recording without a label, a truth or a frame, and for recordings of two
    benches.
    """
    parts: list[Labelled] = []
    objects: dict[str, Mapping[str, Float32]] = {}

    def objects_on(rig: Rig) -> Mapping[str, Float32]:
        if rig.checksum not in objects:
            objects[rig.checksum] = known(shapes.object_box(rig))
        return objects[rig.checksum]

    for path in recordings:
        parts.append(_read(path, objects_on, wall, frames))
        one = parts[0].rig
        other = parts[-1].rig
        if one != other:
            raise RecordingError(
                f"{recordings[0]} and {path} are of two benches (rigs {one.name} {one.checksum} and"
                f" {other.name} {other.checksum}): label one bench at a time, or give its --wall"
            )
        on_progress(len(parts), len(recordings))
    return _join(parts)


def _read(
    path: Path,
    objects_on: Callable[[Rig], Mapping[str, Float32]],
    wall: OpenBench | Path | None,
    frames: int,
) -> Labelled:
    sidecar = load_sidecar(sidecar_path(path))
    if not sidecar.label:
        raise RecordingError(
            f"{path} has no label: record it with `nlos-cam capture --label NAME`, or write its"
            f" name as label into {sidecar_path(path)}"
        )
    images = open_lidar_bag(path).streams["depth"].frames
    with ReplayCamera(path) as camera:
        bench = _bench(path, sidecar, wall, camera)
        truth_m = truth_depth_m(path, sidecar.label, bench.rig, objects_on(bench.rig))
        drifts_m: list[float] = []
        every = spread_maps(
            camera, images, frames, lambda frame: drifts_m.append(bench.follow(frame))
        )
        recorded = [maps for maps in every if maps.valid.any()]
    if not recorded:
        raise RecordingError(
            f"{path} has no frame with any return: inspect it with `nlos-cam replay`"
        )
    own = OwnMaps(bench)
    # The last one, also for the first frames, at which it was not known yet: in some seconds the
    # range does not drift.
    drift_m = drifts_m[-1]
    if bench.moved:
        raise RecordingError(
            f"{path}: the lidar was not where the wall's record has it: record the object again"
            " after `nlos-cam calibrate`, or take the file away"
        )
    truths_m = np.repeat(truth_m[None], len(recorded), axis=0)
    image = shapes.image_from_depth(truths_m, shapes.object_box(bench.rig)).astype(np.float16)
    return Labelled(
        maps=as_map_set([own.correct(maps, drift_m) for maps in recorded], image),
        recorded=as_map_set([without(maps, drift_m) for maps in recorded], image),
        object_depth_m=truths_m,
        label=(sidecar.label,) * len(recorded),
        recording=(path.name,) * len(recorded),
        rig=bench.rig,
    )


def without(maps: LidarMaps, drift_m: float) -> LidarMaps:
    """Return maps less the range's drift."""
    return replace(maps, depth_m=maps.depth_m - np.float32(drift_m))


def as_map_set(maps: Sequence[LidarMaps], image: Float16 | Float32) -> MapSet:
    """Return maps with their true images v (n, 64, 64)."""
    return MapSet(np.stack([m.depth_m for m in maps]), np.stack([m.intensity for m in maps]), image)


def spread(count: int, wanted: int) -> frozenset[int]:
    """Return `wanted` of the numbers below `count`, evenly spread, or all of them if they are
    fewer.
    """
    if wanted >= count:
        return frozenset(range(count))
    return frozenset(((np.arange(wanted) + 0.5) * count / wanted).astype(int).tolist())


def spread_maps(
    camera: Iterable[Frame],
    count: int,
    wanted: int,
    on_frame: Callable[[Frame], object] = ignore,
) -> list[LidarMaps]:
    """Return maps of `wanted` frames evenly spread over a recording, which has about `count`; give
    every frame to `on_frame`.
    """
    while True:
        chosen = spread(count, wanted)
        found: list[LidarMaps] = []
        complete = 0
        for frame in camera:
            on_frame(frame)
            if complete in chosen:
                found.append(maps_from_frame(frame))
            complete += 1
        if complete == count:
            return found
        # Depth images without their infrared make no frame: chosen again over those that are.
        count = complete


def _bench(
    path: Path, sidecar: Sidecar, wall: OpenBench | Path | None, camera: ReplayCamera
) -> CalibratedRig:
    if isinstance(wall, Path):
        return open_bench(wall, camera)
    if wall is not None:
        return wall(camera)
    if sidecar.wall is not None:
        raise RecordingError(
            f"{path} was captured with --wall {sidecar.wall.path}, which corrects its maps: give"
            " --wall here too, or --bench"
        )
    return CalibratedRig(
        sidecar.rig if sidecar.rig and sidecar.rig.object_box else load_rig("paper-rig")
    )


def _join(parts: Sequence[Labelled]) -> Labelled:
    return Labelled(
        maps=_joined([one.maps for one in parts]),
        recorded=_joined([one.recorded for one in parts]),
        object_depth_m=np.concatenate([one.object_depth_m for one in parts]),
        label=tuple(chain(*(one.label for one in parts))),
        recording=tuple(chain(*(one.recording for one in parts))),
        rig=parts[0].rig,
    )


def _joined(parts: Sequence[MapSet]) -> MapSet:
    return MapSet(*(np.concatenate([getattr(one, name) for one in parts]) for name in MAP_CHANNELS))


def label_recordings(
    recordings: Path,
    out: Path,
    *,
    wall: OpenBench | Path | None = None,
    frames: int = FRAMES_PER_RECORDING,
    command: str = "",
    on_progress: OnProgress = ignore,
) -> Labelled:
    """Write a folder of labelled recordings as a dataset, and return its samples; see
    `read_labelled`.
    """
    labelled = read_labelled(
        list_recordings(recordings), wall=wall, frames=frames, on_progress=on_progress
    )
    write_shards(labelled, out, command)
    return labelled


def write_shards(labelled: Labelled, folder: Path, command: str = "") -> None:
    """Write samples as a dataset, with their numbers as seeds; earlier shards go in the same step
    in which these appear.

    Raises DiskFullError where they do not fit, OutputExistsError where `folder` is a file.
    """
    plan = DatasetPlan(labelled.rig, first_seed=0, accuracy=RECORDED)
    samples = _samples(labelled, plan)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with atomic_directory(folder, drop=[SHARD_PATTERN]) as whole:
        for start in range(0, len(labelled.label), SHARD):
            part = {name: values[start : start + SHARD] for name, values in samples.items()}
            try:
                store(shard_path(whole, start), part, plan.provenance, command)
            except DiskFullError as error:
                raise DiskFullError(
                    f"no room for the dataset {folder}: the earlier one is kept; free some space"
                ) from error


def _samples(labelled: Labelled, plan: DatasetPlan) -> Samples:
    maps = labelled.maps
    *geometry, _ = scene_row(plan.rig, plan.sensor)  # the gain of a real sensor is unknown
    return {
        "depth_m": maps.depth_m,
        "intensity": maps.intensity,
        "image": maps.image,
        "recorded_depth_m": labelled.recorded.depth_m,
        "recorded_intensity": labelled.recorded.intensity,
        "object_depth_m": labelled.object_depth_m,
        "seed": np.arange(len(labelled.label)),
        "scene": np.tile([*geometry, np.nan], (len(labelled.label), 1)),
        "category": np.array(labelled.label, object),
    }
