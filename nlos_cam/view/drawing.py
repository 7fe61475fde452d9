"""What the viewer draws: the bench in 3D, the calibration if there is one, and each moment, as Rerun data."""

import uuid
from typing import Any

import numpy as np
import rerun as rr
from nlos_calibration.measured_wall import MeasuredWall
from nlos_calibration.rig import Rig
from numpy.typing import NDArray

from nlos_cam.objects.depth_image import object_box
from nlos_cam.view.layout import TIMELINE, layout
from nlos_cam.view.pictures import (
    PICTURE_WIDTH,
    change_span_m,
    depth_span_m,
    difference_rgb,
    hidden_rgb,
    infrared_grey,
    lidar_rgb,
    surface,
)
from nlos_cam.view.viewer import Moment
from nlos_cam.view.wall_drawing import bench_drawings, wall_names, wall_pictures
from nlos_cam.view.wall_text import calibration_text

APPLICATION = "nlos-cam"
WALL_RGBA, OCCLUDER_RGBA, LIGHT_RGBA = (120, 130, 140, 70), (90, 150, 255, 90), (255, 210, 80, 200)
BOX_RGB, LATENCY_RGB = (150, 150, 150), (80, 200, 120)
OCCLUDER_HEIGHT_M = 0.3
"""How much is drawn of what has no end."""


class Drawing:
    """One browser's recording: `draw` gives the bytes to send it."""

    def __init__(self, rig: Rig, first: Moment, measured: MeasuredWall | None = None) -> None:
        self._rig, self._box, self._measured = rig, object_box(rig), measured
        self._told = ""
        self._difference_span_m = change_span_m(first.difference.depth_m) if measured and first.difference else None
        self._begun_s = first.published_s
        self._span_m = depth_span_m(first.frame.depth_m)
        self._recording = rr.RecordingStream(APPLICATION, recording_id=uuid.uuid4())
        self._bytes = self._recording.binary_stream()
        self._recording.set_log_tick_enabled(False)
        self._recording.set_log_time_enabled(False)
        names = wall_names(measured, self._difference_span_m) if measured else None
        self._recording.send_blueprint(layout(rig, with_truth=first.frame.truth_depth_m is not None, wall=names))
        line = rr.SeriesLines(colors=[LATENCY_RGB], names=["latency"])
        self._log("latency/milliseconds", line, static=True)
        self._draw_bench()
        if measured:
            self._draw_wall(measured)

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
            self._draw_lidar_pictures(moment)
        if self._measured:
            self._tell(calibration_text(self._measured.record, moment.warnings))
        return self._bytes.read() or b""

    def close(self) -> None:
        self._recording.disconnect()

    def _log(self, path: str, thing: Any, *, static: bool = False) -> None:
        self._recording.log(path, thing, static=static)

    def _draw_lidar_pictures(self, moment: Moment) -> None:
        step = max(1, moment.frame.ir.shape[1] // PICTURE_WIDTH)
        self._log("lidar/depth", rr.Image(lidar_rgb(moment.frame.depth_m[::step, ::step], *self._span_m)))
        self._log("lidar/infrared", rr.Image(infrared_grey(moment.frame.ir[::step, ::step])))
        if moment.difference is not None and self._difference_span_m is not None:
            self._log("lidar/difference", rr.Image(difference_rgb(moment.difference.depth_m, self._difference_span_m)))

    def _draw_wall(self, measured: MeasuredWall) -> None:
        for path, drawing in bench_drawings(measured):
            self._log(path, drawing, static=True)
        for name, picture in wall_pictures(measured).items():
            self._log(f"wall/{name}", rr.Image(picture), static=True)

    def _tell(self, text: str) -> None:
        """Show the calibration's page, if it says something else than before."""
        if text != self._told:
            self._told = text
            self._log("calibration", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))

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
