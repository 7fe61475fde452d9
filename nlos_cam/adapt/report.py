"""Report of an adaptation: figures before and after, learning curve, contact sheet, what more
minutes would bring.
"""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from nlos_models import TRAINING_LOG

from nlos_cam.adapt.job import NETWORK
from nlos_cam.adapt.plan import HELD_OUT_OBJECTS, Plan
from nlos_cam.adapt.recordings import Transfer, iou_of
from nlos_cam.adapt.run import AFTER, REPORT, AdaptResult
from nlos_cam.bench import ForecastRecord
from nlos_cam.camera import FRAMES_PER_S
from nlos_cam.files import TEXT_LIMIT, read_bounded
from nlos_cam.forecast import SCATTER_IOU
from nlos_cam.report import (
    Banner,
    Commands,
    Document,
    Facts,
    Picture,
    Section,
    Table,
    figure_of,
    png,
    saved_picture,
    write_document,
)

MIN_EPOCHS = 8
"""A slope over fewer epochs is that of the learning rate, not of the minutes."""
MIN_GROWTH = 1.25
"""Samples of two stages' ends, one over the other, from which on their difference says more than
chance does."""
SHEET = "sheet.png"
"""Pictures of the objects, in the folder of an evaluation."""
LATE_SHARE = 0.5
"""The gain of further work is read off the second half of a run."""


@dataclass(frozen=True)
class Curve:
    """Held-out silhouette IoU of one stage; empty where its log is damaged."""

    samples: Sequence[int]
    """Trained on, earlier stages included, at the end of each epoch."""
    iou: Sequence[float]


def read_curves(plan: Plan, logs: Sequence[Path]) -> list[Curve]:
    """Return the learning curve of each stage from its log."""
    curves: list[Curve] = []
    before = 0
    for stage, path in zip(plan.stages, logs, strict=True):
        samples = stage.samples // stage.epochs
        iou = _read_log(path, stage.epochs)
        curves.append(Curve([before + samples * (k + 1) for k in range(len(iou))], iou))
        before += stage.samples
    return curves


def _read_log(path: Path, epochs: int) -> list[float]:
    """Return the held-out silhouette IoU of each epoch from the log of a whole run; none from a
    damaged or cut one, whose last row would pass for the end of the run.
    """
    try:
        text = read_bounded(path, TEXT_LIMIT).decode()
        iou = [float(row["held_out_iou"]) for row in csv.DictReader(text.splitlines())]
    except (OSError, ValueError, TypeError, KeyError, csv.Error):
        return []
    return iou if len(iou) == epochs and text.endswith("\n") else []


def gain_by_doubling(curves: Sequence[Curve]) -> float | None:
    """Return by how much the held-out IoU rises if the samples are doubled; None from too few
    points.

    Between stages whose samples differ by MIN_GROWTH it is what the later one brought; within the
    first one, the slope against the logarithm of the samples, which also holds what the falling rate
    brings: an upper bound.
    """
    ends = [(curve.samples[-1], curve.iou[-1]) for curve in curves if curve.samples]
    if not ends:
        return None
    more, better = ends[-1]
    earlier = [end for end in ends if end[0] * MIN_GROWTH <= more]
    if earlier:
        fewer, worse = earlier[-1]
        return (better - worse) / np.log2(more / fewer)
    if len(curves[0].iou) < MIN_EPOCHS:
        return None
    late = int(LATE_SHARE * len(curves[0].iou))
    slope, _ = np.polyfit(np.log2(curves[0].samples[late:]), curves[0].iou[late:], 1)
    return float(slope)


def outlook(
    plan: Plan, curves: Sequence[Curve], reached_iou: float, expected_iou: float | None
) -> str:
    """Return in words what more minutes would bring by the learning curve, after the forecast where
    that is far.
    """
    far = expected_iou is not None and reached_iou < expected_iou - SCATTER_IOU
    forecast = f"The forecast for this bench is {expected_iou:.2f}. " if far else ""
    gain = gain_by_doubling(curves)
    if gain is None:
        return f"{forecast}Too few epochs to say what more minutes would bring."
    minutes = f"{2 * plan.minutes:.0f} minutes in all"
    rise = f"{gain:+.3f} of IoU"
    if gain < 0.005:
        return f"{forecast}More minutes bring little: {rise} at {minutes}, by the learning curve."
    return f"{forecast}{minutes} would bring about {rise}, by the learning curve."


def draw_curves(curves: Sequence[Curve]) -> bytes:
    """Draw the learning curves as a PNG."""
    figure = figure_of(6.0, 3.0)
    axis = figure.subplots()
    for number, curve in enumerate(curves):
        axis.plot(curve.samples, curve.iou, marker=".", label=f"stage {number + 1}")
    axis.set(xlabel="samples trained on", ylabel="held-out silhouette IoU")
    axis.grid(alpha=0.3)
    if len(curves) > 1:
        axis.legend()
    return png(figure)


def _lost_words(curves: Sequence[Curve]) -> str:
    """Return in words which stages have no curve; empty where all have one."""
    lost = [f"{number}" for number, curve in enumerate(curves, 1) if not curve.iou]
    return f" Left out, since {TRAINING_LOG} is damaged: stage {', '.join(lost)}." if lost else ""


Rows = Sequence[tuple[str, str, str]]
"""Name of a metric, and its text before and after."""


def transfer_words(found: Transfer) -> str:
    """Return what recordings of known objects brought, in words."""
    before = iou_of(found.before)
    after = iou_of(found.after)
    outcome = "better" if found.is_better else "no better, so not taken"
    if found.is_nearer and not found.is_better:
        outcome = f"but {found.simulated_loss:.2f} worse on simulated objects, so not taken"
    return (
        f"fitted to recordings of {len(found.parts['adaptation'])} objects: silhouette IoU"
        f" {before:.3f} -> {after:.3f} on {len(found.parts['judged'])} objects held out, {outcome}"
    )


def _transfer_parts(found: Transfer, rows: Rows, page: Path) -> list[Section | Picture]:
    words = transfer_words(found)
    objects = {
        "trained on": ", ".join(found.parts["adaptation"]),
        "chose the epoch": ", ".join(found.parts["validation"]),
        "judged on": ", ".join(found.parts["judged"]),
    }
    table = Table(("metric (95 % interval over objects)", "before", "fitted to recordings"), rows)
    section = Section(
        "Recordings of known objects",
        [Banner("good" if found.is_better else "doubtful", words, ""), table, Facts(objects)],
    )
    title = "Objects held out, after the fit"
    sheet = saved_picture(title, "One frame each.", found.folder / AFTER / SHEET, page)
    return [section, sheet]


@dataclass(frozen=True)
class Tables:
    """Figures before and after, in words."""

    test_objects: Rows
    recordings: Rows = ()
    """On the objects held out of the recordings."""
    expected: ForecastRecord | None = None
    """None where there is no forecast."""


def _heading(plan: Plan) -> tuple[str, str]:
    """Return title and subtitle of the page."""
    locked = plan.locked
    if locked is None:
        return (
            "Weights for this bench",
            "54 test objects, rendered on this bench with the sensor's noise. Simulated light.",
        )
    subtitle = (
        f"54 test objects ({locked.material.kind}), {locked.radiometry} radiometry, pulse of"
        f" {plan.sensor.pulse_ns:g} ns; object in less object out over {locked.frames} frames"
        f" ({locked.frames / FRAMES_PER_S:.0f} s). Simulated light."
    )
    return "What locked differences show on this bench", subtitle


def _facts(plan: Plan, expected: ForecastRecord | None) -> Facts:
    """Return the numbers of a plan, and those of a forecast."""
    spread = plan.spread
    pace = plan.pace
    facts = {
        "objects rendered for this bench": f"{plan.stages[-1].objects}",
        "samples trained on": f"{sum(stage.samples for stage in plan.stages)}",
        "expected by the forecast": f"{expected.expected_iou:.2f}" if expected else "",
        "objects that change no cell: nothing there": (
            f"{expected.hidden_share:.0%}" if expected and expected.hidden_share else ""
        ),
        "minutes, as planned": f"{plan.minutes:.0f}",
        "this machine": (
            f"{pace.objects_per_s:.0f} objects and {pace.samples_per_s:.0f} samples a second"
        ),
        "bench may be off its record by": (
            f"{1e3 * spread.place_m:.1f} mm, {spread.angle_deg:.2f} degrees,"
            f" {spread.gain_share:.0%} of the gain"
        ),
    }
    return Facts({name: value for name, value in facts.items() if value})


def write_page(
    result: AdaptResult, tables: Tables, commands: Sequence[str], page: Path, *, kept: bool
) -> None:
    """Write the report of an adaptation, with commands to go on with; `kept` where its weights are
    those in use now.
    """
    plan = result.plan
    curves = read_curves(plan, [folder / NETWORK / TRAINING_LOG for folder in result.folders])
    before = iou_of(result.before)
    after = iou_of(result.after)
    headline = f"Silhouette IoU {before:.3f} -> {after:.3f}"
    expected = tables.expected
    if not (kept or plan.locked):
        headline += "; the weights in use stay"
        if result.shipped_are_better:
            headline += f" (the shipped ones have {result.shipped_iou or 0:.2f})"
    advice = outlook(plan, curves, after, expected.expected_iou if expected else None)
    document = Document(
        *_heading(plan),
        [
            Section(
                "",
                [Banner("good" if kept else "doubtful", headline, advice)],
            ),
            Section(
                "Before and after",
                [
                    Table(
                        (
                            "metric (95 % interval over objects)",
                            "a guess: the mean object" if plan.locked else "start weights, aligned",
                            "adapted",
                        ),
                        tables.test_objects,
                    ),
                    _facts(plan, expected),
                ],
            ),
            Picture(
                "Learning curve",
                f"On {HELD_OUT_OBJECTS} objects that no training saw; by them the epoch was chosen."
                + _lost_words(curves),
                draw_curves(curves),
            ),
            saved_picture(
                "Truth, reconstruction and difference",
                "The 54 test objects.",
                result.weights.parent / REPORT / SHEET,
                page,
            ),
            *(_transfer_parts(result.transfer, tables.recordings, page) if result.transfer else []),
            Section("Next commands", [Commands(commands)]),
        ],
    )
    write_document(document, page)
