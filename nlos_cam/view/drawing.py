"""Rerun data of the view: the bench in 3D (wall frame), the calibration, each moment's pictures and plots."""

import uuid
from collections.abc import Callable, Iterator, Mapping
from math import nan
from typing import Any

import numpy as np
import rerun as rr
from nlos_calibration import MeasuredWall, ObjectBox, Rig
from numpy.typing import NDArray

from nlos_cam.frames import OBJECT_PIXELS
from nlos_cam.objects import object_box
from nlos_cam.view.images import (
    NOTED_PIXELS,
    PICTURE_WIDTH,
    RESIDUAL_SPAN_M,
    banner_rgb,
    change_span_m,
    confidence_rgb,
    depth_span_m,
    difference_rgb,
    dim_untrusted,
    encoded,
    faded,
    hidden_rgb,
    infrared_grey,
    is_trusted,
    lidar_rgb,
    surface,
    uncertainty_rgb,
)
from nlos_cam.view.layout import FRAME_TIMELINE, TIMELINE, Shown, layout
from nlos_cam.view.viewer import Moment
from nlos_cam.view.wall_drawing import bench_drawings, calibration_text, wall_names, wall_pictures

WALL_RGBA, OCCLUDER_RGBA, LIGHT_RGBA = (120, 130, 140, 70), (90, 150, 255, 90), (255, 210, 80, 200)
BOX_RGB, LIDAR_RGB = (150, 150, 150), (255, 110, 90)
OCCLUDER_HEIGHT_M = 0.3
"""Length in metres drawn of endless parts."""
MARGIN_M = 0.1
FRUSTUM_M = 0.12

Corners = list[tuple[float, float, float]]


def bench_parts(rig: Rig) -> Iterator[tuple[str, Any]]:
    """Return the static parts of the bench by path. Raises SceneError for a rig without an object box."""
    low, high = _seen_of_wall(rig)
    on_wall = [(x_m, y_m, 0.0) for x_m, y_m in _around((low[0], high[0]), (low[1], high[1]))]
    yield "bench/wall", _rectangle(on_wall, WALL_RGBA)
    if rig.occluder is not None:
        ends_m = rig.occluder.z_min_m, rig.occluder.z_min_m + OCCLUDER_HEIGHT_M
        corners = [(rig.occluder.x_m, y_m, z_m) for y_m, z_m in _around((low[1], high[1]), ends_m)]
        yield "bench/occluder", _rectangle(corners, OCCLUDER_RGBA)
    box = object_box(rig)
    yield "bench/box", _edges(box)
    yield "bench/light", rr.LineStrips3D([_light_path(rig, box)], colors=[LIGHT_RGBA], radii=0.002)
    yield from _lidar(rig)


def _lidar(rig: Rig) -> Iterator[tuple[str, Any]]:
    pose, pinhole = rig.wall_from_lidar, rig.pinhole
    yield "bench/lidar", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3])
    camera = rr.Pinhole(
        focal_length=(pinhole.fx, pinhole.fy),
        principal_point=(pinhole.ppx, pinhole.ppy),
        resolution=(pinhole.width, pinhole.height),
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=FRUSTUM_M,
    )
    yield "bench/lidar/view", camera
    yield "bench/lidar/body", rr.Points3D([[0, 0, 0]], radii=0.012, labels=["lidar"], colors=[LIDAR_RGB])


def _edges(box: ObjectBox) -> rr.Boxes3D:
    low = np.array([box.x_min_m, box.y_min_m, box.z_near_m])
    high = np.array([box.x_max_m, box.y_max_m, box.z_far_m])
    return rr.Boxes3D(mins=[low], sizes=[high - low], colors=[BOX_RGB], radii=0.001, fill_mode="MajorWireframe")


def _seen_of_wall(rig: Rig) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the corners (x, y) of the wall part to draw: the lit part of the endless plane."""
    relay = rig.relay
    low = np.array([relay.x_min_m - MARGIN_M, relay.y_min_m])
    return low, np.array([relay.x_max_m + MARGIN_M, relay.y_max_m])


def _light_path(rig: Rig, box: ObjectBox) -> NDArray[np.float64]:
    """Return the path of one three-bounce echo (5, 3): lidar, wall, hidden object, wall, lidar."""
    eye = rig.wall_from_lidar[:3, 3]
    middle = np.array([(box.x_min_m + box.x_max_m) / 2, (box.y_min_m + box.y_max_m) / 2, box.z_near_m])
    there, back = (np.array([middle[0] * 0.6, y_m, 0.0]) for y_m in (-0.04, 0.04))
    return np.stack([eye, there, middle, back, eye])


def _around(first: tuple[float, float], second: tuple[float, float]) -> list[tuple[float, float]]:
    (a, b), (c, d) = first, second
    return [(a, c), (b, c), (b, d), (a, d)]


def _rectangle(corners: Corners, rgba: tuple[int, int, int, int]) -> rr.Mesh3D:
    return rr.Mesh3D(vertex_positions=corners, triangle_indices=[(0, 1, 2), (0, 2, 3)], albedo_factor=rgba)


Log = Callable[..., None]
"""`(path, thing, static=False)`."""
STAGE_RGB = ((235, 240, 245), (90, 170, 255), (255, 190, 90), (80, 220, 120), (230, 120, 220), (120, 220, 220))
SENSOR_RGB = ((255, 120, 90), (255, 190, 90), (120, 200, 255), (160, 230, 140))
DROPS_RGB, SCORE_RGB = (255, 110, 90), (90, 170, 255)
WAITED_FOR = "wait"
"""Stage without work: the loop waits for the camera."""


class Plots:
    """Plots of each moment's figures; a series is named when it first appears."""

    def __init__(self, log: Log, first: Moment) -> None:
        self._log = log
        self._stages = [name for name in first.stages_s if name != WAITED_FOR]
        self._sensors: list[str] = []
        self._checked = -1
        self._name("latency", [f"{name}, ms" for name in ("total", *self._stages)], STAGE_RGB)
        self._name("drops", ["frames lost"], [DROPS_RGB])
        self._name("physics/score", ["score"], [SCORE_RGB])

    def draw(self, moment: Moment) -> None:
        """Log the figures of a moment, and those of a new physics check."""
        stages_s = [moment.stages_s.get(name, nan) for name in self._stages]
        self._log("latency", rr.Scalars([1e3 * value for value in (moment.latency_s, *stages_s)]))
        self._log("drops", rr.Scalars([moment.dropped]))
        self._draw_celsius(moment.celsius)
        if moment.check and moment.check.frame_number != self._checked:
            self._checked = moment.check.frame_number
            self._log("physics/score", rr.Scalars([moment.check.score]))

    def _draw_celsius(self, celsius: Mapping[str, float]) -> None:
        if not celsius:
            return
        if not self._sensors:
            self._sensors = sorted(celsius)
            self._name("temperature", [name.replace("_", " ") for name in self._sensors], SENSOR_RGB)
        self._log("temperature", rr.Scalars([celsius.get(name, nan) for name in self._sensors]))

    def _name(self, path: str, names: list[str], colours: Any) -> None:
        rgb = [colours[i % len(colours)] for i in range(len(names))]
        self._log(path, rr.SeriesLines(colors=rgb, names=names, widths=[1.5] * len(names)), static=True)


APPLICATION = "nlos-cam"
MEDIA_TYPES = {".png": "image/png", ".jpg": "image/jpeg"}
NEVER = "never drawn"
"""Sentinel that differs from every verdict and from None."""


def new_recording(batcher: rr.ChunkBatcherConfig | None = None) -> rr.RecordingStream:
    """Return a new Rerun recording whose only timelines are those of `Drawing`."""
    recording = rr.RecordingStream(APPLICATION, recording_id=uuid.uuid4(), batcher_config=batcher)
    recording.set_log_tick_enabled(False)
    recording.set_log_time_enabled(False)
    return recording


class Drawing:
    """Drawing of moments into one browser's or one file's recording.

    For a `saved` one, pictures are compressed, the lidar's are smaller, and the time panel is open.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        rig: Rig,
        first: Moment,
        measured: MeasuredWall | None = None,
        *,
        saved: bool = False,
    ) -> None:
        self._box, self._measured, self._saved = object_box(rig), measured, saved
        self._told, self._verdict, self._checked = "", NEVER, -1
        self._difference_span_m = change_span_m(first.difference.depth_m) if measured and first.difference else None
        self._begun_s = first.published_s
        self._span_m = depth_span_m(first.frame.depth_m)
        self._recording = recording
        names = wall_names(measured, self._difference_span_m) if measured else None
        shown = Shown(with_truth=first.frame.truth_depth_m is not None, wall=names, scrubbed=saved)
        self._recording.send_blueprint(layout(rig, shown))
        self._plots = Plots(self._log, first)
        for path, part in bench_parts(rig):
            self._log(path, part, static=True)
        if measured:
            self._draw_wall(measured)

    def draw(self, moment: Moment, *, with_lidar: bool, with_surface: bool = True) -> None:
        """Draw a moment; the lidar's pictures and the 3D surface only if requested."""
        self._recording.set_time(TIMELINE, duration=moment.published_s - self._begun_s)
        self._recording.set_time(FRAME_TIMELINE, sequence=moment.frame.frame_number)
        self._plots.draw(moment)
        self._draw_verdict(moment)
        self._draw_hidden(moment)
        if with_surface:
            self._draw_surface(moment.reconstruction.depth_m, trusted=is_trusted(moment.verdict))
        if with_lidar:
            self._draw_lidar_pictures(moment)
        if self._measured:
            self._tell(calibration_text(self._measured.record, moment.warnings))

    def _log(self, path: str, thing: Any, *, static: bool = False) -> None:
        self._recording.log(path, thing, static=static)

    def _picture(self, path: str, picture: NDArray[np.uint8], suffix: str = ".png") -> None:
        """Log a picture, compressed in a file (small ones without loss).

        All pictures of one path have one kind: Rerun treats them as a video and would restart it otherwise.
        """
        if self._saved:
            self._log(path, rr.EncodedImage(contents=encoded(picture, suffix), media_type=MEDIA_TYPES[suffix]))
        else:
            self._log(path, rr.Image(picture))

    def _draw_verdict(self, moment: Moment) -> None:
        """Draw the verdict in its panel if it has changed; a picture with a note is larger."""
        if moment.verdict == self._verdict:
            return
        self._verdict = moment.verdict
        self._picture("verdict", banner_rgb(moment.verdict))
        scale = 1.0 if is_trusted(moment.verdict) else OBJECT_PIXELS / NOTED_PIXELS
        self._log("reconstruction", rr.Transform3D(scale=[scale, scale, 1.0]))

    def _draw_hidden(self, moment: Moment) -> None:
        depth_m, truth_m = moment.reconstruction.depth_m, moment.frame.truth_depth_m
        uncertainty_m, rgb = moment.reconstruction.uncertainty_m, hidden_rgb(depth_m, self._box)
        self._picture("reconstruction", dim_untrusted(rgb, moment.verdict))
        if uncertainty_m is not None:
            self._picture("uncertainty", uncertainty_rgb(uncertainty_m, depth_m))
        if truth_m is not None:
            self._picture("truth", hidden_rgb(truth_m, self._box))

    def _draw_surface(self, depth_m: NDArray[np.float32], *, trusted: bool) -> None:
        mesh = surface(depth_m, self._box)
        if len(mesh.triangles) == 0:
            self._log("bench/hidden", rr.Clear(recursive=False))
            return
        drawn = rr.Mesh3D(
            vertex_positions=mesh.points_m,
            triangle_indices=mesh.triangles,
            vertex_normals=mesh.normals,
            vertex_colors=mesh.rgb if trusted else faded(mesh.rgb),
        )
        self._log("bench/hidden", drawn)

    def _draw_lidar_pictures(self, moment: Moment) -> None:
        step = max(1, moment.frame.ir.shape[1] // PICTURE_WIDTH) * (2 if self._saved else 1)
        thinned = slice(None, None, step), slice(None, None, step)
        self._picture("lidar/depth", lidar_rgb(moment.frame.depth_m[thinned], *self._span_m), ".jpg")
        self._picture("lidar/infrared", infrared_grey(moment.frame.ir[thinned]), ".jpg")
        self._picture("lidar/confidence", confidence_rgb(moment.frame.confidence[thinned]), ".jpg")
        if moment.difference is not None and self._difference_span_m is not None:
            self._picture("lidar/difference", difference_rgb(moment.difference.depth_m, self._difference_span_m))
        if moment.check and moment.check.frame_number != self._checked:
            self._checked = moment.check.frame_number
            self._picture("physics/residual", difference_rgb(moment.check.residual_depth_m, RESIDUAL_SPAN_M))

    def _draw_wall(self, measured: MeasuredWall) -> None:
        for path, drawing in bench_drawings(measured):
            self._log(path, drawing, static=True)
        for name, picture in wall_pictures(measured).items():
            self._log(f"wall/{name}", rr.Image(picture), static=True)

    def _tell(self, text: str) -> None:
        """Draw the calibration's text if it has changed."""
        if text != self._told:
            self._told = text
            self._log("calibration", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))
