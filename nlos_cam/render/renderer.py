"""`render`: a scene to the depth and intensity maps that a lidar of highest-echo kind reports (S1 to S5)."""

import time
from dataclasses import dataclass, replace

import numpy as np
from nlos_calibration.rig import Rig
from numpy.typing import NDArray

from nlos_cam.frames import Float32
from nlos_cam.render import cpu, reference
from nlos_cam.render.accuracy import Accuracy, accuracy_named
from nlos_cam.render.beams import SPEED_OF_LIGHT_M_PER_S, Beams, cast
from nlos_cam.render.effects import Plan, included, plan
from nlos_cam.render.relay import NO_OCCLUDER, Relay, occluder_edge, relay_cells
from nlos_cam.render.scene import Patches, Scene
from nlos_cam.render.visibility import height_field, horizon_table

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MultiBounce:
    """The strongest and second strongest three-bounce bins of each beam."""

    peak: Float32
    """(64, 80); 0 where no path comes back."""
    runner_up: Float32
    """(64, 80)."""
    path_m: Float32
    """(64, 80); path length at the strongest bin's centre, NaN where there is none."""


@dataclass(frozen=True)
class Rendering:
    """What the lidar reports of a scene, free of sensor noise."""

    depth_m: Float32
    """(64, 80); along the optical axis, NaN where nothing returns."""
    intensity: Float32
    """(64, 80); in units of I0."""
    margin: Float32
    """(64, 80); how far the winner stands above the runner-up, as a share of the winner: 0 is a tie."""
    multi: MultiBounce
    plan: Plan
    seconds: dict[str, float]
    """Time spent, by effect."""
    accuracy: str


def render(scene: Scene, accuracy: str = "standard") -> Rendering:
    """Depth, intensity and margin of every map cell."""
    setting = accuracy_named(accuracy)
    started = time.perf_counter()
    beams = cast(scene.rig, scene.cell_intrinsics)
    verdicts = plan(scene, beams, setting.tolerance)
    seconds = {"direct": time.perf_counter() - started}
    histogram = _transient(scene, beams, setting, verdicts, seconds)
    multi = strongest(histogram, scene.rig.device.bin_m)
    depth, intensity, margin = compete(beams, multi)
    shape = beams.shape
    multi = MultiBounce(multi.peak.reshape(shape), multi.runner_up.reshape(shape), multi.path_m.reshape(shape))
    maps = depth.reshape(shape), intensity.reshape(shape), margin.reshape(shape)
    return Rendering(*maps, multi, verdicts, seconds, accuracy)


def transient(scene: Scene, accuracy: str = "standard") -> Float32:
    """The three-bounce histograms (64, 80, bins) over path length, from 0 in bins of the device's width."""
    setting = accuracy_named(accuracy)
    beams = cast(scene.rig, scene.cell_intrinsics)
    histogram = _transient(scene, beams, setting, plan(scene, beams, setting.tolerance), {})
    return histogram.reshape(*beams.shape, -1)


def reference_transient(scene: Scene, chosen: NDArray[np.int64]) -> Array:
    """The brute-force histograms (len(chosen), bins) of some beams (flat indices) that light the wall."""
    setting = accuracy_named("reference")
    beams = cast(scene.rig, scene.cell_intrinsics)
    verdicts = plan(scene, beams, setting.tolerance)
    patches, relay, edge = _stage(scene, beams, setting, verdicts)
    if patches is None or scene.object_depth_m is None:
        return np.zeros((len(chosen), 1))
    bin_m = scene.rig.device.bin_m
    field = height_field(scene.object_depth_m, scene.box, shades=included(verdicts, "self-occlusion"))
    bins = _bins(scene.rig, beams, patches, bin_m)
    return reference.transient(beams, chosen, patches, relay, edge, field, bin_m, bins)


def _stage(
    scene: Scene,
    beams: Beams,
    setting: Accuracy,
    verdicts: Plan,
) -> tuple[Patches | None, Relay, tuple[float, float]]:
    """Patches, relay wall and occluder as the plan wants them."""
    patches = scene.patches if included(verdicts, "three-bounce") else None
    if patches is not None and not included(verdicts, "tilt"):
        level = np.zeros_like(patches.normal)
        level[:, 2] = -1.0
        patches = replace(patches, normal=level, beta=np.ones_like(patches.beta))
    relay = relay_cells(scene.rig, beams.lidar_m, setting.relay_columns, setting.relay_rows)
    return patches, relay, occluder_edge(scene.rig) if included(verdicts, "occluder") else NO_OCCLUDER


def _transient(scene: Scene, beams: Beams, setting: Accuracy, verdicts: Plan, seconds: dict[str, float]) -> Float32:
    """Histograms (n, bins) of every beam, and the time each effect took."""
    patches, relay, edge = _stage(scene, beams, setting, verdicts)
    count = len(beams.length_m)
    if patches is None or scene.object_depth_m is None or not beams.on_wall.any():
        return np.zeros((count, 1), np.float32)
    bin_m, chosen = scene.rig.device.bin_m, np.flatnonzero(beams.on_wall)
    bins = _bins(scene.rig, beams, patches, bin_m)
    histogram = np.zeros((count, bins), np.float32)
    started = time.perf_counter()
    field = height_field(scene.object_depth_m, scene.box, shades=included(verdicts, "self-occlusion"))
    if setting.sub_bins == 0:
        histogram[chosen] = reference.transient(beams, chosen, patches, relay, edge, field, bin_m, bins)
    else:
        horizons = horizon_table(field, patches.point_m)
        seconds["self-occlusion"] = time.perf_counter() - started
        started, sub = time.perf_counter(), setting.sub_bins
        fine = cpu.transient(beams, chosen, patches, relay, edge, horizons, bin_m / sub, bins * sub)
        histogram[chosen] = fine.reshape(len(chosen), bins, sub).sum(-1)
    seconds["three-bounce"] = time.perf_counter() - started
    return histogram


def _bins(rig: Rig, beams: Beams, patches: Patches, bin_m: float) -> int:
    """Bins up to the longest possible path or the gate, whichever is shorter."""
    feet = beams.foot_m[beams.on_wall]
    wall = rig.relay
    relay_corner = np.abs([[wall.x_min_m, wall.y_min_m], [wall.x_max_m, wall.y_max_m]]).max(0)
    corner = np.append(np.maximum(np.abs(feet[:, :2]).max(0), relay_corner), 0.0)
    reach = np.linalg.norm(corner + np.abs(patches.point_m).max(0))
    longest = beams.length_m[beams.on_wall].max() + 2 * reach + np.linalg.norm([*relay_corner, beams.lidar_m[2]])
    return int(np.ceil(min(longest, SPEED_OF_LIGHT_M_PER_S * rig.device.gate_s) / bin_m))


def strongest(histogram: NDArray[np.floating], bin_m: float) -> MultiBounce:
    """The strongest and second strongest bins of histograms (n, bins); ties go to the shortest path."""
    rows = np.arange(len(histogram))
    winner = histogram.argmax(1)
    peak = histogram[rows, winner]
    others = histogram.copy()
    others[rows, winner] = 0
    path = np.where(peak > 0, (winner + 0.5) * bin_m, np.nan)
    return MultiBounce(peak.astype(np.float32), others.max(1).astype(np.float32), path.astype(np.float32))


def compete(beams: Beams, multi: MultiBounce) -> tuple[Float32, Float32, Float32]:
    """S5: depth, intensity and margin (n,) of the strongest echo of each beam; a tie goes to the direct return."""
    direct, peak = beams.direct.astype(np.float32), multi.peak
    wins = peak > direct
    intensity = np.where(wins, peak, direct)
    second = np.maximum(np.where(wins, direct, peak), multi.runner_up)
    length = np.where(wins, multi.path_m / 2, beams.length_m)
    depth = np.where(intensity > 0, length * beams.cos_axis, np.nan)
    margin = np.where(intensity > 0, 1 - second / np.maximum(intensity, np.finfo(np.float32).tiny), 0)
    return depth.astype(np.float32), intensity, margin.astype(np.float32)
