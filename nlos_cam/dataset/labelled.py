"""Labelled recordings of known objects as what networks learn from: maps of their frames, and the truth by label.

What was hidden while a labelled recording was made: a test object by its name, or a file beside the recording.

Labelled recordings as a dataset: the shards that `dataset build` makes, so that whatever reads those reads these.
"""

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration import ObjectBox, Rig, first_problem, load_rig
from nlos_calibration.arrays import Float32
from nlos_models import MapSet
from numpy.typing import NDArray
from pydantic import ValidationError

from nlos_cam.dataset.build import SHARD, DatasetPlan
from nlos_cam.dataset.plan import scene_row
from nlos_cam.dataset.samples import Samples
from nlos_cam.dataset.shards import SHARDS, shard_path, store
from nlos_cam.errors import DiskFullError, RecordingError
from nlos_cam.files import atomic_directory
from nlos_cam.frames import OBJECT_PIXELS, LidarMaps, maps_from_frame
from nlos_cam.objects import (
    DEPTH_MAP_SUFFIX,
    MESH_SUFFIXES,
    benchmark_objects,
    image_from_depth,
    invisible_object_error,
    object_box,
    read_depth_map,
)
from nlos_cam.reconstruct import CalibratedRig, open_bench
from nlos_cam.recording import ReplayCamera, Sidecar, load_sidecar, open_lidar_bag, sidecar_path
from nlos_cam.render import HiddenObject, SceneFile

TRUTH_SUFFIX = ".truth.toml"
"""Of a file with the fields of a scene file's [object]: what it is, and how it stands in the rig's object box."""


def fixed_objects(box: ObjectBox) -> Mapping[str, Float32]:
    """The test objects, whose label alone tells them: their depths (64, 64) over a box, by name."""
    return {thing.name: thing.depth_m for thing in benchmark_objects(box)}


def truth_depth_m(recording: Path, label: str, rig: Rig, known: Mapping[str, Float32]) -> Float32:
    """The hidden depth (64, 64) over the rig's object box of one labelled recording, NaN for background.

    Files beside it are asked first, by the recording's name and then by its label: NAME.truth.toml, NAME.npy; then
    `known` objects, by their names. Raises RecordingError where none tells, or two do; SceneError for an odd file.
    """
    for name in dict.fromkeys((recording.stem, Path(label).name)):
        if (file := _truth_file(recording.parent, name)) is not None:
            return _depth_map(file) if file.suffix == DEPTH_MAP_SUFFIX else _placed(file, name, rig)
    if label in known:
        return known[label]
    raise RecordingError(
        f"{recording} is labelled {label!r}, which is no test object (such as {next(iter(known), 'cup-1')}), and "
        f"nothing beside it tells its shape: add {label}{TRUTH_SUFFIX} (what it is, and its pose) or a depth map "
        f"{label}{DEPTH_MAP_SUFFIX}"
    )


def _truth_file(folder: Path, name: str) -> Path | None:
    """The one truth of that name. Raises RecordingError for two, or for a mesh that nothing places."""
    found = [path for end in (TRUTH_SUFFIX, DEPTH_MAP_SUFFIX) if (path := folder / f"{name}{end}").is_file()]
    if len(found) > 1:
        raise RecordingError(f"{found[0]} and {found[1].name} both tell what {name!r} is: leave one of them")
    if not found and (meshes := _meshes(folder, name)):
        raise RecordingError(
            f"nothing tells how {meshes[0]} stands in the object box: write {name}{TRUTH_SUFFIX} beside it, with "
            "size_m, x_m, y_m, front_m and its angles"
        )
    return found[0] if found else None


def _meshes(folder: Path, name: str) -> list[Path]:
    return [path for end in MESH_SUFFIXES if (path := folder / f"{name}{end}").is_file()]


def _depth_map(path: Path) -> Float32:
    depth_m = read_depth_map(path)
    if depth_m.shape != (OBJECT_PIXELS, OBJECT_PIXELS):
        raise RecordingError(
            f"{path} has shape {depth_m.shape}: what networks learn from has {OBJECT_PIXELS} cells along each side"
        )
    return depth_m


def _placed(path: Path, name: str, rig: Rig) -> Float32:
    """What a truth file says, in the rig's object box; without `category` or `file` it is of the mesh beside it."""
    thing = _hidden(path, name)
    depth_m = SceneFile(name=thing.label, rig=rig, object=thing).scene_at(0).object_depth_m
    if depth_m is None or np.isnan(depth_m).all():
        raise invisible_object_error(thing.label, object_box(rig))
    return depth_m


def _hidden(path: Path, name: str) -> HiddenObject:
    try:
        fields: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
        meshes = _meshes(path.parent, name)
        if not fields.keys() & {"category", "file"} and meshes:
            fields["file"] = meshes[0].name
        if isinstance(file := fields.get("file"), str):
            fields["file"] = str((path.parent / file).resolve())
        return HiddenObject.model_validate(fields)
    except ValidationError as error:
        raise RecordingError(f"{path} does not tell a hidden object: {first_problem(error)}") from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise RecordingError(f"{path} cannot be read as TOML: {error}") from error


FRAMES_EACH = 8
"""Of a recording, whose frames differ by their noise alone: more of them add little."""

OnProgress = Callable[[int, int], None]
Known = Callable[[ObjectBox], Mapping[str, Float32]]
"""The objects that a label alone tells, by name: their depths (64, 64) over a box."""


def _say_nothing(done: int, total: int) -> None:
    del done, total


@dataclass(frozen=True)
class Labelled:
    """Samples (n) of labelled recordings, those of a recording one after another."""

    maps: MapSet
    """With the images of the truth."""
    object_depth_m: Float32
    """(n, 64, 64); NaN for background."""
    label: tuple[str, ...]
    """Of each sample."""
    recording: tuple[str, ...]
    """The name of each sample's file."""
    rig: Rig
    """The one bench that all were recorded on."""


@dataclass(frozen=True)
class _Recorded:
    """One recording, read."""

    path: Path
    label: str
    maps: list[LidarMaps]
    truth_m: Float32
    rig: Rig


def recordings_in(folder: Path) -> list[Path]:
    """The recordings of a folder, in the order of their names. Raises RecordingError where there is none."""
    if found := sorted(folder.glob("*.bag")):
        return found
    raise RecordingError(f"no recordings in {folder}: make some with `nlos-cam capture --label NAME --out F.bag`")


def read_labelled(
    recordings: Sequence[Path],
    *,
    known: Known = fixed_objects,
    wall: Path | None = None,
    frames: int = FRAMES_EACH,
    on_progress: OnProgress = _say_nothing,
) -> Labelled:
    """The maps of `frames` single frames of each recording, evenly spread over it, with what was hidden meanwhile.

    Single frames, not their mean: that is what `live` shows the networks, and each has noise of its own. `wall` is the
    record of the bench, by which maps are corrected as `live` corrects them; without one, the bench is the one that the
    sidecars tell, or the paper's. A frame without any return is left out. Raises RecordingError for a recording without
    a label, a truth or a frame, and for recordings of two benches.
    """
    read: list[_Recorded] = []
    objects: dict[str, Mapping[str, Float32]] = {}

    def objects_of(rig: Rig) -> Mapping[str, Float32]:
        if rig.checksum not in objects:
            objects[rig.checksum] = known(object_box(rig))
        return objects[rig.checksum]

    for path in recordings:
        read.append(_read(path, objects_of, wall, frames))
        if read[0].rig != read[-1].rig:
            raise RecordingError(
                f"{read[0].path} and {path} are of two benches (rigs {_told(read[0].rig)} and {_told(read[-1].rig)}): "
                "label the recordings of one bench at a time, or give its --wall"
            )
        on_progress(len(read), len(recordings))
    return _joined(read)


def _told(rig: Rig) -> str:
    return f"{rig.name} {rig.checksum}"


def _read(path: Path, objects_of: Callable[[Rig], Mapping[str, Float32]], wall: Path | None, frames: int) -> _Recorded:
    sidecar = load_sidecar(sidecar_path(path))
    if not sidecar.label:
        raise RecordingError(
            f"{path} has no label: record it with `nlos-cam capture --label NAME`, or write its name as label into "
            f"{sidecar_path(path)}"
        )
    chosen = spread(open_lidar_bag(path).streams["depth"].frames, frames)
    with ReplayCamera(path) as camera:
        bench = _bench(path, sidecar, wall, camera)
        truth_m = truth_depth_m(path, sidecar.label, bench.rig, objects_of(bench.rig))
        taken = (maps_from_frame(frame) for number, frame in enumerate(camera) if number in chosen)
        maps = [bench.correct_range(some) for some in taken if some.valid.any()]
    if not maps:
        raise RecordingError(f"{path} holds no frame with a return in it: look at it with `nlos-cam replay`")
    return _Recorded(path, sidecar.label, maps, truth_m, bench.rig)


def spread(count: int, wanted: int) -> frozenset[int]:
    """`wanted` of the numbers below `count`, evenly spread; all of them if they are fewer."""
    return frozenset(
        ((np.arange(wanted) + 0.5) * count / wanted).astype(int).tolist() if wanted < count else range(count)
    )


def _bench(path: Path, sidecar: Sidecar, wall: Path | None, camera: ReplayCamera) -> CalibratedRig:
    if wall is not None:
        return open_bench(wall, camera)
    if sidecar.wall is not None:
        raise RecordingError(
            f"{path} was captured with --wall {sidecar.wall.path}, by which maps are corrected: give --wall here too"
        )
    return CalibratedRig(sidecar.rig if sidecar.rig and sidecar.rig.object_box else load_rig("paper-rig"))


def _joined(read: Sequence[_Recorded]) -> Labelled:
    counts = [len(one.maps) for one in read]
    box = object_box(read[0].rig)
    truth_m = np.repeat([one.truth_m for one in read], counts, axis=0)
    depth_m, intensity = (
        np.stack([getattr(some, name) for one in read for some in one.maps]) for name in ("depth_m", "intensity")
    )
    image: NDArray[np.float16] = image_from_depth(truth_m, box).astype(np.float16)
    label, recording = (
        tuple(text for text, count in zip(texts, counts, strict=True) for _ in range(count))
        for texts in ([one.label for one in read], [one.path.name for one in read])
    )
    return Labelled(MapSet(depth_m, intensity, image), truth_m, label, recording, read[0].rig)


RECORDED = "recorded"
"""The accuracy of what was not rendered."""


def plan_of(labelled: Labelled) -> DatasetPlan:
    """The plan that stands in the shards. Its sensor says nothing: that of a real device is not known."""
    return DatasetPlan(labelled.rig, first_seed=0, accuracy=RECORDED)


def write_shards(labelled: Labelled, folder: Path, command: str = "") -> None:
    """Write the samples as a dataset, in place of the shards that are there; a seed is a sample's number.

    Those go when all of the new ones are on the disk. Raises DiskFullError where these do not fit, OutputExistsError
    where `folder` is a file.
    """
    provenance, samples = plan_of(labelled).provenance, _samples(labelled)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with atomic_directory(folder) as whole:
        for start in range(0, len(labelled.label), SHARD):
            part = {name: values[start : start + SHARD] for name, values in samples.items()}
            try:
                store(shard_path(whole, start), part, provenance, command)
            except DiskFullError as error:
                raise DiskFullError(f"no room for the dataset {folder}: what was there is kept; make room") from error
        for shard in folder.glob(SHARDS):  # so that no stop leaves shards of both
            shard.unlink()


def _samples(labelled: Labelled) -> Samples:
    maps, plan = labelled.maps, plan_of(labelled)
    *geometry, _ = scene_row(plan.rig, plan.sensor)
    return {
        "depth_m": maps.depth_m,
        "intensity": maps.intensity,
        "image": maps.image,
        "object_depth_m": labelled.object_depth_m,
        "seed": np.arange(len(labelled.label)),
        "scene": np.tile([*geometry, np.nan], (len(labelled.label), 1)),
        "category": np.array(labelled.label, object),
    }
