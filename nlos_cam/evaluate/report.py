"""A judgement as a folder that a person reads in a minute: report.md, pictures, figures.json, objects.csv."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration import ObjectBox
from nlos_calibration.arrays import Float32, Float64

from nlos_cam.evaluate import figures as pictures
from nlos_cam.evaluate import metrics as surfaces
from nlos_cam.evaluate.metrics import (
    BARS,
    SMALLER_IS_BETTER,
    Interval,
    PerObject,
    advantage,
    bars_met,
    over_objects,
    per_category,
    per_object,
    plain,
)
from nlos_cam.files import atomic_directory

SIZE, DETAIL = "surface, cm²", "edges per surface, cm / cm²"
SILHOUETTE_ERROR, DEPTH_ERROR = "1 - silhouette IoU", "foreground RMSE, mm"

READ_WITH_CARE = (
    "Means over objects; intervals by bootstrap over objects. Foreground RMSE is over pixels that are surface in both, "
    "so an answer that finds little of an object is not told by it: read it beside the silhouette IoU."
)


@dataclass(frozen=True)
class Judgement:
    """All that was judged: the images of one reconstructor and of the baselines, against the truth."""

    names: Sequence[str]
    categories: Sequence[str]
    truth: Float32
    """(n, 64, 64)."""
    image: Float32
    guesses: Mapping[str, Float32]
    box: ObjectBox
    facts: Mapping[str, Any]
    """What was judged on what, in words: goes to the figures as it is."""
    left_out: Sequence[str] = ()
    """Categories that training kept out."""

    @property
    def ours(self) -> PerObject:
        """Every metric of every object."""
        return per_object(self.image, self.truth, self.box)

    @property
    def like(self) -> dict[str, Float64]:
        """What the true surfaces are like."""
        return {
            SIZE: surfaces.surface_cm2(self.truth, self.box),
            DETAIL: surfaces.detail_per_cm(self.truth, self.box),
        }

    @property
    def errors(self) -> dict[str, Float64]:
        """The two errors that are held against the surface."""
        ours = self.ours
        return {SILHOUETTE_ERROR: 1 - ours["silhouette_iou"], DEPTH_ERROR: ours["foreground_rmse_mm"]}


def as_figures(judgement: Judgement) -> dict[str, Any]:
    """All figures, ready for JSON."""
    ours = judgement.ours
    theirs = {name: per_object(guess, judgement.truth, judgement.box) for name, guess in judgement.guesses.items()}
    overall = over_objects(ours)
    nearest = theirs.get("nearest_neighbour")
    return {
        **plain(overall),
        "baselines": {name: plain(over_objects(values)) for name, values in theirs.items()},
        "advantage_over_nearest_neighbour": plain(advantage(ours, nearest)) if nearest else None,
        "bars": bars_met(overall),
        "per_category": {name: plain(figures) for name, figures in per_category(ours, judgement.categories).items()},
        "shown_and_left_out": _by_shown(judgement),
        "rank_correlation": {
            f"{error_name} with {like_name}": asdict(surfaces.rank_correlation(like, error))
            for error_name, error in judgement.errors.items()
            for like_name, like in judgement.like.items()
        },
        "where_the_error_is": {
            name: asdict(zone) for name, zone in surfaces.where_the_error_is(judgement.image, judgement.truth).items()
        },
        "objects": len(judgement.truth),
        **judgement.facts,
    }


def _by_shown(judgement: Judgement) -> dict[str, Any] | None:
    """The figures of the kinds that training kept out, and of the others; None where it kept none of these out."""
    if not set(judgement.left_out) & set(judgement.categories):
        return None
    shown = ["left out" if category in judgement.left_out else "shown" for category in judgement.categories]
    return {name: plain(figures) for name, figures in per_category(judgement.ours, shown).items()}


def write(folder: Path, judgement: Judgement, figures: Mapping[str, Any]) -> None:
    """The whole folder, in a folder that is there; what was in it is replaced once all is written."""
    with atomic_directory(folder) as part:
        (part / "figures.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
        _write_objects(part / "objects.csv", judgement)
        _draw(part, judgement)
        (part / "report.md").write_text(as_markdown(figures), encoding="utf-8")


def _write_objects(path: Path, judgement: Judgement) -> None:
    """One row for each object; an empty field where it has no value."""
    columns = {**judgement.ours, "surface_cm2": judgement.like[SIZE], "detail_per_cm": judgement.like[DETAIL]}
    with path.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["name", "category", *columns])
        for k, (name, category) in enumerate(zip(judgement.names, judgement.categories, strict=True)):
            values = [float(column[k]) for column in columns.values()]
            rows.writerow([name, category, *("" if np.isnan(value) else f"{value:.6g}" for value in values)])


def _draw(folder: Path, judgement: Judgement) -> None:
    image, truth, names, ours = judgement.image, judgement.truth, judgement.names, judgement.ours
    pictures.draw_sheet(folder / "sheet.png", image, truth, names)
    pictures.draw_gallery(folder / "gallery.png", image, truth, names, ours["silhouette_iou"])
    pictures.draw_categories(folder / "categories.png", per_category(ours, judgement.categories), over_objects(ours))
    curves = {
        like_name: {error_name: surfaces.curve(like, error) for error_name, error in judgement.errors.items()}
        for like_name, like in judgement.like.items()
    }
    pictures.draw_against_surface(folder / "surface.png", judgement.like, judgement.errors, curves)


def as_markdown(figures: Mapping[str, Any]) -> str:
    """The report, from the figures alone."""
    names = list(figures["baselines"])
    head = "| metric | ours (95 % interval) | wanted | " + " | ".join(name.replace("_", " ") for name in names) + " |"
    weights = f"{figures['weights']} ({figures['input']})"
    parts = [
        f"# Reconstruction of {figures['objects']} hidden objects",
        f"{figures['what']}. Weights: {weights}; rig: {figures['rig']}; {figures['runtime']}.",
        *(f"**Note**: {note}." for note in figures["notes"]),
        "\n".join([head, "| --- " * (3 + len(names)) + "|", *(_row(figures, metric, names) for metric in BARS)]),
        READ_WITH_CARE,
        _against_nearest(figures["advantage_over_nearest_neighbour"], figures["training_objects"]),
        _shown(figures["shown_and_left_out"]),
        _where(figures["where_the_error_is"]),
        "![truth, reconstruction, difference](sheet.png)",
        _categories(figures["per_category"]),
        "![each metric per category](categories.png)",
        _surface(figures["rank_correlation"]),
        "![error against size and detail](surface.png)",
        "![worst and best silhouettes](gallery.png)",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def in_words(figure: Mapping[str, float | None] | Interval) -> str:
    """A figure and its interval."""
    plain = asdict(figure) if isinstance(figure, Interval) else figure
    value, low, high = (plain[name] for name in ("value", "low", "high"))
    return "none" if value is None else f"{value:.3g} ({low:.3g} to {high:.3g})"


def _row(figures: Mapping[str, Any], metric: str, names: Sequence[str]) -> str:
    bar, verdict = figures["bars"][metric], "met" if figures["bars"][metric]["met"] else "not met"
    wanted = f"{'at most' if metric in SMALLER_IS_BETTER else 'at least'} {bar['bar']:g}: {verdict}"
    others = [in_words(figures["baselines"][name][metric]).split(" ")[0] for name in names]
    return f"| {metric} | {in_words(figures[metric])} | {wanted} | {' | '.join(others)} |"


def _against_nearest(figures: Mapping[str, Any] | None, among: int | None) -> str:
    if not figures:
        return ""
    told = [f"{metric} {in_words(figure)}" for metric, figure in figures.items()]
    return (
        f"The nearest neighbour is, of {among} training objects, the one whose maps are nearest (least squares over "
        "all cells, each channel in units of its spread); the mean object is their mean. Better than the nearest, "
        f"object by object where both have a value (positive is better), by: {'; '.join(told)}."
    )


def _shown(figures: Mapping[str, Any] | None) -> str:
    if not figures:
        return ""
    told = [f"{name} {in_words(group['silhouette_iou'])}" for name, group in figures.items()]
    return f"Silhouette IoU of kinds that training was shown, and of those that it was not: {'; '.join(told)}."


def _where(zones: Mapping[str, Any]) -> str:
    if zones["core"]["share_of_error"] is None:
        return "There is no error."
    told = [
        f"{name} {100 * zone['share_of_error']:.0f} % (of the pixels {100 * zone['share_of_pixels']:.0f} %)"
        for name, zone in zones.items()
    ]
    return (
        f"Where the absolute error is, the rim being two pixels on either side of the true outline: {', '.join(told)}."
    )


def _categories(categories: Mapping[str, Any]) -> str:
    ordered = sorted(categories, key=lambda name: categories[name]["silhouette_iou"]["value"] or 0.0)
    told = [f"{name} {categories[name]['silhouette_iou']['value']:.2f}" for name in ordered]
    if len(told) < 6:
        return f"Silhouette IoU by category: {', '.join(told)}."
    return (
        f"Silhouette IoU by category: worst {', '.join(told[:3])}; best {', '.join(told[-3:])}. Of few objects (the "
        "test set has three of each) an interval is rather too narrow than too wide."
    )


def _surface(correlations: Mapping[str, Any]) -> str:
    told = [f"{name} {in_words(figure)}" for name, figure in correlations.items()]
    return f"SI 6 finds least error on large or smooth surfaces. Rank correlations here: {'; '.join(told)}."
