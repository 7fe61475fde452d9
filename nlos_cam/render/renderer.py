"""`render`: a scene to the depth and intensity maps that a lidar of highest-echo kind reports (S1 to S5)."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
from nlos_calibration.arrays import Float32
from numpy.typing import NDArray

from nlos_cam.errors import SceneError
from nlos_cam.frames import MAP_COLUMNS, WINNER_SPREAD_M
from nlos_cam.render import backend_numba, backend_reference
from nlos_cam.render.accuracy import Accuracy, accuracy_named
from nlos_cam.render.echoes import MultiBounce, add_direct, compete, nothing, spread, strongest
from nlos_cam.render.effects import Effects, Plan, included
from nlos_cam.render.geometry import gate_bins
from nlos_cam.render.job import TransportJob, near_legs
from nlos_cam.render.planning import Prepared
from nlos_cam.render.scene import Scene

Implementation = Callable[[TransportJob], NDArray[np.floating[Any]]]
BACKENDS = "cpu", "torch", "cuda"
"""numba; torch on the CPU; torch on a GPU."""
TOGETHER = 16
"""Objects that torch works on at a time: by then starting its kernels takes next to nothing of their time."""


@dataclass(frozen=True)
class Rendering:
    """What the lidar reports of a scene, free of sensor noise."""

    depth_m: Float32
    """(64, 80); along the optical axis, NaN where nothing returns. Of several beams per cell, their median."""
    intensity: Float32
    """(64, 80); in units of I0. Of several beams per cell, the mean of those within 1 cm of the median."""
    margin: Float32
    """(64, 80); how far the winner stands above the runner-up, as a share of the winner: 0 is a tie."""
    multi: MultiBounce
    """Of every beam."""
    plan: Plan
    accuracy: Accuracy
    near_legs: int
    """Legs between patches and wall so short that near contact's average took the place of 1 / d^2."""
    colour: Float32 | None = None
    """(64, 80, 3); intensity in each channel of the albedo, where it has three."""


def render(
    scene: Scene,
    accuracy: str | Accuracy = "standard",
    effects: Effects = "auto",
    backend: str = "cpu",
    rows: tuple[int, int] | None = None,
) -> Rendering:
    """Depth, intensity and margin of every map cell, or of the rows from the first to before the second.

    Raises SceneError for a scene that cannot be rendered.
    """
    ready = Prepared.of(scene, accuracy_named(accuracy), effects, rows)
    job = ready.job()
    return _rendered(ready, job, None if job is None else implementation(job.accuracy, backend)(job), backend)


def _rendered(
    ready: Prepared, job: TransportJob | None, found: NDArray[np.floating[Any]] | None, backend: str
) -> Rendering:
    """What the lidar reports, from the histograms (n, bins) of a job's beams."""
    multi = _echoes(ready, found).of(ready.beams.shape)
    maps = compete(ready.beams, multi)
    colour = _colour(ready, multi, backend) if ready.channels == 3 else None
    near = near_legs(job) if job else 0
    return Rendering(*_cells(*maps), multi, ready.plan, ready.stage.accuracy, near, colour)


def render_all(
    scenes: Iterable[Scene], accuracy: str | Accuracy = "standard", effects: Effects = "auto", backend: str = "cpu"
) -> Iterator[Rendering]:
    """Render a batch: what depends on the rig alone is worked out once, and torch takes many objects at a time."""
    stop, rest = accuracy_named(accuracy), iter(scenes)
    while some := list(islice(rest, 1 if backend == "cpu" else TOGETHER)):
        ready = [Prepared.of(scene, stop, effects) for scene in some]
        jobs = [one.job() for one in ready]
        found = iter(_histograms_of_all([job for job in jobs if job is not None], stop, backend))
        for one, job in zip(ready, jobs, strict=True):
            yield _rendered(one, job, None if job is None else next(found), backend)


def transient(
    scene: Scene, accuracy: str | Accuracy = "standard", effects: Effects = "auto", backend: str = "cpu"
) -> Float32:
    """All that comes back, as histograms (64, 80, bins) over path length, from 0 in bins of the device's width.

    With beams_per_cell k they are (64 k, 80 k, bins); with the colour effect a channel axis (3) follows.
    """
    ready = Prepared.of(scene, accuracy_named(accuracy), effects)
    channels = [None] if ready.channels == 1 else [0, 1, 2]
    parts = [_mixed(_of_all(ready, ready.job(channel), backend), ready) for channel in channels]
    shaped = [part.reshape(*ready.beams.shape, -1) for part in parts]
    return shaped[0] if ready.channels == 1 else np.stack(shaped, -1)


def three_bounce(
    scene: Scene,
    accuracy: str | Accuracy = "standard",
    effects: Effects = "auto",
    backend: str = "cpu",
    chosen: NDArray[np.int64] | None = None,
) -> NDArray[np.floating[Any]]:
    """Three-bounce histograms alone (n, bins), of some beams (flat indices) or of all; float64 from the reference."""
    ready = Prepared.of(scene, accuracy_named(accuracy), effects)
    return histograms(ready, ready.job(), backend, chosen)


def histograms(
    ready: Prepared, job: TransportJob | None, backend: str, chosen: NDArray[np.int64] | None = None
) -> NDArray[np.floating[Any]]:
    """The same of what is prepared already; 0 where a beam does not light the wall."""
    lit = ready.beams.on_wall
    chosen = np.arange(len(lit)) if chosen is None else chosen
    wanted = chosen[lit[chosen]]
    if job is None or not wanted.size:
        return _spread_over(lit[chosen], np.zeros((0, job.bins), np.float32) if job else None)
    some = job if len(wanted) == len(job.foot_m) else job.some((np.cumsum(lit) - 1)[wanted])
    return _spread_over(lit[chosen], implementation(job.accuracy, backend)(some))


def _spread_over(lit: NDArray[np.bool_], found: NDArray[np.floating[Any]] | None) -> NDArray[np.floating[Any]]:
    """The histograms (k, bins) of lit beams as those (n, bins) of all, 0 for the others."""
    if found is None:
        return np.zeros((len(lit), 1), np.float32)
    every = np.zeros((len(lit), found.shape[1]), found.dtype)
    every[lit] = found
    return every


def implementation(accuracy: Accuracy, backend: str) -> Implementation:
    """Which of the three renders at an accuracy. Raises SceneError where there is no such backend, or no GPU for it."""
    if backend not in BACKENDS:
        raise SceneError(f"no backend {backend!r}: choose one of {', '.join(BACKENDS)}")
    if accuracy.sub_bins == 0:
        return backend_reference.histograms
    if backend == "cpu":
        return backend_numba.histograms
    from nlos_cam.render import backend_torch  # torch takes a second to import

    return partial(backend_torch.histograms, device=backend_torch.device_named(backend))


def _histograms_of_all(
    jobs: Sequence[TransportJob], accuracy: Accuracy, backend: str
) -> list[NDArray[np.floating[Any]]]:
    one_by_one = implementation(accuracy, backend)
    if backend == "cpu" or accuracy.sub_bins == 0:
        return [one_by_one(job) for job in jobs]
    from nlos_cam.render import backend_torch

    return [*backend_torch.histograms_of_all(jobs, backend_torch.device_named(backend))]


def _echoes(ready: Prepared, found: NDArray[np.floating[Any]] | None) -> MultiBounce:
    """The strongest bins (n,) of every beam: of three bounces, or with a pulse of some width of the whole waveform."""
    lit, bin_m = ready.beams.on_wall, ready.stage.rig.device.bin_m
    if included(ready.plan, "pulse"):
        whole = _mixed(_spread_over(lit, found).astype(np.float32, copy=False), ready)
        return replace(strongest(whole, bin_m), direct_included=True)
    return nothing(len(lit)) if found is None else strongest(found, bin_m).spread_over(lit)


def _of_all(ready: Prepared, job: TransportJob | None, backend: str) -> Float32:
    return histograms(ready, job, backend).astype(np.float32, copy=False)


def _mixed(histogram: Float32, ready: Prepared) -> Float32:
    """Direct returns and the pulse's width, added to three-bounce histograms, up to the gate."""
    device = ready.stage.rig.device
    whole = add_direct(histogram, ready.beams, device.bin_m)
    if included(ready.plan, "pulse"):
        whole = spread(whole, ready.stage.scene.pulse_ns, device.bin_m)
    return whole[:, : gate_bins(device)]


def _colour(ready: Prepared, multi: MultiBounce, backend: str) -> Float32:
    """Intensity (64, 80, 3) in each channel at the echo that won; the wall is white."""
    bin_m, rows = ready.stage.rig.device.bin_m, np.arange(multi.peak.size)
    wins = (multi.peak.ravel() > ready.beams.direct) | multi.direct_included
    at = np.nan_to_num(multi.path_m.ravel() / bin_m, nan=0).astype(np.int64)
    channels: list[Float32] = []
    for channel in range(3):
        histogram = _of_all(ready, ready.job(channel), backend)
        if multi.direct_included:
            histogram = _mixed(histogram, ready)
        value = np.where(wins, histogram[rows, np.minimum(at, histogram.shape[1] - 1)], ready.beams.direct)
        channels.append(_cell_mean(value.reshape(multi.peak.shape)).astype(np.float32))
    return np.stack(channels, -1)


def _blocks(image: NDArray[Any]) -> NDArray[Any]:
    """An image of k x k beams per cell as (rows, 80, k * k)."""
    k = image.shape[1] // MAP_COLUMNS
    return image.reshape(-1, k, MAP_COLUMNS, k).swapaxes(1, 2).reshape(-1, MAP_COLUMNS, k * k)


def _cell_mean(image: NDArray[Any]) -> NDArray[Any]:
    return _blocks(image).mean(-1)


def _cells(depth: Float32, intensity: Float32, margin: Float32) -> tuple[Float32, Float32, Float32]:
    """Maps of beams to maps of cells, as frames are reduced to cells."""
    if depth.shape[1] == MAP_COLUMNS:
        return depth, intensity, margin
    depths, values = _blocks(depth), _blocks(intensity)
    valid = ~np.isnan(depths)
    some = valid.any(-1)
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
