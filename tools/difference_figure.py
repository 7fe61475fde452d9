"""The picture of the study of difference maps: one object's maps, and signal to noise by frames and by temperature."""

from pathlib import Path
from typing import Any

from difference_paper import USUAL_FRAMES, USUAL_WARMER, Example
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

COLOURS = {"raw": "tab:red", "difference": "tab:blue", "levelled": "tab:green"}
NAMES = {"raw": "raw less plane", "difference": "difference", "levelled": "difference, levelled"}
WHAT = {"merged": "cells whose echo merged (full lines)", "switched": "cells that report another echo (dashed)"}
SHOWN_MM = 2.0


def draw(told: dict[str, Any], example: Example, path: Path) -> None:
    """Three maps above; raw against difference maps by frames and temperature, and `lambertian` by frames, below."""
    figure = Figure(figsize=(14, 8.4), layout="constrained")
    grid = figure.add_gridspec(2, 1, height_ratios=(1, 1.25))
    above, below = (figure.add_subfigure(grid[row]) for row in (0, 1))
    _maps(above, example, told["frames"])
    axes = below.subplots(1, 3)
    wide = told["paper"][-1]
    _by_frames(axes[0], wide)
    _by_temperature(axes[1], wide["by_temperature"])
    _lambertian(axes[2], told["lambertian"])
    for axis in axes:
        axis.grid(visible=True, alpha=0.3)
    figure.savefig(path, dpi=100)


def _maps(figure: Any, example: Example, frames: int) -> None:
    axes = figure.subplots(1, 3, gridspec_kw={"wspace": 0.1})
    titles = {
        "signal: what the object changes (grey: occluder)": example.signal_m,
        f"raw map less the fitted plane, {frames} frames": example.raw_m,
        f"difference map, {frames} frames each": example.difference_m,
    }
    scale = ScalarMappable(Normalize(-SHOWN_MM, SHOWN_MM), colormaps["RdBu_r"].with_extremes(bad="0.75"))
    for axis, (title, picture) in zip(axes, titles.items(), strict=True):
        axis.imshow(scale.to_rgba(1e3 * picture), interpolation="nearest")
        axis.set_title(title, fontsize=10)
        axis.set_axis_off()
    figure.colorbar(scale, ax=axes, shrink=0.8, label="depth, mm", extend="both")


def _by_frames(axis: Axes, wide: dict[str, Any]) -> None:
    """Merged echoes in full lines, with drift and without; other echoes in dashed ones."""
    for part, style in (("switched", "--"), ("merged", "-")):
        rows = wide[part]["by_frames"] if part in wide else []
        if rows:
            axis.annotate(WHAT[part], (rows[-1]["frames"], 1.3 * rows[-1]["raw"]["rms"]), ha="right", fontsize=9)
        for kind, colour in COLOURS.items():
            label = NAMES[kind] if part == "merged" else None
            axis.plot(*_curve(rows, "frames", kind), style, color=colour, marker="o", ms=4, label=label)
    steady = wide["merged"]["by_frames_steady"] if "merged" in wide else []
    axis.plot(*_curve(steady, "frames", "difference"), ":", color="black", lw=2, label="difference, no drift")
    axis.axhline(1, color="0.3", lw=1, ls=":")
    axis.set(xscale="log", yscale="log", xlabel="frames averaged", ylabel="RMS of the signal over RMS of all else")
    axis.set_ylim(top=4e4)
    axis.set_title(f"paper, direct return wins {wide['direct_wins']:.0%}, +{USUAL_WARMER:g} °C", fontsize=10)
    axis.legend(fontsize=8, loc="upper center", ncols=2)


def _curve(rows: list[dict[str, Any]], along: str, kind: str) -> tuple[list[float], list[float]]:
    return [row[along] for row in rows], [row[kind]["rms"] for row in rows]


def _by_temperature(axis: Axes, rows: list[dict[str, Any]]) -> None:
    for frames, style in ((USUAL_FRAMES, "o-"), (1000, "s--")):
        some = [row for row in rows if row["frames"] == frames]
        for kind, colour in COLOURS.items():
            label = f"{NAMES[kind]}, {frames} frames"
            axis.plot(*_curve(some, "warmer_celsius", kind), style, color=colour, ms=4, label=label)
    axis.axhline(1, color="0.3", lw=1, ls=":")
    axis.set(yscale="log", xlabel="warmer than the reference, °C", ylabel="RMS of the signal over RMS of all else")
    axis.set_title("paper, merged echoes", fontsize=10)
    axis.legend(fontsize=8)


def _lambertian(axis: Axes, told: dict[str, Any]) -> None:
    """The median object's matched filter, and its best cell, without drift and with some."""
    drifts = [row for row in told["depth"] if row["warmer_celsius"] is not None]
    colours = ("black", "tab:green", "tab:orange", "tab:red")
    for row, colour in zip(drifts, colours, strict=True):
        warmer = row["warmer_celsius"]
        for curve, style, what in (("matched", "-", "matched filter"), ("best_cell", "--", "best cell")):
            label = f"{what}, {f'+{warmer:g} °C' if warmer else 'no drift'}"
            axis.plot(told["frames"], row["levelled"][f"curve_{curve}"], style, color=colour, label=label)
    axis.plot(
        told["frames"], told["intensity"]["curve_matched"], ":", color="tab:purple", label="matched filter, intensity"
    )
    axis.axhline(1, color="0.3", lw=1, ls=":")
    axis.set(xscale="log", yscale="log", xlabel="frames of object and of bare wall, each", ylabel="signal over noise")
    axis.set_xlim(1, 1e7)
    axis.set_title("lambertian, pulse of 1 ns: levelled difference maps", fontsize=10)
    axis.legend(fontsize=8, loc="upper left", ncols=1)
