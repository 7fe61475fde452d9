"""How well a board seen by a colour camera tells the wall: docs/board_in_colour.json (no arguments).

The colour camera is an L515's as two of them told theirs: intrinsics and lens of one, its place of another. What the
program is given of it is off by what `CameraErrors` allows, what takes the picture is not: that is another camera.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from board_trials import FLAT, Bench, random_bench, summary, trials
from nlos_calibration.arrays import Float64
from nlos_calibration.board import BOARDS, Corners
from nlos_calibration.board_pose import BoardFit, PrintErrors
from nlos_calibration.board_wall import BoardView, CameraErrors, find_in_view, fit_in_lidar
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.rig import load_rig
from numpy.typing import NDArray

from nlos_cam.calibrate.synthetic import Light, View, clean_view, corners_px, frames_of

OUT = Path(__file__).parents[1] / "docs" / "board_in_colour.json"
COLOUR = Intrinsics(1280, 720, 907.114, 907.605, 662.66, 367.428)
LENS = np.array([0.157553, -0.501105, -0.00164696, 0.000623876, 0.466404])
COLOUR_FROM_LIDAR = np.array(
    [
        [0.999965, -0.00754261, -0.0034929, 0.000304],
        [0.00762357, 0.999688, 0.0237769, 0.014235],
        [0.00331248, -0.0238027, 0.999711, -0.006955],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
TOLD = BoardView(
    np.zeros((COLOUR.height, COLOUR.width)),
    COLOUR,
    LENS,
    np.linalg.inv(COLOUR_FROM_LIDAR).astype(np.float64),
    "colour",
    CameraErrors(),
)
"""What the program is told of the colour camera; its image is taken later."""
MARGIN_PX = 5.0
CORNERS, IMAGES = 1000, 100
"""Benches whose corners are known, and benches that are rendered."""
A4, LIDAR = BOARDS["a4"], load_rig("bare-wall").pinhole
ROOM = Light(180.0, spot_mm=0.3)
"""A well exposed picture; the spot stands for the lens's blur."""


@dataclass(frozen=True)
class Taken:
    """The camera that takes the picture."""

    pinhole: Intrinsics
    lidar_from_colour: Float64

    def seen(self, bench: Bench) -> View:
        """A bench by this camera, as if its lens were straight."""
        return View(bench.seen.pose @ self.lidar_from_colour, self.pinhole)


def as_told() -> Taken:
    """A camera that is as it says."""
    return Taken(COLOUR, TOLD.lidar_from_camera)


def as_errors_allow(generator: np.random.Generator, errors: CameraErrors) -> Taken:
    """A camera that is off by random amounts."""
    off = np.eye(4)
    off[:3, :3] = cv2.Rodrigues(np.radians(errors.turn_std_deg) * generator.standard_normal(3))[0]
    moved = TOLD.lidar_from_camera.copy()
    moved[:3, :3] = off[:3, :3] @ moved[:3, :3]
    moved[:3, 3] += errors.shift_std_m * generator.standard_normal(3)
    longer = 1.0 + errors.focal_std * generator.standard_normal()
    return Taken(replace(COLOUR, fx=COLOUR.fx * longer, fy=COLOUR.fy * longer), moved)


def through_lens(pixels: Float64, pinhole: Intrinsics = COLOUR) -> Float64:
    """Where pixels (n, 2) of a straight lens are in the image of this one."""
    rays = np.column_stack([(pixels - [pinhole.ppx, pinhole.ppy]) / [pinhole.fx, pinhole.fy], np.ones(len(pixels))])
    bent, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), pinhole.matrix, LENS)
    return bent.reshape(-1, 2).astype(np.float64)


def image_through_lens(straight: Float64, pinhole: Intrinsics = COLOUR) -> Float64:
    """The image (height, width) that the lens makes of that of a straight one."""
    every = np.stack(np.meshgrid(np.arange(pinhole.width), np.arange(pinhole.height)), axis=-1).astype(np.float32)
    came_from = cv2.undistortImagePoints(every.reshape(-1, 1, 2), pinhole.matrix, LENS).reshape(every.shape)
    mapped = cv2.remap(straight, came_from.astype(np.float32), None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.maximum(mapped, 0.0).astype(np.float64)  # cubic curves swing below black


def colour_frames(bench: Bench, taken: Taken, count: int, generator: np.random.Generator) -> NDArray[np.uint8]:
    """Grey frames (count, height, width) of the board under the room's light."""
    clean = clean_view(bench.board, taken.seen(bench), bench.placed, bench.light)
    return frames_of(image_through_lens(clean, taken.pinhole), generator, count, bench.light)


def by_image(
    bench: Bench, taken: Taken, frames: int, generator: np.random.Generator, view: BoardView = TOLD
) -> BoardFit:
    """The plane in the lidar frame from the mean of rendered frames; prints are flat."""
    image = colour_frames(bench, taken, frames, generator).mean(axis=0)
    return find_in_view(replace(view, image=image), bench.board, FLAT)


def by_corners(
    bench: Bench,
    taken: Taken,
    sigma_px: float,
    generator: np.random.Generator,
    printed: PrintErrors,
    view: BoardView = TOLD,
) -> BoardFit:
    """The plane in the lidar frame from true corners with noise, of a sheet that bows."""
    bow_m = tuple(printed.bow_std_m * generator.standard_normal(2))
    straight = corners_px(bench.board, taken.seen(bench), bench.placed, bow_m)
    size = np.array([COLOUR.width, COLOUR.height])
    inside = np.flatnonzero(((straight > MARGIN_PX) & (straight < size - MARGIN_PX)).all(axis=1))
    pixels = through_lens(straight[inside], taken.pinhole)
    pixels += sigma_px * generator.standard_normal(pixels.shape)
    return fit_in_lidar(Corners(inside, pixels), bench.board, view, printed)


def coverage(count: int, sigma_px: float | None, seed: int, errors: CameraErrors | None = None) -> dict[str, object]:
    """Random benches, prints and cameras: by corners of such noise, or by 4 rendered frames where that is None."""
    generator, view = np.random.default_rng(seed), replace(TOLD, errors=errors or TOLD.errors)
    printed = FLAT if sigma_px is None else PrintErrors()

    def fit(bench: Bench) -> BoardFit:
        taken = as_errors_allow(generator, view.errors)
        if sigma_px is None:
            return by_image(bench, taken, 4, generator, view)
        return by_corners(bench, taken, sigma_px, generator, printed, view)

    return summary(*trials(count, lambda: random_bench(A4, LIDAR, generator, ROOM, printed), fit))


def main() -> None:
    """Measure, write, print."""
    result = {
        "assumed": vars(CameraErrors()),
        "random_benches": {f"corners, {sigma:g} pixels": coverage(CORNERS, sigma, 3) for sigma in (0.05, 0.2)}
        | {"rendered, 4 frames": coverage(IMAGES, None, 4)},
    }
    text = json.dumps(result, indent=1)
    OUT.write_text(text + "\n", encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
