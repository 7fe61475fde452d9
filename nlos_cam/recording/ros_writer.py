"""Export of a recording to a bag of ROS 2, with the topics of Intel's driver realsense2_camera."""

import json
import logging
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from glob import escape
from math import floor
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any, Literal

import apsw
import numpy as np
from nlos_calibration.arrays import Float64
from numpy.typing import NDArray
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from trimesh.transformations import quaternion_from_matrix

from nlos_cam.camera import Sample
from nlos_cam.errors import DiskFullError, RecordingError
from nlos_cam.files import atomic_directory
from nlos_cam.recording.bag_messages import CAMERA, IMAGE
from nlos_cam.recording.bag_reader import BagReader, StreamInfo
from nlos_cam.recording.device_clock import unwrapped_samples
from nlos_cam.recording.export import ExportResult, require_frames
from nlos_cam.recording.ros_messages import METADATA, SDK_LENSES, TRANSFORMS, ros2_types

if TYPE_CHECKING:
    from nlos_cam.recording.ros_reader import RosReader

Storage = Literal["sqlite3", "mcap"]
ROOT_FRAME = "camera_link"
ROOT_FROM_OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""ROS's body frame is x forward, y left, z up (REP 103); the optical frame x right, y down, z
forward.
"""
ENCODINGS = {"y8": "mono8", "raw8": "mono8", "y16": "mono16"}
"""Encodings of the driver by the SDK's format, where they differ from each other."""
COLORS = {"rgb8", "bgr8", "rgba8", "bgra8"}
PLUMB_BOB = "plumb_bob"
ROS_LENSES = {"rational_polynomial": "rational_polynomial"} | {
    model: name for name, model in SDK_LENSES.items()
}
"""ROS's names of distortion models by the SDK's, with the same formulas in both."""
LIKE_PLUMB_BOB = {"modified_brown_conrady", "inverse_brown_conrady"}
"""Models of other formulas, which are ROS's where there is no distortion."""
EQUIDISTANT_COEFFICIENTS = 4
"""The SDK has a fifth, which it does not use."""
MAX_COUNT = 65535
MM_PER_M = 1e3
FOREVER = QosTime(9223372036, 854775807)
"""ROS's spelling of a time without end: 2**63 - 1 ns."""
LATCHED = Qos(
    history=QosHistory.KEEP_LAST,
    depth=1,
    reliability=QosReliability.RELIABLE,
    durability=QosDurability.TRANSIENT_LOCAL,
    deadline=FOREVER,
    lifespan=FOREVER,
    liveliness=QosLiveliness.AUTOMATIC,
    liveliness_lease_duration=FOREVER,
    avoid_ros_namespace_conventions=False,
)
"""Quality of service of static transforms, which `ros2 bag play` offers: tf2 subscribes to
/tf_static as transient local, and receives nothing from a publisher that is not.
"""
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RosOptions:
    """Storage of the bag, and unit of its depth."""

    storage: Storage = "sqlite3"
    metres: bool = False
    """Depth as 32FC1 metres, which keeps every bit; otherwise as 16UC1 millimetres, rounded, as
    the driver writes it.
    """


def export_ros2(
    bag: "BagReader | RosReader",
    out: Path,
    options: RosOptions,
    *,
    stop: Event,
    on_frame: Callable[[], None] = lambda: None,
) -> ExportResult:
    """Write a recording's images, camera_info, metadata and static transforms as a bag of ROS 2.

    Setting `stop` ends it early and keeps the frames so far, and so does damage within the
    recording; before the first frame it raises KeyboardInterrupt and writes nothing. Raises
    RecordingError without a stream or a frame to write.
    """
    streams = [name for name, info in bag.streams.items() if _is_writable(info)]
    if not streams:
        encodings = ", ".join(f"{name} {info.encoding}" for name, info in bag.streams.items())
        raise RecordingError(f"{bag.path} has no stream that can be written: it has {encodings}")
    written: Counter[str] = Counter(dict.fromkeys(streams, 0))
    damage = ""
    name = out.resolve().name
    # an earlier export's in the other storage would be read with this one's metadata
    with atomic_directory(out, drop=[f"{escape(name)}.{end}" for end in ("db3", "mcap")]) as part:
        # rosbags names its files by the folder, which it has to make itself.
        folder = part / name
        plugin = StoragePlugin.MCAP if options.storage == "mcap" else StoragePlugin.SQLITE3
        try:
            with Writer(folder, version=8, storage_plugin=plugin) as writer:
                topics = _Topics(writer, bag, streams, options)
                try:
                    for time_ns, sample in unwrapped_samples(bag, streams):
                        if stop.is_set():
                            break
                        topics.write(time_ns, sample)
                        written[sample.stream] += 1
                        on_frame()
                except RecordingError as error:
                    damage = str(error)
        except (apsw.FullError, apsw.IOError) as error:
            raise DiskFullError(
                f"{out} cannot be written ({error}): free some space or choose another folder"
            ) from error
        for path in folder.iterdir():
            path.rename(part / path.name)
        folder.rmdir()
        reason = damage and f" ({damage})"
        require_frames(written.total(), stop, f"{bag.path} has no frame to write{reason}")
    return ExportResult(dict(written), str(out), damage)


def ros_lens(model: str, coefficients: Float64) -> tuple[str, Float64]:
    """Return the distortion model by ROS's name, and its coefficients, of a lens by the SDK's.

    A model that ROS does not have keeps the SDK's name: image_geometry then takes the distortion
    for unknown, and rectifies nothing, in place of rectifying by another model's formula.
    """
    # librealsense's rsutil.h: the modified model scales x and y by the radial polynomial before its
    # tangential terms, the inverse one leads from distorted to ideal points.
    if model == "none":
        return PLUMB_BOB, np.zeros(5)
    tangential = coefficients[2:4] if model == "modified_brown_conrady" else coefficients
    if model in LIKE_PLUMB_BOB and not tangential.any():
        return PLUMB_BOB, coefficients
    name = ROS_LENSES.get(model, model)
    return name, coefficients[:EQUIDISTANT_COEFFICIENTS] if name == "equidistant" else coefficients


def _is_writable(info: StreamInfo) -> bool:
    return info.format in {"z16", *ENCODINGS, *COLORS}


class _Topics:
    """Topics of the driver in an open bag."""

    def __init__(
        self, writer: Any, bag: "BagReader | RosReader", streams: list[str], options: RosOptions
    ) -> None:
        self._writer = writer
        self._types = ros2_types()
        self._bag = bag
        self._options = options
        self._unit_m = bag.depth_unit_m() if "depth" in streams else 0.0
        self._domains = {name: bag.metadata(name, 0).domain for name in streams}
        self._infos = {name: self._camera_info(name) for name in streams}
        self._connections: dict[tuple[str, str], Any] = {}
        for name in streams:
            base = f"/camera/{name.replace('infrared_', 'infra').replace('infrared', 'infra')}"
            image = "image_raw" if name == "color" else "image_rect_raw"
            for topic, kind in ((image, IMAGE), ("camera_info", CAMERA), ("metadata", METADATA)):
                self._connections[name, kind] = self._add(f"{base}/{topic}", kind)
        self._tf = self._add("/tf_static", TRANSFORMS, LATCHED)
        self._streams = streams
        self._offset_ns: int | None = None

    def _add(self, topic: str, kind: str, *offered: Qos) -> Any:
        return self._writer.add_connection(
            topic, kind, typestore=self._types, offered_qos_profiles=offered
        )

    def write(self, time_ns: int, sample: Sample) -> None:
        """Write a frame with its camera_info and metadata; before the first, the transforms."""
        stamp_ns = floor(sample.timestamp_s) * 10**9 + round(sample.timestamp_s % 1 * 1e9)
        if self._offset_ns is None:  # the recorder's clock starts at 0, that of ROS in 1970
            self._offset_ns = max(stamp_ns - time_ns, 0)
            self._write(self._tf, stamp_ns, TRANSFORMS, self._transforms(stamp_ns))
        at_ns = time_ns + self._offset_ns
        header = self._header(stamp_ns, _frame_of(sample.stream))
        facts = {
            "frame_number": sample.number,
            "clock_domain": self._domains[sample.stream],
            "frame_timestamp": sample.timestamp_s * 1e3,
        }
        info = self._infos[sample.stream]
        info.header = header
        messages = {
            METADATA: self._new(METADATA, header=header, json_data=json.dumps(facts)),
            CAMERA: info,
            IMAGE: self._image(header, sample),
        }
        for kind, message in messages.items():
            self._write(self._connections[sample.stream, kind], at_ns, kind, message)

    def _write(self, connection: Any, time_ns: int, kind: str, message: Any) -> None:
        self._writer.write(connection, time_ns, self._types.serialize_cdr(message, kind))

    def _new(self, kind: str, **fields: Any) -> Any:
        return self._types.types[kind](**fields)

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        sec, nanosec = divmod(stamp_ns, 10**9)
        stamp = self._new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self._new("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)

    def _image(self, header: Any, sample: Sample) -> Any:
        pixels = sample.pixels
        form = self._bag.streams[sample.stream].format
        encoding = ENCODINGS.get(form, form)
        if form == "z16":
            encoding = "32FC1" if self._options.metres else "16UC1"
            pixels = self._depth(pixels)
        return self._new(
            IMAGE,
            header=header,
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=pixels.nbytes // pixels.shape[0],
            data=np.ascontiguousarray(pixels).view(np.uint8).reshape(-1),
        )

    def _depth(self, counts: NDArray[Any]) -> NDArray[Any]:
        if self._options.metres:
            return (counts * np.float32(self._unit_m)).astype("<f4")
        millimetres = np.rint(counts * (self._unit_m * MM_PER_M))
        return np.where(millimetres > MAX_COUNT, 0, millimetres).astype("<u2")

    def _camera_info(self, stream: str) -> Any:
        pinhole = self._bag.streams[stream].intrinsics
        model, coefficients = ros_lens(*self._bag.lens(stream))
        if model not in {PLUMB_BOB, *ROS_LENSES.values()}:
            log.warning(
                "%s: ROS has no distortion model %s: its camera_info names it all the same, and"
                " ROS's tools do not rectify these images",
                stream,
                model,
            )
        matrix = np.array([[pinhole.fx, 0, pinhole.ppx], [0, pinhole.fy, pinhole.ppy], [0, 0, 1.0]])
        region = self._new(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0,
            y_offset=0,
            height=0,
            width=0,
            do_rectify=False,
        )
        return self._new(
            CAMERA,
            header=self._header(0, ""),
            height=pinhole.height,
            width=pinhole.width,
            distortion_model=model,
            d=np.asarray(coefficients, np.float64),
            k=matrix.reshape(-1),
            r=np.eye(3).reshape(-1),
            p=np.hstack([matrix, np.zeros((3, 1))]).reshape(-1),
            binning_x=0,
            binning_y=0,
            roi=region,
        )

    def _transforms(self, stamp_ns: int) -> Any:
        """Return the optical frame of the first stream, preferably depth, below the root, and the
        others' below it.
        """
        reference = "depth" if "depth" in self._streams else self._streams[0]
        found = [self._transform(stamp_ns, ROOT_FRAME, _frame_of(reference), ROOT_FROM_OPTICAL)]
        for name in self._streams:
            if name == reference:
                continue
            try:
                pose = self._bag.pose(reference, name)
            except RecordingError:  # no extrinsics recorded
                continue
            found.append(self._transform(stamp_ns, _frame_of(reference), _frame_of(name), pose))
        return self._new(TRANSFORMS, transforms=found)

    def _transform(self, stamp_ns: int, parent: str, child: str, pose: Float64) -> Any:
        w, x, y, z = (float(value) for value in quaternion_from_matrix(pose))
        shift = [float(value) for value in pose[:3, 3]]
        transform = self._new(
            "geometry_msgs/msg/Transform",
            translation=self._new("geometry_msgs/msg/Vector3", x=shift[0], y=shift[1], z=shift[2]),
            rotation=self._new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        )
        return self._new(
            "geometry_msgs/msg/TransformStamped",
            header=self._header(stamp_ns, parent),
            child_frame_id=child,
            transform=transform,
        )


def _frame_of(stream: str) -> str:
    return f"camera_{stream}_optical_frame"
