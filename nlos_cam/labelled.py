"""Labelled recordings of known objects as what networks learn from: maps of their frames, and the truth by label."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from nlos_calibration.arrays import Float32
from nlos_calibration.rig import ObjectBox, Rig, load_rig
from nlos_models.data import MapSet
from numpy.typing import NDArray

from nlos_cam.errors import RecordingError
from nlos_cam.frames import LidarMaps, maps_from_frame
from nlos_cam.labelled_truth import fixed_objects, truth_depth_m
from nlos_cam.objects.depth_map import image_from_depth, object_box
from nlos_cam.reconstruct.bench import Bench, open_bench
from nlos_cam.recording.playback import ReplayCamera, open_lidar_bag
from nlos_cam.recording.sidecar import Sidecar, load_sidecar, sidecar_path

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
        maps = [bench.corrected(some) for some in taken if some.valid.any()]
    if not maps:
        raise RecordingError(f"{path} holds no frame with a return in it: look at it with `nlos-cam replay`")
    return _Recorded(path, sidecar.label, maps, truth_m, bench.rig)


def spread(count: int, wanted: int) -> frozenset[int]:
    """`wanted` of the numbers below `count`, evenly spread; all of them if they are fewer."""
    return frozenset(
        ((np.arange(wanted) + 0.5) * count / wanted).astype(int).tolist() if wanted < count else range(count)
    )


def _bench(path: Path, sidecar: Sidecar, wall: Path | None, camera: ReplayCamera) -> Bench:
    if wall is not None:
        return open_bench(wall, camera)
    if sidecar.wall is not None:
        raise RecordingError(
            f"{path} was captured with --wall {sidecar.wall.path}, by which maps are corrected: give --wall here too"
        )
    return Bench(sidecar.rig if sidecar.rig and sidecar.rig.object_box else load_rig("paper-rig"))


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
