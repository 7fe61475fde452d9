"""Judge a reconstructor on objects it never saw: figures by name, beside the trivial baselines."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from nlos_calibration.rig import ObjectBox, Rig
from nlos_models import metrics
from nlos_models.data import Half, MapSet
from nlos_models.inference import Reconstructor
from nlos_models.preprocess import channel_statistics, split_and_stack
from numpy.typing import NDArray

from nlos_cam.camera.simulated import SimulatedCamera
from nlos_cam.camera.world import World
from nlos_cam.frames import Float32, LidarMaps, maps_from_frame
from nlos_cam.objects.depth_image import image_from_depth
from nlos_cam.objects.hidden import object_depth
from nlos_cam.render.renderer import MultiBounce, render
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_file import SceneFile

RESAMPLES = 2000
SHEET_COLUMNS = 10

OnProgress = Callable[[int, int], None]


@dataclass(frozen=True)
class Interval:
    """An estimate over objects and its bootstrap 95 % interval."""

    value: float | None
    """None where no object has a value (no reconstruction shares a pixel with its truth)."""
    low: float | None
    high: float | None


def sense_test_objects(rig: Rig, box: ObjectBox, first_seed: int, count: int, on_progress: OnProgress) -> MapSet:
    """Maps and images of unseen objects, each shown to the simulated camera in turn: noise, SDK and all."""
    echoes: list[MultiBounce] = []
    truths: list[Float32 | None] = []
    for seed in range(first_seed, first_seed + count):
        _, depth_m = object_depth(seed, box)
        echoes.append(render(Scene(rig, depth_m)).multi)
        truths.append(depth_m)
        on_progress(len(echoes), count)
    maps = _look(World(SceneFile(name="test objects", rig=rig), echoes, truths), count)
    images = [image_from_depth(depth_m, box) for depth_m in truths if depth_m is not None]
    return MapSet(np.stack([m.depth_m for m in maps]), np.stack([m.intensity for m in maps]), np.stack(images))


def _look(world: World, count: int) -> list[LidarMaps]:
    """The maps of each instant of a loop; an instant that a busy machine dropped is met again in the next round."""
    maps: dict[int, LidarMaps] = {}
    with SimulatedCamera("sim:test objects", world) as camera:
        for frame in camera:
            maps.setdefault(frame.frame_number % count, maps_from_frame(frame))
            if len(maps) == count:
                break
    return [maps[number] for number in range(count)]


def reconstruct_all(reconstructor: Reconstructor, maps: MapSet) -> Float32:
    """Images (n, 64, 64), one object at a time, as live does it."""
    pairs = zip(maps.depth_m, maps.intensity, strict=True)
    return np.concatenate([reconstructor(depth[None], intensity[None]) for depth, intensity in pairs])


def judge(image: Float32, truth: Float32, mm_per_v: float) -> dict[str, Interval]:
    """Every metric of images (n, 64, 64) against the truth, with its interval."""
    values = {
        "silhouette_iou": metrics.silhouette_iou(image, truth),
        "accuracy_mean_abs": metrics.accuracy_mean_abs(image, truth),
        "accuracy_within_2_percent": metrics.accuracy_within_2_percent(image, truth),
        "foreground_rmse_mm": metrics.foreground_rmse_mm(image, truth, mm_per_v),
    }
    return {name: interval(value) for name, value in values.items()}


def interval(values: NDArray[np.float64]) -> Interval:
    """Mean over objects (n,) and its bootstrap 95 % interval; objects without a value are left out."""
    values = values[~np.isnan(values)]
    if not values.size:
        return Interval(None, None, None)
    picks = np.random.default_rng(0).integers(0, len(values), (RESAMPLES, len(values)))
    low, high = np.quantile(values[picks].mean(1), [0.025, 0.975])
    return Interval(float(values.mean()), float(low), float(high))


def baselines(maps: MapSet, training_images: Half, training: MapSet | None) -> dict[str, Float32]:
    """Images (n, 64, 64) that need no network; the nearest neighbour only where training maps are at hand."""
    shape = (len(maps.image), *training_images.shape[1:])
    mean = training_images.astype(np.float32).mean(0)
    guesses = {
        "all_background": np.zeros(shape, np.float32),
        "mean_object": np.broadcast_to(mean, shape).astype(np.float32),
    }
    if training is not None:
        guesses["nearest_neighbour"] = training.image[_nearest(maps, training)].astype(np.float32)
    return guesses


def _nearest(maps: MapSet, training: MapSet) -> NDArray[np.int64]:
    """The training sample (n,) whose normalised maps are nearest in the sense of least squares."""
    stacks = [split_and_stack(torch.from_numpy(m.depth_m), torch.from_numpy(m.intensity)) for m in (maps, training)]
    mean, spread = channel_statistics(stacks[1])
    flat = [torch.nan_to_num((s - mean[:, None, None]) / spread[:, None, None]).flatten(1) for s in stacks]
    return torch.cdist(flat[0], flat[1]).argmin(1).numpy()


def draw_sheet(path: Path, image: Float32, truth: Float32, rows: int = 3) -> None:
    """A contact sheet: truth above reconstruction, object by object."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(SHEET_COLUMNS, 2 * rows + 0.3), layout="constrained")
    axes = figure.subplots(2 * rows, SHEET_COLUMNS)
    for axis in axes.ravel():
        axis.axis("off")
    for k in range(min(rows * SHEET_COLUMNS, len(truth))):
        row, column = divmod(k, SHEET_COLUMNS)
        for offset, picture in enumerate((truth, image)):
            axis = axes[2 * row + offset, column]
            axis.imshow(picture[k], vmin=0, vmax=1, cmap="magma")
            if column == 0:
                axis.set_title(("truth", "reconstruction")[offset], fontsize=7, loc="left", pad=2)
    figure.savefig(path, dpi=100)
