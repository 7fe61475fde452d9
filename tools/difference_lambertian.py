"""`lambertian` radiometry: what a hidden object changes at all, and for how many frames to look until it shows."""

from itertools import pairwise
from typing import Any

import numpy as np
from difference_noise import REFERENCE_CELSIUS, Pattern, biased, rms
from difference_scenes import Bench, Signal
from difference_sight import Mask, Sight, Track
from difference_snr import Cells, frames_for_cells, frames_for_filter, hours, ratio
from difference_waveform import Array, chips_peak, gaussian_peak
from nlos_calibration.arrays import Float32

WARMER_CELSIUS = None, 0.0, 0.1, 1.0, 5.0
"""None has an endless reference."""
CURVE_FRAMES = np.logspace(0, 8, 33)


def lambertian(sight: Sight, benches: list[Bench], later: list[Float32], track: Track) -> dict[str, Any]:
    """What is left on the first bench, without a pulse, and on the second; cells are those that light reaches."""
    sharp, wide = ([bench.signal(one) for one in track(later, "lambertian maps")] for bench in benches)
    pattern, cells = Pattern(benches[1].rig, biased()), sight.cells
    chosen = [one.lit & cells for one in wide]
    depth_um = [1e6 * np.abs(one.depth_m[at]) for one, at in zip(wide, chosen, strict=True)]
    return {
        "without_pulse": {
            "depth_um_max": max(1e6 * float(np.abs(one.depth_m[cells]).max()) for one in sharp),
            "counts_max": max(float(np.abs(one.counts[cells]).max()) for one in sharp),
            "margin": _percentiles([np.abs(one.margin[one.lit & cells]) for one in sharp]),
        },
        "lit_cells": float(np.mean([at.sum() / cells.sum() for at in chosen])),
        "depth_um": _percentiles(depth_um),
        **{
            f"depth_um_{name}": _percentiles(
                [1e6 * np.abs(benches[1].first_order_m(one, peak)[cells]) for one in later]
            )
            for name, peak in (("first_order", gaussian_peak(benches[1].pulse_ns)), ("of_chips", chips_peak()))
        },
        "depth_um_of_best_cell": {
            "least": min(float(one.max()) for one in depth_um),
            "median": float(np.median([one.max() for one in depth_um])),
        },
        "counts": _percentiles([np.abs(one.counts[at]) for one, at in zip(wide, chosen, strict=True)]),
        "single_frame_noise_um": 1e6 * float(np.median(sight.noise.depth_m[cells])),
        "single_frame_noise_counts": float(np.median(sight.noise.counts[cells])),
        "depth": [_by_depth(sight, wide, pattern, warmer) for warmer in WARMER_CELSIUS],
        "intensity": _needed([sight.counts_of(one, _lit) for one in wide], [], times=2.0),
        "frames": CURVE_FRAMES.tolist(),
    }


def _lit(signal: Signal) -> Mask:
    return signal.lit


def _percentiles(values: list[Array]) -> dict[str, float]:
    return {f"p{at}": float(np.percentile(np.concatenate(values), at)) for at in (50, 95, 99, 100)}


def _by_depth(sight: Sight, signals: list[Signal], pattern: Pattern, warmer: float | None) -> dict[str, Any]:
    """Frames of the object, and as many of the bare wall unless `warmer` is None, with that much drift between them."""
    drift_m = pattern.drift_m(REFERENCE_CELSIUS + (warmer or 0.0))
    told: dict[str, Any] = {"warmer_celsius": warmer}
    for name, left_m in (("difference", drift_m), ("levelled", sight.levelled(drift_m))):
        looked = [sight.of(one, _lit, left_m) for one in signals]
        pairs = [_apart(sight, one, other, left_m) for one, other in pairwise(signals)]
        found = _needed(looked, pairs, times=1.0 if warmer is None else 2.0)
        told[name] = {"pattern_um": 1e6 * rms(left_m[sight.cells]), **found}
    return told


def _apart(sight: Sight, one: Signal, other: Signal, left_m: Array) -> Cells:
    """The cells of the wall, with what two objects differ by."""
    cells = sight.cells
    return Cells((one.depth_m - other.depth_m)[cells], sight.noise.depth_m[cells], left_m[cells])


def _needed(looked: list[Cells], pairs: list[Cells], times: float) -> dict[str, Any]:
    """Frames at which signal equals noise, for cells of all objects and for matched filters; and how they get there."""
    every = [times * frames_for_cells(one) for one in looked]
    single, best = np.sort(np.concatenate(every)), np.sort([one.min() for one in every])
    matched = np.sort(times * np.array([frames_for_filter(one) for one in looked]))
    apart = np.sort(times * np.array([frames_for_filter(one) for one in pairs]))
    ratios = [[ratio(one, n / times) for one in looked] for n in CURVE_FRAMES]
    return {
        "cells_never": float(np.isinf(single).mean()),
        "best_cell": _told(best[0]),
        "best_cell_median": _told(best[len(best) // 2]),
        "hundredth_of_cells": _told(single[len(single) // 100]),
        "tenth_of_cells": _told(single[len(single) // 10]),
        "half_of_cells": _told(single[len(single) // 2]),
        "matched_best": _told(matched[0]),
        "matched_median": _told(matched[len(matched) // 2]),
        "matched_worst": _told(matched[-1]),
        "two_objects_median": _told(apart[len(apart) // 2]) if pairs else None,
        "two_objects_worst": _told(apart[-1]) if pairs else None,
        "curve_matched": [float(np.median([one.matched for one in row])) for row in ratios],
        "curve_best_cell": [float(np.median([one.best_cell for one in row])) for row in ratios],
    }


def _told(frames: float) -> dict[str, float | None]:
    """Frames, one at least, and hours of looking at the object; None for never, which JSON has no number for."""
    frames = max(float(frames), 1.0)
    return {"frames": frames, "hours": hours(frames)} if np.isfinite(frames) else {"frames": None, "hours": None}
