"""Evaluation of weights on held-out objects, and its report: report.html, pictures, figures.json,
objects.csv.
"""

import csv
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from nlos_calibration import ObjectBox, Rig
from nlos_calibration.arrays import Float32, Float64
from nlos_models import (
    ANY,
    GOOD_IOU,
    RIG_WEIGHTS,
    load_reconstructor,
    load_uncertainty_model,
    shipped_folder,
    silhouette_iou,
)
from numpy.typing import NDArray

from nlos_cam.evaluate import figures as pictures
from nlos_cam.evaluate import metrics, subjects
from nlos_cam.evaluate.figures import LABELS
from nlos_cam.evaluate.recognition import PER_KIND, recognised
from nlos_cam.files import atomic_directory, cache_folder, program_name
from nlos_cam.objects import CATEGORIES
from nlos_cam.reconstruct import weights_for
from nlos_cam.report import (
    Banner,
    Bullets,
    Commands,
    Document,
    Picture,
    Section,
    Table,
    estimate_in_words,
    saved_picture,
    write_document,
)

REPORT = "report.html"
DEFAULT = RIG_WEIGHTS[0]
UNSEEN_SHEET = "sheet-unseen.png"
QUALITY = "quality.png"
QUALITY_COLUMNS = {
    "correlation": "correlation with the true IoU",
    "mean_error": "mean error",
    "bias": "predicted less true",
    "within_80_percent_interval": "within the 80 % interval",
    "good": f"share with IoU of {GOOD_IOU:g}",
    "trusted": "shown in green",
    "trusted_good": "of these with that IoU",
}
"""Titles of a quality's figures by name."""
QUALITY_TARGETS_TEXT = (
    "Wanted: a correlation of 0.7, and 0.9 of the frames shown in green with that IoU."
)
SIZE = "surface, cm²"
DETAIL = "edges per surface, cm / cm²"
SILHOUETTE_ERROR = "1 - silhouette IoU"
DEPTH_ERROR = "foreground RMSE, mm"

SHEET_CAPTION = "Bright is near the wall. In the difference, red is too near and blue too far."
READ_WITH_CARE = (
    "Means over objects; intervals by bootstrap over objects. Foreground RMSE is over pixels that"
    " are surface in both, so it ignores missed parts: read it together with the silhouette IoU."
)


class Unseen(NamedTuple):
    """Images of objects of kinds that training never sees."""

    names: Sequence[str]
    truth: Float32
    """(n, 64, 64)."""
    image: Float32
    predicted: metrics.Predictions | None = None


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
    unseen: Unseen | None = None
    """The second set of test objects; None beside other objects than the first."""
    predicted: metrics.Predictions | None = None
    """None without a quality model, or for weights of difference maps."""

    @cached_property
    def of_object(self) -> NDArray[np.int64]:
        """Return the number of each frame's object (n,): those of one kind and one truth are frames
        of one recorded object.
        """
        numbers: dict[tuple[str, bytes], int] = {}
        keys = zip(self.categories, map(np.ndarray.tobytes, self.truth), strict=True)
        return np.array([numbers.setdefault(key, len(numbers)) for key in keys], np.int64)

    @cached_property
    def objects(self) -> NDArray[np.int64]:
        """Return the number of each object's first frame."""
        return np.unique(self.of_object, return_index=True)[1]

    @cached_property
    def object_categories(self) -> list[str]:
        """Return the category of each object."""
        return [self.categories[int(first)] for first in self.objects]

    @cached_property
    def ours(self) -> metrics.PerObject:
        """Return every metric of every frame."""
        return metrics.per_object(self.image, self.truth, self.box)

    def by_object(self, values: Mapping[str, Float64]) -> metrics.PerObject:
        """Return values of every frame for every object, over its frames."""
        return metrics.by_object(values, self.of_object)

    @cached_property
    def surfaces(self) -> dict[str, Float64]:
        """Return size and detail of the true surfaces, (n,) each."""
        return {
            SIZE: metrics.surface_cm2(self.truth, self.box),
            DETAIL: metrics.detail_per_cm(self.truth, self.box),
        }

    @cached_property
    def errors(self) -> dict[str, Float64]:
        """Return the two errors that are correlated with size and detail, (n,) each."""
        ours = self.ours
        return {
            SILHOUETTE_ERROR: 1 - ours["silhouette_iou"],
            DEPTH_ERROR: ours["foreground_rmse_mm"],
        }


def evaluate(
    weights: Path | None,
    objects: subjects.HeldOutObjects | Path | None = None,
    *,
    rig: Rig | None = None,
    count: int | None = None,
    wall: Path | None = None,
    training: Path | None = None,
    nearest: bool = True,
    tracked: subjects.Tracked = subjects.untracked,
) -> Evaluation:
    """Reconstruct held-out objects with weights (by default the shipped ones that serve the rig
    best) and with the baselines.

    The objects are those given, those of a dataset (a path), or rendered: the 54 test objects, or
    `count` random ones, on `rig` (the weights' own if None). `wall` is the bare wall of difference
    maps. `training` names the maps searched for the nearest neighbour, unless it is left out.
    `tracked` opens progress bars. Raises SceneError,
    RecordingError.
    """
    if isinstance(objects, Path):
        objects = subjects.dataset_objects(objects)
    its_rig = objects.plan.rig if objects else rig
    if objects and objects.plan.rigs:
        folder = weights or shipped_folder(ANY)
    else:
        folder = weights or (weights_for(its_rig) if its_rig else shipped_folder())
    reconstructor = load_reconstructor(folder, cache_folder() / "onnx")
    record = reconstructor.record
    second: subjects.HeldOutObjects | None = None
    if objects is None:
        rig = rig or subjects.rig_of(record)
        render = partial(subjects.rendered_objects, rig, sensor=subjects.sensor_of(record, rig))
        second = None if count else render(tracked=tracked, test="unseen")
        objects = render(count, tracked)
    bare = subjects.bare_wall_for(record, objects.plan, wall)
    guesses, searched = subjects.baseline_answers(
        objects, training, nearest=nearest, tracked=tracked
    )
    uncertainty_model = (
        load_uncertainty_model(folder, cache_folder() / "onnx")
        if record.input == "raw maps"
        else None
    )
    maps = objects.input_of(record, bare)
    answers = subjects.answer_all(reconstructor, maps)
    predicted = subjects.predict_quality(answers, maps, uncertainty_model, objects.plan.rig)
    unseen = None
    if second:
        maps = second.input_of(record, bare)
        others = subjects.answer_all(reconstructor, maps)
        sure = subjects.predict_quality(others, maps, uncertainty_model, second.plan.rig)
        unseen = Unseen(second.names, second.maps.image.astype(np.float32), others.image, sure)
    facts = {
        "what": objects.description,
        "program": program_name(),
        "weights": str(weights or folder.name),
        "rig": objects.plan.rig.name,
        "runtime": reconstructor.runtime,
        "input": record.input,
        "training_objects": len(searched) if searched else None,
        "notes": subjects.notes_about(record, objects, searched),
    }
    truth = objects.maps.image.astype(np.float32)
    left_out = subjects.left_out_categories(record)
    box = objects.plan.box
    return Evaluation(
        objects.names,
        objects.categories,
        truth,
        answers.image,
        guesses,
        box,
        facts,
        left_out,
        unseen,
        predicted,
    )


def as_figures(evaluation: Evaluation) -> dict[str, Any]:
    """Return all figures, ready for JSON."""
    ours = evaluation.by_object(evaluation.ours)
    theirs = {
        name: evaluation.by_object(metrics.per_object(guess, evaluation.truth, evaluation.box))
        for name, guess in evaluation.guesses.items()
    }
    categories = evaluation.object_categories
    errors = evaluation.by_object(evaluation.errors)
    overall = metrics.over_objects(ours)
    nearest = theirs.get("nearest_neighbour")
    return {
        **metrics.plain(overall),
        "baselines": {
            name: metrics.plain(metrics.over_objects(values)) for name, values in theirs.items()
        },
        "advantage_over_nearest_neighbour": (
            metrics.plain(metrics.advantage(ours, nearest)) if nearest else None
        ),
        "bars": metrics.targets_met(overall),
        "per_category": {
            name: metrics.plain(figures)
            for name, figures in metrics.per_category(ours, categories).items()
        },
        "shown_and_left_out": _by_shown(ours, categories, evaluation.left_out),
        "rank_correlation": {
            f"{error_name} with {measure_name}": asdict(
                metrics.rank_correlation(measure[evaluation.objects], error)
            )
            for error_name, error in errors.items()
            for measure_name, measure in evaluation.surfaces.items()
        },
        "where_the_error_is": {
            name: asdict(zone)
            for name, zone in metrics.error_by_zone(evaluation.image, evaluation.truth).items()
        },
        "unseen": _unseen_figures(evaluation),
        "quality": (
            {
                name: metrics.quality_figures(each)
                for name, each in _predicted_sets(evaluation).items()
            }
            or None
        ),
        "recognised": _recognised(evaluation),
        "objects": len(evaluation.objects),
        "frames": len(evaluation.truth),
        **evaluation.facts,
    }


def _unseen_figures(evaluation: Evaluation) -> dict[str, Any] | None:
    if not (second := evaluation.unseen):
        return None
    return metrics.plain(metrics.judge(second.image, second.truth, evaluation.box)) | {
        "objects": len(second.truth)
    }


def _predicted_sets(evaluation: Evaluation) -> dict[str, metrics.PredictedFrames]:
    """Return predicted and true quality of each set of objects, by its name; mixed objects also by
    share.
    """
    sets = dict[str, metrics.PredictedFrames]()
    second = evaluation.unseen
    if evaluation.predicted:
        iou = evaluation.ours["silhouette_iou"]
        whole = metrics.PredictedFrames(evaluation.predicted, iou, evaluation.of_object)
        kinds = np.isin(evaluation.categories, tuple(CATEGORIES))
        sets["objects"] = whole
        if kinds.any() and not kinds.all():
            sets["the 18 kinds"] = whole.where(kinds)
            sets["generic shapes"] = whole.where(~kinds)
    if second and second.predicted:
        iou = silhouette_iou(second.image, second.truth)
        sets["kinds never seen"] = metrics.PredictedFrames(
            second.predicted, iou, np.arange(len(iou))
        )
    return sets


def _recognised(evaluation: Evaluation) -> dict[str, Any] | None:
    """Return the shares of reconstructions, and of true images, recognised as their kind; None for
    other kinds.
    """
    if not set(evaluation.categories) <= CATEGORIES.keys():
        return None
    each = {"reconstructions": evaluation.image, "truth": evaluation.truth}
    shares = {
        name: recognised(images, evaluation.categories, evaluation.box)
        for name, images in each.items()
    }
    return metrics.plain(metrics.over_objects(evaluation.by_object(shares)))


def _by_shown(
    ours: metrics.PerObject, categories: Sequence[str], left_out: Sequence[str]
) -> dict[str, Any] | None:
    """Return the figures of left-out and of trained categories; None if none of these was left
    out.
    """
    if not set(left_out) & set(categories):
        return None
    shown = ["left out" if category in left_out else "shown" for category in categories]
    return {
        name: metrics.plain(figures) for name, figures in metrics.per_category(ours, shown).items()
    }


def write_report(folder: Path, evaluation: Evaluation, figures: Mapping[str, Any]) -> None:
    """Write the report's folder; an earlier one is replaced once all files are written, with its
    pictures that this one lacks.
    """
    with atomic_directory(folder, drop=[UNSEEN_SHEET, QUALITY]) as part:
        (part / "figures.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
        _write_objects(part / "objects.csv", evaluation)
        _draw(part, evaluation)
        write_document(document(figures, part), part / REPORT)


def _write_objects(path: Path, evaluation: Evaluation) -> None:
    """Write one row per frame, of which an object that was rendered has one; a field without a
    value is empty.
    """
    columns = {
        **evaluation.ours,
        "surface_cm2": evaluation.surfaces[SIZE],
        "detail_per_cm": evaluation.surfaces[DETAIL],
    }
    with path.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["name", "category", *columns])
        for k, (name, category) in enumerate(
            zip(evaluation.names, evaluation.categories, strict=True)
        ):
            values = [float(column[k]) for column in columns.values()]
            rows.writerow(
                [name, category, *("" if np.isnan(value) else f"{value:.6g}" for value in values)]
            )


def _draw(folder: Path, evaluation: Evaluation) -> None:
    image = evaluation.image
    truth = evaluation.truth
    names = evaluation.names
    ours = evaluation.by_object(evaluation.ours)
    categories = evaluation.object_categories
    pictures.draw_sheet(folder / "sheet.png", image, truth, names)
    if second := evaluation.unseen:
        pictures.draw_sheet(folder / UNSEEN_SHEET, second.image, second.truth, second.names)
    pictures.draw_gallery(
        folder / "gallery.png", image, truth, names, evaluation.ours["silhouette_iou"]
    )
    pictures.draw_categories(
        folder / "categories.png",
        metrics.per_category(ours, categories),
        metrics.over_objects(ours),
    )
    if sets := _predicted_sets(evaluation):
        pictures.draw_quality(folder / QUALITY, sets)
    errors = evaluation.by_object(evaluation.errors)
    surfaces = {name: each[evaluation.objects] for name, each in evaluation.surfaces.items()}
    curves = {
        measure_name: {
            error_name: metrics.curve(measure, error) for error_name, error in errors.items()
        }
        for measure_name, measure in surfaces.items()
    }
    pictures.draw_against_surface(folder / "surface.png", surfaces, errors, curves)


def document(figures: Mapping[str, Any], folder: Path) -> Document:
    """Return the report from the figures, with the pictures that are in `folder`."""
    baselines = list(figures["baselines"])
    met = sum(bar["met"] for bar in figures["bars"].values())
    count = len(figures["bars"])
    headline = f"Silhouette IoU {format_interval(figures['silhouette_iou'])}"
    several = figures["frames"] > figures["objects"]
    frames = f" ({figures['frames']} frames)" if several else ""
    advice = (
        f"{met} of {count} targets met, on {figures['objects']} objects{frames}. In brackets: 95 %"
        " interval over objects."
    )
    head = (
        "metric",
        "these weights (95 % interval)",
        "target",
        "met",
        *(name.replace("_", " ") for name in baselines),
    )
    details = [
        _against_nearest(figures["advantage_over_nearest_neighbour"], figures["training_objects"]),
        _shown(figures["shown_and_left_out"]),
        _where(figures["where_the_error_is"]),
        _categories(figures["per_category"]),
        _kinds(figures["recognised"]),
    ]
    return Document(
        f"Reconstruction of {figures['objects']} hidden objects",
        f"{figures['what']}. Weights: {figures['weights']} ({figures['input']}); rig:"
        f" {figures['rig']}; {figures['runtime']}.",
        [
            Section("", [Banner("good" if met == count else "doubtful", headline, advice)]),
            Section("", [Bullets("Note", figures["notes"])]),
            Section(
                "Metrics",
                [
                    Table(head, [_row(figures, metric, baselines) for metric in metrics.TARGETS]),
                    READ_WITH_CARE,
                ],
            ),
            saved_picture(
                "Truth, reconstruction and difference", SHEET_CAPTION, folder / "sheet.png"
            ),
            *_unseen(figures["unseen"], folder),
            *_quality_section(figures["quality"], folder),
            Section("Where the error is", [text for text in details if text]),
            saved_picture(
                "Metrics by category",
                "Mean of each category with its interval.",
                folder / "categories.png",
            ),
            saved_picture(
                "Error against size and detail",
                _surface(figures["rank_correlation"]),
                folder / "surface.png",
            ),
            saved_picture("Worst and best silhouettes", SHEET_CAPTION, folder / "gallery.png"),
            Section("Next commands", [Commands(_next_commands(figures))]),
        ],
    )


def _unseen(figures: Mapping[str, Any] | None, folder: Path) -> list[Section | Picture]:
    if not figures:
        return []
    rows = [(LABELS[metric], format_interval(figures[metric])) for metric in metrics.TARGETS]
    title = f"{figures['objects']} objects of kinds that training never sees"
    table = Section(title, [Table(("metric", "these weights (95 % interval)"), rows)])
    return [table, saved_picture("Kinds never seen", SHEET_CAPTION, folder / UNSEEN_SHEET)]


def _quality_section(figures: Mapping[str, Any] | None, folder: Path) -> list[Section | Picture]:
    if not figures:
        return []
    rows: list[tuple[str, ...]] = []
    for name, each in figures.items():
        values = ("none" if each[key] is None else f"{each[key]:.2f}" for key in QUALITY_COLUMNS)
        rows.append((name, *values))
    head = ("set", *(title for title in QUALITY_COLUMNS.values()))
    return [
        Section("Predicted quality", [Table(head, rows), QUALITY_TARGETS_TEXT]),
        saved_picture("Predicted and true overlap", "Bars: 80 % intervals.", folder / QUALITY),
    ]


def _kinds(figures: Mapping[str, Any] | None) -> str:
    if not figures:
        return ""
    ours, truth = (format_interval(figures[name]) for name in ("reconstructions", "truth"))
    return (
        f"Share recognised as their kind, by the nearest of {PER_KIND} silhouettes of each of the"
        f" 18 kinds: {ours} of the reconstructions, {truth} of the true silhouettes."
    )


def _next_commands(figures: Mapping[str, Any]) -> list[str]:
    named = figures["weights"]
    chosen = "" if named == DEFAULT else f" --weights {shlex.quote(named)}"
    lines = [f"nlos-cam live --camera sim{chosen}", f"nlos-cam tradeoff reconstruct{chosen}"]
    return lines if figures["training_objects"] else [*lines, f"nlos-cam evaluate{chosen}"]


def format_interval(
    figure: Mapping[str, float | None] | metrics.Interval, digits: int | None = None
) -> str:
    """Format an estimate and its interval as `estimate_in_words` does."""
    parts = asdict(figure) if isinstance(figure, metrics.Interval) else figure
    return estimate_in_words(parts["value"], parts["low"], parts["high"], digits)


def _row(figures: Mapping[str, Any], metric: str, baselines: Sequence[str]) -> tuple[str, ...]:
    bar = figures["bars"][metric]
    target = f"{'at most' if metric in metrics.SMALLER_IS_BETTER else 'at least'} {bar['bar']:g}"
    ours = format_interval(figures[metric])
    digits = len(ours.split(" ")[0].partition(".")[2])
    others = [
        format_interval(figures["baselines"][name][metric], digits).split(" ")[0]
        for name in baselines
    ]
    return LABELS[metric], ours, target, "yes" if bar["met"] else "no", *others


def _against_nearest(figures: Mapping[str, Any] | None, among: int | None) -> str:
    if not figures:
        return ""
    parts = [f"{LABELS[metric]} {format_interval(figure)}" for metric, figure in figures.items()]
    return (
        f"The nearest neighbour is the one of {among} training objects with the nearest maps (sum"
        " of squares over all cells, each channel in units of its spread); the mean object is"
        " their mean. Advantage over the nearest neighbour per object, positive is better:"
        f" {'; '.join(parts)}."
    )


def _shown(figures: Mapping[str, Any] | None) -> str:
    if not figures:
        return ""
    parts = [
        f"{name} {format_interval(group['silhouette_iou'])}" for name, group in figures.items()
    ]
    return f"Silhouette IoU of categories in training and of left-out ones: {'; '.join(parts)}."


def _where(zones: Mapping[str, Any]) -> Table | str:
    if zones["core"]["share_of_error"] is None:
        return "No error."
    rows = [
        (name, *(f"{100 * zone[share]:.0f} %" for share in ("share_of_error", "share_of_pixels")))
        for name, zone in zones.items()
    ]
    return Table(
        ("zone (the rim: 2 pixels either side of the true outline)", "absolute error", "pixels"),
        rows,
    )


def _categories(categories: Mapping[str, Any]) -> str:
    ordered = sorted(
        categories, key=lambda name: categories[name]["silhouette_iou"]["value"] or 0.0
    )
    parts = [f"{name} {categories[name]['silhouette_iou']['value']:.2f}" for name in ordered]
    if len(parts) < 6:
        return f"Silhouette IoU by category: {', '.join(parts)}."
    return (
        f"Silhouette IoU by category: worst {', '.join(parts[:3])}; best {', '.join(parts[-3:])}."
        " With few objects (three of each in the test set) the intervals tend to be too narrow."
    )


def _surface(correlations: Mapping[str, Any]) -> str:
    parts = [f"{name} {format_interval(figure)}" for name, figure in correlations.items()]
    return (
        "SI 6 reports the smallest errors on large or smooth objects. Rank correlations here:"
        f" {'; '.join(parts)}."
    )
