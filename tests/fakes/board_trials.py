"""Random benches with a printed board, measured by the lidar's infrared or by a color camera,
against the truth.

The color camera has the intrinsics and lens of one L515 and the pose of another. The program is
given `CALIBRATION`; the camera that takes the picture differs from it by random calibration errors.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from nlos_calibration import (
    BOARDS,
    INTERVAL_STDS,
    Board,
    Corners,
    Intrinsics,
    find_corners,
    load_rig,
    measures_of,
)
from nlos_calibration.arrays import Float64, UInt8
from nlos_calibration.board_pose import BoardFit, PrintErrors
from nlos_calibration.board_wall import BoardView, CameraErrors, fit_in_lidar
from nlos_calibration.errors import BoardRefusedError
from synthetic_scenes import (
    Illumination,
    Placement,
    at_near_edge,
    clean_infrared,
    corners_px,
    infrared_frames,
)

from nlos_cam.calibrate import View, view

Generator = np.random.Generator

A4 = BOARDS["a4"]
LIDAR = load_rig("bare-wall").pinhole
FLAT = replace(PrintErrors(), bow_std_m=1e-6)
"""Errors of a rendered print, whose paper is flat."""
ROOM = Illumination(180.0, spot_mm=0.3)
"""A well exposed picture; the spot stands for the lens's blur."""
COLOR = Intrinsics(1280, 720, 907.114, 907.605, 662.66, 367.428)
LENS = np.array([0.157553, -0.501105, -0.00164696, 0.000623876, 0.466404])
COLOR_FROM_LIDAR = np.array(
    [
        [0.999965, -0.00754261, -0.0034929, 0.000304],
        [0.00762357, 0.999688, 0.0237769, 0.014235],
        [0.00331248, -0.0238027, 0.999711, -0.006955],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
CALIBRATION = BoardView(
    np.zeros((COLOR.height, COLOR.width)),
    COLOR,
    LENS,
    np.linalg.inv(COLOR_FROM_LIDAR),
    "colour",
    CameraErrors(),
)
"""The color camera as the program knows it, without an image."""


@dataclass(frozen=True)
class ColorCamera:
    """The color camera that takes the picture."""

    pinhole: Intrinsics = COLOR
    lidar_from_color: Float64 = field(default_factory=lambda: CALIBRATION.lidar_from_camera)

    def view(self, seen: View) -> View:
        """Return the lidar's view of a wall from here, through a straight lens."""
        return View(seen.pose @ self.lidar_from_color, self.pinhole)


@dataclass(frozen=True)
class BoardBench:
    """A lidar, a board on the wall, and the light; a color camera takes the picture if there is
    one.
    """

    board: Board
    seen: View
    placed: Placement
    light: Illumination = field(default_factory=Illumination)
    camera: ColorCamera | None = None

    def frames(self, count: int, generator: Generator) -> UInt8:
        """Return frames (count, height, width) of the camera, or the lidar's infrared."""
        seen = self.camera.view(self.seen) if self.camera else self.seen
        clean = clean_infrared(self.board, seen, self.placed, self.light)
        clean = image_through_lens(clean, seen.pinhole) if self.camera else clean
        return infrared_frames(clean, generator, count, self.light)

    def fit_image(
        self, count: int, generator: Generator, calibration: BoardView | None = None
    ) -> BoardFit:
        """Fit the plane to the mean of rendered frames."""
        calibration = calibration or BoardView(np.zeros((1, 1)), self.seen.pinhole)
        corners = find_corners(self.frames(count, generator).mean(axis=0), self.board)
        return fit_in_lidar(corners, self.board, calibration, FLAT)

    def fit_corners(
        self,
        sigma_px: float,
        generator: Generator,
        printed: PrintErrors,
        calibration: BoardView | None = None,
    ) -> BoardFit:
        """Fit the plane to true corners with noise, of a sheet that bows."""
        bow_m = tuple(printed.bow_std_m * generator.standard_normal(2))
        seen = self.camera.view(self.seen) if self.camera else self.seen
        pixels = corners_px(self.board, seen, self.placed, bow_m)
        size = np.array([seen.pinhole.width, seen.pinhole.height])
        inside = np.flatnonzero(((pixels > 5.0) & (pixels < size - 5.0)).all(axis=1))
        pixels = through_lens(pixels[inside], seen.pinhole) if self.camera else pixels[inside]
        corners = Corners(inside, pixels + sigma_px * generator.standard_normal(pixels.shape))
        calibration = calibration or BoardView(np.zeros((1, 1)), self.seen.pinhole)
        return fit_in_lidar(corners, self.board, calibration, printed)

    def compare(self, fit: BoardFit) -> tuple[Float64, Float64]:
        """Return errors (3,) of distance (mm), yaw and pitch (degrees), and the same in standard
        uncertainties.
        """
        found = measures_of(fit.slopes, fit.covariance)
        true = measures_of(-self.seen.pose[2, :3] / self.seen.pose[2, 3], np.zeros((3, 3)))
        off = np.array(
            [
                getattr(found, name) - getattr(true, name)
                for name in ("distance_m", "yaw_deg", "pitch_deg")
            ]
        )
        std = np.array([found.distance_std_m, found.yaw_std_deg, found.pitch_std_deg])
        return off * [1e3, 1.0, 1.0], off / std


def bench_at(
    distance_m: float, yaw_deg: float, pitch_deg: float = 0.0, **light: float
) -> BoardBench:
    """Return a bench with an A4 board at the near edge of the view."""
    seen = view(distance_m, yaw_deg, pitch_deg, LIDAR)
    return BoardBench(A4, seen, at_near_edge(A4, seen), Illumination(**light))


def random_bench(
    generator: Generator, printed: PrintErrors, light: Illumination | None = None
) -> BoardBench:
    """Return a bench inside the paper's ranges, with a board hung by hand and a printer's
    errors.
    """
    seen = view(
        generator.uniform(0.15, 0.30), generator.uniform(15, 75), generator.uniform(-10, 10), LIDAR
    )
    near = at_near_edge(A4, seen)
    x_m, y_m, turn_rad = (
        near.x_m + generator.uniform(0.0, 0.03),
        *generator.uniform((-0.02, -0.1), (0.02, 0.1)),
    )
    scale, stretch = (
        float(np.exp(std * generator.standard_normal()))
        for std in (printed.scale_std, printed.stretch_std)
    )
    placed = Placement(float(x_m), float(y_m), float(turn_rad), scale, stretch)
    return BoardBench(A4, seen, placed, light or Illumination())


def random_camera(generator: Generator, errors: CameraErrors) -> ColorCamera:
    """Return a color camera with random calibration errors."""
    moved = CALIBRATION.lidar_from_camera.copy()
    turn = cv2.Rodrigues(np.radians(errors.turn_std_deg) * generator.standard_normal(3))[0]
    moved[:3, :3] = turn @ moved[:3, :3]
    moved[:3, 3] += errors.shift_std_m * generator.standard_normal(3)
    longer = 1.0 + errors.focal_std * generator.standard_normal()
    return ColorCamera(replace(COLOR, fx=COLOR.fx * longer, fy=COLOR.fy * longer), moved)


def through_lens(pixels: Float64, pinhole: Intrinsics = COLOR) -> Float64:
    """Return the pixels (n, 2) behind the lens of those behind a straight one."""
    rays = np.column_stack(
        [(pixels - [pinhole.ppx, pinhole.ppy]) / [pinhole.fx, pinhole.fy], np.ones(len(pixels))]
    )
    return (
        cv2.projectPoints(rays, np.zeros(3), np.zeros(3), pinhole.matrix, LENS)[0]
        .reshape(-1, 2)
        .astype(np.float64)
    )


def image_through_lens(straight: Float64, pinhole: Intrinsics = COLOR) -> Float64:
    """Return the image (height, width) behind the lens of that behind a straight one."""
    every = np.stack(
        np.meshgrid(np.arange(pinhole.width), np.arange(pinhole.height)), axis=-1
    ).astype(np.float32)
    source = cv2.undistortImagePoints(every.reshape(-1, 1, 2), pinhole.matrix, LENS).reshape(
        every.shape
    )
    mapped = cv2.remap(
        straight, source.astype(np.float32), None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    return np.maximum(mapped, 0.0).astype(np.float64)  # cubic interpolation swings below black


@dataclass(frozen=True)
class Coverage:
    """Result of many trials."""

    refused: int
    p95_mm: float
    """95th percentile of the distance's error."""
    inside: Float64
    """(3,); shares of distance, yaw and pitch with the truth inside their 95 % interval."""


def coverage(
    count: int, bench: Callable[[], BoardBench], fit: Callable[[BoardBench], BoardFit]
) -> Coverage:
    """Fit `count` benches and compare them with the truth."""
    results = list[tuple[Float64, Float64]]()
    refused = 0
    for _ in range(count):
        one = bench()
        try:
            results.append(one.compare(fit(one)))
        except BoardRefusedError:
            refused += 1
    off, sigmas = (np.abs(np.stack(column)) for column in zip(*results, strict=True))
    return Coverage(
        refused, float(np.quantile(off[:, 0], 0.95)), (sigmas <= INTERVAL_STDS).mean(axis=0)
    )
