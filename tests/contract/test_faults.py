"""The live loop over every fault of the simulated device, with librealsense in between: it goes on,
and counts.
"""

from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from nlos_calibration import load_rig
from rewritten_bags import rewrite
from rosbags.rosbag1 import Reader
from sdk_playback import SdkReplay
from small_frames import ListViewer, sheet_network

from nlos_cam.camera import Camera, Recording, SimulatedCamera, session
from nlos_cam.camera.timestamps import WRAP_PERIOD_S
from nlos_cam.errors import CameraLostError
from nlos_cam.frames import Frame
from nlos_cam.live import RunReport, run_live
from nlos_cam.reconstruct import CalibratedRig, Pipeline, Verdict, frame_reader
from nlos_cam.recording import ReplayCamera
from nlos_cam.recording.bag_messages import stamp
from nlos_cam.render import Fault, SensedImages
from nlos_cam.view import Moment

RIG = load_rig("paper-rig")
LAST = 30
"""Instant at which a run ends."""
FOREVER = 10**9
PLENTY = 100_000

Make = Callable[..., SimulatedCamera]


@pytest.fixture
def camera(noise_world: Any, hurried_clock: Any, monkeypatch: pytest.MonkeyPatch) -> Make:
    """Make a camera in a world without saturated noise, which drops nothing because the machine is
    slow.
    """
    monkeypatch.setattr(session, "QUEUED_SETS", PLENTY)
    monkeypatch.setattr(frame_reader, "QUEUE_FRAMES", PLENTY)

    class QuietWorld(noise_world):
        def images(self, number: int) -> SensedImages:
            noise = super().images(number)
            return SensedImages(noise.depth_z16 | 1, noise.ir // 2, noise.confidence)

    def make(
        *faults: Fault, clock: Any = None, recording: Recording | None = None
    ) -> SimulatedCamera:
        clock = clock or hurried_clock()
        made = SimulatedCamera(
            "sim:quiet", QuietWorld(), clock=clock, faults=faults, recording=recording
        )
        made.silence_s = 0.5  # of real time: an outage is that long, and no other pause should be
        return made

    return make


class Until:
    """A camera that ends at the LAST, or a later, instant of its world."""

    def __init__(self, camera: SimulatedCamera, last: int = LAST) -> None:
        self.camera = camera
        self.last = last

    def __getattr__(self, name: str) -> Any:
        return getattr(self.camera, name)

    def __iter__(self) -> Iterator[Frame]:
        for frame in self.camera:
            yield frame
            if instant_of(frame) >= self.last:
                return


def instant_of(frame: Frame) -> int:
    return int(frame.truth_depth_m[0, 0])


def live(
    camera: SimulatedCamera, last: int = LAST, **options: Any
) -> tuple[list[Moment], RunReport]:
    viewer = ListViewer()
    with camera:
        processing = Pipeline(CalibratedRig(RIG), sheet_network)
        source: Any = Until(camera, last)
        report = run_live(source, processing, viewer, stop=Event(), **options)
    moments = [
        moment for moment in viewer.moments if moment.result.verdict != Verdict.STALLED
    ]  # the last one, shown again
    assert report.frames == len(moments)
    return moments, report


def fault(kind: Any, frames: int = 3, **options: Any) -> Fault:
    return Fault(kind=kind, at_frame=5, frames=frames, **options)


@pytest.mark.parametrize(
    ("befalls", "missing", "counts"),
    [
        (fault("stall", 3), [5, 6, 7], {}),
        (fault("stall", 10), [*range(5, 15)], {"stalled": 1}),
        (fault("drops"), [5, 6, 7], {"dropped_camera": 3}),
        (fault("drops", stream="depth"), [5, 6, 7], {"incomplete": 3}),
        (fault("drops", stream="confidence"), [5, 6, 7], {"incomplete": 3}),
        (fault("duplicate"), [], {"duplicate": 3}),
        (fault("out_of_order"), [5, 7, 9], {"out_of_order": 3, "dropped_camera": 3}),
        (fault("all_zero"), [], {"blank": 3}),
        (fault("saturated"), [], {"saturated": 3}),
        (fault("half_invalid"), [], {"half_invalid": 3}),
        (fault("wrong_size"), [5, 6, 7], {"wrong_size": 3, "incomplete": 3}),
        (Fault(kind="clock_wrap", at_frame=5), [], {}),
    ],
    ids=lambda value: (
        f"{value.kind} {value.stream or ''}".strip() if isinstance(value, Fault) else ""
    ),
)
def test_passing_fault_is_survived_and_counted(
    camera: Make, befalls: Fault, missing: list[int], counts: dict[str, int]
) -> None:
    moments, report = live(camera(befalls))

    assert [instant_of(moment.result.frame) for moment in moments] == [
        n for n in range(LAST + 1) if n not in missing
    ]
    assert report.counts == counts

    for one, next_one in pairwise(moments):
        rise_s = next_one.result.timestamp_s - one.result.timestamp_s
        assert rise_s * 30 == pytest.approx(
            instant_of(next_one.result.frame) - instant_of(one.result.frame), abs=1e-3
        )


def test_frame_without_depth_shows_nothing(camera: Make) -> None:
    moments, _ = live(camera(fault("all_zero")))
    shown = [
        instant_of(each.result.frame) for each in moments if np.isfinite(each.result.depth_m).any()
    ]

    assert shown == [n for n in range(LAST + 1) if n not in {5, 6, 7}]


def rises(moments: list[Moment]) -> None:
    frames = [moment.result.frame for moment in moments]
    for one, next_one in pairwise(frames):
        assert next_one.frame_number > one.frame_number
        assert next_one.timestamp_s > one.timestamp_s


@pytest.mark.slow
@pytest.mark.parametrize("own_clock", [False, True])
def test_replugged_device_goes_on(camera: Make, own_clock: bool) -> None:
    wraps = [Fault(kind="clock_wrap", at_frame=20)] if own_clock else []
    moments, report = live(camera(fault("unplug", 30), *wraps), last=600)
    rises(moments)
    seen = [instant_of(moment.result.frame) for moment in moments]

    assert seen[:5] == [0, 1, 2, 3, 4]
    assert seen[5] >= 35
    assert seen == sorted(set(seen))
    assert report.counts["replugged"] == 1
    assert report.dropped == moments[-1].result.frame_number + 1 - report.frames


@pytest.mark.slow
def test_long_stall_restarts_the_streams(camera: Make, hurried_clock: Any) -> None:
    class Strolling(hurried_clock):
        def wait(self, stop: Event, seconds: float) -> bool:
            return super().wait(stop, seconds) or stop.wait(0.005)

    stalled = camera(fault("stall", 150), clock=Strolling())  # 0.75 s, or more on a busy machine
    moments, report = live(stalled, last=300)
    rises(moments)

    assert report.counts["restarted"] >= 1
    assert "replugged" not in report.counts


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "words", "counts"),
    [("unplug", "unplugged", {}), ("stall", "3 restarts", {"restarted": 3, "reset": 1})],
)
def test_device_that_stays_away_ends_the_run_with_its_counts(
    camera: Make, kind: Any, words: str, counts: dict[str, int]
) -> None:
    until_then: list[RunReport] = []
    with pytest.raises(CameraLostError, match=words) as error:
        live(
            camera(fault(kind, FOREVER), Fault(kind="duplicate", at_frame=2)),
            on_error=until_then.append,
        )

    assert "\n" not in str(error.value)
    assert until_then[0].frames == 5
    assert until_then[0].counts.pop("stalls") >= 1  # type: ignore[attr-defined]
    assert until_then[0].counts == {"duplicate": 1, **counts}


@pytest.mark.slow
def test_camera_entered_again_meets_the_same_faults(camera: Make) -> None:
    again = camera(fault("unplug", 5), Fault(kind="duplicate", at_frame=2))
    for _ in range(2):
        _, report = live(again, last=300)
        assert (report.counts["duplicate"], report.counts["replugged"]) == (1, 1)


RECORDED = [
    Fault(kind="drops", at_frame=2, stream="infrared"),
    Fault(kind="drops", at_frame=4, frames=2),
    Fault(kind="duplicate", at_frame=7),
    Fault(kind="out_of_order", at_frame=9),
    Fault(kind="wrong_size", at_frame=13),
    Fault(kind="stall", at_frame=15, frames=8),
    Fault(kind="clock_wrap", at_frame=20),
    Fault(kind="all_zero", at_frame=25),
]


@pytest.fixture
def captured(camera: Make, tmp_path: Path) -> tuple[Path, Camera, list[Frame]]:
    """A recording of many faults, the camera that made it, and the frames that it delivered."""
    recording = Recording(tmp_path / "faulty.bag", frames=40)
    with camera(*RECORDED, recording=recording) as recorded:
        seen = list(recorded)
    return recording.path, recorded, seen


def assert_same_frames(again: list[Frame], seen: list[Frame]) -> None:
    numbers = [frame.frame_number for frame in seen]
    times_s = [frame.timestamp_s for frame in seen]

    assert [frame.frame_number for frame in again] == numbers
    np.testing.assert_allclose([frame.timestamp_s for frame in again], times_s, atol=1e-6)
    for one, other in zip(seen, again, strict=True):
        np.testing.assert_array_equal(one.depth_m, other.depth_m)


@pytest.mark.slow
def test_librealsense_replays_faults_as_they_were_captured(
    captured: tuple[Path, Camera, list[Frame]],
) -> None:
    path, recorded, seen = captured
    replayed = SdkReplay(path)
    again = list(replayed)

    assert_same_frames(again, seen)
    expected = {"duplicate": 1, "out_of_order": 1, "wrong_size": 1, "stalled": 1}
    assert replayed.counts == recorded.counts == expected
    assert (replayed.incomplete, replayed.dropped) == (recorded.incomplete, recorded.dropped)
    assert (replayed.incomplete, replayed.dropped) == (2, 3)


def recorded_steadily(path: Path, target: Path) -> Path:
    """Rewrite a recording as by a machine with nothing else to do: a frame comes when its device
    says, and at once where it is late.
    """
    with Reader(path) as reader:
        stamps = [
            (time_ns, stamp(memoryview(raw))[1])
            for found, time_ns, raw in reader.messages()
            if found.topic.endswith("/image/data")
        ]
    steady_ns = dict[int, int]()
    newest_s = stamps[0][1]
    now_s = 0.0
    for time_ns, stamp_s in stamps:
        rise_s = (stamp_s - newest_s) % WRAP_PERIOD_S
        if rise_s < 1.0:  # else it is late
            now_s += rise_s
            newest_s = stamp_s
        steady_ns[time_ns] = round(now_s * 1e9) + len(steady_ns) + 1
    return rewrite(path, target, lambda _, time_ns, raw: [(steady_ns.get(time_ns, time_ns), raw)])


@pytest.mark.slow
def test_replay_of_faults_puts_a_late_frame_in_its_place(
    captured: tuple[Path, Camera, list[Frame]], tmp_path: Path
) -> None:
    path, _, seen = captured
    steady = recorded_steadily(path, tmp_path / "steady.bag")
    with ReplayCamera(steady) as replayed:
        again = list(replayed)
    (late,) = [frame for frame in again if frame.frame_number == 9]

    assert [frame.frame_number for frame in again[5:8]] == [8, 9, 10]
    assert_same_frames([frame for frame in again if frame is not late], seen)
    assert replayed.counts == {"duplicate": 1, "wrong_size": 1, "stalled": 1}
    assert (replayed.incomplete, replayed.dropped) == (2, 2)
