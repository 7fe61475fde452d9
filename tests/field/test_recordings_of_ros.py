"""Someone records with the ROS driver of a RealSense camera, or takes a recording to ROS."""

import json
import os
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from backports import zstd
from rewritten_bags import LENS, TURNED, infrared_lens, turned_infrared
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import Reader, StoragePlugin, Writer, storage_mcap
from rosbags.typesys import Stores, get_typestore

from nlos_cam.camera import WRAP_PERIOD_S
from nlos_cam.errors import RecordingError
from nlos_cam.recording import SAMPLE, BagReader, ReplayCamera, open_recording
from nlos_cam.recording.bag_messages import CAMERA, IMAGE
from nlos_cam.recording.ros_messages import METADATA, ros2_types

Run = Callable[..., Any]
ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)


def frames_of(path: Path) -> list[tuple[Any, ...]]:
    with ReplayCamera(path) as camera:
        return [
            (
                frame.frame_number,
                frame.timestamp_s,
                frame.depth_m.tobytes(),
                frame.ir.tobytes(),
                frame.confidence.tobytes(),
            )
            for frame in camera
        ]


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """Export the sample in both storages, with depth in metres."""
    from nlos_cam.cli.main import main

    folder = tmp_path_factory.mktemp("ros")
    found = SimpleNamespace(sqlite3=folder / "sqlite3", mcap=folder / "mcap")
    for storage, out in vars(found).items():
        options = ["--storage", storage, "--metres", "--json"]
        assert main(["export", str(SAMPLE), "--ros2", str(out), *options]) == 0
    return found


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_bag_of_ros_2_gives_the_same_frames(bags: SimpleNamespace, storage: str) -> None:
    folder = getattr(bags, storage)
    file = next(path for path in folder.iterdir() if path.suffix != ".yaml")

    assert frames_of(folder) == frames_of(SAMPLE)
    assert frames_of(file) == frames_of(SAMPLE)


@pytest.mark.slow
def test_bag_of_ros_2_gives_the_same_reconstructions(bags: SimpleNamespace, run: Run) -> None:
    run("replay", SAMPLE, "--out", "whole")
    run("replay", bags.mcap, "--out", "other")
    with np.load("whole/reconstruction.npz") as whole, np.load("other/reconstruction.npz") as other:
        assert whole.files == other.files
        assert all(whole[name].tobytes() == other[name].tobytes() for name in whole.files)


def test_export_to_ros_replaces_one_in_the_other_storage(run: Run) -> None:
    run("export", SAMPLE, "--ros2", "ros")
    run("export", SAMPLE, "--ros2", "ros", "--storage", "mcap", "--overwrite")

    assert sorted(path.name for path in Path("ros").iterdir()) == ["metadata.yaml", "ros.mcap"]


def test_millimetres_are_rounded(run: Run) -> None:
    run("export", SAMPLE, "--ros2", "mm")
    with ReplayCamera(SAMPLE) as exact, ReplayCamera(Path("mm")) as rounded:
        for one, other in zip(exact, rounded, strict=True):
            np.testing.assert_allclose(other.depth_m, one.depth_m, atol=0.5001e-3)


def test_bag_of_ros_2_keeps_pinholes_lenses_and_poses(
    remake: Callable[..., Path], run: Run
) -> None:
    path = remake(turned_infrared)
    run("export", path, "--ros2", "out")
    ours = open_recording(Path("out"))
    bag = BagReader(path)

    assert ours.lens("infrared")[0] == "brown_conrady"
    np.testing.assert_allclose(bag.pose("depth", "infrared"), TURNED, atol=1e-9)

    for name, info in bag.streams.items():
        assert ours.streams[name].intrinsics == info.intrinsics
        np.testing.assert_allclose(ours.lens(name)[1], bag.lens(name)[1], atol=1e-9)
        np.testing.assert_allclose(ours.pose("depth", name), bag.pose("depth", name), atol=1e-9)


STRAIGHT = [0.0] * 5
RADIAL = [0.15, -0.5, 0.0, 0.0, 0.47]


@pytest.mark.parametrize(
    ("model", "coefficients", "name", "written"),
    [
        ("None", STRAIGHT, "plumb_bob", STRAIGHT),
        ("Brown Conrady", LENS, "plumb_bob", LENS),
        ("Modified Brown Conrady", RADIAL, "plumb_bob", RADIAL),
        ("Modified Brown Conrady", LENS, "modified_brown_conrady", LENS),
        ("Inverse Brown Conrady", STRAIGHT, "plumb_bob", STRAIGHT),
        ("Inverse Brown Conrady", RADIAL, "inverse_brown_conrady", RADIAL),
        ("Kannala Brandt4", LENS, "equidistant", LENS[:4]),
        ("Ftheta", RADIAL, "ftheta", RADIAL),
    ],
)
def test_lens_has_the_name_that_ros_has_for_it(
    remake: Callable[..., Path],
    run: Run,
    caplog: pytest.LogCaptureFixture,
    model: str,
    coefficients: list[float],
    name: str,
    written: list[float],
) -> None:
    run("export", remake(infrared_lens(model, coefficients)), "--ros2", "out")
    with Reader("out") as reader:
        wanted = [each for each in reader.connections if each.topic == "/camera/infra/camera_info"]
        raw = next(reader.messages(wanted))[2]
    info = ROS2.deserialize_cdr(raw, CAMERA)
    said = [each for each in caplog.messages if "infrared" in each]

    assert info.distortion_model == name
    np.testing.assert_allclose(info.d, written, atol=1e-9)
    assert len(said) == (name not in {"plumb_bob", "equidistant"})


def test_fisheye_lens_comes_back_from_ros_by_the_sdks_name(
    remake: Callable[..., Path], run: Run
) -> None:
    run("export", remake(infrared_lens("Kannala Brandt4", LENS)), "--ros2", "out")

    assert open_recording(Path("out")).lens("infrared")[0] == "kannala_brandt4"


class Driver:
    """Messages as a driver publishes them, of ROS 1 or 2, from the sample."""

    def __init__(self, writer: Any, types: Any, base: str) -> None:
        self._writer = writer
        self._types = types
        self._is_ros1 = types is ROS1
        self._base = base
        self._topics: dict[str, Any] = {}

    def _new(self, kind: str, **fields: Any) -> Any:
        return self._types.types[kind](**fields)

    def _write(self, topic: str, kind: str, time_ns: int, message: Any) -> None:
        if topic not in self._topics:
            self._topics[topic] = self._writer.add_connection(topic, kind, typestore=self._types)
        serialize = self._types.serialize_ros1 if self._is_ros1 else self._types.serialize_cdr
        self._writer.write(self._topics[topic], time_ns, serialize(message, kind))

    def publish(
        self, sample: Any, pinhole: Any, *, info: bool = True, recorded_ns: int | None = None
    ) -> None:
        name, encoding = {
            "depth": ("depth", "16UC1"),
            "infrared": ("infra", "mono8"),
            "confidence": ("confidence", "mono8"),
        }[sample.stream]
        nanosec = round(sample.timestamp_s * 1e9)
        sec = 7 + nanosec // 10**9
        stamp = self._new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec % 10**9)
        seq = {"seq": 0} if self._is_ros1 else {}
        header = self._new("std_msgs/msg/Header", stamp=stamp, frame_id=name, **seq)
        pixels = sample.pixels
        if sample.stream == "depth":
            pixels = np.rint(pixels * 0.25).astype("<u2")
        image = self._new(
            IMAGE,
            header=header,
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=pixels.nbytes // pixels.shape[0],
            data=pixels.view(np.uint8).reshape(-1),
        )
        time_ns = nanosec + 1 if recorded_ns is None else recorded_ns
        self._write(f"{self._base}/{name}/image_rect_raw", IMAGE, time_ns, image)
        if info:
            camera = self._info(header, pinhole)
            self._write(f"{self._base}/{name}/camera_info", CAMERA, time_ns, camera)

    def publish_clock(self, domain: str) -> None:
        header = self._new(
            "std_msgs/msg/Header",
            stamp=self._new("builtin_interfaces/msg/Time", sec=0, nanosec=0),
            frame_id="depth",
        )
        found = self._new(METADATA, header=header, json_data=json.dumps({"clock_domain": domain}))
        self._write(f"{self._base}/depth/metadata", METADATA, 1, found)

    def _info(self, header: Any, pinhole: Any) -> Any:
        k = np.array([pinhole.fx, 0, pinhole.ppx, 0, pinhole.fy, pinhole.ppy, 0, 0, 1.0])
        arrays = {"d": np.zeros(5), "k": k, "r": np.eye(3).reshape(-1), "p": np.zeros(12)}
        if self._is_ros1:
            arrays = {name.upper(): value for name, value in arrays.items()}
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
            header=header,
            height=pinhole.height,
            width=pinhole.width,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=region,
            **arrays,
        )


def driven(path: Path, version: int, streams: tuple[str, ...], *, info: bool = True) -> Path:
    """Write the sample as the driver for ROS 1 or 2 does, in millimetres and without metadata."""
    bag = BagReader(SAMPLE)
    if version == 1:
        writer, types, base = Ros1Writer(path), ROS1, "/camera"
    else:
        writer = Writer(path, version=8, storage_plugin=StoragePlugin.MCAP)
        types, base = ROS2, "/camera/camera"
    with writer:
        driver = Driver(writer, types, base)
        for sample in bag.samples(streams):
            driver.publish(sample, bag.streams[sample.stream].intrinsics, info=info)
    return path


LIDAR = ("depth", "infrared", "confidence")


@pytest.mark.parametrize(("name", "version"), [("driver.bag", 1), ("driver", 2)])
def test_recording_of_a_driver_replays(run: Run, name: str, version: int) -> None:
    path = driven(Path(name), version, LIDAR)
    with ReplayCamera(SAMPLE) as exact, ReplayCamera(path) as found:
        pairs = list(zip(exact, found, strict=True))

    assert [frame.frame_number for _, frame in pairs] == list(range(8))
    for one, other in pairs:
        np.testing.assert_allclose(other.depth_m, one.depth_m, atol=0.5001e-3)
        np.testing.assert_array_equal(other.ir, one.ir)
    assert run("info", path, "--verify")["whole"]


def test_driver_without_infrared_is_named(run: Run) -> None:
    path = driven(Path("depth"), 2, ("depth",))
    assert "no infrared" in run("replay", path, "--out", "r", code=4).err


def test_driver_without_camera_info_is_named(run: Run) -> None:
    path = driven(Path("blind.bag"), 1, LIDAR, info=False)
    assert "/camera/depth/camera_info" in run("replay", path, "--out", "r", code=4).err


def edit_yaml(folder: Path, old: str, new: str) -> None:
    file = folder / "metadata.yaml"
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new), encoding="utf-8")


def no_yaml(folder: Path) -> None:
    (folder / "metadata.yaml").write_text("[" * 100_000, encoding="utf-8")


def huge_yaml(folder: Path) -> None:
    with (folder / "metadata.yaml").open("ab") as file:
        file.truncate(1 << 30)


def compressed(folder: Path) -> None:
    edit_yaml(folder, "compression_mode: ''", "compression_mode: FILE")


def outside(folder: Path) -> None:
    edit_yaml(folder, "sqlite3.db3", "../../other.db3")


def pipe(folder: Path) -> None:
    (folder / "sqlite3.db3").unlink()
    os.mkfifo(folder / "sqlite3.db3")


def cut(folder: Path) -> None:
    file = folder / "sqlite3.db3"
    file.write_bytes(file.read_bytes()[:500_000])


def no_database(folder: Path) -> None:
    (folder / "sqlite3.db3").write_bytes(b"SQLite format 3\0" + bytes(range(256)) * 10)


SQL = {
    "endless view": (
        "alter table messages rename to real; create view messages as with recursive n(id) as"
        " (select 1 union all select id + 1 from n) select id, 1 as topic_id, id as timestamp,"
        " zeroblob(100000000) as data from n"
    ),
    "computed blob": (
        "drop table messages; create table messages (id integer, topic_id integer,"
        " timestamp integer, data blob as (zeroblob(900000000)))"
    ),
    "other messages": "update messages set data = substr(data, 1, 60)",
}


def by_sql(folder: Path, name: str) -> None:
    with closing(sqlite3.connect(folder / "sqlite3.db3")) as file:
        file.executescript(SQL[name])


HOSTILE = [
    no_yaml,
    huge_yaml,
    compressed,
    outside,
    pipe,
    cut,
    no_database,
]


@pytest.mark.parametrize(
    "damage",
    [
        *(pytest.param(damage, id=damage.__name__) for damage in HOSTILE),
        *(pytest.param(partial(by_sql, name=name), id=name) for name in SQL),
    ],
)
def test_hostile_bag_of_ros_2_gets_one_line(
    bags: SimpleNamespace, run: Run, damage: Callable[[Path], None]
) -> None:
    folder = Path("sqlite3")
    shutil.copytree(bags.sqlite3, folder)
    damage(folder)
    answer = run("replay", folder, "--out", "r", code=4)

    assert answer["error"]["message"].count("\n") == 0
    assert "sqlite3" in answer["error"]["message"]
    assert not Path("r").exists()


@pytest.mark.parametrize("size", [8, 100, 1_000_000])
def test_cut_mcap_is_refused(bags: SimpleNamespace, size: int) -> None:
    file = Path("other.mcap")
    file.write_bytes(next(bags.mcap.glob("*.mcap")).read_bytes()[:size])
    with pytest.raises(RecordingError) as raised:
        frames_of(file)

    assert str(file) in str(raised.value)


def test_chunk_of_mcap_unpacks_no_more_than_it_declares(bags: SimpleNamespace) -> None:
    open_recording(bags.mcap)
    bomb = zstd.compress(bytes(1 << 28))
    unpack = storage_mcap.DECOMPRESSORS["zstd"]

    assert len(unpack(bomb, 1000)) == 1001
    with pytest.raises(ValueError, match="a chunk of"):
        unpack(bomb, 1 << 28)


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_static_transforms_reach_late_listeners(bags: SimpleNamespace, storage: str) -> None:
    with Reader(getattr(bags, storage)) as reader:
        topics = {each.topic: each.ext.offered_qos_profiles for each in reader.connections}

    assert [one.durability.name for one in topics["/tf_static"]] == ["TRANSIENT_LOCAL"]
    assert topics["/camera/depth/image_rect_raw"] == []


@pytest.mark.parametrize(
    ("domain", "duration_s"), [("hardware_clock", 0.3), ("system_time", WRAP_PERIOD_S - 1 / 30)]
)
def test_duration_counts_a_wrap_of_the_device_clock(
    tmp_path: Path, domain: str, duration_s: float
) -> None:
    bag = BagReader(SAMPLE)
    pinhole = bag.streams["depth"].intrinsics
    first = next(bag.samples(["depth"]))
    with Writer(tmp_path / "wrapped", version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        driver = Driver(writer, ros2_types(), "/camera/camera")
        driver.publish_clock(domain)
        for k in range(10):
            time_s = (WRAP_PERIOD_S - 0.1 + k / 30) % WRAP_PERIOD_S
            sample = replace(first, number=k, timestamp_s=time_s)
            driver.publish(sample, pinhole, recorded_ns=2 + k * 33_000_000)

    found_s = open_recording(tmp_path / "wrapped").duration_s("depth")

    assert found_s == pytest.approx(duration_s, abs=0.04)


def test_metadata_of_a_bag_are_those_of_the_driver(bags: SimpleNamespace) -> None:
    with Reader(bags.sqlite3) as reader:
        topics = {connection.topic: connection for connection in reader.connections}
        found = next(reader.messages([topics["/camera/depth/metadata"]]))[2]

    assert json.loads(found[found.index(b"{") : found.rindex(b"}") + 1])["frame_number"] == 0
    assert "/camera/infra/image_rect_raw" in topics
    assert "/tf_static" in topics
