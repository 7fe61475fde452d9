import gc
import re
import struct
import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from rewritten_bags import Messages, number_of, turned_infrared
from sdk_playback import SdkReplay

from nlos_cam.camera import intrinsics_of, load_sdk, sample_from_sdk
from nlos_cam.camera.session import read_settings
from nlos_cam.camera.timestamps import WRAP_PERIOD_S
from nlos_cam.errors import RecordingError
from nlos_cam.frames import Frame
from nlos_cam.recording import (
    BagReader,
    ExportOptions,
    ReplayCamera,
    RosOptions,
    export_recording,
    export_ros2,
    open_recording,
)

IMAGE = "/image/data"


def values_of(recorded: Iterable[Frame]) -> list[Any]:
    """Return number, time, intrinsics, settings and the bits of each frame's images."""
    values: list[Any] = []
    for frame in recorded:
        images = [image.tobytes() for image in (frame.depth_m, frame.ir, frame.confidence)]
        settings = dict(frame.settings)
        values.append((frame.frame_number, frame.timestamp_s, frame.intrinsics, settings, images))
    return values


def as_recorded(topic: str, time_ns: int, raw: bytes) -> Messages:
    del topic
    yield time_ns, raw


def before_2_49(topic: str, time_ns: int, raw: bytes) -> Messages:
    """Write images without their tail."""
    yield time_ns, raw[:16] + b"0" + raw[17:-4] if topic.endswith(IMAGE) else raw


def around_a_wrap(topic: str, time_ns: int, raw: bytes) -> Messages:
    """Stamp frames by a counter of microseconds that wraps at the tenth frame."""
    if topic.endswith("/image/metadata"):
        raw = raw.replace(b"\x0b\0\0\0Global Time", b"\x0e\0\0\0Hardware Clock")
    if topic.endswith(IMAGE):
        stamp_us = (2**32 + (number_of(raw) - 10) * 33_333) % 2**32
        raw = raw[:4] + struct.pack("<II", stamp_us // 10**6, stamp_us % 10**6 * 1000) + raw[12:]
    yield time_ns, raw


def with_gaps(topic: str, time_ns: int, raw: bytes) -> Messages:
    """Leave out frames 3 and 4, and one stream of frames 8, 12 and 19."""
    number = number_of(raw) if topic.endswith(IMAGE) else -1
    missing = {8: "Infrared_0", 12: "Confidence_0", 19: "Depth_0"}.get(number, "none")
    if number not in {3, 4} and missing not in topic:
        yield time_ns, raw


@pytest.mark.parametrize("edit", [as_recorded, before_2_49, around_a_wrap, with_gaps])
def test_both_readers_give_the_same_frames(
    rewritten: Any, edit: Callable[[str, int, bytes], Messages]
) -> None:
    path = rewritten(edit)
    theirs = SdkReplay(path)
    with ReplayCamera(path) as ours:
        assert values_of(ours) == values_of(theirs)

    assert ours.arrived == theirs.arrived
    assert ours.dropped == theirs.dropped
    assert ours.incomplete == theirs.incomplete


def test_replay_counts_gaps_and_sets_without_all_streams(rewritten: Any) -> None:
    with ReplayCamera(rewritten(with_gaps)) as camera:
        numbers = [frame.frame_number for frame in camera]

    assert numbers == sorted(set(range(20)) - {3, 4, 8, 12, 19})
    assert camera.dropped == 2
    assert camera.incomplete == 3


def test_replay_unwraps_the_device_clock(rewritten: Any) -> None:
    with ReplayCamera(rewritten(around_a_wrap)) as camera:
        times_s = [frame.timestamp_s for frame in camera]
    assert times_s == pytest.approx(WRAP_PERIOD_S + 0.033333 * np.arange(-10, 10))


def test_export_unwraps_the_device_clock(rewritten: Any, tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = ExportOptions(format="npz", streams=["infrared"])
    export_recording(BagReader(rewritten(around_a_wrap)), out, options, stop=Event())
    times_s = np.load(out / "infrared.npz")["timestamp_s"]

    assert times_s == pytest.approx(WRAP_PERIOD_S + 0.033333 * np.arange(-10, 10))


def test_export_to_ros_unwraps_the_device_clock(rewritten: Any, tmp_path: Path) -> None:
    out = tmp_path / "ros"
    export_ros2(BagReader(rewritten(around_a_wrap)), out, RosOptions(), stop=Event())
    stamps_s = [each.timestamp_s for _, each in open_recording(out).timed_samples(["depth"])]

    assert stamps_s == pytest.approx(WRAP_PERIOD_S + 0.033333 * np.arange(-10, 10))


OUTAGE_S = 4300


def over_an_outage(topic: str, time_ns: int, raw: bytes) -> Messages:
    """Let no frame come for longer than the counter's period, before the tenth frame."""
    if topic.endswith(IMAGE):
        number = number_of(raw)
        gap_s = OUTAGE_S if number >= 10 else 0
        stamp_us = (number * 33_333 + gap_s * 10**6) % 2**32
        raw = raw[:4] + struct.pack("<II", stamp_us // 10**6, stamp_us % 10**6 * 1000) + raw[12:]
        time_ns += gap_s * 10**9
    yield time_ns, raw


@pytest.mark.parametrize(("edit", "gap_s"), [(around_a_wrap, 0), (over_an_outage, OUTAGE_S)])
def test_duration_counts_the_wraps_of_the_clock(rewritten: Any, edit: Any, gap_s: int) -> None:
    bag = BagReader(rewritten(edit))

    assert bag.duration_s("depth") == pytest.approx(gap_s + 19 * 0.033333)


class SdkPlayback:
    """What librealsense plays of every sensor: samples, metadata, options and profiles by
    stream.
    """

    def __init__(self, path: Path) -> None:
        self.samples, self.metadata = (defaultdict[str, list[Any]](list) for _ in range(2))
        self.settings, self.profiles, self.device = (dict[str, Any]() for _ in range(3))
        self._sdk = load_sdk()
        self._path = path
        for number in range(len(self._open()[1])):
            self._play(number)
        gc.collect()

    def _open(self) -> tuple[Any, list[Any]]:
        playback = self._sdk.context().load_device(str(self._path)).as_playback()
        playback.set_real_time(False)
        return playback, playback.query_sensors()

    def _play(self, number: int) -> None:
        playback, sensors = self._open()
        sensor = sensors[number]
        infos = self._sdk.camera_info.__members__.items()
        self.device = {
            name: playback.get_info(info) for name, info in infos if playback.supports(info)
        }
        profiles = _pictures(sensor)
        if not profiles:
            return
        for profile in profiles:
            stream = profile.stream_type().name
            self.profiles[stream] = profile.format().name, profile.fps(), intrinsics_of(profile)
            self.settings[stream] = read_settings(sensor)
        before = len(self.samples)
        sensor.open(profiles)
        sensor.start(self._take)
        stopped = self._sdk.playback_status.stopped
        deadline_s = time.monotonic() + 120.0
        while not (playback.current_status() == stopped and len(self.samples) > before):
            assert time.monotonic() < deadline_s
            time.sleep(0.005)
        sensor.stop()
        sensor.close()

    def _take(self, frame: Any) -> None:
        sample = sample_from_sdk(frame)
        known = self._sdk.frame_metadata_value.__members__.items()
        values = {
            name: frame.get_frame_metadata(key)
            for name, key in known
            if frame.supports_frame_metadata(key)
        }
        self.metadata[sample.stream].append((frame.get_frame_timestamp_domain().name, values))
        self.samples[sample.stream].append(sample)


def _pictures(sensor: Any) -> list[Any]:
    """Return the profiles of a sensor that are pictures: an accelerometer has none."""
    return [one for one in sensor.get_stream_profiles() if one.is_video_stream_profile()]


@pytest.fixture(scope="module")
def playbacks() -> dict[Path, SdkPlayback]:
    """Recordings played by librealsense, each once."""
    return {}


@pytest.fixture(params=["noise_bag", "noise_bag_uncompressed", "real_bag"])
def both(
    request: pytest.FixtureRequest, playbacks: dict[Path, SdkPlayback]
) -> tuple[BagReader, SdkPlayback]:
    """A recording by our reader and by librealsense."""
    bag = BagReader(request.getfixturevalue(request.param))
    if bag.path not in playbacks:
        playbacks[bag.path] = SdkPlayback(bag.path)
    return bag, playbacks[bag.path]


def test_streams_agree_with_librealsense(both: tuple[BagReader, SdkPlayback]) -> None:
    bag, played = both

    assert set(bag.streams) == set(played.samples)

    for stream, info in bag.streams.items():
        assert (info.format, info.frames_per_s, info.intrinsics) == played.profiles[stream]
        assert info.frames == len(played.samples[stream])


def test_samples_agree_with_librealsense(both: tuple[BagReader, SdkPlayback]) -> None:
    bag, played = both

    for stream in bag.streams:
        for ours, sample in zip(bag.samples([stream]), played.samples[stream], strict=True):
            assert ours.stream == sample.stream
            assert ours.number == sample.number
            assert ours.timestamp_s == sample.timestamp_s
            np.testing.assert_array_equal(ours.pixels, sample.pixels, strict=True)


def test_metadata_agree_with_librealsense(both: tuple[BagReader, SdkPlayback]) -> None:
    bag, played = both

    for stream in bag.streams:
        for index, (domain, values) in enumerate(played.metadata[stream]):
            found = bag.metadata(stream, index)
            assert found.domain == domain
            common = found.values.keys() & values.keys()
            assert {name: found.values[name] for name in common} == {
                name: values[name] for name in common
            }
            # the SDK makes up numbers for frames without recorded metadata
            if "D435" in bag.device["name"]:
                assert common == values.keys()
                assert len(common) > 10


def test_settings_and_device_agree_with_librealsense(
    both: tuple[BagReader, SdkPlayback],
) -> None:
    bag, played = both

    for stream in bag.streams:
        assert bag.settings(stream=stream) == played.settings[stream]
        assert bag.settings(bag.end_ns, stream) == played.settings[stream]

    assert bag.depth_unit_m() == played.settings["depth"]["depth_units"]
    assert bag.device.items() <= played.device.items()
    assert bag.device["name"]


@pytest.fixture
def turned_bag(rewritten: Any) -> Path:
    return rewritten(turned_infrared)


@pytest.mark.parametrize("kind", ["noise_bag", "turned_bag", "real_bag"])
def test_lenses_and_poses_agree_with_librealsense(
    kind: str, request: pytest.FixtureRequest
) -> None:
    bag = BagReader(request.getfixturevalue(kind))
    sensors = load_sdk().context().load_device(str(bag.path)).as_playback().query_sensors()
    cameras = {profile.stream_type().name: profile for one in sensors for profile in _pictures(one)}
    assert cameras.keys() == bag.streams.keys()

    for stream, camera in cameras.items():
        theirs = camera.as_video_stream_profile().get_intrinsics()
        model, coefficients = bag.lens(stream)
        assert model == theirs.model.name
        np.testing.assert_allclose(coefficients, theirs.coeffs, rtol=1e-6)
        for other, seen_from in cameras.items():
            pose = bag.pose(stream, other)
            extrinsics = seen_from.get_extrinsics_to(camera)
            np.testing.assert_allclose(
                pose[:3, :3], np.reshape(extrinsics.rotation, (3, 3)).T, atol=1e-6
            )
            np.testing.assert_allclose(pose[:3, 3], extrinsics.translation, atol=1e-7)


def test_readers_agree_on_the_frames_before_damage(damaged: Path) -> None:
    ours: list[int] = []
    with ReplayCamera(damaged) as camera, pytest.raises(RecordingError, match="nlos-cam repair"):
        ours.extend(frame.frame_number for frame in camera)

    assert camera.dropped == 0
    assert 0 < len(ours) < 150

    theirs = [frame.frame_number for frame in SdkReplay(damaged)]

    assert theirs == ours[: len(theirs)]  # it loses the frames that it holds at the damage
    assert 0 <= len(ours) - len(theirs) <= 2


def test_built_in_reader_needs_no_index_of_a_chunk(
    noise_bag_uncompressed: Path, tmp_path: Path
) -> None:
    content = bytearray(noise_bag_uncompressed.read_bytes())
    headers = list(re.finditer(rb"(?s)\x2f\0\0\0.\0\0\0(?:op|ver|conn|count)=", content))
    content[headers[-1].start() + 3] = 0xFF
    path = tmp_path / "damaged.bag"
    path.write_bytes(content)
    with ReplayCamera(path) as camera:
        assert len(list(camera)) == 20
