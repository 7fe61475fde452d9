"""Renderer: a scene to the depth and intensity maps of a lidar that reports its strongest echo (S1
to S5).

`render_scan` follows the raster of the MEMS mirror: rows are scanned one after another while
objects move.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from math import ceil
from typing import Any

import numpy as np
from nlos_calibration.arrays import Float32, Float64
from numpy.typing import NDArray

from nlos_cam.errors import SceneError
from nlos_cam.frames import MAP_COLUMNS, MAP_ROWS, WINNER_SPREAD_M
from nlos_cam.render import backend_cpu, backend_reference
from nlos_cam.render.accuracy import Accuracy, accuracy_named
from nlos_cam.render.echoes import (
    MultiBounce,
    StoppedBeams,
    add_direct,
    compete,
    no_echoes,
    strongest,
    with_pulse,
)
from nlos_cam.render.effects import Effect, Effects, Plan
from nlos_cam.render.energy_survey import CAUTION
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
SceneAt = Callable[[float], Scene]
"""Function from the time of the scan, 0 (top row) to 1 (bottom row), to the scene."""
PROBES = 48
"""Beams from which the change by motion is estimated."""
FINEST_SHARE = 2e-2
"""Smallest change of the transient within a slice of a scan: thinner slices are not made."""


@dataclass(frozen=True)
class Rendering:
    """Maps that the lidar reports of a scene, free of sensor noise."""

    depth_m: Float32
    """(64, 80); along the optical axis, NaN where nothing returns. Median of the beams in a
    cell.
    """
    intensity: Float32
    """(64, 80); in units of I0. Mean of the beams in a cell within 1 cm of the median depth."""
    margin: Float32
    """(64, 80); 1 - second / strongest echo: 0 is a tie."""
    multi: MultiBounce
    """Echoes of every beam."""
    plan: Plan
    accuracy: Accuracy
    near_legs: int
    """Number of legs between patches and wall so short that the near-contact average replaced 1 /
    d^2.
    """
    color: Float32 | None = None
    """(64, 80, 3); intensity in each channel of the albedo; None unless it has three and the object
    returns light.
    """


def render(
    scene: Scene,
    accuracy: str | Accuracy = "standard",
    effects: Effects = "auto",
    backend: str = "cpu",
    rows: tuple[int, int] | None = None,
) -> Rendering:
    """Return depth, intensity and margin of every map cell, or of the rows [first, second).

    Raises SceneError for a scene that cannot be rendered, or rows that the map does not have.
    """
    start, end = rows or (0, MAP_ROWS)
    if not 0 <= start < end <= MAP_ROWS:
        raise SceneError(f"rows are {start} to {end}: choose some of 0 to {MAP_ROWS}")
    facts = SceneFacts(scene, accuracy_named(accuracy))
    problem = RenderProblem.of(facts, plan(facts, effects), rows)
    return _rendering(problem, _echoes(problem, backend), backend)


def render_all(
    scenes: Iterable[Scene],
    accuracy: str | Accuracy = "standard",
    effects: Effects = "auto",
    backend: str = "cpu",
) -> Iterator[Rendering]:
    """Yield the renderings of many scenes; torch works on batches of BATCH_OBJECTS."""
    setting = accuracy_named(accuracy)
    rest = iter(scenes)
    while batch := list(islice(rest, 1 if backend == "cpu" else BATCH_OBJECTS)):
        problems = [prepare(scene, setting, effects) for scene in batch]
        for problem, echoes in zip(
            problems, _echoes_of_all(problems, setting, backend), strict=True
        ):
            yield _rendering(problem, echoes, backend)


def transient(
    scene: Scene,
    accuracy: str | Accuracy = "standard",
    effects: Effects = "auto",
    backend: str = "cpu",
) -> Float32:
    """Return all light that comes back, as histograms (64, 80, bins) over path length in bins of
    `device.bin_m`.

    With beams_per_cell k they are (64 k, 80 k, bins); with the color effect a channel axis (3)
    follows.
    """
    problem = prepare(scene, accuracy_named(accuracy), effects, bounded=False)
    lights = problem.channels or [problem]
    parts = _as_long(
        [_waveforms(each, beam_histograms(each, each.job, backend)) for each in lights]
    )
    shaped = [part.reshape(*problem.beams.shape, -1) for part in parts]
    return np.stack(shaped, -1) if problem.color_jobs else shaped[0]


def _as_long(parts: Sequence[Histograms]) -> list[Histograms]:
    """Return histograms (n, bins), all with the bins of the longest: a channel in which the object
    is black ends with its direct returns.
    """
    bins = max(part.shape[1] for part in parts)
    return [
        part if part.shape[1] == bins else np.pad(part, [(0, 0), (0, bins - part.shape[1])])
        for part in parts
    ]


@dataclass(frozen=True)
class TransientAxes:
    """Axes of the histograms of `transient`: bins, beams and relay cells, in the wall frame."""

    path_m: Float64
    """(n,); middle of each bin up to the gate: bin k holds paths from k to k + 1 times `bin_m`.
    `transient` ends with the last bin that can hold light: its bins are the first of these.
    """
    bin_m: float
    """Width of a bin as path length; the first begins at the lidar (path 0), when the pulse
    leaves. Divided by the speed of light it is the time of flight.
    """
    lidar_m: Float64
    """(3,); where all light leaves and comes back."""
    laser_spots_m: Float64
    """(rows, columns, 3); where each beam lands on wall or occluder as if nothing were hidden; NaN
    where it meets nothing."""
    relay_m: Float64
    """(n, 3); centers of the relay wall's cells as if nothing stood in front of it: none comes back
    from those that occluder or object hide."""


def transient_axes(scene: Scene, accuracy: str | Accuracy = "standard") -> TransientAxes:
    """Return bins, beams and relay points of `transient` of the same scene and accuracy."""
    facts = SceneFacts(scene, accuracy_named(accuracy))
    beams = facts.beams()
    relay = facts.relay
    device = scene.rig.device
    bins = gate_bins(device)
    return TransientAxes(
        (np.arange(bins, dtype=np.float64) + 0.5) * device.bin_m,
        device.bin_m,
        beams.lidar_m,
        beams.laser_spot_m.reshape(*beams.shape, 3),
        np.column_stack([relay.x_m, relay.y_m, np.zeros(len(relay.x_m))]),
    )


def three_bounce(
    scene: Scene,
    accuracy: str | Accuracy = "standard",
    effects: Effects = "auto",
    backend: str = "cpu",
    chosen: NDArray[np.int64] | None = None,
) -> Histograms:
    """Return the three-bounce histograms (n, bins) alone, of chosen beams (flat indices) or of
    all.
    """
    problem = prepare(scene, accuracy_named(accuracy), effects, bounded=False)
    if not problem.mixes_colors:
        return beam_histograms(problem, problem.job, backend, chosen)
    return _mean(beam_histograms(problem, job, backend, chosen) for job in problem.color_jobs)


def _mean(parts: Iterable[Histograms]) -> Histograms:
    """Return the mean of histograms (n, bins) of several lengths; one is held beside the sum."""
    rest = iter(parts)
    total = next(rest)
    count = 1
    for part in rest:
        total, longer = _as_long([total, part])
        total = total + longer
        count += 1
    return total / count


def beam_histograms(
    problem: RenderProblem,
    job: TransportJob | None,
    backend: str,
    chosen: NDArray[np.int64] | None = None,
) -> Histograms:
    """Return the three-bounce histograms of a job's beams, or of the chosen; 0 for beams that miss
    the wall.
    """
    _check_backend(backend)
    lit = problem.beams.on_wall
    chosen = np.arange(len(lit)) if chosen is None else chosen
    # A job holds the beams that light the wall alone, in their order: the running count of lit
    # beams is a beam's place among them.
    wanted = chosen[lit[chosen]]
    if job is None or not wanted.size:
        return np.zeros((len(chosen), job.bins if job else 1), np.float32)
    places = (np.cumsum(lit) - 1)[wanted]
    is_whole = np.array_equal(places, np.arange(len(job.laser_spot_m)))
    some = job if is_whole else job.select(places)
    return _spread_over(lit[chosen], transport(some, backend))


def transport(job: TransportJob | None, backend: str) -> Histograms | None:
    """Return the three-bounce histograms (n, bins) of a job's beams by one of the backends; None
    for no job.

    An accuracy without sub-bins is the reference, on any backend. Raises SceneError if there is no
    such backend or GPU.
    """
    _check_backend(backend)
    if job is None:
        return None
    if job.accuracy.sub_bins == 0:
        return backend_reference.histograms(job)
    if backend == "cpu":
        return backend_cpu.histograms(job)
    from nlos_cam.render import backend_torch  # torch takes a second to import

    return backend_torch.histograms(job, backend_torch.device_named(backend))


def _check_backend(backend: str) -> None:
    """Raise SceneError if there is no backend of that name, also where nothing calls for it."""
    if backend not in BACKENDS:
        raise SceneError(f"no backend {backend!r}: choose one of {', '.join(BACKENDS)}")


def _echoes(problem: RenderProblem, backend: str) -> MultiBounce:
    """Return the strongest bins (n,) of all beams, from a part of the transport where the backend
    can do that.
    """
    job = problem.job
    if problem.mixes_colors and job is not None:  # then the channels' jobs are not None either
        every = (transport(one, backend) for one in problem.color_jobs)
        return _strongest(problem, _mean(one for one in every if one is not None))
    # A pulse mixes neighbouring bins, so that the strongest bin before it may not be the strongest
    # after it: only a waveform without one may be summed in part.
    if backend == "cpu" and job and job.accuracy.sub_bins and not problem.includes("pulse"):
        return backend_cpu.echoes(job).spread_over(problem.beams.on_wall)
    return _strongest(problem, transport(job, backend))


def _echoes_of_all(
    problems: Sequence[RenderProblem], accuracy: Accuracy, backend: str
) -> Iterable[MultiBounce]:
    """Return the strongest bins of every problem, torch's in one batch."""
    mixed = any(problem.mixes_colors for problem in problems)
    if backend not in {"torch", "cuda"} or accuracy.sub_bins == 0 or mixed:
        return [_echoes(problem, backend) for problem in problems]
    from nlos_cam.render import backend_torch

    device = backend_torch.device_named(backend)
    jobs = [problem.job for problem in problems]
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
    echoes = replace(echoes.reshape(problem.beams.shape), stopped=_stopped(problem))
    depth, intensity, margin = compete(problem.beams, echoes)
    color = _color(problem, echoes, depth, backend) if problem.color_jobs else None
    near = count_near_legs(problem.job) if problem.job else 0
    return Rendering(
        *_cells(depth, intensity, margin), echoes, problem.plan, problem.accuracy, near, color
    )


def _stopped(problem: RenderProblem) -> StoppedBeams | None:
    """Return the beams that the object stops, with what it returns of them; None where it stops
    none, or where a pulse mixes their returns with the rest.
    """
    if problem.stopped is None or not problem.stopped.any() or problem.includes("pulse"):
        return None
    beams = problem.beams
    columns = (
        np.where(problem.stopped, column, np.nan).astype(np.float32).reshape(beams.shape)
        for column in (beams.direct, beams.length_m)
    )
    return StoppedBeams(*columns)


def _strongest(problem: RenderProblem, histograms: Histograms | None) -> MultiBounce:
    """Return the strongest bins (n,) of all beams: of three bounces, or with a pulse of the whole
    waveform.
    """
    lit = problem.beams.on_wall
    bin_m = problem.scene.rig.device.bin_m
    if problem.includes("pulse"):
        whole = _waveforms(problem, _spread_over(lit, histograms))
        found = strongest(whole, bin_m, problem.scene.pulse_ns)
        return replace(found, direct_included=True)
    if histograms is None:
        return no_echoes(len(lit))
    return strongest(histograms, bin_m).spread_over(lit)


def _waveforms(problem: RenderProblem, histograms: Histograms) -> Float32:
    """Return three-bounce histograms with direct returns added and the pulse applied, up to the
    gate.
    """
    device = problem.scene.rig.device
    # Convolution is linear, so one pulse over the sum of direct and three-bounce light stands for
    # each echo's own. What the pulse's tail carries beyond the gate is cut off.
    whole = add_direct(histograms.astype(np.float32, copy=False), problem.beams, device.bin_m)
    if problem.includes("pulse"):
        return with_pulse(whole, problem.scene.pulse_ns, device.bin_m, gate_bins(device))
    return whole[:, : gate_bins(device)]


def _color(problem: RenderProblem, echoes: MultiBounce, depth: Float32, backend: str) -> Float32:
    """Return the intensity (64, 80, 3) of each channel in the bin of the winning echo, of the depth
    map (rows, columns) of the beams; the wall is white.
    """
    bin_m = problem.scene.rig.device.bin_m
    beams = np.arange(echoes.peak.size)
    # The winner is chosen on the mean albedo, as a lidar of one wavelength would; the channels only
    # share its bin. Choosing anew in each channel could give one beam three depths.
    wins = (echoes.peak.ravel() > problem.beams.direct) | echoes.direct_included
    at = np.nan_to_num(echoes.path_m.ravel() / bin_m, nan=0).astype(np.int64)
    channels: list[Float32] = []
    for own in problem.channels:
        histogram = beam_histograms(own, own.job, backend).astype(np.float32, copy=False)
        if echoes.direct_included:
            histogram = _waveforms(own, histogram)
        value = np.where(
            wins, histogram[beams, np.minimum(at, histogram.shape[1] - 1)], own.beams.direct
        )
        value = value.reshape(echoes.peak.shape).astype(np.float32)
        # over the beams that make a cell's intensity: the channels' mean is that intensity
        channels.append(_cells(depth, value, echoes.peak)[1])
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
    depths = _blocks(depth)
    values = _blocks(intensity)
    valid = ~np.isnan(depths)
    some = valid.any(-1)
    # Median of depth, then mean of the intensities near it: a cell across an edge holds two echoes
    # at two depths, and their mean depth would lie where there is nothing.
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


def scan_effect(scene_at: SceneAt, accuracy: str | Accuracy = "standard") -> Effect:
    """Return the verdict on the raster: the change of the transient from the top row's instant to
    the bottom row's.
    """
    # Only the ends of the scan are compared: an object that comes back within it would go unseen,
    # but a scan lasts 1/30 s.
    setting = accuracy_named(accuracy)
    first = scene_at(0.0)
    last = scene_at(1.0)
    change = 0.0 if _alike(first, last) else min(CAUTION * _change(first, last), 1.0)
    reason = (
        f"motion changes {change:.3g} of the transient during a scan" if change else "nothing moves"
    )
    return Effect("scan-time", change > setting.tolerance, reason, change)


def render_scan(
    scene_at: SceneAt, accuracy: str | Accuracy = "standard", effects: Effects = "auto"
) -> Rendering:
    """Return one frame of a raster: slices of rows, each at the instant of its middle row; the
    first gives the plan.
    """
    setting = accuracy_named(accuracy)
    verdict = scan_effect(scene_at, setting)
    count = slices(verdict, setting)
    parts: list[Rendering] = []
    for rows in np.array_split(np.arange(MAP_ROWS), count):
        # The middle of a slice makes the error of its timing odd in the row, so that it cancels to
        # first order.
        share = float(rows.mean() + 0.5) / MAP_ROWS if verdict.included else 0.0
        parts.append(
            render(scene_at(share), setting, effects, rows=(int(rows[0]), int(rows[-1]) + 1))
        )
    return _joined(parts, verdict)


def slices(verdict: Effect, setting: Accuracy) -> int:
    """Return the number of instants of a scan: within one, at most FINEST_SHARE or the tolerance
    changes.
    """
    if not verdict.included:
        return 1
    # Change is taken as linear over the scan: a slice of 1 / n of the rows then changes 1 / n of
    # the bound. Two slices are the fewest that show motion at all, and more than one a row there
    # cannot be.
    return int(np.clip(ceil(verdict.bound / max(setting.tolerance, FINEST_SHARE)), 2, MAP_ROWS))


def _joined(parts: list[Rendering], verdict: Effect) -> Rendering:
    """Return renderings of some rows each as one of all rows."""

    def stacked(name: str, of: Callable[[Rendering], object] = lambda part: part) -> NDArray[Any]:
        return np.concatenate([getattr(of(part), name) for part in parts])

    multi = {
        name: stacked(name, lambda part: part.multi) for name in ("peak", "runner_up", "path_m")
    }
    stopped = _joined_stops([part.multi for part in parts])
    return replace(
        parts[0],
        **{name: stacked(name) for name in ("depth_m", "intensity", "margin")},
        multi=replace(parts[0].multi, **multi, stopped=stopped),
        plan=(*parts[0].plan, verdict),
        near_legs=sum(part.near_legs for part in parts),
        color=None if any(part.color is None for part in parts) else stacked("color"),
    )


def _joined_stops(parts: list[MultiBounce]) -> StoppedBeams | None:
    """Return the beams that the object stops in echoes of some rows each as those of all rows."""
    if all(part.stopped is None for part in parts):
        return None
    pairs: list[StoppedBeams] = []
    for part in parts:
        nothing = np.full_like(part.peak, np.nan)
        pairs.append(part.stopped or StoppedBeams(nothing, nothing))
    return StoppedBeams(*(np.concatenate(columns) for columns in zip(*pairs, strict=True)))


def _alike(one: Scene, other: Scene) -> bool:
    if one.object_depth_m is None or other.object_depth_m is None:
        return one.object_depth_m is other.object_depth_m
    return np.array_equal(one.object_depth_m, other.object_depth_m, equal_nan=True)


def _change(first: Scene, last: Scene) -> float:
    """Return the relative L1 between the transients of two instants, on some beams at draft."""
    count = first.cell_intrinsics.width * first.cell_intrinsics.height
    chosen = np.arange(count)[:: count // PROBES]
    # Few beams at the coarsest accuracy: a bound on motion is wanted, not its picture.
    one, other = (three_bounce(scene, "draft", chosen=chosen) for scene in (first, last))
    # L1 over all bins, relative to the light: an echo that leaves one bin for the next counts as
    # lost and as new.
    bins = max(one.shape[1], other.shape[1])
    one, other = (np.pad(part, [(0, 0), (0, bins - part.shape[1])]) for part in (one, other))
    whole = float(np.abs(other).sum())
    return float(np.abs(one - other).sum()) / whole if whole > 0 else float(one.any())
