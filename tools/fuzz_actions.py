"""What is done with every corrupted recording. An action is a function of its path and of an empty folder to write to.

It may end in an error of nlos-cam's tree; anything else is a finding. Add to ACTIONS, and the fuzz does it too.
"""

from collections.abc import Callable
from pathlib import Path

from rosbags.rosbag1 import Reader

from nlos_cam.camera.repair import repair


def repair_and_read(path: Path, folder: Path) -> None:
    """What was repaired can be read, and holds each of the frames claimed once."""
    out = folder / "repaired.bag"
    claimed = repair(path, out).recovered_frames
    with Reader(out) as reader:
        images = [connection for connection in reader.connections if connection.topic.endswith("/image/data")]
        found = [(connection.id, time_ns) for connection, time_ns, _ in reader.messages(images)]
    if sum(claimed.values()) != len(found):
        raise AssertionError(f"claimed {claimed}, {len(found)} can be read")
    if len(set(found)) != len(found):
        raise AssertionError("a frame is there twice")


ACTIONS: dict[str, Callable[[Path, Path], None]] = {"repair": repair_and_read}
