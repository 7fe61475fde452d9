"""`paper` radiometry: which echo wins, and signal to noise of raw and difference maps where the direct return does."""

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from difference_noise import REFERENCE_CELSIUS, Pattern, biased, cell_means, maps_of, rms
from difference_scenes import SHAPE, Bench, Signal, paper_rig
from difference_sight import MAPS, Mask, Sight, Track, Which, merged, switched
from difference_waveform import Array
from nlos_calibration.arrays import Float32

from nlos_cam.render.sensor.sensor import Sensor

RECEIVER_CELLS_M2 = 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 2e-2
CHOSEN_M2 = {0.0: 5e-4, 1.0: 5e-3}
"""By the pulse's nanoseconds, the receiver cell at which the direct return wins about nine beams of ten."""
FRAMES = 1, 3, 10, 30, 100, 300, 1000
RIPPLES_M, OFFSETS_M, WARMER_CELSIUS = (0.0, 0.0005, 0.001, 0.002), (0.0, 0.0045), (0.0, 2.0, 5.0, 10.0)
USUAL = biased(ripple_m=0.001, offset_m=0.0045)
USUAL_WARMER, USUAL_FRAMES = 2.0, 30
CONFIDENCE_STEP = 2 / 15
"""Of the winner's margin, half of which counts, is one of the 4-bit confidence."""


def winners(later: list[Float32], cells: Mask, track: Track) -> list[dict[str, float]]:
    """The share of beams that the direct return wins, by receiver cell, without a pulse and with one of 1 ns."""
    rows: list[dict[str, float]] = []
    for cell_m2 in track(RECEIVER_CELLS_M2, "receiver cells"):
        rig = paper_rig(cell_m2)
        shares = {
            f"direct_wins_{pulse_ns:g}_ns": _direct_wins(
                [Bench(rig, "paper", pulse_ns).signal(one) for one in later], cells
            )
            for pulse_ns in CHOSEN_M2
        }
        rows.append({"receiver_cell_m2": cell_m2, **shares})
    return rows


def _direct_wins(signals: list[Signal], cells: Mask) -> float:
    return float(np.mean([one.direct_wins[cells].mean() for one in signals]))


def paper(sight: Sight, bench: Bench, signals: list[Signal], track: Track) -> dict[str, Any]:
    """All of one bench: by frames, by ripples and offset, by temperature; objects that change no such cell left out."""
    usual = Pattern(bench.rig, USUAL)
    usual_m = sight.left_m(usual, USUAL_WARMER)
    parts = {
        which.__name__: [one for one in signals if (which(one) & sight.cells).any()] for which in (merged, switched)
    }
    told: dict[str, Any] = {
        "receiver_cell_m2": bench.rig.device.receiver_cell_m2,
        "pulse_ns": bench.pulse_ns,
        "direct_wins": _direct_wins(signals, sight.cells),
    }
    if not bench.pulse_ns:
        falls = [(one.margin[sight.cells] < -CONFIDENCE_STEP).mean() for one in signals]
        told["confidence_falls"] = float(np.mean(falls))
    for which, some in ((which, parts[which.__name__]) for which in (merged, switched)):
        if some:
            told[which.__name__] = _strength(some, which, sight.cells)
            told[which.__name__]["intensity"] = sight.intensity_ratios(some, which, USUAL_FRAMES)
            for name, left_m in (("by_frames", usual_m), ("by_frames_steady", sight.left_m(usual, 0.0))):
                told[which.__name__][name] = [{"frames": n, **sight.ratios(some, which, left_m, n)} for n in FRAMES]
    if some := parts["merged"]:
        told["by_bias"] = list(_by_bias(sight, bench, some, track))
        told["by_temperature"] = list(_by_temperature(sight, usual, some, track))
    return told


def _strength(signals: list[Signal], which: Which, cells: Mask) -> dict[str, Any]:
    """How many cells, and by how much depth and intensity change: the median over objects of RMS and median."""
    chosen = [which(one) & cells for one in signals]
    found = [np.abs(one.depth_m[at]) for one, at in zip(signals, chosen, strict=True)]
    return {
        "objects": len(signals),
        "cells": float(np.median([len(one) for one in found])),
        "rms_um": 1e6 * float(np.median([rms(one) for one in found])),
        "median_um": 1e6 * float(np.median([np.median(one) for one in found])),
        "rms_counts": float(np.median([rms(one.counts[at]) for one, at in zip(signals, chosen, strict=True)])),
    }


def _by_bias(sight: Sight, bench: Bench, signals: list[Signal], track: Track) -> Any:
    for ripple_m, offset_m in track(list(product(RIPPLES_M, OFFSETS_M)), "ripples and offsets"):
        pattern = Pattern(bench.rig, biased(ripple_m, offset_m))
        left_m = sight.left_m(pattern, USUAL_WARMER)
        yield {
            "ripple_mm": 1e3 * ripple_m,
            "offset_mm": 1e3 * offset_m,
            "verdict": pattern.misfit_m(REFERENCE_CELSIUS)[1],
            "raw_pattern_um": 1e6 * rms(left_m["raw"][sight.cells]),
            **sight.ratios(signals, merged, left_m, USUAL_FRAMES),
        }


def _by_temperature(sight: Sight, usual: Pattern, signals: list[Signal], track: Track) -> Any:
    for warmer, frames in track(list(product(WARMER_CELSIUS, (USUAL_FRAMES, 1000))), "temperatures"):
        left_m = sight.left_m(usual, warmer)
        patterns = {f"{name}_pattern_um": 1e6 * rms(left_m[name][sight.cells]) for name in MAPS}
        yield {"warmer_celsius": warmer, "frames": frames, **patterns, **sight.ratios(signals, merged, left_m, frames)}


@dataclass(frozen=True)
class Example:
    """One object's maps (64, 80) of depth, in metres: what it changes, and what frames of the chain show of it."""

    signal_m: Array
    raw_m: Array
    difference_m: Array


def through_the_chain(
    sight: Sight, bench: Bench, later: list[Float32], track: Track
) -> tuple[list[dict[str, float]], list[Example]]:
    """Maps averaged from frames of the sensor's chain: what differs from signal and drift, over the law of noise."""
    sensor, pattern, celsius = Sensor(bench.rig, USUAL), Pattern(bench.rig, USUAL), REFERENCE_CELSIUS + USUAL_WARMER
    reference_m, reference = maps_of(sensor, bench.multi(None), range(10_000, 10_000 + USUAL_FRAMES), REFERENCE_CELSIUS)
    bare_m = (bench.beams.length_m * bench.beams.cos_axis).reshape(SHAPE)
    plane_m = bare_m + cell_means(pattern.bias_m(celsius)) - pattern.misfit_m(celsius)[0]
    law = np.sqrt(2 / USUAL_FRAMES)
    rows: list[dict[str, float]] = []
    examples: list[Example] = []
    for k, light in track(list(enumerate(later)), "frames of the chain"):
        signal, first = bench.signal(light), 20_000 + 1000 * k
        live_m, live = maps_of(sensor, bench.multi(light), range(first, first + USUAL_FRAMES), celsius)
        maps = signal.depth_m, live_m.mean(0) - plane_m, live_m.mean(0) - reference_m.mean(0)
        examples.append(Example(*(np.where(sight.cells, one, np.nan) for one in maps)))
        chosen = sight.cells & merged(signal)
        left_m = (examples[-1].difference_m - signal.depth_m - pattern.drift_m(celsius))[chosen]
        left = (live.mean(0) - reference.mean(0) - signal.counts)[chosen]
        rows.append(
            {
                "cells": int(chosen.sum()),
                "signal_um": 1e6 * rms(signal.depth_m[chosen]),
                "depth_um": 1e6 * rms(left_m),
                "depth_over_law": rms(left_m) / rms(law * sight.noise.depth_m[chosen]),
                "counts_over_law": rms(left) / rms(law * sight.noise.counts[chosen]),
            }
        )
    return rows, examples
