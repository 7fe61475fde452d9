"""Reconstruction of hidden depth and its uncertainty from lidar maps by networks; pure."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from nlos_calibration import ObjectBox, Rig
from nlos_calibration.arrays import Float32
from nlos_models import MIN_V, Answer, UncertaintyModel, ask

from nlos_cam.frames import OBJECT_PIXELS, LidarMaps
from nlos_cam.objects import (
    SurfaceMesh,
    cell_centers_m,
    depth_from_image,
    mesh_from_depth,
    object_box,
)

Clock = Callable[[], float]
Network = Callable[[Float32, Float32], Float32]
"""depth_m (n, 64, 80) with NaN and intensity (n, 64, 80) to images v (n, 64, 64) in [0, 1]."""


@dataclass(frozen=True)
class Quality:
    """Quality of a reconstruction, predicted by a model that was fitted to known objects."""

    iou: tuple[float, float, float]
    """10 %, 50 % and 90 % quantile of the silhouette IoU with the truth."""
    good: float
    """Probability that the IoU is at least 0.75."""
    error_m: float
    """Expected mean absolute error of the depth."""
    trusted: bool
    """At least 90 % of like frames have an IoU of at least 0.75."""

    def of_incomplete_maps(self, kept_share: float, *, trusted: bool) -> "Quality":
        """Return the quality for maps of which a share is kept: it never rises as data vanish.

        The model was fitted to complete maps, and reads a smaller image as a better one.
        """
        low, middle, high = (kept_share * iou for iou in self.iou)
        return replace(
            self,
            iou=(low, middle, high),
            good=kept_share * self.good,
            trusted=self.trusted and trusted,
        )


@dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of a reconstruction, estimated by the uncertainty model ("doubt network")."""

    p_empty: float
    """Probability that nothing is hidden."""
    p_out_of_distribution: float
    """Probability that the hidden object is unlike the training set."""
    error_m: Float32
    """(64, 64): expected absolute error of the hidden depth if there is a surface; finite
    everywhere.
    """
    p_surface: Float32
    """(64, 64): probability that there is a surface."""
    quality: Quality | None = None
    """None without a surface or a quality model."""


@dataclass(frozen=True)
class Reconstruction:
    """Hidden surface as the networks reconstruct it."""

    depth_m: Float32
    """(64, 64) over the object box: distance from the wall, NaN where there is no surface."""
    box: ObjectBox
    """Box in which objects are reconstructed, in the wall frame."""
    uncertainty_m: Float32 | None
    """(64, 64), finite everywhere: expected absolute error of `depth_m` if there is a surface; None
    without an uncertainty model."""
    timings_s: Mapping[str, float]
    """Seconds by stage."""
    uncertainty: Uncertainty | None = None
    """None without an uncertainty model."""

    @property
    def points_m(self) -> Float32:
        """(n, 3): points of the surface in the wall frame."""
        x_m, y_m = np.meshgrid(*cell_centers_m(self.box))
        points_m = np.stack([x_m, y_m, self.depth_m], -1).astype(np.float32)
        return points_m[np.isfinite(self.depth_m)]

    def to_mesh(self) -> SurfaceMesh:
        """Return the surface as a mesh in the wall frame."""
        return mesh_from_depth(self.depth_m, self.box, self.uncertainty_m)

    def with_quality(self, quality: Quality) -> "Reconstruction":
        """Return the same with another predicted quality; unchanged without an uncertainty."""
        if self.uncertainty is None:
            return self
        return replace(self, uncertainty=replace(self.uncertainty, quality=quality))

    @property
    def quality(self) -> Quality | None:
        """Predicted quality; None without a surface or a quality model."""
        return self.uncertainty.quality if self.uncertainty else None

    @property
    def has_surface(self) -> bool:
        """True if any pixel shows a surface."""
        return bool(np.isfinite(self.depth_m).any())

    @property
    def without_surface(self) -> "Reconstruction":
        """The same with NaN as depth everywhere, and no quality."""
        uncertainty = replace(self.uncertainty, quality=None) if self.uncertainty else None
        nothing_m = np.full_like(self.depth_m, np.nan)
        return replace(self, depth_m=nothing_m, uncertainty=uncertainty)


def reconstruct(
    maps: LidarMaps,
    rig: Rig,
    network: Network,
    clock: Clock = time.perf_counter,
    uncertainty_model: UncertaintyModel | None = None,
) -> Reconstruction:
    """Return the hidden depth behind one frame's maps. Raises SceneError for a rig without an
    object box.
    """
    return reconstruct_all([maps], rig, network, clock, uncertainty_model)[0]


def reconstruct_all(
    batch: Sequence[LidarMaps],
    rig: Rig,
    network: Network,
    clock: Clock = time.perf_counter,
    uncertainty_model: UncertaintyModel | None = None,
) -> list[Reconstruction]:
    """Return the hidden depth behind each of several frames' maps, with an equal share of the
    networks' time each.

    Raises SceneError for a rig without an object box.
    """
    box = object_box(rig)
    start_s = clock()
    images, surfaces = _run_network(batch, network)
    timings_s = {"network": (clock() - start_s) / len(batch)}

    results: list[Reconstruction] = []
    for number, (maps, image) in enumerate(zip(batch, images, strict=True)):
        result = Reconstruction(depth_from_image(image, box), box, None, timings_s)
        if uncertainty_model is not None:
            start_s = clock()
            surface = None if surfaces is None else surfaces[number]
            uncertainty = estimate_uncertainty(uncertainty_model, maps, image, box, surface)
            result = replace(
                result,
                uncertainty_m=uncertainty.error_m,
                timings_s={**timings_s, "doubt": clock() - start_s},
                uncertainty=uncertainty,
            )
        results.append(result)
    return results


def _run_network(batch: Sequence[LidarMaps], network: Network) -> Answer:
    """Return the images (n, 64, 64) in v of a batch; zero (no surface) for maps without any return.

    The networks take a cell without a return for an average one, and would show an average object
    for such maps.
    """
    shape = len(batch), OBJECT_PIXELS, OBJECT_PIXELS
    images = np.zeros(shape, np.float32)  # v is 0 where there is no surface
    valid = [index for index, maps in enumerate(batch) if maps.valid.any()]
    if not valid:
        return Answer(images, None)

    depth_m = np.stack([batch[index].depth_m for index in valid])
    intensity = np.stack([batch[index].intensity for index in valid])
    answer = ask(network, depth_m, intensity)
    images[valid] = answer.image
    if answer.surface is None:
        return Answer(images, None)

    surfaces = np.zeros(shape, np.float32)
    surfaces[valid] = answer.surface
    return Answer(images, surfaces)


def estimate_uncertainty(
    uncertainty_model: UncertaintyModel,
    maps: LidarMaps,
    image: Float32,
    box: ObjectBox,
    surface: Float32 | None = None,
) -> Uncertainty:
    """Return the uncertainty of an image (64, 64) in v that networks made from maps.

    `surface` (64, 64) is their own probability of a surface, if they have one.
    """
    prediction = uncertainty_model(maps.depth_m[None], maps.intensity[None], image[None])
    # v falls linearly from 1 at z_near to MIN_V at z_far (depth_from_image), so an error of 1 in v
    # is this many metres:
    metres_per_v = (box.z_far_m - box.z_near_m) / (1 - MIN_V)

    quality = None
    # The quality model was fitted to images with a surface: an empty one has no outline to judge.
    if uncertainty_model.quality and image.any():
        surfaces = None if surface is None else surface[None]
        predicted = uncertainty_model.quality(image[None], prediction, surfaces)
        low, middle, high = predicted.iou[0].tolist()
        quality = Quality(
            iou=(low, middle, high),
            good=float(predicted.good[0]),
            error_m=float(predicted.error_v[0]) * metres_per_v,
            trusted=bool(predicted.trusted[0]),
        )
    return Uncertainty(
        p_empty=float(prediction.p_empty[0]),
        p_out_of_distribution=float(prediction.p_out_of_distribution[0]),
        error_m=prediction.error_v[0] * metres_per_v,
        p_surface=prediction.p_surface[0],
        quality=quality,
    )
