"""Reality: our renderer beside measured three-bounce light of two public sets.

    python tools/studies/reality.py a|b|c|d|all [--data FOLDER]

a  arrival of the light from five moving objects (Keyhole Imaging, 16 ps bins)
b  fall of their light with distance
c  third bounce over direct light, for a sensor 0.23 m from its wall (consumer-nlos, 88 ps bins)
d  back-projection of that set's hidden U beside a rendered one

FOLDER holds keyhole_*.npz and tmf8828_u.npz (default: $NLOS_CAM_MEASURED). Each part replaces its
own entry of docs/figures/reality.json and its picture.
"""

import argparse
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import harness
import numpy as np
from matplotlib.figure import Figure
from nlos_calibration import (
    DeviceConstants,
    Extent,
    LidarPose,
    ObjectBox,
    PinholeRecord,
    Rig,
)
from nlos_calibration.arrays import Float64
from numpy.typing import NDArray

from nlos_cam.objects import orthographic_depth, triangulate
from nlos_cam.render import (
    EFFECTS,
    Accuracy,
    Effect,
    RenderProblem,
    Scene,
    SceneFacts,
    Surface,
    backend_reference,
    retroreflective,
)

LIGHT_M_PER_S = 299_792_458.0
OBJECTS = "E", "K", "Y", "Mannequin", "Mannequin_Assymetric"
LIDAR_M = 1.0
"""Distance of the confocal spot's lidar: any, as its legs are taken off again."""
MIDDLE_BEAM = 32 * 80 + 40
RADIOMETRIES = "paper", "lambertian"
MATERIALS = {"matt": Surface(1.0), "retroreflective": Surface(1.0, retroreflective(0.1, 0.9, 200))}
SIZES_M = 0.02, 0.3, 0.6
"""Heights of the objects, which the set does not give: nearly a point, half of the window that the
authors reconstruct, and all of it.
"""
SHAPES: dict[str, Sequence[tuple[float, float]]] = {
    "E": [
        *[(0, 0), (6, 0), (6, 2), (2, 2), (2, 4), (5, 4), (5, 6), (2, 6), (2, 8), (6, 8)],
        *[(6, 10), (0, 10)],
    ],
    "K": [
        *[(0, 0), (2, 0), (2, 4), (4.5, 0), (7, 0), (3.5, 5), (7, 10), (4.5, 10), (2, 6)],
        *[(2, 10), (0, 10)],
    ],
    "Y": [(3, 0), (5, 0), (5, 4), (8, 10), (5.7, 10), (4, 6), (2.3, 10), (0, 10), (3, 4)],
    "Mannequin": [(1, 0), (4, 0), (5, 8), (3, 8.4), (3, 10), (2, 10), (2, 8.4), (0, 8)],
    "Mannequin_Assymetric": [
        *[(1, 0), (4, 0), (5, 7.5), (8, 9), (7.5, 9.8), (3, 8.4), (3, 10), (2, 10), (2, 8.4)],
        (0, 8),
    ],
    "U": [(0, 0), (4.6, 0), (4.6, 5.5), (3.6, 5.5), (3.6, 1.1), (1, 1.1), (1, 5.5), (0, 5.5)],
}
"""Outlines as seen from the wall, drawn by us: the sets give none."""


@dataclass(frozen=True)
class Scan:
    """One object's scan before one wall point; the origin is that point."""

    center_m: Float64
    """(n, 3); nominal middle of the object: along the wall, up, into the room."""
    arrival_bins: Float64
    """(n,); centroid of the counts after the direct light, in bins."""
    total: Float64
    """(n,); counts without those of the captures that show no object."""
    bin_s: float


def read_scan(path: Path) -> Scan:
    """Return centroids and sums of a keyhole_*.npz file."""
    with np.load(path) as file:
        free = (
            file["no_object_before_counts"].astype(float)
            + file["no_object_after_counts"].astype(float)
        ) / 2
        first, end = (int(at) for at in file["used_bins"])
        counts = (file["counts"] - free)[:, first:end]
        total = counts.sum(1)
        arrival = counts @ np.arange(first, end) / total - float(file["t0_bin"])
        center = np.stack([file[f"object_{axis}_m"] for axis in "xyz"], 1) - file["wall_point_m"]
        return Scan(center, arrival, total, float(file["bin_s"]))


def outline(name: str, height_m: float) -> Float64:
    """Return the triangles (n, 3, 3) of a flat outline about the origin, facing the wall."""
    points = np.array([(*corner, 0.0) for corner in SHAPES[name]])
    points -= (points.min(0) + points.max(0)) / 2
    return (points * height_m / np.ptp(points[:, 1]))[triangulate(points)]


def prepared(
    rig: Rig, box: ObjectBox, triangles: Float64, look: tuple[str, Surface], relay_cells: int
) -> RenderProblem:
    """Return the problem of an object before a wall, every path by itself.

    The line of sight is left out: both sensors look at the wall, with the object behind or beside.
    """
    radiometry, surface = look
    depth = orthographic_depth(triangles, box, 20)
    scene = Scene(rig, depth, surface, radiometry)  # pyright: ignore[reportArgumentType]
    accuracy = Accuracy("reality", relay_cells, relay_cells, sub_bins=0)
    chosen = {"direct", "three-bounce", "brdf"}
    verdicts = tuple(Effect(name, name in chosen, "chosen by the study", 0.0) for name in EFFECTS)
    return RenderProblem.of(SceneFacts(scene, accuracy), verdicts)


def transported(
    problem: RenderProblem, shift_m: Float64, beams: Sequence[int] | NDArray[np.int64], bins: int
) -> Float64:
    """Return the three-bounce histograms (beams, bins) of a problem's object, moved by a shift
    (3,).
    """
    job = problem.job
    if job is None:
        raise SystemExit("error: no light reaches the object")
    # Only the patches move: the flat objects have no shadows that would move with them.
    patches = replace(job.patches, point_m=job.patches.point_m + shift_m)
    # All beams light the wall in these rigs, so beams of the map and of the job are the same.
    some = job.select(np.asarray(beams, np.int64))
    return backend_reference.histograms(replace(some, patches=patches, bins=bins))


HOME_M = np.array([0.0, -0.3, 0.8])
"""Place at which an object before one wall point is prepared."""


def box_about(center_m: Float64, half_m: float) -> ObjectBox:
    """Return a box about a place."""
    x, y, z = (float(value) for value in center_m)
    return ObjectBox(
        x_min_m=x - half_m,
        x_max_m=x + half_m,
        y_min_m=y - half_m,
        y_max_m=y + half_m,
        z_near_m=z - 0.1,
        z_far_m=z + 0.1,
    )


def confocal_problem(
    name: str, height_m: float, look: tuple[str, Surface], bin_s: float
) -> RenderProblem:
    """Return the problem of an object at HOME_M, with laser and detector at one wall point, the
    origin.

    A lens of 1e6 pixels makes all beams one, and a relay wall of 2 mm, as one cell, the detector's
    spot.
    """
    box = box_about(HOME_M, height_m * 0.52)
    rig = Rig(
        name="one-point",
        lidar=LidarPose(distance_m=LIDAR_M, yaw_deg=0),
        intrinsics=PinholeRecord(fx=1e6, fy=1e6),
        wall=Extent(x_min_m=-3, x_max_m=3, y_min_m=-3, y_max_m=3),
        relay=Extent(x_min_m=-1e-3, x_max_m=1e-3, y_min_m=-1e-3, y_max_m=1e-3),
        object_box=box,
        device=DeviceConstants(bin_m=LIGHT_M_PER_S * bin_s),
    )
    return prepared(rig, box, outline(name, height_m) + HOME_M, look, 1)


def confocal(problem: RenderProblem, center_m: Float64) -> tuple[float, float]:
    """Return arrival in bins after the direct light, and light, of an object moved to a place."""
    histogram = transported(problem, center_m - HOME_M, [MIDDLE_BEAM], 1400)[0]
    total = float(histogram.sum())
    # Light of bin k has lengths from k to k + 1 bins.
    middle = float(histogram @ (np.arange(len(histogram)) + 0.5)) / total
    return middle - 2 * LIDAR_M / problem.scene.rig.device.bin_m, total


def point_arrival(center_m: Float64, bin_s: float) -> Float64:
    """Return the bins (n,) from a wall point at the origin to points (n, 3) and back."""
    return 2 * np.linalg.norm(center_m, axis=-1) / (LIGHT_M_PER_S * bin_s)


Model = Callable[[Float64], Float64]
"""Arrival in bins (n,) of an object with its middle at (n, 3)."""


def arrival_model(name: str, height_m: float, bin_s: float) -> Model:
    """Return rendered arrival as a function of place, a polynomial through 60
    renderings.

    Only the difference from a point's arrival is a polynomial: it is smooth and small.
    """
    axes = (np.linspace(-0.65, 0.65, 5), np.linspace(-0.5, 0.15, 4), np.linspace(0.55, 1.1, 3))
    places = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    look = ("lambertian", MATERIALS["retroreflective"])
    problem = confocal_problem(name, height_m, look, bin_s)
    arrivals = np.array([confocal(problem, at)[0] for at in places])
    off = arrivals - point_arrival(places, bin_s)
    terms, *_ = np.linalg.lstsq(_monomials(places), off, rcond=None)
    return lambda center_m: point_arrival(center_m, bin_s) + _monomials(center_m) @ terms


def _monomials(place_m: Float64) -> Float64:
    """Return the products (n, 19) of x, y and z - 0.8 m up to the third power together, of z to the
    second: three depths are rendered.
    """
    x, y, z = (place_m - [0.0, 0.0, 0.8]).T
    powers = [(i, j, k) for i in range(4) for j in range(4 - i) for k in range(min(4 - i - j, 3))]
    return np.stack([x**i * y**j * z**k for i, j, k in powers], 1)


def fit_offsets(scan: Scan, model: Model) -> tuple[Float64, Float64]:
    """Return the offsets (3,) of the object's middle in metres that fit arrivals best, and the
    residuals (n,) in bins that are left.
    """
    # A place above the spot fits like one below it: the search stays below, within the bounds
    # where the model holds, and begins at three heights.
    low = np.array([-0.15, -0.2, -0.15])
    high = np.array([0.15, 0.33, 0.35])
    starts = [np.array([0.0, up_m, 0.05]) for up_m in (-0.1, 0.1, 0.3)]
    found = [_descend(scan, model, start, (low, high)) for start in starts]
    return min(found, key=lambda each: rms(each[1]))


def _descend(
    scan: Scan, model: Model, offset: Float64, bounds: tuple[Float64, Float64]
) -> tuple[Float64, Float64]:
    """Return the offsets and residuals that a descent from one start finds."""
    step_m = 1e-4
    for _ in range(60):
        left = scan.arrival_bins - model(scan.center_m + offset)
        slope = [
            (model(scan.center_m + offset + step) - model(scan.center_m + offset - step))
            / 2
            / step_m
            for step in step_m * np.eye(3)
        ]
        # Gauss-Newton, damped by half: the model is nearly linear in metres. A coordinate whose
        # bound keeps it from going on is left out, so that the others find their own minimum.
        jacobian = np.stack(slope, 1)
        downhill = jacobian.T @ left
        low, high = bounds
        free = ~(((offset <= low) & (downhill < 0)) | ((offset >= high) & (downhill > 0)))
        step = np.zeros(3)
        if free.any():
            step[free], *_ = np.linalg.lstsq(jacobian[:, free], left, rcond=None)
        offset = np.clip(offset + 0.5 * step, low, high)
    return offset, scan.arrival_bins - model(scan.center_m + offset)


def rms(values: Float64) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def arrivals(data: Path) -> dict[str, Any]:
    """Fit the offsets of all objects at all sizes, and draw the residuals of the best."""
    rows: list[dict[str, Any]] = []
    figure = Figure((9, 2.6), layout="constrained")
    for axes, name in zip(figure.subplots(1, len(OBJECTS), sharey=True), OBJECTS, strict=True):
        scan = read_scan(data / f"keyhole_{name}.npz")
        as_given = rms(scan.arrival_bins - point_arrival(scan.center_m, scan.bin_s))
        found = [
            (size, *fit_offsets(scan, arrival_model(name, size, scan.bin_s))) for size in SIZES_M
        ]
        best = min(found, key=lambda each: rms(each[2]))
        rows += [
            {
                "object": name,
                "height_m": size,
                "as_given_bins": as_given,
                "rms_bins": rms(left),
                "offset_mm": [round(1e3 * value, 1) for value in offset],
                "largest_bins": float(np.abs(left).max()),
            }
            for size, offset, left in found
        ]
        axes.plot(best[2], ".", ms=2)
        axes.axhline(0, lw=0.5, color="gray")
        axes.set_title(f"{name[:13]}: {rms(best[2]):.1f}", fontsize=8)
        axes.set_xlabel("position in the scan", fontsize=7)
        axes.tick_params(labelsize=7)
    figure.axes[0].set_ylabel("measured - rendered\n(bins of 16 ps)", fontsize=7)
    harness.save("reality_arrivals", figure)
    return {"rows": rows, "bin_mm_one_way": 1e3 * LIGHT_M_PER_S * 16e-12 / 2}


def exponents(center_m: Float64, total: Float64) -> dict[str, float]:
    """Return p of light ~ R^-p, and p, q with an error each of light ~ R^-p (z/R)^q."""
    distance = np.linalg.norm(center_m, axis=1)
    cosine = center_m[:, 2] / distance
    light = np.log(total)
    alone = np.polyfit(np.log(distance), light, 1)
    design = np.stack([-np.log(distance), np.log(cosine), np.ones_like(light)], 1)
    both, *_ = np.linalg.lstsq(design, light, rcond=None)
    left = light - design @ both
    spread = np.linalg.inv(design.T @ design) * (left @ left) / (len(light) - 3)
    return {
        "alone": float(-alone[0]),
        "distance": float(both[0]),
        "distance_std": float(np.sqrt(spread[0, 0])),
        "cosine": float(both[1]),
        "cosine_std": float(np.sqrt(spread[1, 1])),
    }


def falls(data: Path) -> dict[str, Any]:
    """Compare the fall of light with distance: measured, and rendered at the same places."""
    rows: list[dict[str, Any]] = []
    for name in OBJECTS:
        scan = read_scan(data / f"keyhole_{name}.npz")
        row: dict[str, Any] = {
            "object": name,
            "nearest_m": float(np.linalg.norm(scan.center_m, axis=1).min()),
            "farthest_m": float(np.linalg.norm(scan.center_m, axis=1).max()),
            "measured": exponents(scan.center_m, scan.total),
        }
        some = scan.center_m[::3]
        for radiometry in RADIOMETRIES:
            for material, surface in MATERIALS.items():
                look = (radiometry, surface)
                problem = confocal_problem(name, 0.3, look, scan.bin_s)
                light = [confocal(problem, at)[1] for at in some]
                row[f"{radiometry} {material}"] = exponents(some, np.array(light))
        rows.append(row)
    return {"rows": rows}


@dataclass(frozen=True)
class Zones:
    """Histograms of a small sensor's zones at several places, and the way that each looks."""

    counts: Float64
    """(places, 9, bins)."""
    sensor_m: Float64
    """(places, 3); the wall is WALL_M ahead, towards +z."""
    ray: Float64
    """(9, 3), unit."""
    direct_bin: Float64
    """(places, 9); bin of the direct light's peak."""
    bin_s: float
    gate: tuple[int, int]
    """Bins after the direct peak that hold the third bounce."""

    @property
    def above_background(self) -> Float64:
        """Counts less the 20th percentile over the places, for each zone and bin."""
        return self.counts - np.percentile(self.counts, 20, axis=0)


WALL_M = 0.23
U_CENTER_M = np.array([0.61, 0.655])
U_HEIGHT_M = 0.55
U_Z_M = -0.29
"""Place and size of the U as the picture of the measured light shows it: its real ones are not
published.
"""
REACH = 0.45
"""Tangent of the half angle of all zones together."""
TMF_START_BIN = 13


def read_zones(path: Path) -> Zones:
    """Return the histograms of tmf8828_u.npz at the places that are known."""
    with np.load(path) as file:
        known = file["position_known"]
        counts = file["counts"][known].reshape(known.sum(), 9, -1)
        ray = file["zone_direction"].reshape(9, 3)
        gate = tuple(int(at) for at in file["used_bins_after_direct"])
        peak = counts.argmax(-1).astype(float)
        bin_s = float(file["bin_s"])
        return Zones(counts, file["sensor_position_m"][known], ray, peak, bin_s, (gate[0], gate[1]))


def response(zones: Zones) -> Float64:
    """Return the mean shape of direct light (25,), its peak 1 at index 5: the sensor's pulse."""
    cut = [
        histogram[int(peak) - 5 : int(peak) + 20] / histogram[int(peak)]
        for histogram, peak in zip(
            zones.counts.reshape(-1, zones.counts.shape[-1]), zones.direct_bin.ravel(), strict=True
        )
    ]
    mean = np.mean(cut, 0)
    return mean - min(mean[:3].mean(), mean[-3:].mean())


def zone_problem(look: tuple[str, Surface], bin_s: float) -> RenderProblem:
    """Return the problem of the U straight before the sensor, with the origin at its foot.

    By reciprocity, light that floods all zones and returns into one travels as light from that
    zone that returns into all: the zone's beams scan, and the relay wall is what all zones see.
    """
    half = REACH * WALL_M
    center = np.array([0.0, 0.0, WALL_M - U_Z_M])
    box = box_about(center, 0.3)
    rig = Rig(
        name="zones",
        lidar=LidarPose(distance_m=WALL_M, yaw_deg=0),
        intrinsics=PinholeRecord(fx=320 / REACH, fy=240 / REACH),
        wall=Extent(x_min_m=-3, x_max_m=3, y_min_m=-3, y_max_m=3),
        relay=Extent(x_min_m=-half, x_max_m=half, y_min_m=-half, y_max_m=half),
        object_box=box,
        device=DeviceConstants(bin_m=LIGHT_M_PER_S * bin_s),
    )
    return prepared(rig, box, outline("U", U_HEIGHT_M) + center, look, 10)


def render_zones(zones: Zones, look: tuple[str, Surface]) -> tuple[Zones, Float64]:
    """Return the third bounce that zones at the same places would measure of a U, as a share of
    their direct peak, and the same before the background is taken off.
    """
    pulse = response(zones)
    beams = np.add.outer(np.arange(3, 64, 7) * 80, np.arange(4, 80, 8)).ravel()
    tangent = zones.ray[:, :2] / zones.ray[:, 2:]
    problem = zone_problem(look, zones.bin_s)
    spot = problem.beams.laser_spot_m[beams, :2] / WALL_M
    zone = np.linalg.norm(spot[:, None] - tangent, axis=-1).argmin(1)
    direct = np.bincount(zone, problem.beams.direct[beams], 9)[:, None]
    bins = zones.counts.shape[-1]
    every: list[Float64] = []
    for sensor_m in zones.sensor_m:
        shift = np.array([*(U_CENTER_M - sensor_m[:2]), 0.0])
        third = transported(problem, shift, beams, bins - TMF_START_BIN)
        light = np.stack([third[zone == number].sum(0) for number in range(9)]) / direct
        whole = np.pad(light, ((0, 0), (TMF_START_BIN, 0)))
        every.append(np.array([np.convolve(row, pulse)[5 : 5 + bins] for row in whole]))
    length = WALL_M / zones.ray[:, 2]
    # Light of the direct path fills a bin about its middle, as the third bounce does.
    direct_bin = TMF_START_BIN + 2 * length / (LIGHT_M_PER_S * zones.bin_s) - 0.5
    places = np.broadcast_to(direct_bin, zones.direct_bin.shape)
    made = np.array(every)
    found = Zones(made, zones.sensor_m, zones.ray, places, zones.bin_s, zones.gate)
    return found, gated_peak(found, made)


def gated_peak(zones: Zones, counts: Float64) -> Float64:
    """Return the highest value (places, 9) of counts inside the gate of the third bounce."""
    bins = np.arange(counts.shape[-1])
    after = bins - np.round(zones.direct_bin)[..., None]
    inside = (after >= zones.gate[0]) & (after < zones.gate[1])
    return np.where(inside, counts, -np.inf).max(-1)


def percentiles(ratio: Float64) -> dict[str, float]:
    """Return the 10th, 50th and 90th percentile of ratios."""
    low, median, high = np.percentile(ratio, [10, 50, 90])
    return {"p10": float(low), "median": float(median), "p90": float(high)}


def measured_ratio(zones: Zones) -> Float64:
    """Return the third bounce's peak over the direct peak (places, 9)."""
    return gated_peak(zones, zones.above_background) / zones.counts.max(-1)


def ratios(data: Path) -> dict[str, Any]:
    """Compare third bounce over direct: measured, and with both radiometries and materials."""
    zones = read_zones(data / "tmf8828_u.npz")
    measured = measured_ratio(zones)
    result: dict[str, Any] = {"measured": percentiles(measured)}
    figure = Figure((5, 2.8), layout="constrained")
    axes = figure.subplots()
    curves = {"measured": measured}
    for radiometry in RADIOMETRIES:
        for material, surface in MATERIALS.items():
            _, ratio = render_zones(zones, (radiometry, surface))
            log = [np.log(np.maximum(each, 1e-6)).ravel() for each in (measured, ratio)]
            result[f"{radiometry} {material}"] = percentiles(ratio) | {
                "correlation_of_logs": float(np.corrcoef(log)[0, 1])
            }
            curves[f"{radiometry}, {material}"] = ratio
    for name, ratio in curves.items():
        values = np.sort(ratio.ravel())
        axes.semilogx(np.maximum(values, 1e-6), np.linspace(0, 1, values.size), label=name, lw=1)
    axes.set_xlabel("third bounce over direct, peak over peak")
    axes.set_ylabel("share of 324 histograms")
    axes.legend(fontsize=7)
    harness.save("reality_ratio", figure)
    return result


AXES_M = np.linspace(0.1, 1.2, 56), np.linspace(0.1, 1.1, 51), np.linspace(-0.55, -0.1, 46)


def back_projection(zones: Zones) -> Float64:
    """Return the front picture (y, x) of light in the room, and by depth (z,).

    Every voxel sums the counts that arrive when its light would; the second difference in depth
    takes the blur off.
    """
    voxel = np.stack(np.meshgrid(*AXES_M, indexing="ij"), -1)
    volume = np.zeros(voxel.shape[:3])
    counts = zones.above_background
    bins = np.arange(counts.shape[-1])
    for place, sensor_m in enumerate(zones.sensor_m):
        for zone, ray in enumerate(zones.ray):
            spot = sensor_m + ray * WALL_M / ray[2]
            path_m = 2 * np.linalg.norm(voxel - spot, axis=-1)
            at = zones.direct_bin[place, zone] + path_m / (LIGHT_M_PER_S * zones.bin_s)
            volume += np.interp(at.ravel(), bins, counts[place, zone]).reshape(volume.shape)
    sharp = np.zeros_like(volume)
    step = 3
    sharp[..., step:-step] = (
        2 * volume[..., step:-step] - volume[..., 2 * step :] - volume[..., : -2 * step]
    )
    return np.maximum(sharp, 0)


def shape_facts(volume: Float64) -> dict[str, float]:
    """Return the places in metres of the arms, the foot and the plane of a U in a volume."""
    front = volume.max(2)
    x_m, y_m, z_m = AXES_M
    arms = front[:, (y_m > 0.6) & (y_m < 0.85)].mean(1)
    foot = front[(x_m > 0.57) & (x_m < 0.66)].mean(0)
    low = y_m < 0.6
    return {
        "left_arm_m": float(x_m[x_m < 0.61][arms[x_m < 0.61].argmax()]),
        "right_arm_m": float(x_m[x_m > 0.61][arms[x_m > 0.61].argmax()]),
        "foot_m": float(y_m[low][foot[low].argmax()]),
        "plane_m": float(z_m[volume.max((0, 1)).argmax()]),
        "middle_over_arms": float(arms[np.abs(x_m - 0.61) < 0.03].mean() / arms.max()),
    }


def pictures(data: Path) -> dict[str, Any]:
    """Back-project the measured U and rendered ones through the same functions."""
    zones = read_zones(data / "tmf8828_u.npz")
    # The measured peak is a whole bin; the wall is flat, so the mean over places is finer.
    flat = np.broadcast_to(zones.direct_bin.mean(0), zones.direct_bin.shape)
    measured = Zones(zones.counts, zones.sensor_m, zones.ray, flat, zones.bin_s, zones.gate)
    made = {"measured": back_projection(measured)}
    for material, surface in MATERIALS.items():
        light, _ = render_zones(zones, ("lambertian", surface))
        made[f"rendered, {material}"] = back_projection(light)
    result: dict[str, Any] = {}
    figure = Figure((8, 2.7), layout="constrained")
    for axes, (name, volume) in zip(figure.subplots(1, 3), made.items(), strict=True):
        front = volume.max(2)
        both = np.corrcoef(front.ravel(), made["measured"].max(2).ravel())
        result[name] = shape_facts(volume) | {"correlation": float(both[0, 1])}
        axes.imshow(front.T, origin="lower", cmap="gray", extent=(0.1, 1.2, 0.1, 1.1))
        axes.set_title(name, fontsize=8)
        axes.tick_params(labelsize=7)
    harness.save("reality_u", figure)
    return result


PARTS: dict[str, Callable[[Path], dict[str, Any]]] = {
    "a": arrivals,
    "b": falls,
    "c": ratios,
    "d": pictures,
}


def main() -> None:
    """Run the parts and keep the other parts' figures."""
    parser = harness.options(__doc__)
    parser.add_argument("part", choices=[*PARTS, "all"])
    parser.add_argument("--data", type=Path, default=os.environ.get("NLOS_CAM_MEASURED"))
    given: argparse.Namespace = parser.parse_args()
    if given.data is None or not (Path(given.data) / "tmf8828_u.npz").is_file():
        raise SystemExit(
            f"error: no measured sets in {given.data}: give --data or NLOS_CAM_MEASURED"
        )
    path = harness.DOCS / "figures" / "reality.json"
    for part in PARTS if given.part == "all" else given.part:
        found = PARTS[part](Path(given.data))
        # Read after the part has run: another part may have ended beside it.
        figures = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
        harness.write("reality", dict(sorted((figures | {part: found}).items())))
        print(json.dumps({part: found}, indent=1))


if __name__ == "__main__":
    main()
