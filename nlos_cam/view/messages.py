"""Messages of the page: the bench, each moment and the run's status as JSON with arrays of bytes.

A message is `<II` (bytes that follow, bytes of JSON), the JSON, then its arrays one after another.
Quantities are quantised to a byte each; the JSON gives the scales, and the page draws colors,
contours and meshes from them.
"""

import json
import struct
from collections.abc import Mapping
from functools import cache
from typing import Any

import cv2
import numpy as np
from nlos_calibration import MeasuredWall, ObjectBox, Rig
from nlos_calibration.arrays import Float64, UInt8
from numpy.typing import NDArray

from nlos_cam.objects import object_box
from nlos_cam.reconstruct import FrameResult, Quality
from nlos_cam.view.assessment import assess
from nlos_cam.view.calibration import calibration_facts, outline_m, wall_pictures
from nlos_cam.view.images import BACKGROUND_RGB, LastingSpan, change_span_m, depth_span_m
from nlos_cam.view.viewer import Moment

HEAD = struct.Struct("<II")
ERROR_STEP_M = 0.5e-3
"""Expected error per count: a byte reaches 127 mm."""
RESIDUAL_SPAN_M = 0.02
"""Of the physics check; the lidar's own noise is a tenth of it."""
PICTURE_WIDTH = 214
"""Columns to which lidar pictures are thinned; the networks see 80."""
OCCLUDER_HEIGHT_M = 0.3
MARGIN_M = 0.1
FRUSTUM_M = 0.12
"""Lengths in metres drawn of endless parts, around the relay wall, and of the lidar's field of
view.
"""
COLOR_MAPS = {
    "depth": cv2.COLORMAP_INFERNO,
    "error": cv2.COLORMAP_VIRIDIS,
}

Arrays = Mapping[str, UInt8]
Corners = list[list[float]]


def pack(fields: Mapping[str, Any], arrays: Arrays | None = None) -> bytes:
    """Return a message; each array's name, shape and place are added to the fields."""
    places = dict[str, list[int]]()
    blobs = list[bytes]()
    at = 0
    for name, array in (arrays or {}).items():
        places[name] = [at, *array.shape]
        blobs.append(np.ascontiguousarray(array).tobytes())
        at += len(blobs[-1])
    text = json.dumps({**fields, "arrays": places}, separators=(",", ":"), allow_nan=False).encode()
    return b"".join([HEAD.pack(HEAD.size - 4 + len(text) + at, len(text)), text, *blobs])


def unpack(message: bytes) -> tuple[dict[str, Any], dict[str, UInt8]]:
    """Return the fields and arrays of a message; the reverse of `pack`."""
    _, size = HEAD.unpack_from(message)
    fields = json.loads(message[HEAD.size : HEAD.size + size])
    body = memoryview(message)[HEAD.size + size :]
    arrays = dict[str, UInt8]()
    for name, (at, *shape) in fields.pop("arrays").items():
        arrays[name] = np.frombuffer(body, np.uint8, int(np.prod(shape)), at).reshape(shape)
    return fields, arrays


def bench_message(rig: Rig, measured: MeasuredWall | None = None) -> bytes:
    """Return the message of the bench: outlines in the wall frame in metres, scales, color maps,
    calibration.
    """
    box = object_box(rig)
    relay = rig.relay
    left_m = relay.x_min_m - MARGIN_M
    right_m = relay.x_max_m + MARGIN_M
    wall = _around(left_m, right_m, relay.y_min_m, relay.y_max_m)
    parts: dict[str, Any] = {
        "wall": [[x_m, y_m, 0.0] for x_m, y_m in wall],
        "lidar": rig.wall_from_lidar[:3, 3].tolist(),
        "frustum": _frustum(rig),
        "light": _light_path(rig, box),
    }
    if rig.occluder is not None:
        gap_m = rig.occluder.z_min_m
        sides = _around(relay.y_min_m, relay.y_max_m, gap_m, gap_m + OCCLUDER_HEIGHT_M)
        parts["occluder"] = [[rig.occluder.x_m, y_m, z_m] for y_m, z_m in sides]
    fields: dict[str, Any] = {
        "kind": "bench",
        "rig": rig.name,
        "parts": parts,
        "box": [box.x_min_m, box.x_max_m, box.y_min_m, box.y_max_m, box.z_near_m, box.z_far_m],
        "lidar_view": _lidar_view(rig),
        "error_step_m": ERROR_STEP_M,
        "background": BACKGROUND_RGB,
    }
    arrays = color_maps()
    if measured:
        outline = outline_m(measured)
        parts["footprint"] = np.column_stack([outline, np.zeros(len(outline))]).tolist()
        pictures = wall_pictures(measured)
        fields["calibration"] = calibration_facts(measured.record)
        fields["wall_pictures"] = {name: title for name, (title, _) in pictures.items()}
        arrays = {**arrays, **{name: picture for name, (_, picture) in pictures.items()}}
    return pack(fields, arrays)


@cache
def color_maps() -> dict[str, UInt8]:
    """Return the color maps (256, 3), the same as in stills and videos."""
    ramp = np.arange(256, dtype=np.uint8)[:, np.newaxis]
    colored = {
        name: cv2.applyColorMap(ramp, number)[:, 0, ::-1] for name, number in COLOR_MAPS.items()
    }
    return {f"map_{name}": np.ascontiguousarray(rgb, np.uint8) for name, rgb in colored.items()}


def _around(left: float, right: float, low: float, high: float) -> list[tuple[float, float]]:
    """Return the corners of a rectangle."""
    return [(left, low), (right, low), (right, high), (left, high)]


def _frustum(rig: Rig) -> Corners:
    """Return the corners (4, 3) of the field of view at FRUSTUM_M before the lidar."""
    pinhole = rig.pinhole
    pose = rig.wall_from_lidar
    pixels = np.array(_around(0.0, pinhole.width, 0.0, pinhole.height))
    slopes = (pixels - [pinhole.ppx, pinhole.ppy]) / [pinhole.fx, pinhole.fy]
    rays = np.column_stack([slopes, np.ones(4)])
    return (pose[:3, 3] + FRUSTUM_M * rays @ pose[:3, :3].T).tolist()


def _lidar_view(rig: Rig) -> dict[str, Any]:
    """Return what turns a lidar pixel's depth into a point in the wall frame: pose (3, 4), and the
    slopes x/z and y/z at the picture's left, right, top and bottom edge.
    """
    pinhole = rig.pinhole
    # Pixel centers are whole numbers: a picture begins half a pixel before its first.
    edges_x = [(x - pinhole.ppx) / pinhole.fx for x in (-0.5, pinhole.width - 0.5)]
    edges_y = [(y - pinhole.ppy) / pinhole.fy for y in (-0.5, pinhole.height - 0.5)]
    return {"pose": rig.wall_from_lidar[:3].tolist(), "slopes": [*edges_x, *edges_y]}


def _light_path(rig: Rig, box: ObjectBox) -> Corners:
    """Return the path (5, 3) of one three-bounce echo: lidar, wall, hidden object, wall, lidar."""
    eye: Float64 = rig.wall_from_lidar[:3, 3]
    x_m = (box.x_min_m + box.x_max_m) / 2
    y_m = (box.y_min_m + box.y_max_m) / 2
    middle = np.array([x_m, y_m, box.z_near_m])
    there = np.array([0.6 * x_m, -0.04, 0.0])
    back = np.array([0.6 * x_m, 0.04, 0.0])
    return np.stack([eye, there, middle, back, eye]).tolist()


class MomentPacker:
    """Packer of one run's moments; the first ranges of depth and change that are known hold for
    all.
    """

    def __init__(self, *, picture_width: int = PICTURE_WIDTH) -> None:
        self._width = picture_width
        self._start_s: float | None = None
        self._span_m = (0.0, 1.0)
        self._span = LastingSpan(depth_span_m)
        self._change_span = LastingSpan(change_span_m)
        self._change_span_m = 0.0

    def pack(self, moment: Moment, *, with_lidar: bool = True) -> bytes:
        """Return a moment's message; the pictures of the lidar's view, most of its bytes, only if
        requested.
        """
        frame = moment.result.frame
        if self._start_s is None:
            self._start_s = moment.time_s
        self._span_m = self._span.of(frame.depth_m)

        arrays = _hidden_arrays(moment.result)
        if with_lidar:
            difference = moment.result.difference
            if difference is not None:
                self._change_span_m = self._change_span.of(difference.depth_m)
                arrays["change"] = signed_bytes(difference.depth_m, self._change_span_m)
            check = moment.result.check
            if check:
                arrays["residual"] = signed_bytes(check.residual_depth_m, RESIDUAL_SPAN_M)
            step = self._step(moment.result)
            arrays["lidar"] = depth_bytes(frame.depth_m[::step, ::step], *self._span_m)
            arrays["infrared"] = frame.ir[::step, ::step]
        return pack(self._fields(moment, moment.time_s - self._start_s), arrays)

    def _step(self, result: FrameResult) -> int:
        """Return the pixels from one column of a thinned lidar picture to the next."""
        return max(1, round(result.frame.ir.shape[1] / self._width))

    def _fields(self, moment: Moment, time_s: float) -> dict[str, Any]:
        result = moment.result
        assessment = assess(moment)
        score = result.check.score if result.check else np.nan
        return {
            "kind": "moment",
            "frame": result.frame_number,
            "time_s": round(time_s, 4),
            "latency_ms": round(1e3 * moment.latency_s, 2),
            "stages_ms": {name: round(1e3 * took_s, 2) for name, took_s in result.stages_s.items()},
            "dropped": moment.dropped,
            "celsius": {
                name.removesuffix("_temperature"): round(value, 1)
                for name, value in moment.known_celsius.items()
            },
            "verdict": result.verdict,
            "headline": assessment.headline,
            "detail": assessment.detail,
            "tone": assessment.tone,
            "trusted": assessment.trusted,
            "quality": _quality_fields(result.reconstruction.quality),
            "warnings": result.warnings,
            "lidar_span_m": self._span_m,
            "lidar_step": self._step(result),
            "change_span_m": self._change_span_m,
            "residual_span_m": RESIDUAL_SPAN_M,
            "score": round(score, 3) if np.isfinite(score) else None,
        }


def _hidden_arrays(result: FrameResult) -> dict[str, UInt8]:
    box = result.reconstruction.box
    span_m = (box.z_near_m, box.z_far_m)
    arrays = {"depth": depth_bytes(result.depth_m, *span_m)}
    if result.truth_depth_m is not None:
        arrays["truth"] = depth_bytes(result.truth_depth_m, *span_m)
    if result.uncertainty_m is not None:
        steps = np.rint(result.uncertainty_m / ERROR_STEP_M)
        arrays["error"] = np.clip(steps, 0, 255).astype(np.uint8)
    uncertainty = result.reconstruction.uncertainty
    if uncertainty is not None:
        p_surface = np.clip(uncertainty.p_surface, 0, 1)
        arrays["surface"] = np.rint(255 * p_surface).astype(np.uint8)
    return arrays


def _quality_fields(quality: Quality | None) -> dict[str, Any] | None:
    if quality is None:
        return None
    return {
        "iou": [round(share, 3) for share in quality.iou],
        "error_mm": round(1e3 * quality.error_m, 1),
        "trusted": quality.trusted,
    }


def depth_bytes(depth_m: NDArray[np.floating], near_m: float, far_m: float) -> UInt8:
    """Return depth as 1 (near) to 255 (far), clipped; 0 for NaN."""
    share = (depth_m - near_m) / max(far_m - near_m, 1e-6)
    counts = 1.5 + 254.0 * np.clip(share, 0.0, 1.0)
    return np.where(np.isnan(depth_m), 0.0, counts).astype(np.uint8)


def signed_bytes(values: NDArray[np.floating], span: float) -> UInt8:
    """Return values from -span to span as 1 to 255, 128 for zero, clipped; 0 for NaN."""
    counts = 128.5 + 127.0 * np.clip(values / span, -1.0, 1.0)
    return np.where(np.isnan(values), 0.0, counts).astype(np.uint8)
