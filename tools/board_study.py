"""How well a printed board tells the wall: docs/board_study.json and docs/images/board_study.png (no arguments).

Rendered infrared images (`board_view`) over the paper's distances and angles: what is found, how far off it is, whether
the stated uncertainty is honest, and what the size of the squares, the laser's spot, the number of frames and the place
on the wall do.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from board_trials import FLAT, Bench, Trial, by_corners, by_image, random_bench, summary, trials
from matplotlib.figure import Figure
from nlos_calibration.arrays import Float64
from nlos_calibration.board import BOARDS, Board, find_corners
from nlos_calibration.board_pose import BoardFit, PrintErrors, fit_board
from nlos_calibration.errors import BoardRefusedError
from nlos_calibration.rig import load_rig

from nlos_cam.calibrate.synthetic import Light, at_near_edge, in_the_middle, view

DOCS = Path(__file__).parents[1] / "docs"
PINHOLE = load_rig("bare-wall").pinhole
DISTANCES_M, ANGLES_DEG = (0.15, 0.20, 0.25, 0.30), (15.0, 30.0, 45.0, 60.0, 75.0)
A4 = BOARDS["a4"]
FRAMES = 30
TO_FILL_A4 = {
    15.0: (13, 18, "DICT_4X4_250"),
    20.0: (9, 13, "DICT_4X4_100"),
    24.0: (8, 11, "DICT_4X4_50"),
    30.0: (6, 9, "DICT_4X4_50"),
    40.0: (5, 6, "DICT_4X4_50"),
}
SPOTS_MM, GAINS = (0.0, 1.0, 2.0, 3.0), (3.0, 12.0, 48.0, 200.0, 800.0)


@dataclass(frozen=True)
class Runs:
    """How many trials."""

    grid: int = 10
    images: int = 300
    corners: int = 1000
    ways: int = 40


RUNS = Runs()


def of_squares(square_mm: float) -> Board:
    """A board of such squares that fills A4."""
    x, y, markers = TO_FILL_A4[square_mm]
    shape = {"squares_x": x, "squares_y": y, "square_mm": square_mm, "marker_mm": 0.75 * square_mm}
    return Board.model_validate(shape | {"dictionary": markers})


def over_grid(bench: Callable[[float, float], Bench], frames: int, repeats: int = 1) -> list[dict[str, object]]:
    """Each distance and angle: how many corners, how often a plane, and its worst errors."""
    generator, rows = np.random.default_rng(11), list[dict[str, object]]()
    for distance_m in DISTANCES_M:
        for angle_deg in ANGLES_DEG:
            corners: list[int] = []
            off: list[Float64] = []
            one = bench(distance_m, angle_deg)
            for _ in range(repeats):
                try:
                    fit = by_image(one, frames, generator)
                except BoardRefusedError:
                    continue
                corners.append(fit.corners)
                off.append(np.abs(one.judged(fit)[0]))
            rows.append(
                {
                    "distance_m": distance_m,
                    "angle_deg": angle_deg,
                    "found": len(corners) / repeats,
                    "corners": min(corners, default=0),
                    "worst_mm": round(float(np.max([o[0] for o in off])), 4) if off else None,
                    "worst_deg": round(float(np.max([np.hypot(o[1], o[2]) for o in off])), 4) if off else None,
                },
            )
    return rows


def near(board: Board, light: Light) -> Callable[[float, float], Bench]:
    """Benches with the board at the near edge of the view."""

    def bench(distance_m: float, angle_deg: float) -> Bench:
        seen = view(distance_m, angle_deg, 0.0, PINHOLE)
        return Bench(board, seen, at_near_edge(board, seen), light)

    return bench


def middle(distance_m: float, angle_deg: float) -> Bench:
    """A bench with the board in the middle of the view, where the wall is farther off and seen more obliquely."""
    seen = view(distance_m, angle_deg, 0.0, PINHOLE)
    return Bench(A4, seen, in_the_middle(seen))


def told(rows: list[dict[str, object]]) -> dict[str, object]:
    """A grid in one line."""
    worst = [row for row in rows if row["worst_mm"] is not None]
    return {
        "found": float(np.mean([row["found"] for row in rows])),
        "fewest_corners": min((row["corners"] for row in worst), default=0),
        "worst_mm": max((row["worst_mm"] for row in worst), default=None),
        "worst_deg": max((row["worst_deg"] for row in worst), default=None),
        "not_found": [
            f"{row['distance_m']:.2f} m, {row['angle_deg']:.0f} degrees" for row in rows if row["found"] == 0
        ],
    }


def honesty(count: int, frames: int, seed: int) -> dict[str, object]:
    """Random benches and prints, by image."""
    generator = np.random.default_rng(seed)
    return summary(
        *trials(
            count,
            lambda: random_bench(A4, PINHOLE, generator, Light(), FLAT),
            lambda bench: by_image(bench, frames, generator),
        ),
    )


def honesty_of_bows(count: int, sigma_px: float) -> dict[str, object]:
    """Random benches and prints, sheets that bow among them, by noisy corners."""
    generator, printed = np.random.default_rng(13), PrintErrors()
    return summary(
        *trials(
            count,
            lambda: random_bench(A4, PINHOLE, generator, Light(), printed),
            lambda bench: by_corners(bench, sigma_px, generator, printed),
        ),
    )


def ways_to_average(count: int) -> dict[str, object]:
    """Of the same frames: one detection in their mean, against the weighted mean of each frame's own plane."""
    generator = np.random.default_rng(17)
    exact = PrintErrors(1e-6, 1e-6, 1e-6)
    image, planes = list[Trial](), list[Trial]()
    for _ in range(count):
        bench = random_bench(A4, PINHOLE, generator, Light(), exact)
        frames = bench.frames(FRAMES, generator)
        try:
            image.append(bench.judged(fit_board(find_corners(frames.mean(axis=0), A4), A4, PINHOLE, exact)))
            fits = [fit_board(find_corners(frame, A4), A4, PINHOLE, exact) for frame in frames]
        except BoardRefusedError:
            continue
        planes.append(bench.judged(_mean_plane(fits)))
    return {"of_images": summary(image, []), "of_planes": summary(planes, [])}


def _mean_plane(fits: list[BoardFit]) -> BoardFit:
    weights = [np.linalg.inv(fit.covariance) for fit in fits]
    covariance = np.linalg.inv(sum(weights))
    slopes = covariance @ sum(weight @ fit.slopes for weight, fit in zip(weights, fits, strict=True))
    return BoardFit(slopes, covariance, fits[0].corners, 0.0, 0.0, 0.0)


def draw(grid: list[dict[str, object]], sizes: dict[str, dict[str, dict[str, object]]], path: Path) -> None:
    """Errors over the grid, and what is found by square and spot."""
    figure = Figure(figsize=(10, 3.2), layout="constrained")
    errors, angles, found = figure.subplots(1, 3)
    for distance_m in DISTANCES_M:
        rows = [row for row in grid if row["distance_m"] == distance_m]
        degrees = [row["angle_deg"] for row in rows]
        errors.plot(degrees, [row["worst_mm"] for row in rows], marker="o", label=f"{distance_m:.2f} m")
        angles.plot(degrees, [row["worst_deg"] for row in rows], marker="o")
    errors.set(xlabel="facing angle (degrees)", ylabel="worst distance error (mm)")
    angles.set(xlabel="facing angle (degrees)", ylabel="worst angle error (degrees)")
    errors.set_ylim(bottom=0)
    angles.set_ylim(bottom=0)
    errors.legend(fontsize=8)
    for square, spots in sizes.items():
        found.plot(SPOTS_MM, [100 * float(str(spots[f"{s:g}"]["found"])) for s in SPOTS_MM], marker="o", label=square)
    found.set(xlabel="laser's spot (mm)", ylabel="found (% of 20 benches)")
    found.legend(fontsize=8, title="squares (mm)")
    figure.savefig(path, dpi=90)


def main() -> None:
    """Measure, write, draw, print."""
    grid = over_grid(near(A4, Light()), FRAMES, RUNS.grid)
    sizes = {
        f"{square:g}": {
            f"{spot:g}": told(over_grid(near(of_squares(square), Light(spot_mm=spot)), FRAMES)) for spot in SPOTS_MM
        }
        for square in TO_FILL_A4
    }
    result = {
        "board": A4.model_dump(),
        "frames": FRAMES,
        "grid": grid,
        "grid_told": told(grid),
        "in_the_middle_of_the_view": told(over_grid(middle, FRAMES)),
        "a3": told(over_grid(near(BOARDS["a3"], Light()), FRAMES)),
        "squares_by_spot_mm": sizes,
        "brightest_counts": {f"{counts:g}": told(over_grid(near(A4, Light(counts)), FRAMES)) for counts in GAINS},
        "random_benches_by_frames": {str(frames): honesty(RUNS.images, frames, frames) for frames in (1, FRAMES)},
        "random_benches_and_bows_by_sigma_px": {
            f"{sigma:g}": honesty_of_bows(RUNS.corners, sigma) for sigma in (0.05, 0.2)
        },
        "ways_to_average": ways_to_average(RUNS.ways),
    }
    text = json.dumps(result, indent=1)
    (DOCS / "board_study.json").write_text(text + "\n", encoding="utf-8")
    draw(grid, sizes, DOCS / "images" / "board_study.png")
    print(text)


if __name__ == "__main__":
    main()
