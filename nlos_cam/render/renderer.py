"""Renderer: a scene to the depth and intensity maps of a lidar that reports its strongest echo (S1 to S5)."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np
from nlos_calibration.arrays import Float32
from numpy.typing import NDArray

from nlos_cam.errors import SceneError
from nlos_cam.frames import MAP_COLUMNS, WINNER_SPREAD_M
from nlos_cam.render import backend_reference, glossy
from nlos_cam.render.accuracy import Accuracy, accuracy_named
from nlos_cam.render.echoes import MultiBounce, add_direct, compete, no_echoes, strongest, with_pulse
from nlos_cam.render.effects import Effects, Plan
from nlos_cam.render.geometry import gate_bins
from nlos_cam.render.job import TransportJob, count_near_legs
from nlos_cam.render.planning import RenderProblem, plan, prepare
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_facts import SceneFacts

Histograms = NDArray[np.floating[Any]]
"""(n, bins); light over path length. float64 from the reference, else float32."""
BACKENDS = "cpu", "torch", "cuda"
"""numba; torch on the CPU; torch on a GPU."""
BATCH_OBJECTS = 16
"""Objects in one batch of torch: enough that the time to launch kernels does not count."""


@dataclass(frozen=True)
class Rendering:
    """Maps that the lidar reports of a scene, free of sensor noise."""

    depth_m: Float32
    """(64, 80); along the optical axis, NaN where nothing returns. Median of the beams in a cell."""
    intensity: Float32
    """(64, 80); in units of I0. Mean of the beams in a cell within 1 cm of the median depth."""
    margin: Float32
    """(64, 80); 1 - second / strongest echo: 0 is a tie."""
    multi: MultiBounce
    """Echoes of every beam."""
    plan: Plan
    accuracy: Accuracy
    near_legs: int
    """Number of legs between patches and wall so short that the near-contact average replaced 1 / d^2."""
    color: Float32 | None = None
    """(64, 80, 3); intensity in each channel of the albedo, if it has three."""


def render(
    scene: Scene,
    accuracy: str | Accuracy = "standard",
    effects: Effects = "auto",
    backend: str = "cpu",
    rows: tuple[int, int] | None = None,
) -> Rendering:
    """Return depth, intensity and margin of every map cell, or of the rows [first, second).

    Raises SceneError for a scene that cannot be rendered.
    """
    facts = SceneFacts(scene, accuracy_named(accuracy))
    problem = RenderProblem.of(facts, plan(facts, effects), rows)
    return _rendering(problem, _echoes(problem, backend), backend)


def render_all(
    scenes: Iterable[Scene], accuracy: str | Accuracy = "standard", effects: Effects = "auto", backend: str = "cpu"
) -> Iterator[Rendering]:
    """Yield the renderings of many scenes; torch works on batches of BATCH_OBJECTS."""
    setting, rest = accuracy_named(accuracy), iter(scenes)
    while batch := list(islice(rest, 1 if backend == "cpu" else BATCH_OBJECTS)):
        problems = [prepare(scene, setting, effects) for scene in batch]
        for problem, echoes in zip(problems, _echoes_of_all(problems, setting, backend), strict=True):
            yield _rendering(problem, echoes, backend)


def transient(
    scene: Scene, accuracy: str | Accuracy = "standard", effects: Effects = "auto", backend: str = "cpu"
) -> Float32:
    """Return all light that comes back, as histograms (64, 80, bins) over path length in bins of `device.bin_m`.

    With beams_per_cell k they are (64 k, 80 k, bins); with the color effect a channel axis (3) follows.
    """
    problem = prepare(scene, accuracy_named(accuracy), effects)
    jobs = problem.color_jobs or (problem.job,)
    parts = [_waveforms(problem, beam_histograms(problem, job, backend)) for job in jobs]
    shaped = [part.reshape(*problem.beams.shape, -1) for part in parts]
    return np.stack(shaped, -1) if problem.color_jobs else shaped[0]


def three_bounce(
    scene: Scene,
    accuracy: str | Accuracy = "standard",
    effects: Effects = "auto",
    backend: str = "cpu",
    chosen: NDArray[np.int64] | None = None,
) -> Histograms:
    """Return the three-bounce histograms (n, bins) alone, of chosen beams (flat indices) or of all."""
    problem = prepare(scene, accuracy_named(accuracy), effects)
    return beam_histograms(problem, problem.job, backend, chosen)


def beam_histograms(
    problem: RenderProblem, job: TransportJob | None, backend: str, chosen: NDArray[np.int64] | None = None
) -> Histograms:
    """Return the three-bounce histograms of a problem's beams, or of the chosen; 0 for beams that miss the wall."""
    lit = problem.beams.on_wall
    chosen = np.arange(len(lit)) if chosen is None else chosen
    # A job holds the beams that light the wall alone, in their order: the running count of lit beams is a beam's place
    # among them.
    wanted = chosen[lit[chosen]]
    if job is None or not wanted.size:
        return np.zeros((len(chosen), job.bins if job else 1), np.float32)
    some = job if len(wanted) == len(job.laser_spot_m) else job.select((np.cumsum(lit) - 1)[wanted])
    return _spread_over(lit[chosen], transport(some, backend))


def transport(job: TransportJob | None, backend: str) -> Histograms | None:
    """Return the three-bounce histograms (n, bins) of a job's beams by one of the backends; None for no job.

    An accuracy without sub-bins is the reference, on any backend. Raises SceneError if there is no such backend or GPU.
    """
    if job is None:
        return None
    if backend not in BACKENDS:
        raise SceneError(f"no backend {backend!r}: choose one of {', '.join(BACKENDS)}")
    if job.accuracy.sub_bins == 0:
        return backend_reference.histograms(job)
    if backend == "cpu":
        return glossy.histograms(job)
    from nlos_cam.render import backend_torch  # torch takes a second to import

    return backend_torch.histograms(job, backend_torch.device_named(backend))


def _echoes(problem: RenderProblem, backend: str) -> MultiBounce:
    """Return the strongest bins (n,) of all beams, from a part of the transport where the backend can do that."""
    job = problem.job
    # A pulse mixes neighbouring bins, so that the strongest bin before it may not be the strongest after it: only a
    # waveform without one may be summed in part.
    if backend == "cpu" and job and job.accuracy.sub_bins and not problem.includes("pulse"):
        return glossy.echoes(job).spread_over(problem.beams.on_wall)
    return _strongest(problem, transport(job, backend))


def _echoes_of_all(problems: Sequence[RenderProblem], accuracy: Accuracy, backend: str) -> Iterable[MultiBounce]:
    """Return the strongest bins of every problem, torch's in one batch."""
    if backend not in {"torch", "cuda"} or accuracy.sub_bins == 0:
        return [_echoes(problem, backend) for problem in problems]
    from nlos_cam.render import backend_torch

    device, jobs = backend_torch.device_named(backend), [problem.job for problem in problems]
    found = iter(backend_torch.histograms_of_all([job for job in jobs if job is not None], device))
    return [_strongest(problem, next(found) if problem.job else None) for problem in problems]


def _spread_over(lit: NDArray[np.bool_], histograms: Histograms | None) -> Histograms:
    """Return the histograms of lit beams as (n, bins) of all beams, 0 for the others."""
    if histograms is None:
        return np.zeros((len(lit), 1), np.float32)
    every = np.zeros((len(lit), histograms.shape[1]), histograms.dtype)
    every[lit] = histograms
    return every


def _rendering(problem: RenderProblem, echoes: MultiBounce, backend: str) -> Rendering:
    """Return the maps of a problem from the strongest bins (n,) of its beams: S5, cells, color."""
    echoes = echoes.reshape(problem.beams.shape)
    depth, intensity, margin = compete(problem.beams, echoes)
    color = _color(problem, echoes, backend) if problem.color_jobs else None
    near = count_near_legs(problem.job) if problem.job else 0
    return Rendering(*_cells(depth, intensity, margin), echoes, problem.plan, problem.accuracy, near, color)


def _strongest(problem: RenderProblem, histograms: Histograms | None) -> MultiBounce:
    """Return the strongest bins (n,) of all beams: of three bounces, or with a pulse of the whole waveform."""
    lit, bin_m = problem.beams.on_wall, problem.scene.rig.device.bin_m
    if problem.includes("pulse"):
        whole = _waveforms(problem, _spread_over(lit, histograms))
        return replace(strongest(whole, bin_m), direct_included=True)
    return no_echoes(len(lit)) if histograms is None else strongest(histograms, bin_m).spread_over(lit)


def _waveforms(problem: RenderProblem, histograms: Histograms) -> Float32:
    """Return three-bounce histograms with direct returns added and the pulse applied, up to the gate."""
    device = problem.scene.rig.device
    # Convolution is linear, so one pulse over the sum of direct and three-bounce light stands for each echo's own; it
    # comes before the gate, since light outside reaches in by the pulse's tail.
    whole = add_direct(histograms.astype(np.float32, copy=False), problem.beams, device.bin_m)
    if problem.includes("pulse"):
        whole = with_pulse(whole, problem.scene.pulse_ns, device.bin_m)
    return whole[:, : gate_bins(device)]


def _color(problem: RenderProblem, echoes: MultiBounce, backend: str) -> Float32:
    """Return the intensity (64, 80, 3) of each channel in the bin of the winning echo; the wall is white."""
    bin_m, beams = problem.scene.rig.device.bin_m, np.arange(echoes.peak.size)
    # The winner is chosen on the mean albedo, as a lidar of one wavelength would; the channels only share its bin.
    # Choosing anew in each channel could give one beam three depths.
    wins = (echoes.peak.ravel() > problem.beams.direct) | echoes.direct_included
    at = np.nan_to_num(echoes.path_m.ravel() / bin_m, nan=0).astype(np.int64)
    channels: list[Float32] = []
    for job in problem.color_jobs:
        histogram = beam_histograms(problem, job, backend).astype(np.float32, copy=False)
        if echoes.direct_included:
            histogram = _waveforms(problem, histogram)
        value = np.where(wins, histogram[beams, np.minimum(at, histogram.shape[1] - 1)], problem.beams.direct)
        channels.append(_cell_mean(value.reshape(echoes.peak.shape)).astype(np.float32))
    return np.stack(channels, -1)


def _blocks(image: NDArray[Any]) -> NDArray[Any]:
    """Return an image of k x k beams per cell as (rows, 80, k * k)."""
    k = image.shape[1] // MAP_COLUMNS
    return image.reshape(-1, k, MAP_COLUMNS, k).swapaxes(1, 2).reshape(-1, MAP_COLUMNS, k * k)


def _cell_mean(image: NDArray[Any]) -> NDArray[Any]:
    """Return the mean (rows, 80) of the beams in each cell."""
    return _blocks(image).mean(-1)


def _cells(depth: Float32, intensity: Float32, margin: Float32) -> tuple[Float32, Float32, Float32]:
    """Reduce maps of beams to maps of cells, exactly as camera frames are reduced."""
    if depth.shape[1] == MAP_COLUMNS:
        return depth, intensity, margin
    depths, values = _blocks(depth), _blocks(intensity)
    valid = ~np.isnan(depths)
    some = valid.any(-1)
    # Median of depth, then mean of the intensities near it: a cell across an edge holds two echoes at two depths, and
    # their mean depth would lie where there is nothing.
    median = np.full(some.shape, np.nan, np.float32)
    median[some] = np.nanmedian(depths[some], axis=-1)
    near = valid & (np.abs(depths - median[..., None]) <= WINNER_SPREAD_M)
    count = near.sum(-1)
    mean = np.where(
        count > 0,
        (values * near).sum(-1) / np.maximum(count, 1),
        (values * valid).sum(-1) / np.maximum(valid.sum(-1), 1),
    )
    return median, mean.astype(np.float32), _cell_mean(margin).astype(np.float32)
