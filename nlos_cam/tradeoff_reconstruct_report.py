"""A measured trade-off of reconstruction as a table for machines (JSON), one for people (Markdown), and a plot."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from nlos_cam.evaluate import BARS, plain
from nlos_cam.tradeoff_reconstruct import AS_GOOD, FRAMES, Row, losses, pareto_front, recommended

HEAD = (
    "| setting | ms: median | 90 % | wait for frames, ms | IoU | mean abs | within 2 % | foreground RMSE, mm "
    "| loses accuracy |\n| --- | --- | --- | --- | --- | --- | --- | --- | --- |"
)
NOTES = f"""Milliseconds are of one call on one object's maps: medians over all objects, after a first call
that is not counted; they are this machine's, and of this run. More frames cost no network time: their maps
are averaged while the next come, and the picture is as old as the wait. "Loses accuracy" is against the first row: by
more than any of {", ".join(f"{least:g} of {name}" for name, least in AS_GOOD.items())}."""


def facts(rows: Sequence[Row], planned: int, objects: int, machine: str) -> dict[str, Any]:
    """Everything, ready for JSON; `complete` tells whether all that was planned is in it."""
    pick = recommended(rows)
    return {
        "machine": machine,
        "objects": objects,
        "complete": len(rows) == planned,
        "settings": [
            {
                **asdict(row.setting),
                "milliseconds": row.milliseconds,
                "milliseconds_p90": row.milliseconds_p90,
                "wait_ms": row.wait_ms,
                **plain(row.figures),
                "loses_accuracy": any(loss > AS_GOOD[name] for name, loss in losses(row, rows[0]).items()),
            }
            for row in rows
        ],
        "recommended": {"name": pick.setting.name, "weights": pick.setting.weights} if pick else None,
        "pareto_front": [{"name": row.setting.name, "weights": row.setting.weights} for row in pareto_front(rows)],
    }


def as_markdown(table: Mapping[str, Any]) -> str:
    """The table for people."""
    whole = "" if table["complete"] else " Interrupted: not all was measured."
    parts = [
        f"{table['machine']}; {table['objects']} objects.{whole}",
        "\n".join([HEAD, *map(_line, table["settings"])]),
        NOTES,
        f"Recommended: {_called(table['recommended'])} (the quickest of one frame that loses no accuracy)."
        if table["recommended"]
        else "Nothing was measured.",
    ]
    return "\n\n".join(parts) + "\n"


def _called(setting: Mapping[str, Any]) -> str:
    return setting["name"] if setting["weights"] == "shipped" else f"{setting['weights']}: {setting['name']}"


def _line(row: Mapping[str, Any]) -> str:
    values = [row[name]["value"] for name in BARS]
    told = ["none" if value is None else f"{value:.3f}" if value < 1 else f"{value:.1f}" for value in values]
    times = f"{row['milliseconds']:.1f}", f"{row['milliseconds_p90']:.1f}", f"{row['wait_ms']:.0f}"
    return f"| {' | '.join([_called(row), *times, *told, 'yes' if row['loses_accuracy'] else 'no'])} |"


def draw(path: Path, rows: Sequence[Row]) -> None:
    """Silhouette IoU against milliseconds of one call, and against the frames averaged."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 5.5), layout="constrained")
    times, frames = figure.subplots(1, 2, width_ratios=(2, 1))
    front = pareto_front(rows)
    places = [row.milliseconds for row in front], [row.figures["silhouette_iou"].value for row in front]
    times.plot(*places, color="0.8", linewidth=6, solid_capstyle="round", label="nothing is quicker and better")
    singles = [row for row in rows if row.setting.frames == 1]
    for runtime in dict.fromkeys((row.setting.weights, row.setting.runtime) for row in singles):
        _series(times, [row for row in singles if (row.setting.weights, row.setting.runtime) == runtime])
    times.set(xscale="log", xlabel="milliseconds a call (log)", ylabel="silhouette IoU, 95 % interval over objects")
    times.set_title("one frame: format, runtime, threads")
    times.legend(fontsize=8)
    for weights in dict.fromkeys(row.setting.weights for row in rows):
        _against_frames(frames, weights, [row for row in rows if row.setting.weights == weights])
    frames.set(xscale="log", xlabel="frames averaged", xticks=FRAMES, xticklabels=FRAMES, title="averaged frames")
    for axis in (times, frames):
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=100)


def _series(axis: Any, rows: Sequence[Row]) -> None:
    """One runtime with its numbers of threads."""
    setting = rows[0].setting
    label = setting.runtime if setting.weights == "shipped" else f"{setting.weights}: {setting.runtime}"
    (line,) = axis.plot(
        [row.milliseconds for row in rows], [row.figures["silhouette_iou"].value for row in rows], "o-", label=label
    )
    for row in rows:
        iou = row.figures["silhouette_iou"]
        axis.plot([row.milliseconds] * 2, [iou.low, iou.high], color=line.get_color(), alpha=0.35)
        words = f"{row.setting.threads}"
        axis.annotate(words, (row.milliseconds, iou.value), (4, 4), textcoords="offset points", fontsize=8)


def _against_frames(axis: Any, weights: str, rows: Sequence[Row]) -> None:
    """The runtime that more frames were tried on."""
    tried = {row.setting.runtime for row in rows if row.setting.frames > 1}
    some = [row for row in rows if row.setting.runtime in tried and row.setting.threads == 1]
    ious = [row.figures["silhouette_iou"] for row in some]
    (line,) = axis.plot([row.setting.frames for row in some], [iou.value for iou in ious], "o-", label=weights)
    for row, iou in zip(some, ious, strict=True):
        axis.plot([row.setting.frames] * 2, [iou.low, iou.high], color=line.get_color(), alpha=0.35)
