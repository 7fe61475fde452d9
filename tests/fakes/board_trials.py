"""Random benches with a printed board, measured by the lidar's infrared, against the truth."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from nlos_calibration import (
    BOARDS,
    INTERVAL_STDS,
    Board,
    Corners,
    find_corners,
    load_rig,
    measures_of,
)
from nlos_calibration.arrays import Float64, UInt8
from nlos_calibration.board_pose import BoardFit, PrintErrors, fit_board
from nlos_calibration.errors import BoardRefusedError
from synthetic_scenes import (
    Illumination,
    Placement,
    at_near_edge,
    clean_infrared,
    corners_px,
    infrared_frames,
)
from synthetic_walls import View, view

Generator = np.random.Generator

A4 = BOARDS["a4"]
LIDAR = load_rig("bare-wall").pinhole
FLAT = replace(PrintErrors(), bow_std_m=1e-6)
"""Errors of a rendered print, whose paper is flat."""


@dataclass(frozen=True)
class BoardBench:
    """A lidar, a board on the wall, and the light."""

    board: Board
    seen: View
    placed: Placement
    light: Illumination = field(default_factory=Illumination)

    def frames(self, count: int, generator: Generator) -> UInt8:
        """Return frames (count, height, width) of the lidar's infrared."""
        clean = clean_infrared(self.board, self.seen, self.placed, self.light)
        return infrared_frames(clean, generator, count, self.light)

    def fit_image(self, count: int, generator: Generator) -> BoardFit:
        """Fit the plane to the mean of rendered frames."""
        corners = find_corners(self.frames(count, generator).mean(axis=0), self.board)
        return fit_board(corners, self.board, self.seen.pinhole, FLAT)

    def fit_corners(self, sigma_px: float, generator: Generator, printed: PrintErrors) -> BoardFit:
        """Fit the plane to true corners with noise, of a sheet that bows."""
        bow_m = tuple(printed.bow_std_m * generator.standard_normal(2))
        pinhole = self.seen.pinhole
        pixels = corners_px(self.board, self.seen, self.placed, bow_m)
        size = np.array([pinhole.width, pinhole.height])
        inside = np.flatnonzero(((pixels > 5.0) & (pixels < size - 5.0)).all(axis=1))
        noise_px = sigma_px * generator.standard_normal((len(inside), 2))
        return fit_board(Corners(inside, pixels[inside] + noise_px), self.board, pinhole, printed)

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


def random_bench(generator: Generator, printed: PrintErrors) -> BoardBench:
    """Return a bench inside the paper's ranges, with a board hung by hand and a printer's
    errors.
    """
    seen = view(
        generator.uniform(0.15, 0.30), generator.uniform(15, 75), generator.uniform(-10, 10), LIDAR
    )
    near = at_near_edge(A4, seen)
    x_m = near.x_m + generator.uniform(0.0, 0.03)
    y_m, turn_rad = generator.uniform((-0.02, -0.1), (0.02, 0.1))
    scale, stretch = (
        float(np.exp(std * generator.standard_normal()))
        for std in (printed.scale_std, printed.stretch_std)
    )
    placed = Placement(float(x_m), float(y_m), float(turn_rad), scale, stretch)
    return BoardBench(A4, seen, placed, Illumination())


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
