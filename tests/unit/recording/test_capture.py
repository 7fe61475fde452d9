import re
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from threading import Event
from typing import Any

import pytest

from nlos_cam.camera import FORMATS, Recording, SimulatedCamera
from nlos_cam.cli.capture import format_take
from nlos_cam.errors import CameraLostError, DiskFullError, RecordingError
from nlos_cam.frames import Frame
from nlos_cam.recording.capture import CaptureResult, CaptureSession, CaptureTarget, finalize
from nlos_cam.recording.playback import VerifyResult, verify
from nlos_cam.recording.sidecar import load_sidecar, sidecar_path

Patch = pytest.MonkeyPatch

Run = Callable[..., list[CaptureResult]]


@pytest.fixture
def world(noise_world: Any) -> Any:
    world = noise_world()
    world.error = CameraLostError("sim vanished: replug it")
    return world


@pytest.fixture
def session(
    world: Any, hurried_clock: Any, tmp_path: Path
) -> Callable[..., tuple[CaptureSession, SimulatedCamera]]:
    """Make a session of takes 0.bag, 1.bag, ... of a NoiseWorld, and its camera."""

    def make(count: int = 1, **limits: Any) -> tuple[CaptureSession, SimulatedCamera]:
        targets = [
            CaptureTarget(tmp_path / f"{number}.bag", label=f"object {number}")
            for number in range(count)
        ]
        recording = Recording(targets[0].path, last=count == 1, **limits)
        camera = SimulatedCamera("sim", world, clock=hurried_clock(), recording=recording)
        return CaptureSession(camera, recording, targets), camera

    return make


@pytest.fixture
def run(session: Any) -> Run:
    """Record takes of a NoiseWorld and finalize each; stop, as by Ctrl-C, after `stop_at` sets."""

    def call(
        count: int = 1, stop_at: int | None = None, read_back: Any = verify, **limits: Any
    ) -> list[CaptureResult]:
        stop = Event()

        def on_sets(sets: int) -> None:
            if stop_at is not None and sets >= stop_at:
                stop.set()

        with closing(session(count, **limits)[0].record(stop, on_sets)) as takes:
            return [finalize(take, read_back) for take in takes]

    return call


def saved_state(take: CaptureResult) -> str:
    return load_sidecar(take.sidecar.path).state


def test_take_holds_the_frames_that_came(run: Run) -> None:
    (take,) = run(frames=5)

    assert (take.state, take.sets, take.error) == ("complete", 5, None)
    assert take.verified == verify(take.target.path)


def test_sidecar_agrees_with_its_take(run: Run) -> None:
    (take,) = run(frames=5)
    found = load_sidecar(sidecar_path(take.target.path))

    assert found.state == "complete"
    assert found.label == "object 0"
    assert found.camera == "sim"
    assert found.summary == take.summary
    assert found.summary.frames == 5
    assert found.summary.streams["infrared"] == 5
    assert found.rig


def test_capture_of_a_silent_camera_stops_when_told(session: Any, monkeypatch: Patch) -> None:
    gone = Event()
    leave = SimulatedCamera.__exit__

    def silent(_: SimulatedCamera) -> Iterator[Frame]:
        assert gone.wait(60.0), "nobody left the camera"
        yield from ()

    def left(camera: SimulatedCamera, *error: object) -> None:
        gone.set()
        leave(camera, *error)

    monkeypatch.setattr(SimulatedCamera, "__iter__", silent)
    monkeypatch.setattr(SimulatedCamera, "__exit__", left)
    monkeypatch.setattr("nlos_cam.recording.capture.LAST_FRAME_S", 0.05)
    stop = Event()
    stop.set()

    (take,) = (finalize(take, verify) for take in session()[0].record(stop, lambda _: None))

    assert take.state == "interrupted"


def test_quality_of_a_take_is_that_of_its_images(run: Run, noise_world: Any) -> None:
    (take,) = run(frames=5)
    images = [noise_world().images(number) for number in range(5)]

    assert take.quality.frames_seen == 5
    assert take.quality.saturated_share == sum((image.ir == 255).mean() for image in images) / 5
    assert take.quality.invalid_share == sum((image.depth_z16 == 0).mean() for image in images) / 5
    assert take.quality.confidence_mean == pytest.approx(
        sum(image.confidence.mean() for image in images) / 5
    )


@pytest.mark.slow
def test_takes_have_own_files_and_follow_each_other(run: Run, tmp_path: Path) -> None:
    there: list[list[str]] = []

    def read_back(path: Path) -> VerifyResult:
        there.append(sorted(entry.name for entry in tmp_path.glob("*.bag")))
        return verify(path)

    takes = run(count=3, frames=6, read_back=read_back)

    assert there == [["0.bag"], ["0.bag", "1.bag"], ["0.bag", "1.bag", "2.bag"]]

    for take in takes:
        assert (take.state, take.verified.streams) == ("complete", dict.fromkeys(FORMATS, 6))
        assert take.quality.frames_seen <= 6


@pytest.mark.parametrize(
    ("vanishes_at", "limits", "state", "sets", "error"),
    [
        (None, {"stop_at": 7}, "interrupted", range(7, 500), "None"),
        (8, {}, "lost", range(8, 9), "CameraLostError.*vanished"),
        (None, {"free": lambda _: 0}, "disk full", range(1, 2), "DiskFullError.*200 MB"),
    ],
)
def test_take_that_ends_early_is_whole_and_the_last(
    run: Run,
    world: Any,
    tmp_path: Path,
    vanishes_at: int,
    limits: dict[str, Any],
    state: str,
    sets: range,
    error: str,
) -> None:
    world.fails_at = vanishes_at
    (take,) = run(count=3, frames=500, **limits)

    assert take.state == saved_state(take) == state
    assert take.verified.frames == take.sets
    assert take.sets in sets
    assert re.match(error, repr(take.error))
    assert not (tmp_path / "1.bag").exists()


def test_take_without_a_frame_or_a_start_leaves_no_file(
    session: Any, world: Any, tmp_path: Path
) -> None:
    def fail(_: Any) -> None:
        raise CameraLostError("sim does not start: replug it")

    takes, camera = session()
    camera._prepare = fail
    with pytest.raises(CameraLostError, match="does not start"):
        list(takes.record(Event(), print))

    assert list(tmp_path.iterdir()) == []

    takes, _ = session()
    world.fails_at = 0
    (take,) = [finalize(take, verify) for take in takes.record(Event(), print)]

    assert (take.state, take.sets, take.verified) == ("lost", 0, None)
    assert list(tmp_path.iterdir()) == []


def test_take_without_a_frame_leaves_the_old_pair(session: Any, world: Any, tmp_path: Path) -> None:
    for name in ("0.bag", "0.json"):
        (tmp_path / name).write_text("old")
    takes, _ = session()
    world.fails_at = 0
    (take,) = [finalize(take, verify) for take in takes.record(Event(), print)]

    assert (take.state, take.sets) == ("lost", 0)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {
        "0.bag": "old",
        "0.json": "old",
    }


def test_take_whose_file_goes_away_ends_with_its_reason(session: Any, tmp_path: Path) -> None:
    takes, _ = session(frames=500)
    recorded = takes.record(Event(), lambda _: (tmp_path / "0.bag").unlink(missing_ok=True))
    (take,) = [finalize(take, verify) for take in recorded]

    assert (take.state, take.closed, take.recoverable) == ("file gone", False, None)
    assert "gone" in str(take.error)
    assert "look for the disk" in str(take.error)
    assert take.sets < 500
    assert "cannot be read back" in format_take(take)


@pytest.mark.parametrize("indexed", [True, False])
def test_sidecar_that_cannot_be_written_hides_no_other_error(
    run: Run, monkeypatch: Patch, indexed: bool
) -> None:
    def full(*_: Any) -> None:
        raise DiskFullError("0.json cannot be written")

    monkeypatch.setattr("nlos_cam.recording.sidecar.SidecarFile.finish", full)
    monkeypatch.setattr("nlos_cam.camera.recorder.can_grow", lambda *_: indexed)
    (take,) = run(frames=4)

    assert (take.verified is not None) == indexed
    assert ("0.json" if indexed else "nlos-cam repair") in str(take.error)


@pytest.mark.parametrize("count", [1, 2])
def test_take_whose_file_cannot_be_closed_is_not_read_back(
    run: Run, monkeypatch: Patch, count: int
) -> None:
    monkeypatch.setattr("nlos_cam.camera.recorder.can_grow", lambda *_: False)
    (take,) = run(count=count, frames=4, read_back=lambda _: pytest.fail("it has no index"))

    assert (take.state, saved_state(take), take.closed, take.verified) == (
        "disk full",
        "disk full",
        False,
        None,
    )
    assert "nlos-cam repair" in str(take.error)

    summary = load_sidecar(take.sidecar.path).summary

    assert summary.frames == min(summary.streams.values())
    assert summary.frames_seen in range(
        1, 5
    )  # a slow machine may notice the full disk before the last frame


def test_take_whose_reading_back_fails_is_damaged(run: Run) -> None:
    def read_back(path: Path) -> VerifyResult:
        raise RecordingError(f"{path} is cut short")

    (take,) = run(frames=5, read_back=read_back)

    assert take.state == "damaged"
    assert str(take.error) == f"{take.target.path} is cut short"


@pytest.mark.slow
def test_take_with_missing_frames_in_its_file_is_damaged(run: Run) -> None:
    (take,) = run(frames=5, read_back=lambda _: VerifyResult(3, 0, 0.1, {}))

    assert take.state == "damaged"
    assert saved_state(take) == "damaged"
    assert "3 of the 5" in str(take.error)

    whole, short = ({"depth": 5, "infrared": 5, "confidence": count} for count in (5, 4))
    for streams, state in (
        (whole, "complete"),
        (short, "damaged"),
    ):  # frames that are in no set are no damage
        (take,) = run(
            frames=5, read_back=lambda _, streams=streams: VerifyResult(2, 3, 0.1, streams)
        )
        assert take.state == state
    takes = run(count=2, frames=5, read_back=lambda _: VerifyResult(4, 0, 0.1, {}))

    assert [take.state for take in takes] == [
        "damaged",
        "complete",
    ]  # a first set may have been on its way


def test_closing_between_takes_stops_the_camera(session: Any, tmp_path: Path) -> None:
    recorder, camera = session(2, frames=3)
    takes = recorder.record(Event(), print)
    next(takes)

    assert camera._thread

    takes.close()

    assert camera._thread is None
    assert verify(tmp_path / "0.bag").frames == 3
    assert not (tmp_path / "1.bag").exists()
