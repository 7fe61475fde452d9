import gc
import re
import struct
import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nlos_cam.camera import intrinsics_of, load_sdk, sample_from_sdk
from nlos_cam.camera.session import SampleQueue, read_settings
from nlos_cam.camera.timestamps import WRAP_PERIOD_S
from nlos_cam.errors import RecordingError
from nlos_cam.recording import BagReader, ReplayCamera, SdkReplayCamera

IMAGE = "/image/data"
Messages = Iterable[tuple[int, bytes]]


def frames_of(camera: Any, pause_s: float = 0.0) -> tuple[list[Any], dict[str, Any]]:
    frames: list[Any] = []
    with camera:
        for frame in camera:
            time.sleep(pause_s)
            images = frame.depth_m.tobytes(), frame.ir.tobytes(), frame.confidence.tobytes()
            frames.append(
                (
                    frame.frame_number,
                    frame.timestamp_s,
                    frame.intrinsics,
                    dict(frame.settings),
                    images,
                )
            )
        return frames, {
            name: getattr(camera, name) for name in ("incomplete", "dropped", "arrived", "identity")
        }


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


def number_of(raw: bytes) -> int:
    return int.from_bytes(raw[:4], "little")


@pytest.mark.parametrize("edit", [as_recorded, before_2_49, around_a_wrap, with_gaps])
def test_both_readers_give_the_same_frames(
    rewritten: Any, edit: Callable[[str, int, bytes], Messages]
) -> None:
    path = rewritten(edit)
    ours = frames_of(ReplayCamera(path))
    missing = {3, 4, 8, 12, 19} if edit is with_gaps else set()
    assert [frame[0] for frame in ours[0]] == [
        number for number in range(20) if number not in missing
    ]
    assert (ours[1]["dropped"], ours[1]["incomplete"]) == ((2, 3) if missing else (0, 0))
    assert ours == frames_of(SdkReplayCamera(path), pause_s=0.01 if edit is as_recorded else 0.0)
    if edit is around_a_wrap:
        expected_s = WRAP_PERIOD_S + 0.033333 * np.arange(-10, 10)
        assert [frame[1] for frame in ours[0]] == pytest.approx(expected_s)


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
        for profile in (profiles := sensor.get_stream_profiles()):
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


@pytest.mark.parametrize("kind", ["noise_bag", "noise_bag_uncompressed", "real_bag"])
def test_bag_file_agrees_with_librealsense(kind: str, request: pytest.FixtureRequest) -> None:
    bag = BagReader(request.getfixturevalue(kind))
    played = SdkPlayback(bag.path)
    assert set(bag.streams) == set(played.samples)
    for stream, info in bag.streams.items():
        assert (info.format, info.frames_per_s, info.intrinsics) == played.profiles[stream]
        assert info.frames == len(played.samples[stream])
        for ours, sample in zip(bag.samples([stream]), played.samples[stream], strict=True):
            assert (ours.stream, ours.number, ours.timestamp_s) == (
                sample.stream,
                sample.number,
                sample.timestamp_s,
            )
            np.testing.assert_array_equal(ours.pixels, sample.pixels, strict=True)
        for index, (domain, values) in enumerate(played.metadata[stream]):
            found = bag.metadata(stream, index)
            assert found.domain == domain
            common = found.values.keys() & values.keys()
            assert {name: found.values[name] for name in common} == {
                name: values[name] for name in common
            }
            if (
                "D435" in bag.device["name"]
            ):  # the SDK makes up numbers for frames without recorded metadata
                assert common == values.keys()
                assert len(common) > 10
        assert (
            bag.settings(stream=stream)
            == bag.settings(bag.end_ns, stream)
            == played.settings[stream]
        )
    assert bag.depth_unit_m() == played.settings["depth"]["depth_units"]
    assert bag.device.items() <= played.device.items()
    assert bag.device["name"]


@pytest.mark.parametrize("kind", ["noise_bag", "real_bag"])
def test_lenses_and_poses_agree_with_librealsense(
    kind: str, request: pytest.FixtureRequest
) -> None:
    bag = BagReader(request.getfixturevalue(kind))
    sensors = load_sdk().context().load_device(str(bag.path)).as_playback().query_sensors()
    cameras = {
        profile.stream_type().name: profile
        for one in sensors
        for profile in one.get_stream_profiles()
    }
    for stream, camera in cameras.items():
        theirs = camera.as_video_stream_profile().get_intrinsics()
        model, coefficients = bag.lens(stream)
        assert (model, list(coefficients)) == (theirs.model.name, theirs.coeffs)
        for other, seen_from in cameras.items():
            pose = bag.pose(stream, other)
            extrinsics = seen_from.get_extrinsics_to(camera)
            np.testing.assert_allclose(
                pose[:3, :3], np.reshape(extrinsics.rotation, (3, 3)).T, atol=1e-6
            )
            np.testing.assert_allclose(pose[:3, 3], extrinsics.translation, atol=1e-7)


MESSAGE = r"nlos-cam repair"
LOAD = "nlos_cam.recording.sdk_playback.load_sdk"


def test_sdk_is_never_given_a_damaged_or_cut_file(
    damaged: Path, noise_bag_uncompressed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        LOAD, lambda: SimpleNamespace(context=lambda: pytest.fail("the SDK was given the file"))
    )
    with pytest.raises(RecordingError, match=rf"\d+\.\d s .*{MESSAGE}"):
        SdkReplayCamera(damaged)
    content = bytearray(noise_bag_uncompressed.read_bytes())
    path = tmp_path / "damaged.bag"
    headers = list(
        re.finditer(rb"(?s)\x2f\0\0\0.\0\0\0(?:op|ver|conn|count)=", content)
    )  # of indexes
    content[headers[-1].start() + 3] = 0xFF
    path.write_bytes(content)
    assert len(frames_of(ReplayCamera(path))[0]) == 20  # our reader does not need that index
    with pytest.raises(RecordingError, match=rf"byte \d+.*{MESSAGE}"):
        SdkReplayCamera(path)
    for share in (0.0, 0.1, 0.5, 0.99):
        path.write_bytes(content[: int(share * len(content))])
        with pytest.raises(RecordingError):
            SdkReplayCamera(path)


def test_playback_that_ends_too_early_is_an_error(
    damaged: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SdkReplayCamera, "_check_all", lambda _: None)
    found: dict[type, list[int]] = {}
    for camera in (ReplayCamera(damaged), SdkReplayCamera(damaged)):
        frames = found[type(camera)] = []
        with camera, pytest.raises(RecordingError, match=MESSAGE):
            frames.extend(frame.frame_number for frame in camera)
        assert camera.dropped == 0
    ours = found[ReplayCamera]
    theirs = found[SdkReplayCamera]
    assert theirs == ours[: len(theirs)]  # it loses the frames that it holds at the damage
    assert 0 <= len(ours) - len(theirs) <= 2
    assert 0 < len(ours) < 150


def test_sdk_playback_reports_what_the_sdk_refuses(
    noise_bag: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: str) -> None:
        raise RuntimeError("no such stream")

    with monkeypatch.context() as patch:
        patch.setattr("nlos_cam.recording.sdk_playback.find_streams", lambda _: (None, {}))
        with pytest.raises(RecordingError, match=rf"'depth'.*{MESSAGE}"):
            SdkReplayCamera(noise_bag)
    monkeypatch.setattr(
        LOAD, lambda: SimpleNamespace(context=lambda: SimpleNamespace(load_device=refuse))
    )
    with pytest.raises(RecordingError, match=rf"no such stream.*{MESSAGE}"):
        SdkReplayCamera(noise_bag)


def test_playback_that_never_starts_is_an_error(
    noise_bag: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nlos_cam.recording.sdk_playback.START_TIMEOUT_S", 0.0)
    stopped = SimpleNamespace(current_status=lambda: load_sdk().playback_status.stopped)
    with SdkReplayCamera(noise_bag) as camera, pytest.raises(RecordingError, match=r"noise\.bag"):
        camera._next(SampleQueue(lossless=True), stopped)
