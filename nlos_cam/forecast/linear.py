"""Linear model of the maps about an object, and the posterior of outline and depth under it.

The model is y = O (s - mean s) + D (d - mean d) + noise: y are the intensities and paths of the
cells that a three-bounce echo wins, s the albedo of every cell over the box (the outline) and d its
depth. O and D are the derivatives about the object itself (`Gradients`), whose surface goes on,
black, beyond its outline, so that the maps can say where light is missing. Tilt and self-occlusion
are in the model; the winner of each beam is held.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, Self

import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Float32, Float64, Mask
from nlos_models import CUTS

from nlos_cam.forecast.prior import DEPTH_RADIUS, GRID, OUTLINE_RADIUS, Prior, Shape, modes
from nlos_cam.objects import object_box
from nlos_cam.render import (
    Gradients,
    Material,
    Radiometry,
    Scene,
    SensorModel,
    Surface,
    accuracy_named,
    intensity_noise,
    render,
)

MaterialName = Literal["matt", "glossy", "retroreflective"]
MATERIALS: Mapping[MaterialName, Material] = {
    "matt": Material(),
    "glossy": Material(kind="phong"),
    "retroreflective": Material(kind="retroreflective"),
}
MODEL_ERROR = 0.005
"""Error of the model relative to the light, which no averaging removes; `fit_pose` has the same."""
BLACK = 1e-6
"""Albedo beyond the outline: too dark to be seen, and a surface to differentiate by."""
ACCURACY = replace(
    accuracy_named("draft"), name="forecast", object_stride=1, finest_cells=0, scatter_error=0.1
)
EFFECTS = "three-bounce", "occluder", "self-occlusion", "tilt"
OUTLINES = 360
DEPTHS = 90
"""Principal components that the maps are asked for."""


@dataclass(frozen=True)
class Echoes:
    """What the cells (k) that three bounces win say of an object, to first order."""

    light: Float64
    """(k,); intensity."""
    by_outline: Float32
    """(k, GRID^2); rate of the intensity by the albedo of each cell over the box."""
    by_depth: Float32
    """(k, GRID^2); rate of the intensity by the depth of each cell, as a share of the box's."""
    path_by_depth: Float32
    """(k, GRID^2); rate of the path by the same."""
    noise: Float64
    """(k,); of the intensity, in one frame."""
    path_noise_m: Float64
    """(k,); of the path, in one frame."""
    bin_m: float
    """Step of the path, which averaging does not refine."""
    margin: Float64
    """(k,); 1 less the wall's own return over the echo: 0 is a tie."""

    @classmethod
    def none(cls) -> Self:
        """Return the echoes of a rig that sees nothing."""
        empty = np.zeros(0)
        rates = np.zeros((0, GRID * GRID), np.float32)
        return cls(empty, rates, rates, rates, empty, empty, 0.01, empty)

    def and_those(self, other: "Echoes") -> "Echoes":
        """Return these and another place's echoes of the same object."""
        mine = vars(self)
        both = {
            name: np.concatenate([value, getattr(other, name)])
            for name, value in mine.items()
            if name != "bin_m"
        }
        return Echoes(**both, bin_m=self.bin_m)

    def scaled_noise(self, frames: int) -> tuple[Float64, Float64]:
        """Return the deviations (k,) of intensity and path after averaging frames."""
        light = np.hypot(self.noise / np.sqrt(frames), MODEL_ERROR * self.light)
        # A number rounded to steps errs by a twelfth of the step's square.
        path = np.hypot(self.path_noise_m / np.sqrt(frames), self.bin_m / np.sqrt(12))
        return light, path


def echoes_of(
    rig: Rig,
    shape: Shape,
    sensor: SensorModel,
    radiometry: Radiometry = "paper",
    materials: Sequence[MaterialName] = ("matt",),
) -> dict[MaterialName, Echoes]:
    """Return what the maps of a rig hold of an object, by material."""
    box = object_box(rig)
    depth_m = shape.depth_m(box)
    albedo = np.where(shape.outline, 1.0, BLACK)
    scene = Scene(rig, depth_m, Surface(albedo), radiometry)
    if not shape.outline.any():
        return dict.fromkeys(materials, Echoes.none())
    # Without the wall's return every beam's strongest three-bounce echo is differentiated: which of
    # them wins is decided below, for each material.
    every = Gradients(scene, ACCURACY, EFFECTS)
    if not every.three_bounce.any():
        return dict.fromkeys(materials, Echoes.none())
    wall = Gradients(Scene(rig, None, radiometry=radiometry), ACCURACY, ("direct", "occluder"))
    direct = wall.intensity.astype(np.float64)
    light = {name: _light(every, scene, shape, MATERIALS[name]) for name in materials}
    found = dict.fromkeys(materials, Echoes.none())
    wins = {name: every.three_bounce & (own > direct) for name, own in light.items()}
    if not any(mask.any() for mask in wins.values()):
        return found
    chosen = ChosenBeams(every, np.any(list(wins.values()), axis=0))
    span_m = box.z_far_m - box.z_near_m
    by_outline = chosen.jacobian("albedo")[0]
    by_depth, path_by_depth = (
        (part * span_m).astype(np.float32) for part in chosen.jacobian("depth")
    )
    noise_m = sensor.range_noise_m + sensor.range_noise_per_m * every.depth_m.astype(np.float64)
    pixels = rig.pinhole.width * rig.pinhole.height / every.intensity.size
    for name in materials:
        own = light[name][wins[name]]
        rows = wins[name][chosen.three_bounce]
        # A lobe changes how much a cell gets, and hardly from where: the matt rates, brighter.
        gain = (own / every.intensity[wins[name]])[:, None].astype(np.float32)
        brightened = copy(every)
        brightened.intensity = light[name].astype(np.float32)
        found[name] = Echoes(
            light=own,
            by_outline=gain * by_outline[rows],
            by_depth=gain * by_depth[rows],
            path_by_depth=path_by_depth[rows],
            noise=intensity_noise(brightened, sensor)[wins[name]],
            path_noise_m=2 * noise_m[wins[name]] / np.sqrt(pixels),
            bin_m=rig.device.bin_m,
            margin=1 - direct[wins[name]] / own,
        )
    return found


class ChosenBeams(Gradients):
    """Gradients of some of the beams that three bounces win: Jacobians cost in proportion."""

    def __init__(self, every: Gradients, beams: Mask) -> None:
        vars(self).update(vars(every))
        kept = beams[every.three_bounce]
        self.three_bounce = every.three_bounce & beams
        self._peak = self._peak[kept]
        self._path = self._path[kept]


def _light(every: Gradients, scene: Scene, shape: Shape, material: Material) -> Float64:
    """Return the strongest three-bounce light of each beam (rows, columns) from a material."""
    matt = every.intensity.astype(np.float64)
    if material.brdf is None:
        return matt
    depth_m = np.where(shape.outline, shape.depth_m(object_box(scene.rig)), np.nan)
    alone = replace(scene, object_depth_m=depth_m.astype(np.float32), surface=material.surface)
    rendered = render(alone, ACCURACY, (*EFFECTS, "brdf"))
    return rendered.intensity.astype(np.float64)


@dataclass(frozen=True)
class Basis:
    """Prior in few numbers: the largest principal components of outline and of depth."""

    outline: Float64
    """(GRID^2, OUTLINES); orthonormal."""
    depth: Float64
    """(GRID^2, DEPTHS); orthonormal."""
    covariance: Float64
    """(OUTLINES + DEPTHS, the same); outlines first."""
    mean_outline: Float64
    """(GRID^2,)."""
    mean_depth: Float64
    """(GRID^2,); share of the box's depth."""

    @classmethod
    def of(cls, prior: Prior) -> Self:
        """Return the basis of a prior."""
        cells = GRID * GRID
        outlines = _components(prior.covariance[:cells, :cells], OUTLINES)
        depths = _components(prior.covariance[cells:, cells:], DEPTHS)
        turn = np.zeros((2 * cells, OUTLINES + DEPTHS))
        turn[:cells, :OUTLINES] = outlines
        turn[cells:, OUTLINES:] = depths
        return cls(
            modes(OUTLINE_RADIUS) @ outlines,
            modes(DEPTH_RADIUS) @ depths,
            turn.T @ prior.covariance @ turn,
            prior.outline.ravel(),
            prior.depth.ravel(),
        )

    @cached_property
    def precision(self) -> Float64:
        """Inverse of the covariance."""
        return np.linalg.inv(self.covariance).astype(np.float64)


def _components(covariance: Float64, count: int) -> Float64:
    """Return the largest principal axes, the largest first."""
    _, axes = np.linalg.eigh(covariance)
    return axes[:, ::-1][:, :count]


@dataclass(frozen=True)
class Posterior:
    """Outline and depth as the linear model determines them from the maps."""

    iou: float
    """Of the estimated outline and the true one."""
    depth_rmse: float
    """Over the cells of both outlines, as a share of the box's depth; of the true outline if they
    share none.
    """
    outline_numbers: float
    depth_numbers: float
    """Numbers that the maps determine beyond the prior: the trace of the resolution."""
    outline_std: Float64
    """(GRID, GRID)."""
    depth_std: Float64
    """(GRID, GRID); share of the box's depth."""


@dataclass(frozen=True)
class LinearMaps:
    """Linear model of averaged maps: rates of k cells' intensity and path, each in units of its own
    noise.
    """

    light_by_outline: Float64
    """(k, GRID^2); rate of the intensity by the outline."""
    light_by_depth: Float64
    """(k, GRID^2); rate of the intensity by the depth, as a share of the box's."""
    path_by_depth: Float64
    """(k, GRID^2); rate of the path by the same."""

    @classmethod
    def of(cls, echoes: Echoes, frames: int) -> Self:
        """Return the model of echoes after averaging frames; cells without a noise are left out."""
        light_noise, path_noise_m = echoes.scaled_noise(frames)
        known = np.isfinite(light_noise)
        light_noise = light_noise[known, None]
        path_noise_m = path_noise_m[known, None]
        return cls(
            echoes.by_outline[known] / light_noise,
            echoes.by_depth[known] / light_noise,
            echoes.path_by_depth[known] / path_noise_m,
        )

    def in_basis(self, basis: Basis) -> Float64:
        """Return the rates (2 k, OUTLINES + DEPTHS) by a basis's numbers, intensities first."""
        path_by_outline = np.zeros((len(self.path_by_depth), basis.outline.shape[1]))
        light = np.hstack(
            [self.light_by_outline @ basis.outline, self.light_by_depth @ basis.depth]
        )
        path = np.hstack([path_by_outline, self.path_by_depth @ basis.depth])
        return np.vstack([light, path])

    def measure(self, outline_residual: Float64, depth_residual: Float64, seed: int) -> Float64:
        """Return a simulated measurement (2 k,), with noise of deviation 1, of an object whose
        outline and depth, both (GRID^2,), are off the prior's means by the residuals.
        """
        light = self.light_by_outline @ outline_residual + self.light_by_depth @ depth_residual
        expected = np.concatenate([light, self.path_by_depth @ depth_residual])
        return expected + np.random.default_rng(seed).standard_normal(len(expected))


def posterior(basis: Basis, shape: Shape, echoes: Echoes, frames: int, seed: int) -> Posterior:
    """Return the posterior of an object from noisy linear maps of it."""
    # Relief too fine for the basis is taken as known: about it, steps of centimeters are no small
    # changes, and the linear model says nothing.
    depth = shape.depth.ravel()  # (GRID^2,)
    depth_off_mean = depth - basis.mean_depth
    fine_relief = depth_off_mean - basis.depth @ (basis.depth.T @ depth_off_mean)
    outline_residual = shape.outline.ravel() - basis.mean_outline  # (GRID^2,)
    depth_residual = depth - fine_relief - basis.mean_depth

    maps = LinearMaps.of(echoes, frames)
    rates = maps.in_basis(basis)  # (2 k, OUTLINES + DEPTHS)
    measured = maps.measure(outline_residual, depth_residual, seed)  # (2 k,)

    # Bayes for a linear model with Gaussian prior and noise of deviation 1: the precisions add.
    covariance: Float64 = np.linalg.inv(rates.T @ rates + basis.precision).astype(np.float64)
    coefficients = covariance @ (rates.T @ measured)  # (OUTLINES + DEPTHS,)
    count = basis.outline.shape[1]
    outlines = slice(None, count)
    depths = slice(count, None)
    outline = basis.mean_outline + basis.outline @ coefficients[outlines]
    depth_found = basis.mean_depth + basis.depth @ coefficients[depths] + fine_relief
    iou, depth_rmse = _score(cut(outline), depth_found, shape)
    return Posterior(
        iou,
        depth_rmse,
        _numbers_beyond(basis.covariance[outlines, outlines], covariance[outlines, outlines]),
        _numbers_beyond(basis.covariance[depths, depths], covariance[depths, depths]),
        _deviation(basis.outline, covariance[outlines, outlines]),
        _deviation(basis.depth, covariance[depths, depths]),
    )


def _score(inside: Mask, depth: Float64, shape: Shape) -> tuple[float, float]:
    """Return `iou` and `depth_rmse` of a `Posterior`: those of an estimated outline and depth, both
    (GRID^2,).
    """
    truly_inside = shape.outline.ravel()
    shared = inside & truly_inside
    iou = shared.sum() / max((inside | truly_inside).sum(), 1)
    compared = shared if shared.any() else truly_inside
    if not compared.any():
        return float(iou), 0.0
    error = (depth - shape.depth.ravel())[compared]
    return float(iou), float(np.sqrt(np.mean(error**2)))


def _numbers_beyond(prior: Float64, found: Float64) -> float:
    """Return the count of numbers that maps determine beyond a prior, by both covariances (n, n).

    trace(I - C^-1 P): how far the posterior P is below the prior C.
    """
    left = np.linalg.solve(prior, found)
    return float(len(left) - np.trace(left))


def cut(outline: Float64) -> Mask:
    """Return where an estimated outline is inside: above the value whose expected overlap is
    largest, as the program cuts its images.
    """
    share = np.clip(outline, 0, 1)
    best = -1.0
    inside = share > CUTS[0]
    for value in CUTS:
        chosen = share > value
        overlap = share[chosen].sum() / max(chosen.sum() + share[~chosen].sum(), 1e-9)
        if overlap > best:
            best = float(overlap)
            inside = chosen
    return inside


def _deviation(axes: Float64, covariance: Float64) -> Float64:
    """Return the standard deviation (GRID, GRID) of each cell."""
    variance = np.einsum("ik,kl,il->i", axes, covariance, axes, optimize=True)
    return np.sqrt(np.maximum(variance, 0)).reshape(GRID, GRID)
