"""A picture of some frames of a run side by side: what the lidar saw, and what came of it."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nlos_cam.processing import Step
from nlos_cam.view.pictures import MOST_UNCERTAIN_M

USUAL_PERCENT = 95
Images = list[NDArray[np.float32]]


def draw_sheet(path: Path, chosen: list[Step]) -> None:
    """A picture of some frames, one column each with its verdict: lidar depth, infrared, difference, hidden depth.

    And its uncertainty; what there is none of is left out.
    """
    from matplotlib.figure import Figure

    looks = _looks(chosen)
    figure = Figure(figsize=(2.2 * len(chosen) + 1, 6.5 * len(looks) / 3), layout="constrained")
    rows = figure.subplots(len(looks), len(chosen), squeeze=False)
    for axes, (title, (colours, (low, high), images)) in zip(rows, looks.items(), strict=True):
        drawn = [axis.imshow(image, colours, vmin=low, vmax=high) for axis, image in zip(axes, images, strict=True)]
        figure.colorbar(drawn[0], ax=list(axes), label=title)
        for axis in axes:
            axis.set_axis_off()
    for axis, step in zip(rows[0], chosen, strict=True):
        axis.set_title("\n".join([f"frame {step.frame.frame_number}", *([step.verdict] if step.verdict else [])]))
    figure.savefig(path, dpi=80)


def _looks(chosen: list[Step]) -> dict[str, tuple[str, tuple[float, float], Images]]:
    """The rows of the sheet: by title, their colours, limits and images."""
    depths_m, intensities = [step.maps.depth_m for step in chosen], [step.maps.intensity for step in chosen]
    differences_mm = [1e3 * step.difference.depth_m for step in chosen if step.difference]
    hidden_m = [step.reconstruction.depth_m for step in chosen]
    uncertainties_mm = [
        np.where(np.isnan(made.depth_m), np.float32(np.nan), 1e3 * made.uncertainty_m)
        for made in (step.reconstruction for step in chosen)
        if made.uncertainty_m is not None
    ]
    looks = {
        "lidar depth (m)": ("turbo_r", _limits(depths_m), depths_m),
        "infrared (counts)": ("gray", _limits(intensities), intensities),
        "difference (mm)": ("coolwarm", _even_limits(differences_mm), differences_mm),
        "hidden depth (m)": ("inferno_r", _limits(hidden_m), hidden_m),
        "uncertainty (mm)": ("viridis", (0.0, 1e3 * MOST_UNCERTAIN_M), uncertainties_mm),
    }
    return {title: look for title, look in looks.items() if look[2]}


def _limits(images: Images) -> tuple[float, float]:
    values = _finite(images)
    return (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)


def _even_limits(images: Images) -> tuple[float, float]:
    """About zero, and wide enough for most: an occluder is far from the bare wall."""
    values = _finite(images)
    most = float(np.percentile(np.abs(values), USUAL_PERCENT)) if values.size else 1.0
    return -most, most


def _finite(images: Images) -> NDArray[np.float32]:
    return np.concatenate([np.empty(0, np.float32), *(image[np.isfinite(image)] for image in images)])
