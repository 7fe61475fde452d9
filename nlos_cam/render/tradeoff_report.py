"""A measured trade-off as a table for machines (JSON), a table for people (Markdown) and a Pareto plot."""

import platform
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numba

from nlos_cam.render.tradeoff import FINEST_BEAMS, Facts, Row, pareto_front

HEAD = (
    "| setting | seconds | times faster | peak error: median | p99 | max | same bin | within one "
    "| depth: median | mean |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"
)
BEAMS = f"{FINEST_BEAMS} x {FINEST_BEAMS}"
NOTES = f"""Seconds are the least of several renderings, all in one run; brute force is compiled too, and ran once. Peak
error is that of the strongest three-bounce bin, relative, over the beams that light the wall; depth is what the lidar
reports.
Ingredients are `standard` with one thing changed. `beams_per_cell` is held against {BEAMS} beams per cell at
`standard`, cell by cell: brute force has one beam per cell, and that is its own error. Brute force stands on the same
relay grid as `standard`: where a finer relay grid differs from it, the finer one is the nearer to the truth."""


def machine() -> str:
    """The machine in words."""
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text(encoding="utf-8").splitlines() if cpu.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    model = names[0] if names else platform.processor() or platform.machine()
    return f"{numba.get_num_threads()} threads, {model}, {platform.system()}, Python {platform.python_version()}"


def as_table(facts: Facts, rows: list[Row], planned: int) -> dict[str, Any]:
    """Everything, in the order of `measure`, ready for JSON; `complete` tells whether all that was planned is in it."""
    flat = [
        {"name": row.name, "part": row.part, "seconds": row.seconds, "speedup": row.speedup, **asdict(row.errors)}
        for row in rows
    ]
    return {
        "machine": machine(),
        **asdict(facts),
        "reference_seconds": rows[0].seconds if rows else None,
        "complete": len(rows) == planned,
        "stops": [{k: v for k, v in row.items() if k != "part"} for row in flat if row["part"] == "stop"],
        "ingredients": [row for row in flat if row["part"] != "stop"],
        "pareto_front": [row.name for row in pareto_front(rows)],
    }


def as_markdown(table: dict[str, Any]) -> str:
    """The table for people."""
    size = f"{table['patches']} patches, {table['beams_on_wall']} beams on the wall"
    parts = [
        f"{table['machine']}; {size}; brute force {table['reference_seconds']:.3g} s."
        + ("" if table["complete"] else " Interrupted: not all was measured."),
        "\n".join([HEAD, *map(_line, table["stops"])]),
        "\n".join([HEAD, *map(_line, table["ingredients"])]),
        NOTES,
        f"Nothing measured is both quicker and nearer than: {', '.join(table['pareto_front'])}.",
    ]
    return "\n\n".join(parts) + "\n"


def _line(row: dict[str, Any]) -> str:
    errors = (f"{100 * row[f'intensity_error_{of}']:.3g} %" for of in ("median", "p99", "max"))
    bins = (f"{100 * row[of]:.2f} %" for of in ("bin_exact", "bin_within_1"))
    depths = (f"{row[of]:.2g} mm" for of in ("depth_error_mm", "depth_error_mean_mm"))
    first = row["name"], f"{row['seconds']:.4f}", f"{row['speedup']:.0f}"
    return f"| {' | '.join([*first, *errors, *bins, *depths])} |"


def draw(path: Path, rows: list[Row], title: str) -> None:
    """Error against time, both logarithmic; what has no error stands on the lower edge."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 6.5), layout="constrained")
    axis = figure.add_subplot()
    shown = [row for row in rows if row.part != "beams_per_cell"]
    floor = 0.5 * min((error for row in shown if (error := row.errors.intensity_error_p99) > 0), default=1e-6)

    def places(of: list[Row]) -> tuple[list[float], list[float]]:
        return [1000 * row.seconds for row in of], [100 * max(row.errors.intensity_error_p99, floor) for row in of]

    axis.plot(*places(pareto_front(rows)), color="0.8", linewidth=6, solid_capstyle="round", label="Pareto front")
    for part in dict.fromkeys(row.part for row in shown if row.part != "stop"):
        series = [row for row in shown if row.part == part]
        line = "none" if part == "effect left out" else "-"
        (drawn,) = axis.plot(*places(series), marker="o", markersize=4, linestyle=line, label=part)
        _label(axis, series, places(series), drawn.get_color(), 7)
    stops = [row for row in shown if row.part == "stop"]
    axis.plot(*places(stops), linestyle="none", marker="*", markersize=15, color="black", clip_on=False, label="stops")
    _label(axis, stops, places(stops), "black", 11)
    axis.set(xscale="log", yscale="log", xlabel="milliseconds", title=title)
    axis.set_ylim(bottom=100 * floor)
    axis.set_ylabel("99th percentile of the relative peak error, % (no error: lower edge)")
    axis.grid(visible=True, which="both", alpha=0.2)
    axis.legend()
    figure.savefig(path, dpi=110)


def _label(axis: Any, rows: list[Row], places: tuple[list[float], list[float]], colour: Any, size: int) -> None:
    for row, x, y in zip(rows, *places, strict=True):
        name = row.name.removeprefix(row.part).strip()
        style = {"fontsize": size, "color": colour, "ha": "center"}
        axis.annotate(name, (x, y), xytext=(0, size), textcoords="offset points", **style)
