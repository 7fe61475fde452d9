"""Physics with a prior: does a picture become better that also explains the light?
docs/figures/physics.json and docs/images/physics.png.

    python tools/studies/physics.py WORK [--objects N] [--sets NAMES ...] [--ways NAMES ...]
        [--settings FIGURES] [--name NAME] [--out DIR]

Objects: the 54 of the kinds of training and the 54 of kinds never seen, maps of FRAMES averaged frames
as `live` forms them, from one place (home), two (home and near) and four. Outline and depth over 32 x
32 cells, started from the shipped network's answer at home. Three ways:

- "gauss-newton": outline and depth together in the principal components of the forecast's prior, its
  mean and covariance as the prior, the damped steps of SCHEDULE, the model rendered anew before each
  (tilt and self-occlusion in it); intensity and path of every cell that is an echo in data and model.
- "network in the loop": the same steps, with the network's answer as the prior's mean and a share of
  the covariance. After each step the network answers again, to the maps plus the model's residual.
- "lifted": each cell a mixture over LAYERS of depth. Linear in the mixture, so convex: the light of
  each echo at its measured path, the network's answer as the prior's mean, no negative albedo. Patches
  face the wall and hide nothing; the renderer's light of the network's answer, tilt and self-occlusion
  in it, corrects each beam.

How far the model is trusted, the share of the covariance and the weight of the depth's prior are
chosen by the IoU of TUNING other objects, seen from home and near, or taken from an earlier run's
figures (`--settings`). Of the first two ways the figures hold the light that the estimate, its start
and the truth leave unexplained ("cost", of one echo). Where the truth costs more than the estimate,
light and model do not distinguish them; where it costs less, the search has not found it. WORK keeps
the figures of each object: a second call goes on.
"""

import json
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import product
from math import sqrt
from pathlib import Path
from typing import Any, Self
from zlib import crc32

import cv2
import harness
import numpy as np
from matplotlib.figure import Figure
from nlos_calibration import ObjectBox, Rig, load_rig
from nlos_calibration.arrays import Float32, Float64, Mask
from nlos_models import Answer, ask
from stations import PLACES, rig_at

from nlos_cam.camera import World
from nlos_cam.cli.common import tracked
from nlos_cam.errors import SceneError
from nlos_cam.evaluate import (
    Subject,
    advantage,
    echoes_of,
    over_objects,
    plain,
    seeded_objects,
)
from nlos_cam.forecast import ACCURACY, BLACK, EFFECTS, Shape, cut, shipped_basis
from nlos_cam.frames import LidarMaps, MapMean, maps_from_frame
from nlos_cam.objects import benchmark_objects, depth_from_image, object_box, unseen_objects
from nlos_cam.reconstruct import load_networks
from nlos_cam.render import (
    Gradients,
    Scene,
    SceneFile,
    SensorModel,
    Surface,
    cast,
    intensity_noise,
    prepare,
    three_bounce,
    transient_axes,
)

SETS = "home", "home+near", "home+near+back+fore"
WAYS = "network", "gauss-newton", "network in the loop", "lifted"
FRAMES = 30
SCHEDULE = (4.0, 4.0, 2.0, 2.0, *[1.0] * 6)
"""Steps, by how much looser than at the end the model's light is trusted."""
DAMPING = 1.0
"""At first, as a multiple of the prior's precision: a step must stay where the linear model
holds."""
RELAXED = 4.0
"""Factor by which damping falls after a step that improves."""
TIGHTENED = 5.0
"""Factor by which it rises after one that does not."""
MAX_DAMPING = 1e5
TRIES = 5
"""Dampings that are tried for one step."""
TUNING = 12
TUNING_SEED = 96_000_000
TUNED_ON = "home+near"
TRUSTS = 0.1, 0.2, 0.4
"""Errors of the model relative to the light to choose from."""
LOOSE_TRUSTS = 0.1, 0.3, 1.0
"""The same for "lifted", whose model is rougher."""
SHARES = 0.1, 0.3
"""Shares of the forecast prior's covariance that "network in the loop" chooses its own from."""
WEIGHTS = 0.1, 1.0
"""Weights of the prior of the depth that "lifted" chooses from."""
DEPTH_STD = 0.1
"""Standard deviation of the network's depth in "lifted", as a share of the box's depth."""
MAX_CORRECTION = 3.0
"""Largest factor by which a beam's correction for tilt and self-occlusion may differ from the
median of all beams."""
PATH_ERROR_M = 0.01
MAX_OFF = 3.0
"""Largest residual of a path, in units of PATH_ERROR_M."""
MIN_HELD_SHARE = 0.05
"""Of the model's strongest bin, in the bin of a measured path: below it no rates are taken."""
GAIN_ERROR = 0.1
"""Of each place's light: cells of the model are coarser than the objects' outlines."""
BESIDE_M = 0.01
"""Depth beyond the bare wall's by more than this is an echo of the object."""
LAYERS = 12
LAYER_M = 0.01
UNMODELLED = 0.02
"""Variance of an outline's cell beyond the prior's components."""
DESCENTS = 150
BEAM_STEP = 16
"""One beam of this number gives the path length from a patch on, which is the same for all."""


@dataclass(frozen=True)
class Seen:
    """Maps of an object from one place, in the renderer's units."""

    rig: Rig
    maps: LidarMaps
    light: Float64
    """(64, 80)."""
    path_m: Float64
    """(64, 80); there and back, as the device divided it."""
    echo: Mask
    """(64, 80); cells that hold the object."""
    sensor_noise: Float64
    """(64, 80); of the light, the mean over the frames."""

    def noise(self, trust: float) -> Float64:
        """Return the deviation (64, 80) of the light, the model's own error included."""
        return np.hypot(self.sensor_noise, trust * self.light)


@dataclass(frozen=True)
class State:
    """Outline and depth of an estimate, in the cells of the forecast."""

    outline: Float64
    """(GRID^2,); not cut off at 0 and 1."""
    depth: Float64
    """(GRID^2,); share of the box's depth."""

    @classmethod
    def of(cls, surface: Mask, depth_m: Float32) -> Self:
        """Return a depth map and where it is a surface in these cells."""
        shape = Shape.of(depth_m, object_box(load_rig("paper-rig")))
        outline = cv2.resize(
            surface.astype(np.float32), shape.depth.shape, interpolation=cv2.INTER_AREA
        )
        return cls(outline.ravel().astype(np.float64), shape.depth.ravel())

    def shape(self) -> Shape:
        """Return it as the model takes it."""
        side = int(np.sqrt(len(self.outline)))
        kept = np.clip(self.depth, 0.01, 0.99).reshape(side, side)
        return Shape(self.outline.reshape(side, side) > 0, kept)


@dataclass(frozen=True)
class Choice:
    """Settings of the three ways, chosen on other objects."""

    trust: float = TRUSTS[1]
    share: float = SHARES[0]
    weight: float = WEIGHTS[0]


@dataclass(frozen=True)
class Bare:
    """A place without an object."""

    model: Gradients
    cos_axis: Float64
    gain: float
    """Counts for each unit of light."""


@cache
def bare_of(place: str) -> Bare:
    """Return the bare wall of a place."""
    rig = rig_at(place)
    model = Gradients(Scene(rig), ACCURACY, ("direct", "occluder"))
    brightest = cast(rig, rig.pinhole, occluder=False).direct.max()
    cosine = model.problem.beams.cos_axis.reshape(model.depth_m.shape)
    return Bare(model, cosine, SensorModel().bare_wall_counts / float(brightest))


def averaged_from(place: str, subject: Subject) -> LidarMaps:
    """Return the mean maps of frames of an object; every object has noise of its own at every
    place.
    """
    rig = rig_at(place)
    scene = SceneFile(name=place, rig=rig, sensor=SensorModel())
    world = World(scene, echoes_of([subject], rig, lambda *_: None), [None])
    number = crc32(subject.name.encode()) * len(PLACES) + [*PLACES].index(place)
    mean = MapMean(FRAMES)
    numbers = range(number * FRAMES, (number + 1) * FRAMES)
    frames = (world.images(frame).frame(rig.pinhole) for frame in numbers)
    return [mean.add(maps_from_frame(frame)) for frame in frames][-1]


def seen_from(place: str, subject: Subject) -> Seen:
    """Return the averaged maps of an object from a place."""
    rig = rig_at(place)
    bare = bare_of(place)
    maps = averaged_from(place, subject)
    with np.errstate(invalid="ignore"):
        echo = maps.valid & (np.abs(maps.depth_m - bare.model.depth_m) > BESIDE_M)
    path_m = 2 * maps.depth_m / bare.cos_axis
    lit = copy(bare.model)
    lit.intensity = maps.intensity / np.float32(bare.gain)
    noise = intensity_noise(lit, SensorModel(), FRAMES)
    light = lit.intensity.astype(np.float64)
    return Seen(rig, maps, light, path_m.astype(np.float64), echo, noise)


def network_state(answer: Answer) -> State:
    """Return a network's answer (one image) in the cells of the forecast."""
    surface = answer.image[0] > 0 if answer.surface is None else answer.surface[0]
    box = object_box(load_rig("paper-rig"))
    return State.of(surface, depth_from_image(answer.image[0], box))


@dataclass(frozen=True)
class Model:
    """Maps that an estimate would show at one place."""

    seen: Seen
    every: Gradients
    held: Float64
    """(64, 80); light in the bin of the measured path: which bin wins is left to the data."""
    path_m: Float64
    """(64, 80); of the model's own strongest echo."""

    @classmethod
    def of(cls, seen: Seen, state: State) -> Self:
        """Render an estimate."""
        shape = state.shape()
        albedo = np.clip(state.outline, BLACK, 1).reshape(shape.depth.shape)
        scene = Scene(seen.rig, shape.depth_m(object_box(seen.rig)), Surface(albedo))
        every = Gradients(scene, ACCURACY, EFFECTS)
        histogram = three_bounce(scene, ACCURACY, EFFECTS)
        held = np.zeros(seen.echo.size)
        beams = np.flatnonzero(seen.echo)
        bins = np.floor(seen.path_m.ravel()[beams] / seen.rig.device.bin_m).astype(int)
        inside = bins < histogram.shape[1]
        held[beams[inside]] = histogram[beams[inside], bins[inside]]
        path_m = 2 * every.depth_m / every.problem.beams.cos_axis.reshape(every.depth_m.shape)
        return cls(seen, every, held.reshape(seen.echo.shape), path_m.astype(np.float64))

    def residuals(self, trust: float, gain: float) -> tuple[Float64, Float64]:
        """Return what the echoes (k,) leave of light and path, in units of their noise."""
        echo = self.seen.echo
        light = (self.seen.light - (1 + gain) * self.held)[echo] / self.seen.noise(trust)[echo]
        with np.errstate(invalid="ignore"):
            path = (self.seen.path_m - self.path_m)[echo] / PATH_ERROR_M
        # beyond that it says that something else is there, not how far off the depth is
        path = np.where(self.every.three_bounce[echo], np.clip(path, -MAX_OFF, MAX_OFF), MAX_OFF)
        return light, path

    def rows(self, trust: float, gain: float) -> tuple[Float64, Float64, Float64]:
        """Return residuals (r,), their rates (r, components), and their rates by the gain (r,), of the
        echoes whose bin has some of the model's light.
        """
        noise = self.seen.noise(trust)
        bright = self.held > MIN_HELD_SHARE * self.every.intensity
        used = self.seen.echo & self.every.three_bounce & bright & np.isfinite(noise)
        basis = shipped_basis()
        if not used.any():
            width = basis.outline.shape[1] + basis.depth.shape[1]
            return np.zeros(0), np.zeros((0, width)), np.zeros(0)
        box = object_box(self.seen.rig)
        span_m = box.z_far_m - box.z_near_m
        chosen = HeldBins(self, used)
        by_albedo = chosen.jacobian("albedo")[0] @ basis.outline
        by_depth, path_by_depth = (
            span_m * (part @ basis.depth) for part in chosen.jacobian("depth")
        )
        light = (1 + gain) * np.hstack([by_albedo, by_depth]) / noise[used][:, None]
        path = np.hstack([np.zeros_like(by_albedo), path_by_depth]) / PATH_ERROR_M
        among = used[self.seen.echo]
        off = np.concatenate([part[among] for part in self.residuals(trust, gain)])
        by_gain = self.held[used] / noise[used]
        return off, np.vstack([light, path]), np.concatenate([by_gain, np.zeros(len(by_gain))])


class HeldBins(Gradients):
    """Gradients of some beams' light in the bins of their measured paths."""

    def __init__(self, model: Model, beams: Mask) -> None:
        vars(self).update(vars(model.every))
        self.three_bounce = beams
        self._peak = model.held[beams].astype(np.float32)
        bin_m = model.seen.rig.device.bin_m
        self._path = (np.floor(model.seen.path_m[beams] / bin_m) + 0.5) * bin_m


@dataclass(frozen=True)
class Prior:
    """Mean and inverse covariance of an estimate, in principal components."""

    mean: State
    precision: Float64

    def components(self, state: State) -> Float64:
        """Return an estimate less the mean, in principal components."""
        basis = shipped_basis()
        outline = basis.outline.T @ (state.outline - self.mean.outline)
        return np.concatenate([outline, basis.depth.T @ (state.depth - self.mean.depth)])


@dataclass(frozen=True)
class Estimate:
    """An estimate with its models, and each place's error of gain."""

    state: State
    models: Sequence[Model]
    gains: Float64

    def cost(self, prior: Prior, trust: float) -> float:
        """Return -2 times the logarithm of its probability, but for a constant."""
        here = prior.components(self.state)
        left = here @ prior.precision @ here + np.sum((self.gains / GAIN_ERROR) ** 2)
        for model, gain in zip(self.models, self.gains, strict=True):
            left += sum(np.sum(part**2) for part in model.residuals(trust, gain))
        return float(left)


def improved(
    estimate: Estimate, prior: Prior, trust: float, damping: float
) -> tuple[Estimate, float]:
    """Return the estimate after a damped Gauss-Newton step towards the most probable one, and the
    damping of the next; the same estimate if no step makes it more probable.
    """
    basis = shipped_basis()
    count = basis.outline.shape[1]
    here = prior.components(estimate.state)
    places = len(estimate.models)
    precision = np.zeros((len(here) + places, len(here) + places))
    precision[: len(here), : len(here)] = prior.precision
    precision[len(here) :, len(here) :] = np.eye(places) / GAIN_ERROR**2
    information = precision.copy()
    told = -precision @ np.concatenate([here, estimate.gains])
    for place, (model, gain) in enumerate(zip(estimate.models, estimate.gains, strict=True)):
        off, rates, by_gain = model.rows(trust, gain)
        column = np.zeros((len(off), places))
        column[:, place] = by_gain
        rates = np.hstack([rates, column])
        information += rates.T @ rates
        told += rates.T @ off

    before = estimate.cost(prior, trust)
    for _ in range(TRIES):
        change = np.linalg.solve(information + damping * precision, told)
        outline = estimate.state.outline + basis.outline @ change[:count]
        depth = estimate.state.depth + basis.depth @ change[count : len(here)]
        state = State(np.clip(outline, -0.1, 1.1), depth)
        models = [Model.of(model.seen, state) for model in estimate.models]
        found = Estimate(state, models, estimate.gains + change[len(here) :])
        if found.cost(prior, trust) < before:
            return found, damping / RELAXED
        damping *= TIGHTENED
    return estimate, damping


def estimated(seen: Sequence[Seen], state: State) -> Estimate:
    """Return a state with its models."""
    return Estimate(state, [Model.of(each, state) for each in seen], np.zeros(len(seen)))


def started(seen: Sequence[Seen]) -> Estimate:
    """Return the network's answer as an estimate."""
    return estimated(seen, network_state(answer_to(seen[0].maps)))


def by_gauss_newton(seen: Sequence[Seen], choice: Choice) -> Estimate:
    """Return outline and depth under the forecast's prior."""
    prior = forecast_prior()
    estimate = started(seen)
    damping = DAMPING
    for looser in SCHEDULE:
        estimate, damping = improved(estimate, prior, looser * choice.trust, damping)
        if damping > MAX_DAMPING:
            break
    return estimate


def forecast_prior() -> Prior:
    """Return mean and covariance of the training generators' objects."""
    basis = shipped_basis()
    return Prior(State(basis.mean_outline, basis.mean_depth), basis.precision)


def by_network_in_the_loop(seen: Sequence[Seen], choice: Choice) -> Estimate:
    """Return outline and depth about the network's answers to corrected maps."""
    precision = shipped_basis().precision / choice.share
    estimate = started(seen)
    mean = estimate.state
    damping = DAMPING
    for looser in SCHEDULE:
        prior = Prior(mean, precision)
        estimate, damping = improved(estimate, prior, looser * choice.trust, damping)
        if damping > MAX_DAMPING:
            break
        mean = network_state(answer_to(corrected(seen[0], estimate.models[0].every)))
    return estimate


def corrected(seen: Seen, model: Gradients) -> LidarMaps:
    """Return the maps plus the model's residual, in cells that are echoes in both."""
    both = seen.echo & model.three_bounce & (model.intensity > 0)
    gain = bare_of("home").gain
    with np.errstate(invalid="ignore"):
        left_m = np.where(both, seen.maps.depth_m - model.depth_m, 0)
    left = np.where(both, seen.maps.intensity - gain * model.intensity, 0)
    return replace(
        seen.maps,
        depth_m=(seen.maps.depth_m + left_m).astype(np.float32),
        intensity=np.maximum(seen.maps.intensity + left, 1).astype(np.float32),
    )


def answer_to(maps: LidarMaps) -> Answer:
    """Return the shipped network's answer."""
    return ask(shipped_network(), maps.depth_m[None], maps.intensity[None])


@cache
def shipped_network() -> Any:
    """Return the shipped network for the paper's rig."""
    return load_networks()


@dataclass(frozen=True)
class Dictionary:
    """Light of each small patch over the box (voxels), as each beam of one place sees it."""

    light: Float32
    """(voxels, beams); over all path lengths."""
    first_m: Float32
    """(voxels, beams); path from the lidar by the laser's spot to the patch."""
    later: Float32
    """(voxels, bins); share of the light by the path from the patch on."""
    bin_m: float

    def rows(self, beams: Mask, path_m: Float64) -> Float32:
        """Return the light (k, voxels) of some beams at their measured paths (k,)."""
        after = (path_m[:, None] - self.first_m[:, beams].T) / self.bin_m - 0.5
        low = np.clip(np.floor(after).astype(int), 0, self.later.shape[1] - 2)
        share = np.clip(after - low, 0, 1).astype(np.float32)
        voxel = np.arange(len(self.later))[None]
        found = (1 - share) * self.later[voxel, low] + share * self.later[voxel, low + 1]
        inside = (after > -1) & (after < self.later.shape[1])
        return self.light[:, beams].T * found * inside


def voxels_of(box: ObjectBox) -> tuple[int, Float64]:
    """Return the cells along a side, and the middles (LAYERS,) of the layers in metres."""
    side = int(np.sqrt(len(shipped_basis().mean_outline)))
    return side, box.z_near_m + LAYER_M * (np.arange(LAYERS) + 0.5)


@cache
def dictionary_of(place: str, work: Path) -> Dictionary:
    """Return the dictionary of a place, rendered patch by patch and read once."""
    path = work / f"dictionary-{place}.npz"
    if not path.exists():
        render_dictionary(place, path)
    stored = np.load(path)
    parts = {name: stored[name] for name in ("light", "first_m", "later")}
    return Dictionary(**parts, bin_m=rig_at(place).device.bin_m)


def render_dictionary(place: str, path: Path) -> None:
    """Write a place's dictionary: light and paths of one patch after the other."""
    rig = rig_at(place)
    box = object_box(rig)
    side, layers_m = voxels_of(box)
    axes = transient_axes(Scene(rig, np.full((side, side), layers_m[0], np.float32)), ACCURACY)
    spots = axes.laser_spots_m.reshape(-1, 3)
    legs_m = np.linalg.norm(spots - axes.lidar_m, axis=1)
    bins = round(1.2 / rig.device.bin_m)
    light = np.zeros((LAYERS * side * side, len(spots)), np.float32)
    first_m = np.zeros_like(light)
    later = np.zeros((len(light), bins), np.float32)
    effects = "three-bounce", "occluder"
    with tracked(f"rendering patches from {place}") as on_progress:
        for layer, depth_m in enumerate(layers_m):
            sheet = Scene(rig, np.full((side, side), depth_m, np.float32))
            job = prepare(sheet, ACCURACY, effects).job
            if job is None:  # beyond the gate
                continue
            patches = job.patches
            for row, column, point_m in zip(
                patches.row, patches.column, patches.point_m, strict=True
            ):
                alone_m = np.full((side, side), np.nan, np.float32)
                alone_m[row, column] = depth_m
                waves = three_bounce(Scene(rig, alone_m), ACCURACY, effects)
                path_m = legs_m + np.linalg.norm(spots - point_m, axis=1)
                voxel = (layer * side + row) * side + column
                light[voxel] = waves.sum(1)
                first_m[voxel] = np.nan_to_num(path_m)
                later[voxel] = after_the_patch(waves, path_m, rig.device.bin_m, bins)
            on_progress(layer + 1, LAYERS)
    part = path.with_suffix(".part.npz")
    np.savez(part, light=light, first_m=first_m, later=later)
    part.rename(path)


def after_the_patch(waves: Float32, first_m: Float64, bin_m: float, bins: int) -> Float64:
    """Return the share of a patch's light by the path from it on, the mean over some beams."""
    waves = waves[::BEAM_STEP]
    path_m = (np.arange(waves.shape[1]) + 0.5) * bin_m
    at = np.floor((path_m - first_m[::BEAM_STEP, None]) / bin_m)
    kept = (at >= 0) & (at < bins)
    found = np.bincount(at[kept].astype(int), waves[kept], minlength=bins)
    return found / max(found.sum(), 1e-12)


def by_lifting(seen: Sequence[Seen], choice: Choice, dictionaries: Sequence[Dictionary]) -> State:
    """Return outline and depth of the mixture that explains the echoes best, about the network's
    answer.
    """
    basis = shipped_basis()
    box = object_box(seen[0].rig)
    side, layers_m = voxels_of(box)
    share = (layers_m - box.z_near_m) / (box.z_far_m - box.z_near_m)
    start = started(seen)
    mixed = mixture_of(start.state, share)
    rows = list[Float32]()
    wanted = list[Float64]()
    for model, dictionary in zip(start.models, dictionaries, strict=True):
        each = model.seen
        echo = each.echo.ravel()
        noise = each.noise(choice.trust).ravel()[echo]
        facing = dictionary.rows(echo, each.path_m.ravel()[echo])
        factor = correction(model.held.ravel()[echo], facing @ mixed)
        rows.append(facing * (factor / noise)[:, None])
        wanted.append(each.light.ravel()[echo] / noise)
    matrix = np.vstack(rows).astype(np.float32)
    data = np.concatenate(wanted).astype(np.float32)

    count = basis.outline.shape[1]
    inner = np.linalg.inv(basis.covariance[:count, :count]) - np.eye(count) / UNMODELLED
    unlikely = 0.5 * ((share[:, None] - start.state.depth) / DEPTH_STD) ** 2

    def slope(mixture: Float32) -> Float32:
        outline = mixture.reshape(LAYERS, -1).sum(0)
        off = outline - start.state.outline
        pull = off / UNMODELLED + basis.outline @ (inner @ (basis.outline.T @ off))
        layered = pull[None] + choice.weight * unlikely
        return matrix.T @ (matrix @ mixture - data) + layered.ravel().astype(np.float32)

    mixture = descend(slope, matrix.shape[1])
    layered = mixture.reshape(LAYERS, side * side)
    outline = layered.sum(0).astype(np.float64)
    depth = (layered * share[:, None]).sum(0) / np.maximum(outline, 1e-6)
    return State(outline, np.where(outline > 1e-3, depth, start.state.depth))


def mixture_of(state: State, share: Float64) -> Float32:
    """Return an estimate as a mixture (voxels,): each cell's albedo in the two layers about its
    depth.
    """
    at = np.interp(state.depth, share, np.arange(LAYERS))
    low = np.minimum(at.astype(int), LAYERS - 2)
    mixture = np.zeros((LAYERS, len(at)), np.float32)
    cell = np.arange(len(at))
    albedo = np.clip(state.outline, 0, 1)
    mixture[low, cell] = (low + 1 - at) * albedo
    mixture[low + 1, cell] = (at - low) * albedo
    return mixture.ravel()


def correction(rendered: Float64, facing: Float32) -> Float64:
    """Return what tilt and self-occlusion change of each echo's light (k,)."""
    both = (rendered > 0) & (facing > 0)
    if not both.any():
        return np.ones(len(rendered))
    factor = np.divide(rendered, facing, out=np.ones(len(rendered)), where=both)
    middle = np.median(factor[both])
    return np.clip(np.where(both, factor, middle), middle / MAX_CORRECTION, middle * MAX_CORRECTION)


def descend(slope: Callable[[Float32], Float32], count: int) -> Float32:
    """Return the minimum over nonnegative vectors, by accelerated projected gradients."""
    # the slope is affine: a difference of two slopes is the curvature along their difference
    zero = slope(np.zeros(count, np.float32))
    along = np.full(count, 1 / sqrt(count), np.float32)
    for _ in range(12):
        turned = slope(along) - zero
        curvature = float(np.linalg.norm(turned))
        along = turned / max(curvature, 1e-12)
    here = np.zeros(count, np.float32)
    ahead = here
    pace = 1.0
    for _ in range(DESCENTS):
        there = np.maximum(ahead - slope(ahead) / (1.05 * curvature), 0)
        # a plain number: with one of float64 the products would be in float64, and ten times slower
        faster = (1 + sqrt(1 + 4 * pace**2)) / 2
        ahead = there + (pace - 1) / faster * (there - here)
        here = there
        pace = faster
    return here


def figures_of(state: State, subject: Subject) -> dict[str, float]:
    """Return the silhouette IoU of an estimate at the depth maps' own cells, and the median depth
    error in millimetres.
    """
    truth = np.asarray(subject.depth_m)
    side = int(np.sqrt(len(state.outline)))

    def fine(values: Float64) -> Float32:
        coarse = values.reshape(side, side).astype(np.float32)
        return cv2.resize(coarse, truth.shape[::-1], interpolation=cv2.INTER_LINEAR)

    box = object_box(load_rig("paper-rig"))
    inside = cut(fine(state.outline).ravel().astype(np.float64)).reshape(truth.shape)
    depth_m = box.z_near_m + fine(state.depth) * (box.z_far_m - box.z_near_m)
    return compared(inside, depth_m, truth)


def compared(inside: Mask, depth_m: Float32, truth_m: Float32) -> dict[str, float]:
    """Return IoU and median depth error."""
    surface = ~np.isnan(truth_m)
    both = inside & surface
    error_m = np.median(np.abs(depth_m - truth_m)[both]) if both.any() else np.nan
    return {
        "silhouette_iou": float(both.sum() / max((inside | surface).sum(), 1)),
        "depth_median_mm": 1e3 * float(error_m),
    }


def judged(
    subject: Subject, way: str, places: Sequence[str], choice: Choice, work: Path
) -> dict[str, float]:
    """Return the figures of one way for one object."""
    if way == "network":
        image = answer_to(seen_from("home", subject).maps).image[0]
        box = object_box(load_rig("paper-rig"))
        return compared(image > 0, depth_from_image(image, box), np.asarray(subject.depth_m))
    seen = [seen_from(place, subject) for place in places]
    if way == "lifted":
        found = by_lifting(seen, choice, [dictionary_of(place, work) for place in places])
        return figures_of(found, subject)
    ways = {"gauss-newton": by_gauss_newton, "network in the loop": by_network_in_the_loop}
    estimate = ways[way](seen, choice)
    costs = {
        "cost": estimate,
        "cost_of_the_start": started(seen),
        "cost_of_the_truth": estimated(seen, true_state(subject)),
    }
    echoes = sum(int(each.echo.sum()) for each in seen)
    prior = forecast_prior()
    return figures_of(estimate.state, subject) | {
        name: each.cost(prior, choice.trust) / echoes for name, each in costs.items()
    }


def true_state(subject: Subject) -> State:
    """Return the truth in the cells of the forecast."""
    truth_m = np.asarray(subject.depth_m)
    return State.of(~np.isnan(truth_m), truth_m)


def measured(
    name: str,
    subjects: Sequence[Subject],
    make: Callable[[Subject], Mapping[str, float]],
    work: Path,
) -> list[dict[str, float]]:
    """Return the figures of all objects; those that WORK has are not made again."""
    path = work / f"{name.replace(' ', '-')}.jsonl"
    found = [json.loads(line) for line in harness.whole_lines(path)][: len(subjects)]
    with tracked(name) as on_progress, path.open("a", encoding="utf-8") as file:
        for subject in subjects[len(found) :]:
            found.append(dict(make(subject)))
            file.write(json.dumps(found[-1]) + "\n")
            file.flush()
            on_progress(len(found), len(subjects))
    return found


def tuned(way: str, work: Path) -> Choice:
    """Return what is best for a way on objects of their own."""
    box = object_box(load_rig("paper-rig"))
    subjects = seeded_objects(TUNING_SEED, TUNING, box)
    options = [Choice()] if way == "network" else [Choice(trust=trust) for trust in TRUSTS]
    if way == "network in the loop":
        options = [Choice(trust, share) for trust, share in product(TRUSTS[1:], SHARES)]
    if way == "lifted":
        options = [Choice(trust, weight=weight) for trust, weight in product(LOOSE_TRUSTS, WEIGHTS)]

    def mean_iou(choice: Choice) -> float:
        name = f"tuning {way} {choice.trust:g} {choice.share:g} {choice.weight:g}"
        make = partial(judged, way=way, places=TUNED_ON.split("+"), choice=choice, work=work)
        rows = measured(name, subjects, make, work)
        return float(np.mean([row["silhouette_iou"] for row in rows]))

    return options[0] if len(options) == 1 else max(options, key=mean_iou)


def chosen_earlier(way: str, figures: Path) -> Choice:
    """Return what an earlier run chose for a way. Raises SceneError where it has no such way."""
    rows = json.loads(figures.read_text(encoding="utf-8"))["rows"]
    for row in rows:
        if row["way"] == way:
            return Choice(**row["choice"])
    raise SceneError(f"{figures} has no settings of {way!r}: leave out --settings to tune them")


def draw(rows: Sequence[Mapping[str, Any]], groups: Sequence[str]) -> Figure:
    """Draw each way's IoU over the number of places."""
    figure = Figure(figsize=(7.2, 3.2), layout="constrained")
    for axis, group in zip(figure.subplots(1, 2, sharey=True), groups, strict=True):
        for way in WAYS:
            own = [row for row in rows if row["way"] == way]
            places = [row["places"].count("+") + 1 for row in own]
            axis.plot(
                places, [row[group]["silhouette_iou"]["value"] for row in own], "o-", label=way
            )
        axis.set(title=group, xlabel="places", xticks=[1, 2, 4])
    figure.axes[0].set_ylabel("silhouette IoU")
    figure.axes[0].legend(frameon=False)
    return figure


def main() -> None:
    """Run the study."""
    parser = harness.options(__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--objects", type=int, default=54, help="of each kind, at most 54")
    parser.add_argument("--sets", nargs="+", default=list(SETS), choices=SETS)
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=WAYS)
    parser.add_argument("--settings", type=Path, help="figures whose settings to take")
    parser.add_argument("--name", default="physics", help="of the results' files")
    parser.add_argument("--out", type=Path, help="folder of the results (default: docs)")
    asked = parser.parse_args()
    harness.claim(asked.work, settings=asked.settings)

    box = object_box(load_rig("paper-rig"))
    groups = {"kinds of training": benchmark_objects, "kinds never seen": unseen_objects}
    rows = list[dict[str, Any]]()
    for way, places in product(asked.ways, asked.sets):
        earlier = asked.settings
        choice = chosen_earlier(way, earlier) if earlier else tuned(way, asked.work)
        row: dict[str, Any] = {"way": way, "places": places, "choice": vars(choice)}
        for group, objects_in in groups.items():
            subjects = objects_in(box)[: asked.objects]
            make = partial(
                judged, way=way, places=places.split("+"), choice=choice, work=asked.work
            )
            found = measured(f"{way} {places} {group}", subjects, make, asked.work)
            values = {name: np.array([one[name] for one in found]) for name in found[0]}
            row[group] = plain(over_objects(values))
            row[f"{group}, each"] = values["silhouette_iou"].tolist()
        rows.append(row)
        print(
            way,
            places,
            {group: row[group]["silhouette_iou"]["value"] for group in groups},
            flush=True,
        )
    start = next((row for row in rows if row["way"] == "network"), None)
    for row in rows if start else []:
        for group in groups:
            mine, its = (
                {"silhouette_iou": np.array(one[f"{group}, each"])} for one in (row, start)
            )
            row[f"{group}, gain"] = plain(advantage(mine, its))
    facts = {
        "machine": f"{os.cpu_count()} cores, {platform.machine()}",
        "objects": min(asked.objects, len(benchmark_objects(box))),
        "frames": FRAMES,
        "rows": rows,
    }
    harness.write(asked.name, facts, asked.out)
    if start and len(asked.ways) == len(WAYS):
        harness.save(asked.name, draw(rows, list(groups)), asked.out)


if __name__ == "__main__":
    main()
