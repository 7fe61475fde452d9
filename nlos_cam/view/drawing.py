"""What the viewer draws: the bench in 3D, the calibration if there is one, and each moment, as Rerun data."""

import uuid
from typing import Any

import numpy as np
import rerun as rr
from nlos_calibration.measured_wall import MeasuredWall
from nlos_calibration.rig import Rig
from numpy.typing import NDArray

from nlos_cam.frames import OBJECT_PIXELS
from nlos_cam.objects.depth_map import object_box
from nlos_cam.view.bench_drawing import bench_parts
from nlos_cam.view.layout import FRAME_TIMELINE, TIMELINE, Shown, layout
from nlos_cam.view.pictures import (
    PICTURE_WIDTH,
    RESIDUAL_SPAN_M,
    change_span_m,
    confidence_rgb,
    depth_span_m,
    difference_rgb,
    encoded,
    faded,
    hidden_rgb,
    infrared_grey,
    lidar_rgb,
    surface,
    uncertainty_rgb,
)
from nlos_cam.view.plots import Plots
from nlos_cam.view.verdict_picture import NOTED_PIXELS, as_believed, banner_rgb, may_be_believed
from nlos_cam.view.viewer import Moment
from nlos_cam.view.wall_drawing import bench_drawings, wall_names, wall_pictures
from nlos_cam.view.wall_text import calibration_text

APPLICATION = "nlos-cam"
MEDIA_TYPES = {".png": "image/png", ".jpg": "image/jpeg"}
NEVER = "never drawn"
"""What no verdict equals, None included."""


def new_recording(batcher: rr.ChunkBatcherConfig | None = None) -> rr.RecordingStream:
    """A recording of its own, whose only times are those that `Drawing` sets."""
    recording = rr.RecordingStream(APPLICATION, recording_id=uuid.uuid4(), batcher_config=batcher)
    recording.set_log_tick_enabled(False)
    recording.set_log_time_enabled(False)
    return recording


class Drawing:
    """Draws moments into a recording, which is one browser's or one file's.

    Of a `saved` one pictures are compressed and the lidar's smaller, and the panel of time opens with it.
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
        """Draw a moment, and what is large of it if asked to: the lidar's pictures, the surface in 3D."""
        self._recording.set_time(TIMELINE, duration=moment.published_s - self._begun_s)
        self._recording.set_time(FRAME_TIMELINE, sequence=moment.frame.frame_number)
        self._plots.draw(moment)
        self._draw_verdict(moment)
        self._draw_hidden(moment)
        if with_surface:
            self._draw_surface(moment.reconstruction.depth_m, believed=may_be_believed(moment.verdict))
        if with_lidar:
            self._draw_lidar_pictures(moment)
        if self._measured:
            self._tell(calibration_text(self._measured.record, moment.warnings))

    def _log(self, path: str, thing: Any, *, static: bool = False) -> None:
        self._recording.log(path, thing, static=static)

    def _picture(self, path: str, picture: NDArray[np.uint8], suffix: str = ".png") -> None:
        """Log a picture; in a file compressed, small ones without loss.

        All of one path must be of one kind: Rerun takes such a sequence for a video, and would start it anew live.
        """
        if self._saved:
            self._log(path, rr.EncodedImage(contents=encoded(picture, suffix), media_type=MEDIA_TYPES[suffix]))
        else:
            self._log(path, rr.Image(picture))

    def _draw_verdict(self, moment: Moment) -> None:
        """Show the verdict in its panel, if it is another than before; a picture with a note on it is larger."""
        if moment.verdict == self._verdict:
            return
        self._verdict = moment.verdict
        self._picture("verdict", banner_rgb(moment.verdict))
        scale = 1.0 if may_be_believed(moment.verdict) else OBJECT_PIXELS / NOTED_PIXELS
        self._log("reconstruction", rr.Transform3D(scale=[scale, scale, 1.0]))

    def _draw_hidden(self, moment: Moment) -> None:
        depth_m, truth_m = moment.reconstruction.depth_m, moment.frame.truth_depth_m
        uncertainty_m, rgb = moment.reconstruction.uncertainty_m, hidden_rgb(depth_m, self._box)
        self._picture("reconstruction", as_believed(rgb, moment.verdict))
        if uncertainty_m is not None:
            self._picture("uncertainty", uncertainty_rgb(uncertainty_m, depth_m))
        if truth_m is not None:
            self._picture("truth", hidden_rgb(truth_m, self._box))

    def _draw_surface(self, depth_m: NDArray[np.float32], *, believed: bool) -> None:
        mesh = surface(depth_m, self._box)
        if len(mesh.triangles) == 0:
            self._log("bench/hidden", rr.Clear(recursive=False))
            return
        drawn = rr.Mesh3D(
            vertex_positions=mesh.points_m,
            triangle_indices=mesh.triangles,
            vertex_normals=mesh.normals,
            vertex_colors=mesh.rgb if believed else faded(mesh.rgb),
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
        """Show the calibration's page, if it says something else than before."""
        if text != self._told:
            self._told = text
            self._log("calibration", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))
