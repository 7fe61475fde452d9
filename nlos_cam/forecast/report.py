"""Report of a forecast: words, tables and maps over the object box."""

from collections.abc import Sequence
from pathlib import Path

from nlos_cam.files import atomic_file
from nlos_cam.forecast.advice import Change
from nlos_cam.forecast.curve import SCATTER_IOU
from nlos_cam.forecast.expectation import Expectation, Forecast
from nlos_cam.report import Bullets, Document, Picture, Section, Table, figure_of, png

USEFUL_GAIN = 0.1
"""IoU above a guess from which on a bench shows shapes."""
MOSTLY_HIDDEN = 0.5
"""Share of hidden objects from which on a bench is said to hide most."""
CAVEATS = (
    "Networks gain less from averaged frames than the linear estimate does: on the home rig nothing.",
    (
        "The linear estimate holds the winner of each cell and the edges of shadows; it knows the true"
        " shape that it is linear about. Its depth error is a lower bound: networks err four to five"
        " times as much."
    ),
    "The paper's radiometry is brighter than any measured third bounce; the Lambertian one dimmer.",
)
"""Where a forecast misleads."""


COLUMNS = (
    "IoU: of the silhouette, to expect of a network trained for the rig. For one frame: numbers of"
    " the outline and of the depth that the maps determine, depth error of the linear estimate,"
    " cells won by the object."
)
"""Meaning of the columns of the table."""


def words_of(found: Forecast, subject: str = "") -> list[str]:
    """Return the forecast in sentences, the verdict first."""
    best = found.at()
    if found.sees_nothing:
        return [
            "This bench sees nothing: no cell's strongest echo comes from the object.",
            f"Expected silhouette IoU {found.guess_iou:.2f}, which is a guess.",
        ]
    gain = best.linear_iou - found.guess_iou
    verdict = "shows shapes" if gain >= USEFUL_GAIN else "hardly shows more than a guess"
    if found.hidden_share >= MOSTLY_HIDDEN:
        verdict = "hides most objects"
    whose = f"of {subject}" if subject else "of a typical matt object"
    lines = [
        (
            f"This bench {verdict}: expected silhouette IoU {found.expected_iou:.2f} "
            f"(± {SCATTER_IOU:.2f}) for a network trained for it."
        ),
        (
            f"One frame {whose} determines {best.outline_numbers:.0f} numbers of the outline and"
            f" {best.depth_numbers:.0f} of the depth, in {best.cells:.0f} of 5120 cells;"
            f" signal to noise {best.signal_to_noise:.0f}."
        ),
        f"The echoes stand {_margin(best)} the wall's own return.",
    ]
    if found.hidden_share > 0 and not subject:
        lines.insert(1, hidden_words(found.hidden_share))
    if found.visible_share > 0:
        lines.append(
            f"The lidar sees {found.visible_share:.0%} of the object box directly: this forecast"
            " leaves that light out."
        )
    return lines


def hidden_words(hidden_share: float) -> str:
    """Return in words what becomes of objects that change no cell."""
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
        *(f"IoU, {n} frame{'s' if n > 1 else ''}" for n in frames),
        "outline",
        "depth",
        "error, mm",
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
    """Return the best changes, and the place worth most as a second one, in words."""
    lines = [
        f"{change.words}: IoU {change.gain_iou:+.2f}"
        for change in found[:count]
        if change.gain_iou > 0
    ] or ["No change tried would help: " + ", ".join(change.words for change in found[:count])]
    seconds = [change for change in found if change.as_second_gain_iou is not None]
    if seconds:
        best = max(seconds, key=lambda change: change.as_second_gain_iou or 0.0)
        lines.append(
            f"As a second place beside this one: {best.words}: IoU {best.as_second_gain_iou:+.2f}"
        )
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
    found: Forecast, path: Path, advice: Sequence[Change] = (), subject: str = ""
) -> None:
    """Write the forecast as a page (.html) or as its picture alone (.png)."""
    image = picture_of(found)
    if path.suffix == ".png":
        content = image
    else:
        lines = words_of(found, subject)
        parts: list[Section | Picture] = [Section("", lines)]
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
