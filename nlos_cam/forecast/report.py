"""Report of a forecast: words, tables and maps over the object box."""

from collections.abc import Sequence
from pathlib import Path

from nlos_cam.files import atomic_file
from nlos_cam.forecast.advice import Change
from nlos_cam.forecast.curve import SCATTER_IOU, network_iou
from nlos_cam.forecast.expectation import Expectation, Forecast
from nlos_cam.forecast.lidar_view import LidarView
from nlos_cam.report import Bullets, Document, Picture, Section, Table, figure_of, png

USEFUL_SHARE = 0.2
"""Share of a guess's error, 1 less its linear IoU, from which on a bench that takes it away shows
shapes. A difference would depend on the object: the guess at a round one is good already."""
USEFUL_CHANGE_IOU = 0.05
"""Gain of a change below which the order of two rigs is weaker than the forecasts' scatter."""
MOSTLY_HIDDEN = 0.5
"""Share of hidden objects from which on a bench is said to hide most."""
CAVEATS = (
    "Networks gain less from averaged frames than the linear estimate does: on the home rig nothing.",
    (
        "The linear estimate holds the winner of each cell and the edges of shadows; it knows the true"
        " shape that it is linear about. Its depth error is a lower bound: networks err four to six"
        " times as much."
    ),
    "The paper's radiometry is brighter than any measured third bounce; the Lambertian one dimmer.",
)
"""Where a forecast misleads."""


COLUMNS = (
    "IoU 1: of the silhouette, to expect of a network trained for the rig, from one frame; IoU 100:"
    " from a hundred, averaged. For one frame: numbers of the outline and of the depth that the maps"
    " determine, depth error of the linear estimate in mm, cells won by the object."
)
"""Meaning of the columns of the table."""


VIEW_CAPTION = (
    "One frame of the simulated camera, as 64 x 80 map cells. Below, what differs from the bench with"
    " nothing hidden, in standard deviations of the noise: red is farther or brighter."
)


def words_of(found: Forecast, subject: str = "") -> list[str]:
    """Return the forecast in sentences, the verdict first."""
    best = found.at()
    alone = _alone(found, subject)
    # Printed IoUs are all of networks, by the curve; only the verdict compares linear ones.
    guess = f"{network_iou(found.guess_iou):.2f}"
    if found.sees_nothing:
        of_it = f" of {alone}" if alone else ""
        return [
            f"This bench sees nothing{of_it}: no cell's strongest echo comes from the object.",
            f"Expected silhouette IoU {guess}, which is a guess.",
        ]
    lines = [
        (
            f"This bench {_verdict(found, alone)}: expected silhouette IoU"
            f" {found.expected_iou:.2f} (± {SCATTER_IOU:.2f}) for a network trained for it; a guess"
            f" has {guess}."
        ),
        (
            f"One frame of {alone or 'a typical matt object'} determines"
            f" {best.outline_numbers:.0f} numbers of the outline and {best.depth_numbers:.0f} of"
            f" the depth, in {best.cells:.0f} of 5120 cells; signal to noise"
            f" {best.signal_to_noise:.0f}."
        ),
        f"The echoes stand {_margin(best)} the wall's own return.",
    ]
    if found.hidden_share > 0:
        lines.insert(1, hidden_words(found.hidden_share, alone))
    if found.visible_share > 0:
        lines.append(
            f"The lidar sees {found.visible_share:.0%} of the object box directly: this forecast"
            " leaves that light out."
        )
    return lines


def _alone(found: Forecast, subject: str) -> str:
    """Return the name of the one object that was asked for; empty for typical objects."""
    return subject or ("the object" if found.objects == 1 else "")


def _verdict(found: Forecast, alone: str) -> str:
    """Return the verdict on typical objects, or on the one that is named."""
    if found.hidden_share >= MOSTLY_HIDDEN:
        return f"hides {alone or 'most objects'}"
    gain = found.at().linear_iou - found.guess_iou
    if gain >= USEFUL_SHARE * (1.0 - found.guess_iou):
        return f"shows the shape of {alone}" if alone else "shows shapes"
    return f"hardly shows more{f' of {alone}' if alone else ''} than a guess"


def hidden_words(hidden_share: float, alone: str = "") -> str:
    """Return in words what becomes of objects that change no cell, or of the one that is named."""
    if alone:
        return (
            f'Without {alone} the maps would be the same: `live` says "nothing there", whatever'
            " the weights."
        )
    return (
        f"{hidden_share:.0%} of the test objects change no cell of the maps: `live` says"
        ' "nothing there" of them, whatever the weights.'
    )


def _margin(row: Expectation) -> str:
    """Return the median margin of the echoes as a factor."""
    return f"{1 / max(1 - row.margin, 1e-9):.1f} times above"


def table_of(found: Forecast) -> Table:
    """Return a row for each material and radiometry, by frames averaged."""
    frames = sorted({row.conditions.frames for row in found.expectations})
    head = (
        "object",
        *(f"IoU {n}" for n in frames),  # short: on 80 columns nothing may be cut
        "outline",
        "depth",
        "error mm",
        "cells",
    )
    rows: list[tuple[str, ...]] = []
    for first in [row.conditions for row in found.expectations if row.conditions.frames == 1]:
        material = first.material
        radiometry = first.radiometry
        own = [found.at(n, material, radiometry) for n in frames]
        once = own[0]
        rows.append(
            (
                f"{material}, {radiometry}",
                *(f"{row.network_iou:.2f}" for row in own),
                f"{once.outline_numbers:.0f}",
                f"{once.depth_numbers:.0f}",
                f"{1e3 * once.depth_rmse_m:.1f}",
                f"{once.cells:.0f}",
            )
        )
    return Table(head, rows)


def change_words(found: Sequence[Change], count: int = 2) -> list[str]:
    """Return the best changes, and the place worth most as a second one, in words; gains below
    USEFUL_CHANGE_IOU are none.
    """
    least = f"{USEFUL_CHANGE_IOU:.2f}"
    lines = [
        f"{change.words}: IoU {change.gain_iou:+.2f}"
        for change in found[:count]
        if change.gain_iou >= USEFUL_CHANGE_IOU
    ] or [f"No change tried gains {least} or more: less is within the forecasts' scatter"]
    seconds = [
        (change.as_second_gain_iou, change.words)
        for change in found
        if change.as_second_gain_iou is not None
    ]
    if seconds:
        gain_iou, words = max(seconds)
        second = f"{words}: IoU {gain_iou:+.2f}"
        if gain_iou < USEFUL_CHANGE_IOU:
            second = f"none tried gains {least} or more"
        lines.append(f"As a second place beside this one: {second}")
    return lines


def picture_of(found: Forecast) -> bytes:
    """Return the maps over the object box as a PNG: rows outline and depth, columns by frames."""
    frames = sorted(found.outline_std)
    figure = figure_of(3.2 * len(frames), 6.2)
    axes = figure.subplots(2, len(frames), squeeze=False)
    last_m = max(image.max() for image in found.depth_std_m.values())
    for column, count in enumerate(frames):
        shown = axes[0][column].imshow(found.outline_std[count], cmap="magma", vmin=0, vmax=0.5)
        axes[0][column].set_title(f"{count} frame{'s' if count > 1 else ''}")
        deep = axes[1][column].imshow(
            1e3 * found.depth_std_m[count], cmap="magma", vmin=0, vmax=1e3 * last_m
        )
        for row in (0, 1):
            axes[row][column].set_xticks([])
            axes[row][column].set_yticks([])
        if column == len(frames) - 1:
            figure.colorbar(shown, ax=axes[0][column], label="uncertainty of the outline (1: all)")
            figure.colorbar(deep, ax=axes[1][column], label="uncertainty of the depth (mm)")
    figure.suptitle(f"Over the object box of {found.rig}: what the maps leave uncertain")
    return png(figure)


def write_report(
    found: Forecast,
    path: Path,
    advice: Sequence[Change] = (),
    subject: str = "",
    view: LidarView | None = None,
) -> None:
    """Write the forecast as a page (.html), of one object with what the lidar would show of it, or
    as its picture alone (.png).
    """
    image = picture_of(found)
    if path.suffix == ".png":
        content = image
    else:
        lines = words_of(found, subject)
        lines += [view.words()] if view else []
        parts: list[Section | Picture] = [Section("", lines)]
        if view:
            parts.append(Picture("What the lidar would show", VIEW_CAPTION, view.picture()))
        if advice:
            parts.append(Section("What to change", [Bullets("", change_words(advice))]))
        parts += [
            Picture("Uncertainty over the object box", "Black is determined.", image),
            Section("By frames, material and radiometry", [table_of(found), COLUMNS]),
            Section("Where this misleads", list(CAVEATS)),
        ]
        title = f"Forecast of {found.rig}"
        content = Document(title, f"rig {found.rig_checksum}", parts).as_html().encode()
    with atomic_file(path) as part:
        part.write_bytes(content)
