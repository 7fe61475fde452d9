"""Trials of the board: random benches and prints, what is measured of them, how far off it is and by how much it says.

A trial is (errors in mm and degrees, the same over their stated standard uncertainty), or None where it was refused.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from nlos_calibration.arrays import Float64
from nlos_calibration.board import Board, Corners, find_corners
from nlos_calibration.board_pose import BoardFit, PrintErrors, fit_board
from nlos_calibration.errors import BoardRefusedError
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.wall import INTERVAL_STDS, measures_of
from numpy.typing import NDArray

from nlos_cam.calibrate.synthetic import Light, Placed, View, at_near_edge, clean_view, corners_px, frames_of, view

Trial = tuple[Float64, Float64]
"""(3,) distance in mm, yaw and pitch in degrees: how far off, and in stated standard uncertainties."""

NAMES = ("distance_mm", "yaw_deg", "pitch_deg")
FLAT = replace(PrintErrors(), bow_std_m=1e-6)
"""What is to be expected of a print that is rendered: paper in images is flat."""


@dataclass(frozen=True)
class Bench:
    """A lidar, a board on the wall, and the light."""

    board: Board
    seen: View
    placed: Placed
    light: Light = field(default_factory=Light)

    def frames(self, count: int, generator: np.random.Generator) -> NDArray[np.uint8]:
        """Infrared frames (count, height, width)."""
        return frames_of(clean_view(self.board, self.seen, self.placed, self.light), generator, count, self.light)

    def judged(self, fit: BoardFit) -> Trial:
        """A fit against the truth."""
        found, true = measures_of(fit.slopes, fit.covariance), measures_of(*_truth(self.seen))
        off = np.array([getattr(found, name) - getattr(true, name) for name in ("distance_m", "yaw_deg", "pitch_deg")])
        std = np.array([found.distance_std_m, found.yaw_std_deg, found.pitch_std_deg])
        return off * [1e3, 1.0, 1.0], off / std


def _truth(seen: View) -> tuple[Float64, Float64]:
    return -seen.pose[2, :3] / seen.pose[2, 3], np.zeros((3, 3))


def random_bench(
    board: Board, pinhole: Intrinsics, generator: np.random.Generator, light: Light, printed: PrintErrors
) -> Bench:
    """A bench inside the paper's ranges, the board put up by hand on the near side of the view, as printers print."""
    seen = view(generator.uniform(0.15, 0.30), generator.uniform(15, 75), generator.uniform(-10, 10), pinhole)
    placed = at_near_edge(board, seen)
    return Bench(
        board,
        seen,
        Placed(
            placed.x_m + generator.uniform(0.0, 0.03),
            generator.uniform(-0.02, 0.02),
            generator.uniform(-0.1, 0.1),
            float(np.exp(printed.scale_std * generator.standard_normal())),
            float(np.exp(printed.stretch_std * generator.standard_normal())),
        ),
        light,
    )


def by_image(bench: Bench, frames: int, generator: np.random.Generator, printed: PrintErrors = FLAT) -> BoardFit:
    """The plane from the mean of rendered frames."""
    found = find_corners(bench.frames(frames, generator).mean(axis=0), bench.board)
    return fit_board(found, bench.board, bench.seen.pinhole, printed)


def by_corners(bench: Bench, sigma_px: float, generator: np.random.Generator, printed: PrintErrors) -> BoardFit:
    """The plane from true corners with noise, of a sheet that bows."""
    bow_m = tuple(printed.bow_std_m * generator.standard_normal(2))
    pixels = corners_px(bench.board, bench.seen, bench.placed, bow_m)
    pixels += sigma_px * generator.standard_normal(pixels.shape)
    size = bench.seen.pinhole.width, bench.seen.pinhole.height
    inside = np.flatnonzero(((pixels > 5.0) & (pixels < np.array(size) - 5.0)).all(axis=1))
    return fit_board(Corners(inside, pixels[inside]), bench.board, bench.seen.pinhole, printed)


def trials(count: int, bench: Callable[[], Bench], fit: Callable[[Bench], BoardFit]) -> tuple[list[Trial], list[str]]:
    """Trials that were measured, and why the others were refused."""
    measured: list[Trial] = []
    refused: list[str] = []
    for _ in range(count):
        one = bench()
        try:
            measured.append(one.judged(fit(one)))
        except BoardRefusedError as error:
            refused.append(str(error))
    return measured, refused


def summary(measured: list[Trial], refused: list[str]) -> dict[str, object]:
    """Share measured, errors at the 95th percentile, and how often the truth lies in the 95 % interval."""
    if not measured:
        return {"measured": 0, "refused": len(refused)}
    off, sigmas = (np.abs(np.stack(column)) for column in zip(*measured, strict=True))
    inside = sigmas <= INTERVAL_STDS
    return {
        "measured": len(measured),
        "refused": len(refused),
        "p95": dict(zip(NAMES, np.quantile(off, 0.95, axis=0).round(4).tolist(), strict=True)),
        "in_95_percent_interval": dict(zip(NAMES, inside.mean(axis=0).round(4).tolist(), strict=True)),
        "in_95_percent_interval_pooled": round(float(inside.mean()), 4),
    }
