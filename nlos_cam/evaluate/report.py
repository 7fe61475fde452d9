"""Evaluation of weights on held-out objects, and its report: report.md, pictures, figures.json, objects.csv."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration import ObjectBox, Rig
from nlos_calibration.arrays import Float32, Float64
from nlos_models import load_reconstructor

from nlos_cam.evaluate import figures as pictures
from nlos_cam.evaluate import metrics
from nlos_cam.evaluate.metrics import (
    SMALLER_IS_BETTER,
    TARGETS,
    Interval,
    PerObject,
    advantage,
    over_objects,
    per_category,
    per_object,
    plain,
    targets_met,
)
from nlos_cam.evaluate.subjects import (
    HeldOutObjects,
    Tracked,
    bare_wall_for,
    baseline_answers,
    dataset_objects,
    left_out_categories,
    network_input,
    notes_about,
    reconstruct_all,
    rendered_objects,
    rig_of,
    untracked,
)
from nlos_cam.files import atomic_directory, cache_folder

SHIPPED = "the shipped ones"
SIZE, DETAIL = "surface, cm²", "edges per surface, cm / cm²"
SILHOUETTE_ERROR, DEPTH_ERROR = "1 - silhouette IoU", "foreground RMSE, mm"

READ_WITH_CARE = (
    "Means over objects; intervals by bootstrap over objects. Foreground RMSE is over pixels that are surface in both, "
    "so it ignores missed parts: read it together with the silhouette IoU."
)


@dataclass(frozen=True)
class Evaluation:
    """Images of one reconstructor and of the baselines, with the truth."""

    names: Sequence[str]
    categories: Sequence[str]
    truth: Float32
    """(n, 64, 64)."""
    image: Float32
    guesses: Mapping[str, Float32]
    box: ObjectBox
    facts: Mapping[str, Any]
    """Weights, rig, runtime and notes: copied to the figures."""
    left_out: Sequence[str] = ()
    """Categories that training left out."""

    @property
    def ours(self) -> PerObject:
        """Return every metric of every object."""
        return per_object(self.image, self.truth, self.box)

    @property
    def surfaces(self) -> dict[str, Float64]:
        """Return size and detail of the true surfaces, (n,) each."""
        return {
            SIZE: metrics.surface_cm2(self.truth, self.box),
            DETAIL: metrics.detail_per_cm(self.truth, self.box),
        }

    @property
    def errors(self) -> dict[str, Float64]:
        """Return the two errors that are correlated with size and detail, (n,) each."""
        ours = self.ours
        return {SILHOUETTE_ERROR: 1 - ours["silhouette_iou"], DEPTH_ERROR: ours["foreground_rmse_mm"]}


def evaluate(
    weights: Path | None,
    objects: HeldOutObjects | Path | None = None,
    *,
    rig: Rig | None = None,
    count: int | None = None,
    wall: Path | None = None,
    training: Path | None = None,
    nearest: bool = True,
    tracked: Tracked = untracked,
) -> Evaluation:
    """Reconstruct held-out objects with weights (the shipped ones if None) and with the baselines.

    The objects are those given, those of a dataset (a path), or rendered: the 54 test objects, or `count` random ones,
    on `rig` (the weights' own if None). `wall` is the bare wall of difference maps. `training` names the maps searched
    for the nearest neighbour, unless it is left out. `tracked` opens progress bars. Raises SceneError, RecordingError.
    """
    reconstructor = load_reconstructor(weights, cache_folder() / "onnx")
    record = reconstructor.record
    if isinstance(objects, Path):
        objects = dataset_objects(objects)
    elif objects is None:
        objects = rendered_objects(rig or rig_of(record), count, tracked)
    bare = bare_wall_for(record, objects.plan, wall)
    guesses, searched = baseline_answers(objects, training, nearest=nearest, tracked=tracked)
    image = reconstruct_all(reconstructor, network_input(objects.maps, bare))
    facts = {
        "what": objects.description,
        "weights": str(weights or SHIPPED),
        "rig": objects.plan.rig.name,
        "runtime": reconstructor.runtime,
        "input": record.input,
        "training_objects": len(searched) if searched else None,
        "notes": notes_about(record, objects, searched),
    }
    truth, left_out = objects.maps.image.astype(np.float32), left_out_categories(record)
    return Evaluation(objects.names, objects.categories, truth, image, guesses, objects.plan.box, facts, left_out)


def as_figures(evaluation: Evaluation) -> dict[str, Any]:
    """Return all figures, ready for JSON."""
    ours = evaluation.ours
    theirs = {name: per_object(guess, evaluation.truth, evaluation.box) for name, guess in evaluation.guesses.items()}
    overall = over_objects(ours)
    nearest = theirs.get("nearest_neighbour")
    return {
        **plain(overall),
        "baselines": {name: plain(over_objects(values)) for name, values in theirs.items()},
        "advantage_over_nearest_neighbour": plain(advantage(ours, nearest)) if nearest else None,
        "bars": targets_met(overall),
        "per_category": {name: plain(figures) for name, figures in per_category(ours, evaluation.categories).items()},
        "shown_and_left_out": _by_shown(evaluation),
        "rank_correlation": {
            f"{error_name} with {measure_name}": asdict(metrics.rank_correlation(measure, error))
            for error_name, error in evaluation.errors.items()
            for measure_name, measure in evaluation.surfaces.items()
        },
        "where_the_error_is": {
            name: asdict(zone) for name, zone in metrics.error_by_zone(evaluation.image, evaluation.truth).items()
        },
        "objects": len(evaluation.truth),
        **evaluation.facts,
    }


def _by_shown(evaluation: Evaluation) -> dict[str, Any] | None:
    """Return the figures of left-out and of trained categories; None if none of these was left out."""
    if not set(evaluation.left_out) & set(evaluation.categories):
        return None
    shown = ["left out" if category in evaluation.left_out else "shown" for category in evaluation.categories]
    return {name: plain(figures) for name, figures in per_category(evaluation.ours, shown).items()}


def write_report(folder: Path, evaluation: Evaluation, figures: Mapping[str, Any]) -> None:
    """Write the report's folder; an earlier one is replaced once all files are written."""
    with atomic_directory(folder) as part:
        (part / "figures.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
        _write_objects(part / "objects.csv", evaluation)
        _draw(part, evaluation)
        (part / "report.md").write_text(as_markdown(figures), encoding="utf-8")


def _write_objects(path: Path, evaluation: Evaluation) -> None:
    """Write one row per object; a field without a value is empty."""
    columns = {
        **evaluation.ours,
        "surface_cm2": evaluation.surfaces[SIZE],
        "detail_per_cm": evaluation.surfaces[DETAIL],
    }
    with path.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["name", "category", *columns])
        for k, (name, category) in enumerate(zip(evaluation.names, evaluation.categories, strict=True)):
            values = [float(column[k]) for column in columns.values()]
            rows.writerow([name, category, *("" if np.isnan(value) else f"{value:.6g}" for value in values)])


def _draw(folder: Path, evaluation: Evaluation) -> None:
    image, truth, names, ours = evaluation.image, evaluation.truth, evaluation.names, evaluation.ours
    pictures.draw_sheet(folder / "sheet.png", image, truth, names)
    pictures.draw_gallery(folder / "gallery.png", image, truth, names, ours["silhouette_iou"])
    pictures.draw_categories(folder / "categories.png", per_category(ours, evaluation.categories), over_objects(ours))
    curves = {
        measure_name: {error_name: metrics.curve(measure, error) for error_name, error in evaluation.errors.items()}
        for measure_name, measure in evaluation.surfaces.items()
    }
    pictures.draw_against_surface(folder / "surface.png", evaluation.surfaces, evaluation.errors, curves)


def as_markdown(figures: Mapping[str, Any]) -> str:
    """Return the report as Markdown, from the figures alone."""
    names = list(figures["baselines"])
    head = "| metric | ours (95 % interval) | target | " + " | ".join(name.replace("_", " ") for name in names) + " |"
    weights = f"{figures['weights']} ({figures['input']})"
    parts = [
        f"# Reconstruction of {figures['objects']} hidden objects",
        f"{figures['what']}. Weights: {weights}; rig: {figures['rig']}; {figures['runtime']}.",
        *(f"**Note**: {note}." for note in figures["notes"]),
        "\n".join([head, "| --- " * (3 + len(names)) + "|", *(_row(figures, metric, names) for metric in TARGETS)]),
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


def format_interval(figure: Mapping[str, float | None] | Interval) -> str:
    """Format an estimate with its interval, "0.696 (0.66 to 0.73)"."""
    plain = asdict(figure) if isinstance(figure, Interval) else figure
    value, low, high = (plain[name] for name in ("value", "low", "high"))
    return "none" if value is None else f"{value:.3g} ({low:.3g} to {high:.3g})"


def _row(figures: Mapping[str, Any], metric: str, names: Sequence[str]) -> str:
    bar, verdict = figures["bars"][metric], "met" if figures["bars"][metric]["met"] else "not met"
    wanted = f"{'at most' if metric in SMALLER_IS_BETTER else 'at least'} {bar['bar']:g}: {verdict}"
    others = [format_interval(figures["baselines"][name][metric]).split(" ")[0] for name in names]
    return f"| {metric} | {format_interval(figures[metric])} | {wanted} | {' | '.join(others)} |"


def _against_nearest(figures: Mapping[str, Any] | None, among: int | None) -> str:
    if not figures:
        return ""
    parts = [f"{metric} {format_interval(figure)}" for metric, figure in figures.items()]
    return (
        f"The nearest neighbour is the one of {among} training objects with the nearest maps (sum of squares over all "
        "cells, each channel in units of its spread); the mean object is their mean. Advantage over the nearest "
        f"neighbour per object, positive is better: {'; '.join(parts)}."
    )


def _shown(figures: Mapping[str, Any] | None) -> str:
    if not figures:
        return ""
    parts = [f"{name} {format_interval(group['silhouette_iou'])}" for name, group in figures.items()]
    return f"Silhouette IoU of categories in training and of left-out ones: {'; '.join(parts)}."


def _where(zones: Mapping[str, Any]) -> str:
    if zones["core"]["share_of_error"] is None:
        return "No error."
    parts = [
        f"{name} {100 * zone['share_of_error']:.0f} % (of the pixels {100 * zone['share_of_pixels']:.0f} %)"
        for name, zone in zones.items()
    ]
    return f"Absolute error by zone (the rim is two pixels on either side of the true outline): {', '.join(parts)}."


def _categories(categories: Mapping[str, Any]) -> str:
    ordered = sorted(categories, key=lambda name: categories[name]["silhouette_iou"]["value"] or 0.0)
    parts = [f"{name} {categories[name]['silhouette_iou']['value']:.2f}" for name in ordered]
    if len(parts) < 6:
        return f"Silhouette IoU by category: {', '.join(parts)}."
    return (
        f"Silhouette IoU by category: worst {', '.join(parts[:3])}; best {', '.join(parts[-3:])}. With few objects "
        "(three of each in the test set) the intervals tend to be too narrow."
    )


def _surface(correlations: Mapping[str, Any]) -> str:
    parts = [f"{name} {format_interval(figure)}" for name, figure in correlations.items()]
    return f"SI 6 reports the smallest errors on large or smooth metrics. Rank correlations here: {'; '.join(parts)}."
