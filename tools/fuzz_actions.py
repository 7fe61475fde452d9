"""What is done with every corrupted recording. An action is a function of its path and of an empty folder to write to.

It may end in an error of nlos-cam's tree; anything else is a finding. Add to ACTIONS, and the fuzz does it too.
"""

from collections.abc import Callable
from pathlib import Path
from threading import Event

from rosbags.rosbag1 import Reader

from nlos_cam.errors import RecordingError
from nlos_cam.recording.bag_reader import BagFile
from nlos_cam.recording.export import Wanted, export
from nlos_cam.recording.playback import ReplayCamera
from nlos_cam.recording.repair import repair


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


def replay_all(path: Path, folder: Path) -> None:
    """Every frame that is given is whole, and they come in order."""
    del folder
    last = -1
    with ReplayCamera(path) as camera:
        for frame in camera:
            if (
                not frame.depth_m.shape
                == frame.ir.shape
                == frame.confidence.shape
                == (frame.intrinsics.height, frame.intrinsics.width)
            ):
                raise AssertionError(f"frame {frame.frame_number} is not whole")
            if frame.frame_number <= last:
                raise AssertionError(f"frame {frame.frame_number} comes after {last}")
            last = frame.frame_number


def export_all(path: Path, folder: Path) -> None:
    """As many files are there as are told of, wherever the recording is damaged."""
    made = export(BagFile(path), folder / "export", Wanted(points=True), stop=Event())
    for stream, count in made.frames.items():
        if len(list((folder / "export" / stream).iterdir())) != count:
            raise AssertionError(f"told of {count} {stream}, and wrote others")
    if made.damage:
        raise RecordingError(made.damage)


ACTIONS: dict[str, Callable[[Path, Path], None]] = {
    "replay": replay_all,
    "export": export_all,
    "repair": repair_and_read,
}
