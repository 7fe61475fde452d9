"""Pictures of the docs: the gallery's failures, sheets of the hidden objects, stills and video of a
replay.

`python tools/docs/pictures.py [failures] [objects] [replay] [--out docs/images]`: all without
names. Frames of the replay come as fast as they are reconstructed, so that a slow machine drops
none.
"""

import argparse
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event
from typing import Self

import numpy as np
from matplotlib.figure import Figure
from nlos_calibration import ObjectBox, load_rig
from nlos_calibration.arrays import Float32, Float64
from nlos_models import silhouette_iou
from PIL import Image

from nlos_cam import objects as shapes
from nlos_cam.camera import FRAMES_PER_S, World, open_world, render_loop
from nlos_cam.cli.common import tracked
from nlos_cam.evaluate import (
    SeededObject,
    Subject,
    as_map_set,
    echoes_of,
    reconstruct_all,
    sense,
    truth_of,
)
from nlos_cam.files import atomic_file
from nlos_cam.frames import OBJECT_PIXELS, Frame
from nlos_cam.reconstruct import CalibratedRig, build_pipeline, load_networks, load_uncertainty
from nlos_cam.render import load_scene
from nlos_cam.replay import VIDEO, ReplayMedia, replay_recording

ROOT = Path(__file__).parents[2]
WORST = 6
NEAR_M = 0.16
FAR_M = 0.24
VARIATIONS = 5
SIDE_BY_SIDE = 2
INCHES = 0.85
SCENES = {"airplane": "", "cup": "examples/cup.toml", "empty": "examples/empty.toml"}
"""Scenes by the names of their stills."""
FILMED = "airplane"
FILM_S = 4.0
STILL_FRAMES = 2
MAX_BYTES = 1_000_000


def unlike_training() -> list[SeededObject]:
    """Return shapes unlike any training object, and nothing at all."""
    y, x = (np.mgrid[:OBJECT_PIXELS, :OBJECT_PIXELS] - (OBJECT_PIXELS - 1) / 2) / OBJECT_PIXELS
    radius = np.hypot(x, y)
    depths_m = {
        "a ring": np.where(abs(radius - 0.3) < 0.06, NEAR_M, np.nan),
        "two posts": np.where((abs(abs(x) - 0.25) < 0.06) & (abs(y) < 0.4), NEAR_M, np.nan),
        "a slanted plate": np.where(
            np.maximum(abs(x), abs(y)) < 0.35, (NEAR_M + FAR_M) / 2 + 0.15 * x, np.nan
        ),
        "a wall of steps": np.where(
            abs(y) < 0.4, np.where(np.floor(8 * x) % 2 == 0, NEAR_M, FAR_M), np.nan
        ),
        "nothing": np.full_like(x, np.nan),
    }
    return [
        SeededObject(name, name, depth_m.astype(np.float32)) for name, depth_m in depths_m.items()
    ]


def reconstructed(subjects: Sequence[Subject]) -> tuple[Float32, Float32, Float64]:
    """Return the shipped networks' images of objects (n, 64, 64), the truth, and the silhouettes'
    IoU.
    """
    rig = load_rig("paper-rig")
    truth = truth_of(subjects, shapes.object_box(rig))
    maps = as_map_set(sense(echoes_of(subjects, rig, lambda *_: None), rig), truth)
    image = reconstruct_all(load_networks(), maps)
    return image, truth, silhouette_iou(image, truth)


def draw_pairs(
    path: Path, rows: Sequence[tuple[str, Sequence[Subject], Float32, Float32, Float64]]
) -> None:
    """Draw truth above reconstruction, one block of two rows for each of `rows`."""
    columns = max(len(subjects) for _, subjects, *_ in rows)
    figure = Figure(figsize=(1.35 * columns, 3.1 * len(rows)), layout="constrained")
    parts = np.atleast_1d(figure.subfigures(len(rows)))
    for part, (title, subjects, image, truth, iou) in zip(parts, rows, strict=True):
        part.suptitle(title, fontsize=10)
        axes = part.subplots(2, columns)
        for axis in axes.flat:
            axis.set_axis_off()
        for k, subject in enumerate(subjects):
            for axis, picture in zip(axes[:, k], (truth[k], image[k]), strict=True):
                axis.imshow(picture, cmap="magma", vmin=0, vmax=1)
            axes[0, k].set_title(subject.name, fontsize=8)
            axes[1, k].set_title(
                "no truth to meet" if not truth[k].any() else f"IoU {iou[k]:.2f}", fontsize=7
            )
    with atomic_file(path) as unfinished:
        figure.savefig(unfinished, dpi=90, format="png")


def failures(out: Path) -> None:
    """Draw the worst of the test objects, and shapes unlike training."""
    fixed = shapes.benchmark_objects(shapes.object_box(load_rig("paper-rig")))
    others = unlike_training()
    image, truth, iou = reconstructed(fixed)
    worst = np.argsort(iou, kind="stable")[:WORST]
    rows = [
        (
            "the six worst of the 54 test objects",
            [fixed[k] for k in worst],
            image[worst],
            truth[worst],
            iou[worst],
        ),
        ("unlike anything trained on, and nothing at all", others, *reconstructed(others)),
    ]
    draw_pairs(out / "failures.png", rows)


def variations(category: str, box: ObjectBox) -> list[Float32]:
    """Return images of a category as training has them, each with another seed and pose."""
    poses = [
        shapes.random_pose(np.random.default_rng([k, *category.encode()]), box)
        for k in range(VARIATIONS)
    ]
    placed = [
        shapes.place(shapes.category_triangles(category, k), pose, box)
        for k, pose in enumerate(poses)
    ]
    return [
        shapes.image_from_depth(shapes.orthographic_depth(triangles, box), box)
        for triangles in placed
    ]


def draw_sheet(path: Path, images: dict[str, list[Float32]]) -> Figure:
    """Draw one line per category with its name, two categories side by side."""
    wide = max(len(row) for row in images.values())
    lines = -(-len(images) // SIDE_BY_SIDE)
    figure = Figure(
        figsize=(INCHES * SIDE_BY_SIDE * wide, 1.25 * INCHES * lines), layout="constrained"
    )
    axes = figure.subplots(lines, SIDE_BY_SIDE * wide)
    for axis in axes.ravel():
        axis.axis("off")
    for number, (name, row) in enumerate(images.items()):
        side, line = divmod(number, lines)
        for k, image in enumerate(row):
            axes[line, side * wide + k].imshow(image, vmin=0, vmax=1, cmap="magma")
        axes[line, side * wide].set_title(name, loc="left", fontsize=8, pad=2)
    figure.savefig(path, dpi=100)
    return figure


def objects(out: Path) -> None:
    """Draw the sheet of training's objects."""
    box = shapes.object_box(load_rig("paper-rig"))
    draw_sheet(out / "objects.webp", {name: variations(name, box) for name in shapes.CATEGORIES})


class Unhurried:
    """Camera that yields the frames of a simulated world with their truth, each as soon as it is
    asked for.
    """

    def __init__(self, world: World, frames: int) -> None:
        self.uri = f"sim:{world.scene.name}"
        self.rig = world.rig
        self.identity = {"serial": ""}
        self.intrinsics = world.rig.pinhole
        self.incomplete = 0
        self.dropped = 0
        self.counts: Counter[str] = Counter()
        self._world = world
        self._frames = frames
        self._number = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def __iter__(self) -> Iterator[Frame]:
        for number in range(self._frames):
            self._number = number
            frame = self._world.images(number).frame(self.intrinsics)
            truth_m = self._world.truth_depth_m(number)
            time_s = number / FRAMES_PER_S
            yield replace(frame, frame_number=number, timestamp_s=time_s, truth_depth_m=truth_m)

    def telemetry(self, ending: str = "") -> Mapping[str, float]:
        return {
            name: celsius
            for name, celsius in self._world.celsius(self._number).items()
            if name.endswith(ending)
        }


def _advance(update: Callable[[int, int], None], done: Iterator[int], total: int) -> None:
    update(next(done), total)


def first_poses(path: Path, poses: int, on_progress: Callable[[int, int], None]) -> World:
    """Return the world of a scene file with only its first poses, which are all that a still
    shows.
    """
    scene = load_scene(path)
    echoes, truths = render_loop(scene, on_progress, range(min(poses, scene.poses)))
    return World(scene, echoes, list(truths) if scene.hidden else [None])


def replays(out: Path) -> None:
    """Draw a still of each scene, and the video of one."""
    for name, scene in SCENES.items():
        frames = round(FILM_S * FRAMES_PER_S) if name == FILMED else STILL_FRAMES
        with tracked(f"rendering {name}") as on_progress:
            world = first_poses(ROOT / scene, frames, on_progress) if scene else open_world("")
        bench = CalibratedRig(world.rig if world.rig.object_box else load_rig("paper-rig"))
        processing = build_pipeline(bench, load_networks(), uncertainty_model=load_uncertainty())
        media = ReplayMedia(bench, stills=2, video=name == FILMED)
        camera = Unhurried(world, frames)
        with TemporaryDirectory() as folder, tracked(f"reconstructing {name}") as update:
            made = Path(folder) / "replay"
            done = iter(range(1, frames + 1))
            advance = partial(_advance, update, done, frames)
            replay_recording(camera, processing, made, stop=Event(), on_frame=advance, media=media)
            with Image.open(max(made.glob("still-*.png"))) as still:
                still.convert("RGB").save(out / f"gallery-{name}.webp", quality=85, method=6)
            if media.video:
                shutil.copyfile(made / VIDEO, out / VIDEO)
    if (size := (out / VIDEO).stat().st_size) > MAX_BYTES:
        print(
            f"{VIDEO} has {size / 1e6:.1f} MB, and the docs have room for {MAX_BYTES / 1e6:.0f}:"
            " shorten it"
        )


PICTURES: dict[str, Callable[[Path], None]] = {
    "failures": failures,
    "objects": objects,
    "replay": replays,
}


def main() -> None:
    """Draw the named pictures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "names", nargs="*", metavar="PICTURE", help=f"some of {', '.join(PICTURES)} (default: all)"
    )
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "images")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    for name in asked.names or PICTURES:
        PICTURES[name](asked.out)


if __name__ == "__main__":
    main()
