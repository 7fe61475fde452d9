"""Judge reconstructions in colour (simulation only): figures by name, beside what needs no network, and a picture."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from nlos_models.colour_metrics import brightness, colour_metrics
from nlos_models.data import Half
from nlos_models.metrics import surface

from nlos_cam.evaluate import interval
from nlos_cam.frames import Float32

SIMULATION_ONLY = "simulation only: the L515's laser is infrared (860 nm)"
ROWS = ("truth", "reconstruction", "difference")


def judge_colour(image: Float32, truth: Float32) -> dict[str, dict[str, float | None]]:
    """Every metric of colour images (n, 3, 64, 64) against the truth, as {value, low, high}."""
    return {name: asdict(interval(values)) for name, values in colour_metrics(image, truth).items()}


def colour_guesses(image: Float32, training: Half | Float32) -> dict[str, Float32]:
    """Images (n, 3, 64, 64) to beat: nothing, the mean training object, and our silhouettes in the mean colour."""
    training = training.astype(np.float32)
    seen, shown = surface(brightness(training)), surface(brightness(image))
    colour = np.where(seen[:, None], training, 0.0).sum((0, 2, 3)) / max(int(seen.sum()), 1)
    return {
        "all_background": np.zeros_like(image),
        "mean_object": np.broadcast_to(training.mean(0), image.shape).astype(np.float32),
        "mean_colour": np.where(shown[:, None], colour[:, None, None], 0.0).astype(np.float32),
    }


def draw_colour_sheet(path: Path, image: Float32, truth: Float32, columns: int = 10) -> None:
    """Truth, reconstruction and the size of their difference in each channel, object by object, in colour."""
    from matplotlib.figure import Figure

    count = min(columns, len(truth))
    figure = Figure(figsize=(count + 0.3, len(ROWS) + 0.6), layout="constrained")
    axes: Any = figure.subplots(len(ROWS), count, squeeze=False)
    looks = truth[:count], image[:count], np.abs(image[:count] - truth[:count])
    for row, (title, pictures) in enumerate(zip(ROWS, looks, strict=True)):
        for axis, picture in zip(axes[row], pictures, strict=True):
            axis.imshow(np.clip(np.moveaxis(picture, 0, -1), 0, 1))
            axis.axis("off")
        axes[row, 0].set_title(title, fontsize=7, loc="left", pad=2)
    figure.suptitle(SIMULATION_ONLY, fontsize=8)
    figure.savefig(path, dpi=100)
