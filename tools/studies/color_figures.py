"""Judge reconstructions in colour (simulation only): figures by name, beside what needs no network,
and a picture.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Float16, Float32
from nlos_models import SIMULATION_ONLY, SMALLER_IS_BETTER, brightness, color_metrics, surface
from nlos_models.training import MapSet

from nlos_cam.dataset import sense_color
from nlos_cam.evaluate import advantage, over_objects, plain
from nlos_cam.objects import TEXTURES, image_from_albedo, paint
from nlos_cam.render import Scene, Sensor, SensorModel, Surface
from nlos_cam.report import figure_of

ROWS = "truth", "reconstruction", "difference"


def painted_maps(
    depths_m: Sequence[Float32],
    rig: Rig,
    first_seed: int,
    accuracy: str,
    on_progress: Callable[[int, int], None],
) -> MapSet:
    """Return noisy maps and true images of objects (64, 64), each painted from its own seed."""
    sensor = Sensor(rig, SensorModel())
    maps = list[tuple[Float32, Float32]]()
    images = list[Float32]()
    for seed, depth_m in enumerate(depths_m, first_seed):
        albedo = paint(seed, depth_m, [*TEXTURES]).albedo
        seen = sense_color(Scene(rig, depth_m, Surface(albedo)), sensor, seed, accuracy)
        maps.append((seen.depth_m, seen.intensity))
        images.append(image_from_albedo(albedo, depth_m))
        on_progress(len(images), len(depths_m))
    depth, intensity = (np.stack(one) for one in zip(*maps, strict=True))
    return MapSet(depth, intensity, np.stack(images))


def color_baselines(image: Float32, training: Float16 | Float32) -> dict[str, Float32]:
    """Return baselines (n, 3, 64, 64): background, mean training object, our silhouettes in the
    mean color.
    """
    training = training.astype(np.float32)
    trained = surface(brightness(training))
    ours = surface(brightness(image))
    mean_color = np.where(trained[:, None], training, 0.0).sum((0, 2, 3)) / max(
        int(trained.sum()), 1
    )
    return {
        "all_background": np.zeros_like(image),
        "mean_object": np.broadcast_to(training.mean(0), image.shape).astype(np.float32),
        "mean_colour": np.where(ours[:, None], mean_color[:, None, None], 0.0).astype(np.float32),
    }


def figures_of_color(
    image: Float32, truth: Float32, others: Mapping[str, Float32], training: Float16 | Float32
) -> dict[str, Any]:
    """Return all figures of images (n, 3, 64, 64) with those of other answers and of the baselines,
    ready for JSON.
    """
    guesses = {**others, **color_baselines(image, training)}
    ours = color_metrics(image, truth)
    theirs = {name: color_metrics(guess, truth) for name, guess in guesses.items()}
    compared = ("mean_object", "mean_colour")
    return {
        "note": SIMULATION_ONLY,
        "objects": len(truth),
        **plain(over_objects(ours)),
        "baselines": {name: plain(over_objects(values)) for name, values in theirs.items()},
        "better_than": {
            name: plain(advantage(ours, theirs[name], SMALLER_IS_BETTER)) for name in compared
        },
    }


def draw_color_sheet(path: Path, image: Float32, truth: Float32) -> None:
    """Draw truth, reconstruction and absolute difference per channel, in color."""
    count = len(truth)
    canvas = figure_of(count + 0.3, len(ROWS) + 0.6)
    axes: Any = canvas.subplots(len(ROWS), count, squeeze=False)
    for row, (title, pictures) in enumerate(
        zip(ROWS, (truth, image, np.abs(image - truth)), strict=True)
    ):
        for axis, picture in zip(axes[row], pictures, strict=True):
            axis.imshow(np.clip(np.moveaxis(picture, 0, -1), 0, 1))
            axis.axis("off")
        axes[row, 0].set_title(title, fontsize=7, loc="left", pad=2)
    canvas.suptitle(SIMULATION_ONLY, fontsize=8)
    canvas.savefig(path, dpi=100)
