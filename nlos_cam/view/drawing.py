"""What the viewer draws: the layout, the bench in 3D, and each moment, as Rerun data."""

import uuid
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from nlos_calibration.rig import Rig
from numpy.typing import NDArray

from nlos_cam.objects.depth_image import object_box
from nlos_cam.view.pictures import depth_span_m, hidden_rgb, infrared_grey, lidar_rgb, surface
from nlos_cam.view.viewer import Moment

APPLICATION = "nlos-cam"
TIMELINE = "time"
PLOT_WINDOW_S = 20.0
HIDDEN_SHARES, BENCH_SHARE, BOTTOM_PLOT_SHARE = (1.25, 1.0), 1.25, 1.2
"""Widths of the views, side by side."""
LIDAR_WIDTH = 320
"""Depth and IR are thinned to about this many columns."""
WALL_RGBA, OCCLUDER_RGBA, LIGHT_RGBA = (120, 130, 140, 70), (90, 150, 255, 90), (255, 210, 80, 200)
BOX_RGB, LATENCY_RGB, PAGE_RGB = (150, 150, 150), (80, 200, 120), (13, 16, 17)
OCCLUDER_HEIGHT_M = 0.3
"""How much is drawn of what has no end."""


class Drawing:
    """One browser's recording: `draw` gives the bytes to send it."""

    def __init__(self, rig: Rig, first: Moment) -> None:
        self._rig, self._box = rig, object_box(rig)
        self._begun_s = first.published_s
        self._span_m = depth_span_m(first.frame.depth_m)
        self._recording = rr.RecordingStream(APPLICATION, recording_id=uuid.uuid4())
        self._bytes = self._recording.binary_stream()
        self._recording.set_log_tick_enabled(False)
        self._recording.set_log_time_enabled(False)
        self._recording.send_blueprint(layout(rig, with_truth=first.frame.truth_depth_m is not None))
        line = rr.SeriesLines(colors=[LATENCY_RGB], names=["latency"])
        self._log("latency/milliseconds", line, static=True)
        self._draw_bench()

    def draw(self, moment: Moment, *, with_lidar: bool) -> bytes:
        """Draw a moment, and its lidar pictures if asked to; returns what the browser has yet to be sent."""
        self._recording.set_time(TIMELINE, duration=moment.published_s - self._begun_s)
        self._log("latency/milliseconds", rr.Scalars([moment.latency_s * 1e3]))
        hidden_depth_m, truth_depth_m = moment.reconstruction.depth_m, moment.frame.truth_depth_m
        self._log("reconstruction", rr.Image(hidden_rgb(hidden_depth_m, self._box)))
        if truth_depth_m is not None:
            self._log("truth", rr.Image(hidden_rgb(truth_depth_m, self._box)))
        self._draw_surface(hidden_depth_m)
        if with_lidar:
            step = max(1, moment.frame.ir.shape[1] // LIDAR_WIDTH)
            self._log("lidar/depth", rr.Image(lidar_rgb(moment.frame.depth_m[::step, ::step], *self._span_m)))
            self._log("lidar/infrared", rr.Image(infrared_grey(moment.frame.ir[::step, ::step])))
        return self._bytes.read() or b""

    def close(self) -> None:
        self._recording.disconnect()

    def _log(self, path: str, thing: Any, *, static: bool = False) -> None:
        self._recording.log(path, thing, static=static)

    def _draw_surface(self, depth_m: NDArray[np.float32]) -> None:
        mesh = surface(depth_m, self._box)
        if len(mesh.triangles) == 0:
            self._log("bench/hidden", rr.Clear(recursive=False))
            return
        drawn = rr.Mesh3D(
            vertex_positions=mesh.points_m,
            triangle_indices=mesh.triangles,
            vertex_colors=mesh.rgb,
        )
        self._log("bench/hidden", drawn)

    def _draw_bench(self) -> None:
        """Wall, lidar, occluder and box in the wall frame: none of them moves."""
        rig, box = self._rig, self._box
        wall_low, wall_high = _seen_of_wall(rig)
        self._log("bench/wall", _rectangle(_on_wall(wall_low, wall_high), WALL_RGBA), static=True)
        if rig.occluder is not None:
            x_m, low_m = rig.occluder.x_m, rig.occluder.z_min_m
            ends_m = low_m, low_m + OCCLUDER_HEIGHT_M
            corners = [(x_m, y_m, z_m) for y_m, z_m in _around((wall_low[1], wall_high[1]), ends_m)]
            self._log("bench/occluder", _rectangle(corners, OCCLUDER_RGBA), static=True)
        low = np.array([box.x_min_m, box.y_min_m, box.z_near_m])
        high = np.array([box.x_max_m, box.y_max_m, box.z_far_m])
        edges = rr.Boxes3D(mins=[low], sizes=[high - low], colors=[BOX_RGB], radii=0.001, fill_mode="MajorWireframe")
        self._log("bench/box", edges, static=True)
        self._draw_lidar()

    def _draw_lidar(self) -> None:
        pose, pinhole = self._rig.wall_from_lidar, self._rig.pinhole
        self._log("bench/lidar", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]), static=True)
        camera = rr.Pinhole(
            focal_length=(pinhole.fx, pinhole.fy),
            principal_point=(pinhole.ppx, pinhole.ppy),
            resolution=(pinhole.width, pinhole.height),
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.12,
        )
        self._log("bench/lidar/view", camera, static=True)
        self._log("bench/lidar/body", rr.Points3D([[0, 0, 0]], radii=0.012, labels=["lidar"]), static=True)
        self._log(
            "bench/light", rr.LineStrips3D([_light_path(self._rig)], colors=[LIGHT_RGBA], radii=0.002), static=True
        )


def layout(rig: Rig, *, with_truth: bool) -> rrb.Blueprint:
    """What a newcomer sees: the reconstruction first, then what it was made from."""
    hidden = [rrb.Spatial2DView(origin="reconstruction", name="Reconstruction (bright: near the wall)")]
    if with_truth:
        hidden.append(rrb.Spatial2DView(origin="truth", name="Truth (known in simulation)"))
    bench = rrb.Spatial3DView(
        origin="bench", name="Bench (drag to turn)", line_grid=False, eye_controls=_eye(rig), background=PAGE_RGB
    )
    window = rrb.VisibleTimeRange(
        TIMELINE,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-PLOT_WINDOW_S),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    quiet = rrb.PlotLegend(visible=False)
    plot = rrb.TimeSeriesView(origin="latency", name="Latency (milliseconds)", time_ranges=[window], plot_legend=quiet)
    lidar = [
        rrb.Spatial2DView(origin="lidar/depth", name="Lidar depth (red: near)"),
        rrb.Spatial2DView(origin="lidar/infrared", name="Lidar infrared"),
    ]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(*hidden, bench, column_shares=[*HIDDEN_SHARES[: len(hidden)], BENCH_SHARE]),
            rrb.Horizontal(*lidar, plot, column_shares=[1, 1, BOTTOM_PLOT_SHARE]),
            row_shares=[3, 2],
        ),
        rrb.TimePanel(timeline=TIMELINE, play_state="following"),
        collapse_panels=True,
        auto_views=False,
    )


def _eye(rig: Rig) -> rrb.EyeControls3D:
    """From above and behind the lidar, looking at the wall between lidar and box."""
    box = object_box(rig)
    middle = np.array([box.x_max_m / 2 + 0.03, 0.0, rig.lidar.distance_m / 2])
    position = middle + np.array([-0.36, 0.42, 0.72])
    return rrb.EyeControls3D(position=position, look_target=middle, eye_up=(0.0, 1.0, 0.0))


def _seen_of_wall(rig: Rig) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners of the part of the wall that is drawn: what matters to light, not the endless plane."""
    relay, margin_m = rig.relay, 0.1
    low = np.array([relay.x_min_m - margin_m, relay.y_min_m, 0.0])
    return low, np.array([relay.x_max_m + margin_m, relay.y_max_m, 0.0])


def _light_path(rig: Rig) -> NDArray[np.float64]:
    """The way of one three-bounce echo (5, 3): lidar, wall, hidden object, wall, lidar."""
    box, eye = object_box(rig), rig.wall_from_lidar[:3, 3]
    middle = np.array([(box.x_min_m + box.x_max_m) / 2, (box.y_min_m + box.y_max_m) / 2, box.z_near_m])
    there, back = (np.array([middle[0] * 0.6, y_m, 0.0]) for y_m in (-0.04, 0.04))
    return np.stack([eye, there, middle, back, eye])


def _on_wall(low: NDArray[np.float64], high: NDArray[np.float64]) -> list[tuple[float, float, float]]:
    return [(x_m, y_m, 0.0) for x_m, y_m in _around((low[0], high[0]), (low[1], high[1]))]


def _around(first: tuple[float, float], second: tuple[float, float]) -> list[tuple[float, float]]:
    (a, b), (c, d) = first, second
    return [(a, c), (b, c), (b, d), (a, d)]


def _rectangle(corners: list[tuple[float, float, float]], rgba: tuple[int, int, int, int]) -> rr.Mesh3D:
    return rr.Mesh3D(vertex_positions=corners, triangle_indices=[(0, 1, 2), (0, 2, 3)], albedo_factor=rgba)
