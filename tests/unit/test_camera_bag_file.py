import gc
import struct
import time
from collections import defaultdict
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nlos_cam.camera.sdk import load_sdk
from nlos_cam.camera.session import read_settings
from nlos_cam.camera.streams import intrinsics_of, sample_from_sdk
from nlos_cam.errors import RecordingError
from nlos_cam.recording.bag_container import BagContainer
from nlos_cam.recording.bag_reader import BagFile

BAGS = ("noise_bag", "noise_bag_uncompressed", "real_bag")


@pytest.fixture(params=BAGS)
def bag(request: pytest.FixtureRequest) -> BagFile:
    return BagFile(request.getfixturevalue(request.param))


class SdkPlayback:
    """Every sensor of a recording as librealsense plays it: samples, metadata, options, profiles by stream."""

    def __init__(self, path: Path) -> None:
        self.samples: dict[str, list[Any]] = defaultdict(list)
        self.metadata: dict[str, list[tuple[str, dict[str, float]]]] = defaultdict(list)
        self.settings: dict[str, dict[str, float]] = {}
        self.profiles: dict[str, tuple[str, int, Any]] = {}
        self.device: dict[str, str] = {}
        self._sdk, self._path = load_sdk(), path
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
        self.device = {name: playback.get_info(info) for name, info in infos if playback.supports(info)}
        profiles = sensor.get_stream_profiles()
        for profile in profiles:
            stream = profile.stream_type().name
            self.profiles[stream] = profile.format().name, profile.fps(), intrinsics_of(profile)
            self.settings[stream] = read_settings(sensor)
        before = len(self.samples)
        sensor.open(profiles)
        sensor.start(self._take)
        stopped, deadline_s = self._sdk.playback_status.stopped, time.monotonic() + 20.0
        while not (playback.current_status() == stopped and len(self.samples) > before):
            assert time.monotonic() < deadline_s
            time.sleep(0.005)
        sensor.stop()
        sensor.close()

    def _take(self, frame: Any) -> None:
        sample = sample_from_sdk(frame)
        known = self._sdk.frame_metadata_value.__members__.items()
        values = {name: frame.get_frame_metadata(key) for name, key in known if frame.supports_frame_metadata(key)}
        self.metadata[sample.stream].append((frame.get_frame_timestamp_domain().name, values))
        self.samples[sample.stream].append(sample)


def test_every_frame_is_the_one_that_the_sdk_plays(bag: BagFile) -> None:
    played = SdkPlayback(bag.path)
    assert set(bag.streams) == set(played.samples)
    for stream, theirs in played.samples.items():
        for ours, sample in zip(bag.samples([stream]), theirs, strict=True):
            assert (ours.stream, ours.number, ours.timestamp_s) == (sample.stream, sample.number, sample.timestamp_s)
            np.testing.assert_array_equal(ours.pixels, sample.pixels, strict=True)


def test_what_is_told_of_streams_and_frames_is_what_the_sdk_tells(bag: BagFile) -> None:
    played = SdkPlayback(bag.path)
    for stream, info in bag.streams.items():
        assert (info.format, info.frames_per_s, info.intrinsics) == played.profiles[stream]
        assert info.frames == len(played.samples[stream])
        for index, (domain, values) in enumerate(played.metadata[stream]):
            found = bag.metadata(stream, index)
            assert found.domain == domain
            common = found.values.keys() & values.keys()
            assert {name: found.values[name] for name in common} == {name: values[name] for name in common}
            if "D435" in bag.device["name"]:  # the SDK makes up numbers for frames of which nothing was recorded
                assert common == values.keys()
                assert len(common) > 10


def test_options_and_names_are_those_that_the_sdk_tells(bag: BagFile) -> None:
    played = SdkPlayback(bag.path)
    for stream in bag.streams:
        assert bag.settings(stream=stream) == played.settings[stream]
        assert bag.settings(bag.end_ns, stream) == played.settings[stream]
    assert bag.depth_unit_m() == played.settings["depth"]["depth_units"]
    assert bag.device.items() <= played.device.items()
    assert bag.device["name"]
    assert bag.sensor_name("depth") in {"L500 Depth Sensor", "Stereo Module"}


def test_lenses_and_poses_are_those_that_the_sdk_tells(bag: BagFile) -> None:
    sensors = load_sdk().context().load_device(str(bag.path)).as_playback().query_sensors()
    cameras = {profile.stream_type().name: profile for one in sensors for profile in one.get_stream_profiles()}
    for stream, camera in cameras.items():
        told = camera.as_video_stream_profile().get_intrinsics()
        model, coefficients = bag.lens(stream)
        assert (model, list(coefficients)) == (told.model.name, told.coeffs)
        for other, seen_from in cameras.items():
            pose, extrinsics = bag.pose(stream, other), seen_from.get_extrinsics_to(camera)
            np.testing.assert_allclose(pose[:3, :3], np.reshape(extrinsics.rotation, (3, 3)).T, atol=1e-6)
            np.testing.assert_allclose(pose[:3, 3], extrinsics.translation, atol=1e-7)


def test_frames_come_in_the_order_in_which_they_were_recorded(bag: BagFile) -> None:
    places = list(bag.order(bag.streams))
    assert all(one.time_ns <= other.time_ns for one, other in pairwise(places))
    for stream, info in bag.streams.items():
        assert [place.index for place in places if place.stream == stream] == list(range(info.frames))
    assert places[-1].time_ns <= bag.end_ns


def test_a_frame_by_its_index_is_the_one_that_comes_in_order(bag: BagFile) -> None:
    in_order = list(zip(bag.order(bag.streams), bag.samples(bag.streams), strict=True))
    for place, sample in reversed(in_order):
        again = bag.sample(place.stream, place.index)
        assert (again.stream, again.number, again.timestamp_s) == (sample.stream, sample.number, sample.timestamp_s)
        np.testing.assert_array_equal(again.pixels, sample.pixels)


def test_pixels_are_the_readers_own(noise_bag: Path) -> None:
    bag = BagFile(noise_bag)
    first = bag.sample("depth", 0)
    first.pixels[:] = 0
    assert bag.sample("depth", 0).pixels.any()


def test_a_frame_beyond_the_last_is_an_index_error(noise_bag: Path) -> None:
    with pytest.raises(IndexError):
        BagFile(noise_bag).sample("depth", 20)


def with_unit(*, option: bool, tail_m: float | None) -> Callable[[str, int, bytes], list[tuple[int, bytes]]]:
    """Makes a recording tell its depth unit here, there, or not at all; librealsense put it there from 2.49 on."""

    def edit(topic: str, time_ns: int, raw: bytes) -> list[tuple[int, bytes]]:
        if topic.endswith("/image/data"):
            raw = raw[:16] + b"0" + raw[17:-4] if tail_m is None else raw[:-4] + struct.pack("<f", tail_m)
        return [(time_ns, raw)] if option or "/Depth_Units/value" not in topic else []

    return edit


@pytest.mark.parametrize(("option", "tail_m"), [(True, None), (True, 0.5), (False, 0.00025)])
def test_the_depth_unit_is_an_option_or_stands_after_the_images(
    rewritten: Any, option: bool, tail_m: float | None
) -> None:
    path = rewritten(with_unit(option=option, tail_m=tail_m))
    assert BagFile(path).depth_unit_m() == pytest.approx(0.00025)


@pytest.mark.parametrize("tail_m", [None, 0.0, -1.0, float("nan"), float("inf")])
def test_a_recording_that_tells_no_depth_unit_is_an_error(rewritten: Any, tail_m: float | None) -> None:
    with pytest.raises(RecordingError, match="does not tell its depth unit"):
        BagFile(rewritten(with_unit(option=False, tail_m=tail_m))).depth_unit_m()


def test_a_stream_without_its_intrinsics_is_an_error(rewritten: Any) -> None:
    path = rewritten(lambda topic, time_ns, raw: [] if topic.endswith("camera_info") else [(time_ns, raw)])
    with pytest.raises(RecordingError, match=r"it has no .*camera_info"):
        BagFile(path)


def test_an_encoding_that_we_cannot_read_is_told_when_it_is_asked_for(rewritten: Any) -> None:
    path = rewritten(lambda _, time_ns, raw: [(time_ns, raw.replace(b"8UC1", b"Y10B"))])
    bag = BagFile(path)
    assert not bag.streams["infrared"].format
    assert bag.sample("depth", 0).number == 0
    with pytest.raises(RecordingError, match="encoded as Y10B, which we cannot read"):
        bag.sample("infrared", 0)


def test_streams_of_one_kind_are_told_apart_by_their_index(noise_bag_uncompressed: Path, tmp_path: Path) -> None:
    path = tmp_path / "stereo.bag"
    path.write_bytes(noise_bag_uncompressed.read_bytes().replace(b"Infrared_0", b"Infrared_2"))
    assert set(BagFile(path).streams) == {"depth", "infrared_2", "confidence"}
    assert BagFile(path).sample("infrared_2", 19).number == 19


def test_a_whole_recording_passes_the_check(bag: BagFile) -> None:
    bag.check()


@pytest.mark.parametrize("topic", ["/sensor_0/info", "/Depth_Units/description", "/Infrared_0/tf/1", "/image/data"])
def test_damage_in_any_message_is_found_by_the_check(noise_bag_uncompressed: Path, tmp_path: Path, topic: str) -> None:
    bag, path = BagContainer(noise_bag_uncompressed), tmp_path / "damaged.bag"
    name = next(name for name in bag.entries if name.endswith(topic))
    content, message = noise_bag_uncompressed.read_bytes(), bytes(bag.raw(bag.entries[name][-1]))
    where = content.rindex(message) - 4  # its length
    path.write_bytes(content[:where] + b"\xff\xff" + content[where + 2 :])
    with pytest.raises(RecordingError, match="is damaged"):
        BagFile(path).check()


def test_an_image_that_is_smaller_than_it_says_is_found_by_the_check(rewritten: Any) -> None:
    def wider(topic: str, time_ns: int, raw: bytes) -> list[tuple[int, bytes]]:
        doubled = raw.replace(struct.pack("<II", 48, 64), struct.pack("<II", 48, 128), 1)
        return [(time_ns, doubled if topic.endswith("Depth_0/image/data") else raw)]

    with pytest.raises(RecordingError, match="an image of 128 x 48 mono16"):
        BagFile(rewritten(wider)).check()
