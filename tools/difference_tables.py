"""The study of difference maps as tables for docs/calibration-measured.md."""

from collections.abc import Iterable
from typing import Any

KINDS = "raw", "difference", "levelled"


def as_markdown(told: dict[str, Any]) -> str:
    """All tables."""
    noise = [
        [
            f"{row['frames']}",
            f"{row['depth_um']:.0f}",
            f"{row['depth_over_law']:.3f}",
            f"{row['counts']:.3f}",
            f"{row['counts_over_law']:.3f}",
        ]
        for row in told["noise"]["falls"]
    ]
    won = [
        [f"{1e4 * row['receiver_cell_m2']:g}", f"{row['direct_wins_0_ns']:.0%}", f"{row['direct_wins_1_ns']:.0%}"]
        for row in told["winners"]
    ]
    chain = [
        [
            f"{row['signal_um']:.0f}",
            f"{row['depth_um']:.0f}",
            f"{row['depth_over_law']:.3f}",
            f"{row['counts_over_law']:.3f}",
        ]
        for row in told["chain"]
    ]
    parts = [
        _table("frames averaged | depth noise of a cell, um | over the law | IR noise, counts | over the law", noise),
        _table("receiver cell, cm2 | direct return wins, no pulse | pulse of 1 ns", won),
        _table(
            "through the chain: signal, um | rest of the difference map, um | over the law | IR over the law", chain
        ),
        *(part for one in told["paper"] for part in _paper(one)),
        *_lambertian(told["lambertian"]),
    ]
    return "\n\n".join(parts)


def _table(head: str, rows: Iterable[list[str]]) -> str:
    columns = head.count("|") + 1
    return "\n".join([f"| {head} |", "|" + "---|" * columns, *(f"| {' | '.join(row)} |" for row in rows)])


def _ratios(row: dict[str, Any], names: Iterable[str] = ("rms", "median_cell", "seen", "matched")) -> list[str]:
    return [" / ".join(_short(row[kind][name]) for kind in KINDS) for name in names]


def _short(value: float) -> str:
    return f"{value:.2g}" if value < 100 else f"{value:.0f}"


def _paper(one: dict[str, Any]) -> Iterable[str]:
    name = f"{one['pulse_ns']:g} ns, {1e4 * one['receiver_cell_m2']:g} cm2, direct wins {one['direct_wins']:.0%}"
    name += f", confidence falls in {one['confidence_falls']:.0%}" if "confidence_falls" in one else ""
    ratios = " | ".join(
        f"{of}: raw / difference / levelled" for of in ("RMS", "median cell", "cells over 1", "matched")
    )
    for kind in ("merged", "switched"):
        if kind in one:
            part = one[kind]
            yield (
                f"{name}; {kind}: {part['cells']:.0f} cells, RMS {part['rms_um']:.3g} um, "
                f"median {part['median_um']:.3g} um, {part['rms_counts']:.2g} counts; IR: "
                f"{part['intensity']['raw']['rms']:.2g} raw, {part['intensity']['difference']['rms']:.2g} difference"
            )
            yield _table(f"frames | {ratios}", [[f"{row['frames']}", *_ratios(row)] for row in part["by_frames"]])
    if "by_bias" in one:
        yield _table(
            f"ripple, mm | offset, mm | verdict | raw pattern, um | {ratios}",
            [
                [
                    f"{row['ripple_mm']:g}",
                    f"{row['offset_mm']:g}",
                    row["verdict"],
                    f"{row['raw_pattern_um']:.0f}",
                    *_ratios(row),
                ]
                for row in one["by_bias"]
            ],
        )
        yield _table(
            f"degrees warmer | frames | pattern, um: raw / difference / levelled | {ratios}",
            [
                [
                    f"{row['warmer_celsius']:g}",
                    f"{row['frames']}",
                    " / ".join(f"{row[f'{k}_pattern_um']:.0f}" for k in KINDS),
                    *_ratios(row),
                ]
                for row in one["by_temperature"]
            ],
        )


def _lambertian(told: dict[str, Any]) -> Iterable[str]:
    sharp, percents = told["without_pulse"], ("p50", "p95", "p99", "p100")
    changes = {
        "depth, um": told["depth_um"],
        "depth, um, to first order": told["depth_um_first_order"],
        "depth, um, to first order, of chips": told["depth_um_of_chips"],
        "IR, counts": told["counts"],
        "margin, without a pulse": sharp["margin"],
    }
    yield f"lambertian without a pulse: at most {sharp['depth_um_max']:g} um and {sharp['counts_max']:g} counts"
    yield _table(
        "lambertian, change by an object | median cell | 95th percentile | 99th | most",
        [[name, *(_short(row[at]) for at in percents)] for name, row in changes.items()],
    )
    names = (
        "best_cell",
        "best_cell_median",
        "hundredth_of_cells",
        "tenth_of_cells",
        "half_of_cells",
        "matched_best",
        "matched_median",
        "matched_worst",
        "two_objects_median",
    )
    rows = [
        [
            _since(row["warmer_celsius"]),
            kind,
            f"{row[kind]['pattern_um']:.1f}",
            *(_told(row[kind][name]) for name in names),
        ]
        for row in told["depth"]
        for kind in ("difference", "levelled")
    ]
    rows.append(["intensity", "difference", "0", *(_told(told["intensity"][name]) for name in names)])
    yield _table(
        "drift since the reference | map | pattern, um | best cell: best object | median | hundredth of cells | tenth "
        "| half | matched filter: best object | median | worst | two objects, median pair",
        rows,
    )


def _since(warmer: float | None) -> str:
    return "endless reference" if warmer is None else f"{warmer:g} degrees"


def _told(needed: dict[str, float | None] | None) -> str:
    if needed is None:
        return ""
    frames, hours = needed["frames"], needed["hours"]
    if frames is None or hours is None:
        return "never"
    if hours > 24 * 365:
        return f"{hours / 24 / 365:.2g} years"
    if hours >= 1:
        return f"{hours:.2g} h"
    return f"{frames:.0f} frame{'s' * (frames >= 1.5)}"
