"""Opening of a recording of any format: librealsense's .bag, or a bag of ROS 1 or 2."""

from pathlib import Path
from typing import TYPE_CHECKING

from nlos_cam.errors import RecordingError
from nlos_cam.recording.bag_messages import IMAGE
from nlos_cam.recording.bag_reader import DEVICE, BagReader, no_frames

if TYPE_CHECKING:
    from nlos_cam.recording.ros_reader import RosReader

SUFFIXES = {".db3", ".mcap"}
METADATA_FILE = "metadata.yaml"
"""File that makes a folder a bag of ROS 2."""


def is_ros2(path: Path) -> bool:
    """Return whether a path is that of a bag of ROS 2: a folder with metadata.yaml, .db3, .mcap."""
    return path.suffix in SUFFIXES or (path / METADATA_FILE).exists()


def open_recording(path: Path) -> "BagReader | RosReader":
    """Open a recording of librealsense or of a ROS driver. Raises RecordingError, also for one
    without frames.
    """
    if is_ros2(path):
        if not path.exists():
            raise RecordingError(f"{path} does not exist: give the path of a recording")
        from nlos_cam.recording.ros_reader import RosReader

        return RosReader(path)
    bag = BagReader(path)
    if bag.streams:
        return bag
    from nlos_cam.recording.ros_reader import IMAGE_TOPIC, RosReader

    images = [
        topic
        for topic, entries in bag.entries.items()
        if entries and bag.types[topic] == IMAGE and not topic.startswith(DEVICE)
    ]
    if any(map(IMAGE_TOPIC.match, images)):
        return RosReader(bag.path, bag)
    raise RecordingError(no_frames(bag))
