"""The docs' stills and video of a replay: docs/images/gallery-*.png and replay.webm, of simulated scenes.

Run from the repository: `python tools/replay_pictures.py`. The scenes are rendered ahead, and kept; frames come as fast
as they are reconstructed, so that none is dropped on a slow machine. Those of your own recording: `nlos-cam replay
F.bag --stills 4 --video`.
"""

import argparse
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event
from typing import Self

from nlos_calibration.rig import load_rig

from nlos_cam.camera.simulated_world import World, open_world
from nlos_cam.camera.streams import FRAMES_PER_S
from nlos_cam.cli.common import tracked
from nlos_cam.frames import Frame
from nlos_cam.live.replay import replay
from nlos_cam.live.replay_media import VIDEO, Looks
from nlos_cam.reconstruct.bench import Bench
from nlos_cam.reconstruct.pipeline import load_doubt, load_networks, set_up

IMAGES = Path("docs/images")
SCENES = {"airplane": "", "cup": "examples/cup.toml", "empty": "examples/empty.toml"}
"""By what a still is called, the scenes."""
FILMED, STILL_FRAMES = "airplane", 2
MOST_BYTES = 1_000_000
"""Of a video in the docs: the repository stays small."""


class Unhurried:
    """A world's frames as a recording's: each of them, when it is asked for, with its truth."""

    def __init__(self, world: World, frames: int) -> None:
        self.uri, self.rig, self.identity = f"sim:{world.scene.name}", world.rig, {"serial": ""}
        self.intrinsics, self.incomplete, self.dropped = world.rig.pinhole, 0, 0
        self.counts: Counter[str] = Counter()
        self._world, self._frames, self._number = world, frames, 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def __iter__(self) -> Iterator[Frame]:
        world = self._world
        for number in range(self._frames):
            self._number = number
            yield replace(
                world.images(number).frame(self.intrinsics),
                frame_number=number,
                timestamp_s=number / FRAMES_PER_S,
                truth_depth_m=world.truth_depth_m(number),
            )

    def telemetry(self, ending: str = "") -> Mapping[str, float]:
        return {name: celsius for name, celsius in self._world.celsius(self._number).items() if name.endswith(ending)}


def draw(name: str, scene: str, frames: int, out: Path) -> None:
    """A still of a scene's last sampled moment, and of one of them the video."""
    with tracked(f"rendering {name}") as on_progress:
        world = open_world(scene, on_progress)
    bench = Bench(world.rig if world.rig.object_box else load_rig("paper-rig"))
    processing = set_up(bench, load_networks(), doubter=load_doubt())
    looks, camera = Looks(bench, stills=2, video=name == FILMED), Unhurried(world, frames)
    with TemporaryDirectory() as folder, tracked(f"reconstructing {name}") as on_progress:
        made, done = Path(folder) / "replay", iter(range(1, frames + 1))
        replay(camera, processing, made, stop=Event(), on_frame=lambda: on_progress(next(done), frames), looks=looks)
        shutil.copyfile(max(made.glob("still-*.png")), out / f"gallery-{name}.png")
        if looks.video:
            shutil.copyfile(made / VIDEO, out / VIDEO)


def main() -> None:
    """Draw each scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=IMAGES)
    parser.add_argument("--seconds", type=float, default=4.0, help="of the video")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for name, scene in SCENES.items():
        frames = round(options.seconds * FRAMES_PER_S) if name == FILMED else STILL_FRAMES
        draw(name, scene, frames, options.out)
    if (size := (options.out / VIDEO).stat().st_size) > MOST_BYTES:
        print(f"{VIDEO} has {size / 1e6:.1f} MB, and the docs have room for {MOST_BYTES / 1e6:.0f}: --seconds less")
    print(f"wrote {', '.join(sorted(f'gallery-{name}.png' for name in SCENES))} and {VIDEO} to {options.out}")


if __name__ == "__main__":
    main()
