"""Rendering of transients: four captures of one scene, pulse and noise."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from math import ceil, floor
from typing import Literal, get_args

import numpy as np
from nlos_calibration import Extent
from nlos_calibration.arrays import Float32, Float64, Int64

from nlos_cam.errors import SceneError, UnknownNameError, did_you_mean
from nlos_cam.render import Accuracy, Scene, WallGrid, WallPaths, accuracy_named, with_pulse
from nlos_cam.transients.transient import Layout, Transient

CaptureKind = Literal["lidar", "confocal", "single", "exhaustive"]
CAPTURES: tuple[CaptureKind, ...] = get_args(CaptureKind)
DEFAULT_CELLS = {"lidar": 32, "confocal": 32, "single": 32, "exhaustive": 8}
MAX_BYTES = 1 << 30
"""Largest histograms, as readers of this package take them."""
MAX_TABLES = 4 << 30
"""Largest tables of the paths between wall and object."""
MAX_POINTS = 128
"""Cells along a side of the wall grid."""
SPARE_BINS = 2
OnProgress = Callable[[int, int], None]


@dataclass(frozen=True)
class Noise:
    """Noise of counted photons."""

    photons: float
    """Photons expected in the histogram that holds most light: sets the exposure. Above 0."""
    background: float = 0.0
    """Further photons expected in each bin: ambient light and dark counts."""
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("photons", "background"):
            value = getattr(self, name)
            if not 0 <= value <= 1e9:
                raise SceneError(f"{name} is {value}: give 0 to 1e9")
        if not self.photons:
            raise SceneError("photons is 0: give more than 0, or leave the noise out")
        if self.seed < 0:
            raise SceneError(f"seed is {self.seed}: it must be at least 0")

    def applied(self, histograms: Float32) -> Float32:
        """Return counts (n, bins) drawn for the light (n, bins). Raises SceneError where there is
        none, which the noise would hide.
        """
        most = float(histograms.sum(1, dtype=np.float64).max(initial=0))
        if not most:
            raise SceneError(
                "no light returns within the bins, so that no photons can be counted: move the"
                " object into the box, or take more bins, an earlier start or a larger wall"
            )
        expected = histograms * (self.photons / most) + self.background
        return np.random.default_rng(self.seed).poisson(expected).astype(np.float32)


@dataclass(frozen=True)
class Capture:
    """Geometry and time axis of a capture. Raises SceneError for a value out of range."""

    kind: CaptureKind = "lidar"
    """lidar: the laser scans the wall grid, and one detector sees the rig's whole relay wall.
    confocal: the detector looks at the lit point. single: one laser point, the detector scans.
    exhaustive: every laser point with every detector's point.
    """
    cells: int | None = None
    """Cells of the wall grid along each axis; None is 32, or 8 if exhaustive."""
    wall: Extent | None = None
    """Rectangle of the wall that the grid covers; None is the rig's relay wall."""
    laser_m: tuple[float, float] | None = None
    """(x, y); laser point of `single`. None is the middle of the rectangle."""
    bin_m: float | None = None
    """Path length of a bin; None is the device's."""
    start_m: float = 0.0
    """Path length at which the first bin begins, rounded down to whole bins."""
    bins: int | None = None
    """Number of bins; None is up to the longest path."""
    first_and_last: bool = True
    """False leaves the legs from the lidar to the wall and back out of path lengths."""
    noise: Noise | None = None

    def __post_init__(self) -> None:
        if self.kind not in CAPTURES:
            raise UnknownNameError(
                f"no capture {self.kind!r}.{did_you_mean(self.kind, CAPTURES)} Choose one of"
                f" {', '.join(CAPTURES)}"
            )
        if self.cells is not None and not 1 <= self.cells <= MAX_POINTS:
            raise SceneError(f"a wall grid of {self.cells} cells: give 1 to {MAX_POINTS}")
        if self.bin_m is not None and not 1e-5 <= self.bin_m <= 10:
            raise SceneError(f"bin_m is {self.bin_m}: give 1e-5 to 10 m of path")
        if not 0 <= self.start_m <= 1e3:
            raise SceneError(f"start_m is {self.start_m}: give 0 to 1000 m of path")
        if self.bins is not None and not 1 <= self.bins <= 1 << 20:
            raise SceneError(f"bins is {self.bins}: give 1 to {1 << 20}")
        if self.kind == "lidar" and not self.first_and_last:
            raise SceneError(
                "one wide detector cannot leave the last leg out, as it differs for each part of"
                " the wall: choose another capture"
            )
        if self.laser_m is not None and self.kind != "single":
            raise SceneError(f"laser_m is for the capture single, not for {self.kind}: drop it")


def render_transient(
    scene: Scene,
    capture: Capture | None = None,
    accuracy: str | Accuracy = "standard",
    backend: str = "cpu",
    on_progress: OnProgress | None = None,
) -> Transient:
    """Return the three-bounce transient of a scene, with the pulse of the scene and the noise of the
    capture.

    In units of the laser's power per point, in each of the two radiometries (docs/physics.md); with
    noise in photons. `lidar` takes accuracy and backend of the renderer; the other captures sum
    path by path. Raises SceneError for a scene or a capture that cannot be rendered.
    """
    capture = capture or Capture()
    setting = accuracy_named(accuracy)
    side = capture.cells or DEFAULT_CELLS[capture.kind]
    grid = WallGrid(capture.wall or scene.rig.relay, side, side)
    laser_m = _laser_points(capture, grid, scene.rig.wall)
    is_lidar = capture.kind == "lidar"
    rows = grid.size**2 if capture.kind == "exhaustive" else grid.size
    _check_size(rows, capture.bins or 1, side, "or fewer bins")
    cells = (
        WallGrid(scene.rig.relay, setting.relay_columns, setting.relay_rows) if is_lidar else grid
    )
    bin_m = capture.bin_m or scene.rig.device.bin_m
    paths = WallPaths.of(scene, laser_m.reshape(-1, 3), cells, bin_m, setting)
    if paths.table_bytes > MAX_TABLES:
        raise SceneError(
            f"the paths from the object to {side} x {side} cells need"
            f" {paths.table_bytes / 2**30:.1f} GiB, at most {MAX_TABLES >> 30}: take fewer cells, or"
            " a coarser accuracy"
        )
    first = floor(capture.start_m / bin_m + 1e-9)
    _, longest_m = paths.range_m(first_and_last=capture.first_and_last)
    tail = _pulse_tail(scene.pulse_ns, bin_m)
    count = capture.bins or max(ceil(longest_m / bin_m) + tail + SPARE_BINS - first, 1)

    # Light outside the window reaches into it by the pulse's tail. One detector that sees all cells
    # is computed over all paths, whatever the window is.
    margin = min(tail, first)
    window = first - margin, count + margin + tail
    computed = max(sum(window), ceil(longest_m / bin_m)) if is_lidar else window[1]
    advice = "or wider bins" if is_lidar else "wider bins, or give start and bins"
    _check_size(rows, computed, side, advice)
    pairs = _pairs(capture.kind, laser_m.size // 3, grid.size)
    if pairs is None:
        light = paths.summed(*window, backend)
    else:
        light = paths.paired(
            pairs, *window, first_and_last=capture.first_and_last, on_progress=on_progress
        )
    light = with_pulse(light, scene.pulse_ns, bin_m)[:, margin : margin + count]
    if capture.noise:
        light = capture.noise.applied(light)
    return _transient(scene, capture, grid, cells, laser_m, light, first * bin_m, bin_m)


def _laser_points(capture: Capture, grid: WallGrid, wall: Extent) -> Float64:
    """Return the laser points (x, y, 3). Raises SceneError for a given one that is not on the
    wall.
    """
    if capture.kind != "single":
        return grid.points_m
    extent = grid.extent
    middle = (extent.x_min_m + extent.x_max_m) / 2, (extent.y_min_m + extent.y_max_m) / 2
    x_m, y_m = capture.laser_m or middle
    point_m = np.array([[[x_m, y_m, 0.0]]])
    if capture.laser_m is not None and not wall.contains(point_m).all():
        raise SceneError(
            f"the laser point ({x_m:g}, {y_m:g}) m is not on the wall: choose x from"
            f" {wall.x_min_m:g} to {wall.x_max_m:g} m and y from {wall.y_min_m:g} to"
            f" {wall.y_max_m:g} m"
        )
    return point_m


def _pairs(kind: CaptureKind, lasers: int, detectors: int) -> Int64 | None:
    """Return the pairs (k, 2) of a laser point and a cell; None for a detector that sees all
    cells.
    """
    if kind == "lidar":
        return None
    every = np.arange(detectors)
    if kind == "confocal":
        return np.stack([every, every], 1)
    return np.stack([np.repeat(np.arange(lasers), detectors), np.tile(every, lasers)], 1)


def _pulse_tail(pulse_ns: float, bin_m: float) -> int:
    """Return the bins by which the pulse reaches beyond an echo."""
    return (
        (with_pulse(np.zeros((1, 1), np.float32), pulse_ns, bin_m).shape[1] - 1) if pulse_ns else 0
    )


def _check_size(rows: int, bins: int, side: int, advice: str) -> None:
    size = rows * bins * 4
    if size > MAX_BYTES:
        raise SceneError(
            f"{rows} histograms of {bins} bins need {size / 2**30:.1f} GiB, at most"
            f" {MAX_BYTES >> 30}: take fewer cells than {side}, {advice}"
        )


def _transient(
    scene: Scene,
    capture: Capture,
    grid: WallGrid,
    cells: WallGrid,
    laser_m: Float64,
    light: Float32,
    start_m: float,
    bin_m: float,
) -> Transient:
    """Return histograms (n, bins) as a transient in the layout of its capture."""
    lidar_m = scene.rig.wall_from_lidar[:3, 3]
    side = grid.columns
    if capture.kind == "lidar":
        detector_m = cells.points_m.reshape(-1, 3).mean(0).reshape(1, 1, 3)
        layout, shape = Layout.T_Lx_Ly_Sx_Sy, (side, side, 1, 1)
    else:
        detector_m = grid.points_m
        layout, shape = Layout.T_Sx_Sy, (side, side)
    if capture.kind == "exhaustive":
        layout, shape = Layout.T_Lx_Ly_Sx_Sy, (side, side, side, side)
    return Transient(
        np.ascontiguousarray(light.T).reshape(-1, *shape),
        layout,
        laser_m,
        detector_m,
        bin_m,
        start_m,
        capture.first_and_last,
        lidar_m,
        lidar_m,
        _facing(laser_m),
        _facing(detector_m),
        json.dumps(_facts(scene, capture)),
    )


def _facing(grid_m: Float64) -> Float64:
    """Return the wall's normal at each point."""
    return np.broadcast_to(np.array([0.0, 0.0, 1.0]), grid_m.shape).copy()


def _facts(scene: Scene, capture: Capture) -> dict[str, object]:
    """Return the description of a scene: tal's keys, and what only nlos-cam knows."""
    box = scene.box
    low = np.array([box.x_min_m, box.y_min_m, box.z_near_m])
    high = np.array([box.x_max_m, box.y_max_m, box.z_far_m])
    depth_m = scene.object_depth_m
    return {
        "original_format": "nlos-cam",
        "volume": {
            "center": _rounded((low + high) / 2),
            "rotation": [0.0, 0.0, 0.0],
            "size": _rounded(high - low),
        },
        "config": {
            "name": scene.rig.name,
            "capture": capture.kind,
            "radiometry": scene.radiometry,
            "pulse_ns": scene.pulse_ns,
            "unit": "photons" if capture.noise else "share of the laser's power at one point",
        },
        # Rows run from the top of the box down, columns along x; -1 where there is no surface.
        "object_depth_m": [] if depth_m is None else _rounded(np.nan_to_num(depth_m, nan=-1.0)),
    }


def _rounded(values: Float64 | Float32) -> list[float]:
    """Return numbers as nested lists in tenths of a millimeter, which YAML reads as JSON does."""
    return np.round(values.astype(np.float64), 4).tolist()
