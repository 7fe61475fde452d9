"""What accuracy costs in time on one scene: the stops of the dial and their ingredients against
brute force.

A measured trade-off as a table for machines (JSON), a report for people and a Pareto plot.
"""

import json
import platform
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

import numba
import numpy as np

from nlos_cam import report
from nlos_cam.errors import SceneError
from nlos_cam.files import atomic_directory
from nlos_cam.render import (
    STOPS,
    Accuracy,
    Agreement,
    EchoMaps,
    Effects,
    Rendering,
    Scene,
    Stopwatch,
    agreement,
    least_seconds,
    prepare,
    render,
    three_bounce,
)

TRADEOFF_REPORT = "tradeoff.html"
INCOMPLETE = "Interrupted: some settings are missing."
Row = TypeVar("Row")
Part = Literal[
    "stop", "sub_bins", "relay grid", "object_stride", "beams_per_cell", "effect left out"
]

REPEATS = 7
"""Repetitions of each setting but brute force; the shortest counts."""
FINEST_BEAMS = 4
"""Beams per cell along each axis in the reference for `beams_per_cell`: brute force itself has only
one.
"""


@dataclass(frozen=True)
class RenderSetting:
    """Accuracy stop, or `standard` with one ingredient changed."""

    name: str
    part: Part
    accuracy: Accuracy
    effects: Effects = "auto"


@dataclass(frozen=True)
class RenderRow:
    """Time and error of one setting."""

    name: str
    part: Part
    seconds: float
    speedup: float
    """Ratio to the time of compiled brute force."""
    errors: Agreement
    """Against brute force; for `beams_per_cell`, against FINEST_BEAMS at `standard`."""


@dataclass(frozen=True)
class RenderFacts:
    """Size of the scene."""

    patches: int
    beams_on_wall: int


def render_settings(scene: Scene, stops: Mapping[str, Accuracy] = STOPS) -> list[RenderSetting]:
    """Return all settings to measure on a scene, brute force first."""
    standard = stops["standard"]
    ordered = sorted(stops.values(), key=lambda stop: stop.sub_bins > 0)
    columns = standard.relay_columns
    rows = standard.relay_rows
    grids = [
        (max(int(columns * share), 1), max(int(rows * share), 1)) for share in (0.25, 0.5, 1, 2)
    ]
    called_for = [effect.name for effect in prepare(scene, standard).plan if effect.included]
    return [
        *(RenderSetting(stop.name, "stop", stop) for stop in ordered),
        *(
            RenderSetting(f"sub_bins {n}", "sub_bins", replace(standard, sub_bins=n))
            for n in (1, 2, 4, 8, 16, 32, 64)
        ),
        *(
            RenderSetting(
                f"relay grid {x} x {y}",
                "relay grid",
                replace(standard, relay_columns=x, relay_rows=y),
            )
            for x, y in grids
        ),
        *(
            RenderSetting(f"object_stride {n}", "object_stride", replace(standard, object_stride=n))
            for n in (1, 2, 4)
        ),
        *(
            RenderSetting(
                f"beams_per_cell {n}", "beams_per_cell", replace(standard, beams_per_cell=n)
            )
            for n in (1, 2)
        ),
        *(
            RenderSetting(
                f"without {name}",
                "effect left out",
                standard,
                tuple(e for e in called_for if e != name),
            )
            for name in called_for
        ),
    ]


def render_facts(scene: Scene, stops: Mapping[str, Accuracy] = STOPS) -> RenderFacts:
    """Return the scene's size. Raises SceneError if no three-bounce path is possible."""
    job = prepare(scene, stops["reference"]).job
    if job is None:
        raise SceneError(
            "nothing is hidden, or no light reaches it and returns: give an object within the gate"
        )
    return RenderFacts(len(job.patches.beta), len(job.laser_spot_m))


def measure_renders(
    scene: Scene, stops: Mapping[str, Accuracy] = STOPS, stopwatch: Stopwatch = least_seconds
) -> Iterator[RenderRow]:
    """Measure each of `render_settings` and yield its row."""
    brute, *others = render_settings(scene, stops)
    lit = prepare(scene, brute.accuracy).beams.on_wall
    bin_m = scene.rig.device.bin_m
    three_bounce(scene, brute.accuracy, chosen=np.flatnonzero(lit)[:1])  # compiles
    slow_s, slow = _timed(scene, brute, stopwatch, 1)
    truth = EchoMaps.of_beams(slow).select(lit)
    yield RenderRow(brute.name, brute.part, slow_s, 1.0, agreement(truth, truth, bin_m))
    finest = render(scene, replace(stops["standard"], beams_per_cell=FINEST_BEAMS))
    true_cells = EchoMaps.of_cells(finest, scene).select(lit)
    for setting in others:
        render(scene, setting.accuracy, setting.effects)  # compiles
        seconds, found = _timed(scene, setting, stopwatch, REPEATS)
        if setting.part == "beams_per_cell":
            errors = agreement(EchoMaps.of_cells(found, scene).select(lit), true_cells, bin_m)
        else:
            errors = agreement(EchoMaps.of_beams(found).select(lit), truth, bin_m)
        yield RenderRow(setting.name, setting.part, seconds, slow_s / seconds, errors)


def _timed(
    scene: Scene, setting: RenderSetting, stopwatch: Stopwatch, repeats: int
) -> tuple[float, Rendering]:
    renderings: list[Rendering] = []
    seconds = stopwatch(
        lambda: renderings.append(render(scene, setting.accuracy, setting.effects)), repeats
    )
    return seconds, renderings[-1]


def undominated(rows: Iterable[Row], costs: Callable[[Row], tuple[float, float]]) -> list[Row]:
    """Return the rows that no other beats in both `costs` (time, loss), from fast to slow."""
    front: list[Row] = []
    for row in sorted(rows, key=costs):
        if not front or costs(row)[1] < costs(front[-1])[1]:
            front.append(row)
    return front


def pareto_front(rows: list[RenderRow]) -> list[RenderRow]:
    """Return the rows that no other beats in both time and error; leaving an effect out may change
    only the map.
    """
    alike = [row for row in rows if row.part not in {"beams_per_cell", "effect left out"}]
    return undominated(alike, lambda row: (row.seconds, row.errors.intensity_error_p99))


HEAD = (
    *("setting", "time, ms", "times faster", "peak error, %: median", "p99", "max"),
    *("same bin, %", "within one, %", "depth error, mm: median", "mean"),
)
BEAMS = f"{FINEST_BEAMS} x {FINEST_BEAMS}"
NOTES = (
    "Times are the shortest of several renderings in one run; brute force is compiled too and ran"
    " once. Peak error: the relative error of the strongest three-bounce bin over the beams that"
    " light the wall; depth is the reported depth. Ingredients are `standard` with one change."
    f" `beams_per_cell` is compared with {BEAMS} beams per cell at `standard`, cell by cell, since"
    " brute force has one beam per cell. Brute force uses the relay grid of `standard`: where a"
    " finer grid differs from it, the finer grid is closer to the truth."
)
PLOT_CAPTION = (
    "Lower left is better: less time, less error. Labels are settings; stars are the stops of"
    " `--accuracy`."
)


def machine() -> str:
    """Return a description of processor, system and Python."""
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text(encoding="utf-8").splitlines() if cpu.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    model = names[0] if names else platform.processor() or platform.machine()
    return (
        f"{numba.get_num_threads()} threads, {model}, {platform.system()}, Python"
        f" {platform.python_version()}"
    )


def as_table(facts: RenderFacts, rows: list[RenderRow], planned: int) -> dict[str, Any]:
    """Return all rows in the order measured, ready for JSON; `complete` is False after an
    interruption.
    """
    flat = [
        {
            "name": row.name,
            "part": row.part,
            "seconds": row.seconds,
            "speedup": row.speedup,
            **asdict(row.errors),
        }
        for row in rows
    ]
    return {
        "machine": machine(),
        **asdict(facts),
        "reference_seconds": rows[0].seconds if rows else None,
        "complete": len(rows) == planned,
        "stops": [
            {k: v for k, v in row.items() if k != "part"} for row in flat if row["part"] == "stop"
        ],
        "ingredients": [row for row in flat if row["part"] != "stop"],
        "pareto_front": [row.name for row in pareto_front(rows)],
    }


def render_document(
    table: Mapping[str, Any], name: str, plot: Path | None = None
) -> report.Document:
    """Return the report on a table about rendering an object called `name`."""
    front = (
        f"Settings that no other beats in both time and error: {', '.join(table['pareto_front'])}."
    )
    size = f"{table['patches']} patches, {table['beams_on_wall']} beams on the wall"
    slow = f"brute force {table['reference_seconds']:.3g} s"
    parts: list[report.Section | report.Picture] = [
        report.Section("", [report.Bullets("Note", [] if table["complete"] else [INCOMPLETE])]),
        report.Section(
            "Stops of the accuracy setting",
            [report.Table(HEAD, [_line(row) for row in table["stops"]]), front],
        ),
        report.Section(
            "Ingredients", [report.Table(HEAD, [_line(row) for row in table["ingredients"]]), NOTES]
        ),
        report.Section(
            "Next commands",
            [report.Commands([f"nlos-cam render {shlex.quote(name)} --max-error 0.005"])],
        ),
    ]
    if plot:
        parts.insert(2, report.saved_picture("Error against time", PLOT_CAPTION, plot))
    return report.Document(
        f"Rendering {name}: accuracy against time", f"{table['machine']}; {size}; {slow}.", parts
    )


def _line(row: Mapping[str, Any]) -> tuple[str, ...]:
    errors = (f"{100 * row[f'intensity_error_{of}']:.2g}" for of in ("median", "p99", "max"))
    bins = (f"{100 * row[of]:.2f}" for of in ("bin_exact", "bin_within_1"))
    depths = (f"{row[of]:.2f}" for of in ("depth_error_mm", "depth_error_mean_mm"))
    time_ms = 1000 * row["seconds"]
    return (
        row["name"],
        f"{time_ms:.{1 if time_ms < 100 else 0}f}",
        f"{row['speedup']:.0f}",
        *errors,
        *bins,
        *depths,
    )


def write_table(folder: Path, table: Mapping[str, Any], document: report.Document) -> None:
    """Write a trade-off's table as JSON, and its report."""
    (folder / "tradeoff.json").write_text(json.dumps(table, indent=2) + "\n", encoding="utf-8")
    report.write_document(document, folder / TRADEOFF_REPORT)


def write_renders(folder: Path, table: dict[str, Any], rows: list[RenderRow], name: str) -> None:
    """Write the measured trade-off as JSON, report and plot; `name` is the object's."""
    title = f"{name}: {table['patches']} patches, {table['beams_on_wall']} beams on the wall"
    with atomic_directory(folder) as part:
        draw_renders(part / "tradeoff.png", rows, title)
        write_table(part, table, render_document(table, name, part / "tradeoff.png"))


def draw_renders(path: Path, rows: list[RenderRow], title: str) -> None:
    """Error against time, both logarithmic; what has no error stands on the lower edge."""
    figure = report.figure_of(10, 6.5)
    axis = figure.add_subplot()
    shown = [row for row in rows if row.part != "beams_per_cell"]
    floor = 0.5 * min(
        (error for row in shown if (error := row.errors.intensity_error_p99) > 0), default=1e-6
    )

    def places(of: list[RenderRow]) -> tuple[list[float], list[float]]:
        return [1000 * row.seconds for row in of], [
            100 * max(row.errors.intensity_error_p99, floor) for row in of
        ]

    axis.plot(
        *places(pareto_front(rows)),
        color="0.8",
        linewidth=6,
        solid_capstyle="round",
        label="Pareto front",
    )
    for part in dict.fromkeys(row.part for row in shown if row.part != "stop"):
        series = [row for row in shown if row.part == part]
        line = "none" if part == "effect left out" else "-"
        (drawn,) = axis.plot(*places(series), marker="o", markersize=4, linestyle=line, label=part)
        _label(axis, series, places(series), drawn.get_color(), 7)
    stops = [row for row in shown if row.part == "stop"]
    axis.plot(
        *places(stops),
        linestyle="none",
        marker="*",
        markersize=15,
        color="black",
        clip_on=False,
        label="stops",
    )
    _label(axis, stops, places(stops), "black", 11)
    axis.set(xscale="log", yscale="log", xlabel="milliseconds", title=title)
    axis.set_ylim(bottom=100 * floor)
    axis.set_ylabel("99th percentile of the relative peak error, % (no error: lower edge)")
    axis.grid(visible=True, which="both", alpha=0.2)
    axis.legend()
    figure.savefig(path, dpi=110)


def _label(
    axis: Any,
    rows: list[RenderRow],
    places: tuple[list[float], list[float]],
    colour: Any,
    size: int,
) -> None:
    for row, x, y in zip(rows, *places, strict=True):
        name = row.name.removeprefix(row.part).strip()
        style = {"fontsize": size, "color": colour, "ha": "center"}
        axis.annotate(name, (x, y), xytext=(0, size), textcoords="offset points", **style)
