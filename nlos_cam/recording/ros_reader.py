"""Reader of recordings made by the ROS drivers of RealSense cameras (realsense2_camera 1 and 2)."""

import json
import re
from collections import Counter, deque
from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration import Intrinsics
from nlos_calibration.arrays import Float64
from numpy.typing import NDArray

from nlos_cam.camera import FRAMES_PER_S, SAME_INSTANT_S, ClockUnwrap, Sample
from nlos_cam.errors import RecordingError
from nlos_cam.files import describe
from nlos_cam.recording import bag_messages
from nlos_cam.recording.bag_messages import CAMERA, HARDWARE_CLOCK, IMAGE, FrameMetadata
from nlos_cam.recording.bag_reader import BagReader, StreamInfo
from nlos_cam.recording.ros_messages import (
    SDK_LENSES,
    TRANSFORMS,
    Ros1Source,
    Ros2Source,
    Source,
)

IMAGE_TOPIC = re.compile(
    r"(?:/[^/]{1,100}){0,6}?/(depth|infra|infrared|confidence|color)([12]?)/image(_rect)?(_raw)?$"
)
ROLES = {"infra": "infrared"}
"""The SDK's names of streams by the driver's, where they differ."""
DEPTH_UNITS_M = {"16UC1": 1e-3, "mono16": 1e-3, "32FC1": 1.0}
"""Depth in metres per count, by encoding (REP 118: millimetres as integers, metres as floats)."""
PIXELS = {
    "16UC1": ("u2", 1),
    "mono16": ("u2", 1),
    "32FC1": ("f4", 1),
    "8UC1": ("u1", 1),
    "mono8": ("u1", 1),
    "rgb8": ("u1", 3),
    "bgr8": ("u1", 3),
    "rgba8": ("u1", 4),
    "bgra8": ("u1", 4),
}
"""Type and values of a pixel, by encoding."""
SDK_ENCODINGS = {
    "depth": dict.fromkeys(DEPTH_UNITS_M, "mono16"),
    "infrared": {"8UC1": "8UC1", "mono8": "8UC1", "16UC1": "16UC1", "mono16": "16UC1"},
    "confidence": {"8UC1": "mono8", "mono8": "mono8"},
    "color": {name: name for name in ("rgb8", "bgr8", "rgba8", "bgra8")},
}
"""Encoding as librealsense's recorder names it, by stream and by the driver's encoding."""
MAX_NUMBERS = 1_000_000
"""Bound on the frames whose numbers are read in advance."""
MAX_TRANSFORMS = 1000
RECENT_INSTANTS = 30


class RosReader:
    """Recording of a RealSense camera by its ROS driver, with the methods of `BagReader`.

    Streams are found by the roles in their topics' names, depth's unit by its encoding. Frame
    numbers are the device's where the driver's metadata were recorded, otherwise those of instants
    in steps of 1 / 30 s. Opening and every method raise RecordingError.
    """

    def __init__(self, path: Path, bag: BagReader | None = None) -> None:
        """Take the `bag` of ROS 1 that was opened at `path`, if it is one."""
        self.path = path
        self.device: Mapping[str, str] = {"name": "camera of a ROS driver"}
        self.end_ns = 0
        self._images: dict[str, tuple[str, str]] = {}
        """Topic of a stream's images, and their encoding."""
        self._frame_ids: dict[str, str] = {}
        self._lenses: dict[str, tuple[str, Float64]] = {}
        self._numbers: dict[tuple[str, int, int], int] = {}
        """Frame number by stream and stamp in s and ns."""
        self._domain = ""
        self.streams: dict[str, StreamInfo] = {}
        with self._raise():
            self._source: Source = Ros1Source(bag) if bag else Ros2Source(path)
            for topic, (kind, count) in self._source.topics.items():
                if kind == IMAGE and count and (match := IMAGE_TOPIC.match(topic)):
                    self._add_stream(topic, ROLES.get(match[1], match[1]), match[2])
            if not self.streams:
                raise RecordingError(self._no_streams())
            self._read_numbers()

    def _no_streams(self) -> str:
        topics = ", ".join(sorted(self._source.topics)[:4]).encode("unicode_escape").decode()
        return (
            f"{self.path} has no images of a RealSense driver (it has {topics[:300] or 'no topics'}):"
            " record depth/image_rect_raw, infra/image_rect_raw and their camera_info"
        )

    @contextmanager
    def _raise(self) -> Generator[None]:
        """Raise any exception within the block as a RecordingError of one line."""
        try:
            yield
        except RecordingError:
            raise
        except Exception as error:  # damaged bytes make the libraries raise almost anything
            raise RecordingError(
                f"{self.path} is not a whole bag of ROS ({describe(error)[:300]}): record or copy"
                " it again"
            ) from error

    def _first(self, topic: str) -> tuple[int, Any]:
        """Return the recorder's time and the first message of a topic."""
        for _, time_ns, message in self._source.messages({topic}):
            return time_ns, message
        raise RecordingError(f"{self.path} has no message on {topic}")

    def _add_stream(self, topic: str, role: str, index: str) -> None:
        name = f"{role}_{index}" if index else role
        if name in self.streams:
            raise RecordingError(
                f"{self.path} has two streams for {name} ({self._images[name][0]}, {topic}):"
                " record one camera"
            )
        described_by = f"{topic.rpartition('/')[0]}/camera_info"
        if self._source.topics.get(described_by, ("", 0))[0] != CAMERA:
            raise RecordingError(
                f"{self.path} has no {described_by}, which describes {topic}: record it too"
            )
        _, image = self._first(topic)
        _, info = self._first(described_by)
        encoding = str(image.encoding)[: bag_messages.MAX_TEXT]
        self._images[name] = topic, encoding
        self._frame_ids[name] = str(image.header.frame_id)
        coefficients = np.asarray(_field(info, "D"), np.float64)
        model = bag_messages.sdk_name(info.distortion_model)
        self._lenses[name] = SDK_LENSES.get(model, model), coefficients
        frames = self._source.topics[topic][1]
        sdk_encoding = SDK_ENCODINGS[role].get(encoding, encoding)
        self.streams[name] = StreamInfo(
            name, topic, 0, sdk_encoding, FRAMES_PER_S, _intrinsics_of(info), frames
        )

    def _read_numbers(self) -> None:
        """Read the device's frame numbers from the driver's metadata, as far as recorded."""
        topics = {
            f"{topic.rpartition('/')[0]}/metadata": name
            for name, (topic, _) in self._images.items()
        }
        present = {topic for topic in topics if topic in self._source.topics}
        for topic, _, message in self._source.messages(present):
            values = json.loads(message.json_data)
            number = values.get("frame_number")
            stamp = message.header.stamp
            if isinstance(number, int) and 0 <= number < 1 << 62:
                self._numbers[topics[topic], stamp.sec, stamp.nanosec] = number
            domain = values.get("clock_domain")
            if topics[topic] == "depth" and not self._domain and isinstance(domain, str):
                self._domain = bag_messages.sdk_name(domain)
            if len(self._numbers) > MAX_NUMBERS:
                raise ValueError(f"more than {MAX_NUMBERS} frames")

    def timed_samples(self, streams: Iterable[str]) -> Iterator[tuple[int, Sample]]:
        """Yield the recorder's time in ns of all frames of these streams, and the frames, in the
        order of recording.
        """
        names = {self._images[name][0]: name for name in streams}
        instants = _InstantNumbers()
        last = Counter[str]()
        with self._raise():
            for topic, time_ns, image in self._source.messages(set(names)):
                name = names[topic]
                stamp = image.header.stamp
                number = self._numbers.get((name, stamp.sec, stamp.nanosec))
                time_s = bag_messages.timestamp_s(image)
                if number is None:
                    number = last[name] + 1 if self._numbers else instants.add(name, time_s)
                last[name] = number
                yield time_ns, Sample(name, number, time_s, self._pixels(name, image))

    def samples(self, streams: Iterable[str]) -> Iterator[Sample]:
        """Yield all frames of these streams, in the order of recording."""
        return (sample for _, sample in self.timed_samples(streams))

    def _pixels(self, stream: str, image: Any) -> NDArray[Any]:
        """Return an image's values, (height, width) or (height, width, channels)."""
        encoding = self._images[stream][1]
        if not self.streams[stream].format:
            raise RecordingError(
                f"{self.path}: unsupported encoding of the {stream} stream: {encoding!r}"
            )
        dtype, channels = PIXELS[encoding]
        pinhole = self.streams[stream].intrinsics
        row_bytes = image.width * channels * np.dtype(dtype).itemsize
        is_whole = image.step >= row_bytes and image.data.nbytes == image.height * image.step
        is_declared = (image.width, image.height) == (pinhole.width, pinhole.height)
        if image.encoding != encoding or not is_whole or not is_declared:
            raise ValueError(
                f"an image of {image.width} x {image.height} {image.encoding[:20]!r} on"
                f" {self._images[stream][0]}, where its camera_info and the first one differ"
            )
        rows = image.data.reshape(image.height, image.step)[:, :row_bytes]
        order = ">" if image.is_bigendian else "<"
        values = np.array(rows).view(order + dtype).astype(dtype)
        if encoding == "32FC1":
            values[~(np.isfinite(values) & (values > 0))] = 0.0
        shape = image.height, image.width, channels
        return values.reshape(shape if channels > 1 else shape[:2])

    def check(self) -> None:
        """Read every frame. Raises RecordingError at the first damage."""
        for _ in self.timed_samples(name for name, info in self.streams.items() if info.format):
            pass

    def duration_s(self, stream: str) -> float:
        """Return the time from the first frame of a stream to its last, by their stamps, and over
        the wraps of a device's own clock.
        """
        with self._raise():
            times_s = [
                bag_messages.timestamp_s(image)
                for _, _, image in self._source.messages({self._images[stream][0]})
            ]
        if self._domain == HARDWARE_CLOCK:
            clock = ClockUnwrap()
            times_s = [clock.add(time_s) for time_s in times_s]
        return max(times_s) - min(times_s)

    def metadata(self, stream: str, index: int) -> FrameMetadata:
        """Return the clock of the frames, where the driver's metadata say it."""
        del stream, index
        return FrameMetadata(self._domain, {})

    def settings(self, time_ns: int = 0, stream: str = "depth") -> Mapping[str, float]:
        """Return no options: the driver records none."""
        del time_ns, stream
        return {}

    def lens(self, stream: str) -> tuple[str, Float64]:
        """Return the distortion model of a stream and its coefficients."""
        return self._lenses[stream]

    def gravity(self) -> None:
        """Return None: the driver's accelerometer is not read."""

    def depth_unit_m(self) -> float:
        """Return metres per depth count, by the encoding."""
        encoding = self._images["depth"][1]
        if encoding not in DEPTH_UNITS_M:
            raise RecordingError(
                f"{self.path}: unsupported encoding of the depth stream: {encoding!r}"
            )
        return DEPTH_UNITS_M[encoding]

    def pose(self, stream: str, other: str) -> Float64:
        """Return stream_from_other (4, 4). Raises RecordingError where no transforms join the
        two.
        """
        if stream == other:
            return np.eye(4)
        with self._raise():
            parents = self._transforms()
            mine_root, root_from_mine = _to_root(self._frame_ids[stream], parents)
            other_root, root_from_other = _to_root(self._frame_ids[other], parents)
        if mine_root != other_root:
            raise RecordingError(f"{self.path} has no extrinsics between {stream} and {other}")
        return np.linalg.inv(root_from_mine) @ root_from_other

    def _transforms(self) -> dict[str, tuple[str, Float64]]:
        """Return the parent of each frame, and parent_from_frame (4, 4)."""
        parents = dict[str, tuple[str, Float64]]()
        if self._source.topics.get("/tf_static", ("", 0))[0] != TRANSFORMS:
            return parents
        for _, _, message in self._source.messages({"/tf_static"}):
            for found in message.transforms:
                pose = bag_messages.pose_of(found.transform)
                parents[found.child_frame_id] = found.header.frame_id, pose
            if len(parents) > MAX_TRANSFORMS:
                raise ValueError(f"more than {MAX_TRANSFORMS} frames of reference")
        return parents


class _InstantNumbers:
    """Numbers of frames by their stamps: frames of one instant share one, a gap skips some."""

    def __init__(self) -> None:
        self._recent: deque[tuple[int, float, set[str]]] = deque(maxlen=RECENT_INSTANTS)

    def add(self, stream: str, time_s: float) -> int:
        """Return the number of a frame; feed frames in the order of recording."""
        for number, instant_s, streams in self._recent:
            if stream not in streams and abs(instant_s - time_s) <= SAME_INSTANT_S:
                streams.add(stream)
                return number
        number = 0
        if self._recent:
            last, last_s, _ = self._recent[-1]
            number = last + max(1, round((time_s - last_s) * FRAMES_PER_S))
        self._recent.append((number, time_s, {stream}))
        return number


def _field(info: Any, name: str) -> Any:
    """Return a field of CameraInfo, which ROS 1 writes in capitals."""
    return getattr(info, name, None) if hasattr(info, name) else getattr(info, name.lower())


def _intrinsics_of(info: Any) -> Intrinsics:
    """Return the pinhole parameters of a CameraInfo. Raises ValueError for absurd ones."""
    matrix = _field(info, "K")
    numbers = [float(matrix[i]) for i in (0, 4, 2, 5)]
    size = info.width * info.height
    if not 0 < size <= bag_messages.MAX_PIXELS or not all(map(isfinite, numbers)):
        raise ValueError(
            f"a camera of {info.width} x {info.height} pixels with the pinhole {numbers}"
        )
    return Intrinsics(info.width, info.height, *numbers)


def _to_root(frame: str, parents: Mapping[str, tuple[str, Float64]]) -> tuple[str, Float64]:
    """Return the root above a frame, and root_from_frame (4, 4)."""
    pose = np.eye(4)
    for _ in range(len(parents)):
        if frame not in parents:
            break
        frame, parent_from_frame = parents[frame]
        pose = parent_from_frame @ pose
    return frame, pose
