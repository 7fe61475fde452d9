"""The 54 test objects as labelled recordings of a simulated bench, for adaptation, validation and judging.

`python tools/studies/transfer_bench.py DIR [--scene examples/bench.toml] [--frames 8]` resumes. 54
recordings of 8 frames of 640 x 480 take 0.4 GB and two minutes. Frames of a bench at rest differ by their noise alone,
so that more of them would add little; a person's recordings of a few seconds have more.
"""

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event

import numpy as np

from nlos_cam.camera import FRAMES_PER_S, Recording, SimulatedCamera, World
from nlos_cam.cli.common import tracked
from nlos_cam.errors import RecordingError
from nlos_cam.objects import CATEGORIES, BenchmarkObject, benchmark_objects, object_box
from nlos_cam.recording import CaptureSession, CaptureTarget, finalize, load_sidecar, sidecar_path, verify
from nlos_cam.render import Scene, SceneFile, SensedImages, load_scene, render

SCENE = Path(__file__).parents[2] / "examples" / "bench.toml"
ADAPTATION, VALIDATION, HELD_OUT = "adaptation", "validation", "held-out"
"""30 objects, 6 for the training's schedule, and 18 for judging: no object is in two parts."""
HELD_OUT_NUMBER, VALIDATION_NUMBER, VALIDATION_EVERY = 3, 2, 3
"""Of each category's three objects, one is held out; of every third category, another is for validation."""
FRAMES = 8
BETWEEN_S = 30.0
"""Time between starts of recordings, in which the object is changed and the lidar warms."""


class HurriedClock:
    """Clock that moves only by waiting, so that nothing has to wait."""

    def __init__(self, start_s: float = 1e9) -> None:
        self.time_s = start_s

    def now(self) -> float:
        return self.time_s

    def wait(self, stop: Event, seconds: float) -> bool:
        self.time_s += max(seconds, 0.0)
        return stop.wait(0.0005)


class Later(World):
    """World at rest, seen by a camera that was switched on `since` frames ago."""

    def __init__(self, scene: SceneFile, shown: Scene, since: int) -> None:
        super().__init__(scene, [render(shown).multi], [shown.object_depth_m])
        self._since = since

    def images(self, number: int) -> SensedImages:
        return super().images(self._since + number)

    def celsius(self, number: int) -> Mapping[str, float]:
        return super().celsius(self._since + number)


@dataclass(frozen=True)
class Take:
    """Recording to be made: object, file, and frames since the device was switched on."""

    thing: BenchmarkObject
    path: Path
    since: int

    @property
    def truth(self) -> Path:
        """Path of the hidden depth: labels stay true when a generator of objects changes."""
        return self.path.with_suffix(".npy")

    @property
    def is_whole(self) -> bool:
        """True where the recording exists, of the object in its present shape."""
        if not (self.path.is_file() and self.truth.is_file()):
            return False
        same = np.array_equal(np.load(self.truth), self.thing.depth_m, equal_nan=True)
        try:
            return same and load_sidecar(sidecar_path(self.path)).state == "complete"
        except RecordingError:
            return False


def part_of(thing: BenchmarkObject) -> str:
    """Return the part of an object."""
    if thing.number == HELD_OUT_NUMBER:
        return HELD_OUT
    looked_at = sorted(CATEGORIES).index(thing.category) % VALIDATION_EVERY == 0
    return VALIDATION if looked_at and thing.number == VALIDATION_NUMBER else ADAPTATION


def takes(things: Sequence[BenchmarkObject], folder: Path) -> list[Take]:
    """Return one take of each object, in order: F/adaptation/cup-1.bag, F/held-out/cup-3.bag, ..."""
    apart = round(BETWEEN_S * FRAMES_PER_S)
    return [Take(thing, folder / part_of(thing) / f"{thing.name}.bag", k * apart) for k, thing in enumerate(things)]


def record(take: Take, scene: SceneFile, frames: int) -> None:
    """Make one recording and its sidecar, and read it back. Raises the error that ended it, if one did."""
    take.path.parent.mkdir(parents=True, exist_ok=True)
    sidecar_path(take.path).unlink(missing_ok=True)  # until it is there, nothing is whole
    np.save(take.truth, take.thing.depth_m)
    bare = scene.bare
    shown = Scene(scene.rig, take.thing.depth_m, bare.surface, scene.radiometry, scene.jump_m, bare.pulse_ns)
    recording = Recording(take.path, frames=frames)
    camera = SimulatedCamera(
        f"sim:{scene.rig.name}", Later(scene, shown, take.since), clock=HurriedClock(), recording=recording
    )
    job = CaptureTarget(take.path, take.thing.name)
    for made in CaptureSession(camera, recording, [job]).record(Event(), lambda _: None):
        settled = finalize(made, verify)
        if settled.error:
            raise settled.error


def record_all(
    scene: SceneFile,
    things: Sequence[BenchmarkObject],
    folder: Path,
    frames: int,
    on_progress: Callable[[int, int], None],
) -> Iterator[Path]:
    """Make the missing recordings in order; yield each when it exists."""
    for done, take in enumerate(every := takes(things, folder)):
        on_progress(done, len(every))
        if not take.is_whole:
            record(take, scene, frames)
        yield take.path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scene", type=Path, default=SCENE)
    parser.add_argument("--frames", type=int, default=FRAMES)
    asked = parser.parse_args()
    scene = load_scene(asked.scene)
    with tracked("recording the test objects") as on_progress:
        made = list(
            record_all(scene, benchmark_objects(object_box(scene.rig)), asked.folder, asked.frames, on_progress)
        )
    size_gb = sum(path.stat().st_size for path in made) / 1e9
    print(f"{len(made)} recordings of {asked.frames} frames, {size_gb:.2f} GB: {asked.folder}")


if __name__ == "__main__":
    main()
