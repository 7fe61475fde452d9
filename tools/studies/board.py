"""Accuracy of the wall from a printed board: docs/board_study.json and docs/images/board_study.png.

Infrared images rendered over the paper's distances and angles: corners found, errors, honesty of the stated
uncertainty, and the effect of square size, laser spot, brightness and frames. `--scale` multiplies all trials.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import harness  # before the synthetic scenes: it puts their folder on the path
import numpy as np
from matplotlib.figure import Figure
from nlos_calibration import (
    BOARDS,
    INTERVAL_STDS,
    Board,
    BoardFit,
    Corners,
    PrintErrors,
    find_corners,
    fit_board,
    load_rig,
    measures_of,
)
from nlos_calibration.errors import BoardRefusedError
from wall import DISTANCES_M, FACING_DEG

from nlos_cam.calibrate import Light, Placed, at_near_edge, clean_view, corners_px, frames_of, in_the_middle, view

Generator = np.random.Generator

PINHOLE, A4, FRAMES = load_rig("bare-wall").pinhole, BOARDS["a4"], 30
TO_FILL_A4 = {
    15.0: (13, 18, "DICT_4X4_250"),
    20.0: (9, 13, "DICT_4X4_100"),
    24.0: (8, 11, "DICT_4X4_50"),
    30.0: (6, 9, "DICT_4X4_50"),
    40.0: (5, 6, "DICT_4X4_50"),
}
SPOTS_MM, COUNTS = (0.0, 1.0, 2.0, 3.0), (3.0, 12.0, 48.0, 200.0, 800.0)
FLAT = replace(PrintErrors(), bow_std_m=1e-6)
"""Errors of a rendered print, whose paper is flat."""
QUANTITIES = "distance_mm", "yaw_deg", "pitch_deg"


@dataclass(frozen=True)
class Setting:
    """Board and conditions; a random bench where the distance is 0, corners with noise where `sigma_px` is not."""

    group: str
    distance_m: float = 0.0
    angle_deg: float = 0.0
    square_mm: float = 0.0
    """0 stands for the board's own squares."""
    board: str = "a4"
    spot_mm: float = Light().spot_mm
    counts: float = Light().brightest_counts
    frames: int = FRAMES
    middle: bool = False
    sigma_px: float = 0.0


def board_of(setting: Setting) -> Board:
    """Return the board, or one with other squares that fills A4."""
    if not setting.square_mm:
        return BOARDS[setting.board]
    x, y, markers = TO_FILL_A4[setting.square_mm]
    shape = {"squares_x": x, "squares_y": y, "square_mm": setting.square_mm, "marker_mm": 0.75 * setting.square_mm}
    return Board.model_validate(shape | {"dictionary": markers})


def grids(scale: float) -> list[tuple[Setting, int]]:
    """Return the settings with their numbers of trials."""
    places = [{"distance_m": d, "angle_deg": a} for d in DISTANCES_M for a in FACING_DEG]
    once = [
        *(Setting("in_the_middle_of_the_view", middle=True, **at) for at in places),
        *(Setting("a3", board="a3", **at) for at in places),
        *(
            Setting("squares", square_mm=mm, spot_mm=spot, **at)
            for mm in TO_FILL_A4
            for spot in SPOTS_MM
            for at in places
        ),
        *(Setting("brightest_counts", counts=counts, **at) for counts in COUNTS for at in places),
    ]
    repeats = {
        **{Setting("grid", **at): 10 for at in places},
        **{Setting("random_benches", frames=frames): 300 for frames in (1, FRAMES)},
        **{Setting("random_benches_and_bows", sigma_px=sigma): 1000 for sigma in (0.05, 0.2)},
    }
    return [(one, 1) for one in once] + [(one, max(1, round(scale * count))) for one, count in repeats.items()]


def trial(setting: Setting, generator: Generator) -> harness.Record:
    """Measure a plane from a board, and return errors, their ratio to the stated uncertainty, or the refusal."""
    board, light = board_of(setting), Light(setting.counts, spot_mm=setting.spot_mm)
    printed = PrintErrors() if setting.sigma_px else FLAT
    if setting.distance_m:
        seen = view(setting.distance_m, setting.angle_deg, 0.0, PINHOLE)
        placed = in_the_middle(seen) if setting.middle else at_near_edge(board, seen)
    else:  # inside the paper's ranges, put up by hand on the near side of the view, with a printer's errors
        seen = view(generator.uniform(0.15, 0.30), generator.uniform(15, 75), generator.uniform(-10, 10), PINHOLE)
        near, scales = at_near_edge(board, seen), (printed.scale_std, printed.stretch_std)
        x_m, y_m, turn_rad = near.x_m + generator.uniform(0.0, 0.03), *generator.uniform((-0.02, -0.1), (0.02, 0.1))
        scale, stretch = (float(np.exp(std * generator.standard_normal())) for std in scales)
        placed = Placed(float(x_m), float(y_m), float(turn_rad), scale, stretch)
    try:
        if setting.sigma_px:
            fit = fit_board(noisy_corners(board, seen, placed, setting.sigma_px, generator), board, PINHOLE, printed)
        else:
            frames = frames_of(clean_view(board, seen, placed, light), generator, setting.frames, light)
            fit = fit_board(find_corners(frames.mean(axis=0), board), board, PINHOLE, printed)
    except BoardRefusedError as error:
        return {"refused": str(error), "corners": 0}
    off, sigmas = compare(fit, seen.pose)
    return {"refused": "", "corners": int(fit.corners), "off": off, "sigmas": sigmas}


def noisy_corners(board: Board, seen: Any, placed: Placed, sigma_px: float, generator: Generator) -> Corners:
    """Return the true corners, of a sheet that bows, with noise."""
    bow_m = tuple(PrintErrors().bow_std_m * generator.standard_normal(2))
    pixels = corners_px(board, seen, placed, bow_m)
    pixels += sigma_px * generator.standard_normal(pixels.shape)
    inside = ((pixels > 5.0) & (pixels < np.array([PINHOLE.width, PINHOLE.height]) - 5.0)).all(axis=1)
    return Corners(np.flatnonzero(inside), pixels[inside])


def compare(fit: BoardFit, pose: Any) -> tuple[list[float], list[float]]:
    """Return absolute errors (mm, degrees, degrees), and the same in stated standard uncertainties."""
    found, true = measures_of(fit.slopes, fit.covariance), measures_of(-pose[2, :3] / pose[2, 3], np.zeros((3, 3)))
    off = np.array([getattr(found, name) - getattr(true, name) for name in ("distance_m", "yaw_deg", "pitch_deg")])
    std = np.array([found.distance_std_m, found.yaw_std_deg, found.pitch_std_deg])
    return np.abs(off * [1e3, 1.0, 1.0]).tolist(), np.abs(off / std).tolist()


def cell(records: list[harness.Record]) -> harness.Record:
    """Summarize the trials at one distance and angle by their worst."""
    off = [one["off"] for one in records if not one["refused"]]
    return {
        "distance_m": records[0]["distance_m"],
        "angle_deg": records[0]["angle_deg"],
        "found": len(off) / len(records),
        "corners": min((one["corners"] for one in records if not one["refused"]), default=0),
        "worst_mm": round(max(o[0] for o in off), 4) if off else None,
        "worst_deg": round(float(max(np.hypot(o[1], o[2]) for o in off)), 4) if off else None,
    }


def over_grid(records: list[harness.Record]) -> list[harness.Record]:
    """Return the cells of every distance and angle."""
    places = dict.fromkeys((one["distance_m"], one["angle_deg"]) for one in records)
    return [cell([one for one in records if (one["distance_m"], one["angle_deg"]) == at]) for at in places]


def worst(records: list[harness.Record]) -> harness.Record:
    """Summarize a grid in one line."""
    rows = over_grid(records)
    found = [row for row in rows if row["found"]]
    missed = [f"{row['distance_m']:.2f} m, {row['angle_deg']:.0f} degrees" for row in rows if not row["found"]]
    return {
        "found": float(np.mean([row["found"] for row in rows])),
        "fewest_corners": min((row["corners"] for row in found), default=0),
        "worst_mm": max((row["worst_mm"] for row in found), default=None),
        "worst_deg": max((row["worst_deg"] for row in found), default=None),
        "not_found": missed,
    }


def summary(records: list[harness.Record]) -> harness.Record:
    """Return the number measured, errors at the 95th percentile, and coverage of the 95 % interval."""
    measured = [one for one in records if not one["refused"]]
    counted = {"measured": len(measured), "refused": len(records) - len(measured)}
    if not measured:
        return counted
    p95 = np.quantile([one["off"] for one in measured], 0.95, axis=0).round(4).tolist()
    inside = harness.coverage(([s <= INTERVAL_STDS for s in one["sigmas"]] for one in measured), QUANTITIES) or {}
    pooled = float(np.mean(list(inside.values())))
    return counted | {
        "p95": dict(zip(QUANTITIES, p95, strict=True)),
        "in_95_percent_interval": inside,
        "in_95_percent_interval_pooled": pooled,
    }


def tables(records: list[harness.Record]) -> harness.Record:
    """Return every table of the study."""

    def of(group: str) -> list[harness.Record]:
        return [one for one in records if one["group"] == group]

    def each(group: str, field: str, make: Callable[[list[harness.Record]], Any]) -> harness.Record:
        return split(of(group), field, make)

    return {
        "board": A4.model_dump(),
        "frames": FRAMES,
        "grid": over_grid(of("grid")),
        "grid_told": worst(of("grid")),
        "in_the_middle_of_the_view": worst(of("in_the_middle_of_the_view")),
        "a3": worst(of("a3")),
        "squares_by_spot_mm": each("squares", "square_mm", lambda some: split(some, "spot_mm", worst)),
        "brightest_counts": each("brightest_counts", "counts", worst),
        "random_benches_by_frames": each("random_benches", "frames", summary),
        "random_benches_and_bows_by_sigma_px": each("random_benches_and_bows", "sigma_px", summary),
    }


def split(records: list[harness.Record], field: str, make: Callable[[list[harness.Record]], Any]) -> harness.Record:
    """Summarize records by the levels of a field."""
    levels = dict.fromkeys(one[field] for one in records)
    return {f"{level:g}": make([one for one in records if one[field] == level]) for level in levels}


def draw(found: harness.Record) -> Figure:
    """Draw errors over the grid, and the share found by square and spot."""
    figure = Figure(figsize=(10, 3.2), layout="constrained")
    errors, angles, shares = figure.subplots(1, 3)
    for distance_m in dict.fromkeys(row["distance_m"] for row in found["grid"]):
        rows = [row for row in found["grid"] if row["distance_m"] == distance_m]
        for axis, key in ((errors, "worst_mm"), (angles, "worst_deg")):
            axis.plot([row["angle_deg"] for row in rows], [row[key] for row in rows], "o-", label=f"{distance_m:.2f} m")
    errors.set(xlabel="facing angle (degrees)", ylabel="worst distance error (mm)", ylim=(0, None))
    angles.set(xlabel="facing angle (degrees)", ylabel="worst angle error (degrees)", ylim=(0, None))
    errors.legend(fontsize=8)
    for square, spots in found["squares_by_spot_mm"].items():
        shares.plot([float(s) for s in spots], [100 * one["found"] for one in spots.values()], "o-", label=square)
    shares.set(xlabel="laser's spot (mm)", ylabel="found (% of benches)")
    shares.legend(fontsize=8, title="squares (mm)")
    return figure


def main() -> None:
    """Measure, write, draw, print."""
    parser = harness.options(__doc__)
    parser.add_argument("--scale", type=float, default=1.0, help="factor on the number of trials (default: 1)")
    chosen = grids(parser.parse_args().scale)
    records = list[harness.Record]()
    for runs in dict.fromkeys(runs for _, runs in chosen):
        records += harness.collect(f"board x {runs}", [one for one, times in chosen if times == runs], trial, runs)
    found = tables(records)
    harness.write("board_study", found)
    harness.save("board_study", draw(found), dpi=90)
    summarized = {key: value for key, value in found.items() if key not in {"board", "grid"}}
    print(*(f"{key}: {value}" for key, value in summarized.items()), sep="\n")


if __name__ == "__main__":
    main()
