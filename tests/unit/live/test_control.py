import json
import threading
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from fake_wall import wall_frame
from made_up_moments import RIG, Recorded, full_moment, moment
from nlos_calibration import (
    LidarPose,
    MeasuredWall,
    OccluderRecord,
    load_measured,
    load_rig,
    wall_depth,
)
from nlos_calibration.errors import CalibrationError
from nlos_models import load_record, shipped_folder
from small_frames import SMALL, FrameCamera, sheet_network
from view_streams import saved_moments

from nlos_cam.camera import SimulatedCamera
from nlos_cam.errors import NlosCamError
from nlos_cam.frames import Frame
from nlos_cam.live import RunControl, RunReport, run_commands, run_live
from nlos_cam.live.run_commands import measured_rig
from nlos_cam.live.statistics import WARM_UP_FRAMES
from nlos_cam.reconstruct import CalibratedRig, Pipeline
from nlos_cam.reconstruct.bench import NOT_MEASURED
from nlos_cam.recording import WallFile, load_sidecar
from nlos_cam.view import NullViewer, SessionFile, WrittenFiles


@pytest.fixture
def control(tmp_path: Path) -> RunControl:
    """Controls of a running camera, with a first frame."""
    control = RunControl(folder=tmp_path, clock=lambda: 2.0)
    control.attach(Recorded(0), Pipeline(CalibratedRig(RIG), sheet_network))  # type: ignore[arg-type]
    for number in range(30):
        control.add(full_moment(number))
    return control


def files(folder: Path) -> list[str]:
    return sorted(path.suffix for path in folder.iterdir())


def test_status_is_json_and_gives_pace_age_and_disk(control: RunControl) -> None:
    status = json.loads(json.dumps(control.status(), allow_nan=False))

    assert status["state"] == "running"
    assert status["fps"] == pytest.approx(30.0)
    assert status["p50_ms"] == status["p99_ms"] == pytest.approx(20.0)
    assert status["age_s"] == pytest.approx(2.0 - 29 / 30 + 0.02, abs=0.01)
    assert status["disk_s"] > 0


def test_paused_run_has_frames_and_no_pace(control: RunControl) -> None:
    control.set_state("stalled", "no frame for 3 s")
    control.run("pause", {})

    assert control.status()["state"] == "stalled"

    control.pass_frame()  # the camera is back

    assert control.status()["state"] == "paused"
    assert "fps" not in control.status()


def test_old_results_say_nothing_of_the_pace(tmp_path: Path) -> None:
    control = RunControl(folder=tmp_path, clock=lambda: 10.0)
    for number in range(30):  # of ten seconds ago
        control.add(full_moment(number))

    assert "fps" not in control.status()


def test_pace_after_a_stall_is_that_of_the_new_frames(tmp_path: Path) -> None:
    control = RunControl(folder=tmp_path, clock=lambda: 21.0)
    for number in (*range(30), *range(600, 630)):
        control.add(full_moment(number))

    assert control.status()["fps"] == pytest.approx(30.0)


@pytest.mark.parametrize("command", [("resume", {}), ("option", {"name": "gain", "value": 2})])
def test_what_changes_the_scene_begins_a_new_mean(
    control: RunControl, monkeypatch: pytest.MonkeyPatch, command: tuple[str, Any]
) -> None:
    begun = Mock()
    monkeypatch.setattr(Pipeline, "begin_mean", begun)
    monkeypatch.setattr(run_commands, "AdjustableCamera", Recorded)
    monkeypatch.setattr(Recorded, "set_option", lambda *_: "set", raising=False)
    monkeypatch.setattr(Recorded, "adjustable", lambda _: [], raising=False)
    control.run(*command)

    assert begun.call_count == 1


def test_no_reference_is_taken_while_a_session_is_saved(control: RunControl) -> None:
    control.run("save_session", {})

    assert "end it first" in control.status()["control"]["no_reference"]
    with pytest.raises(NlosCamError, match="session is saved"):
        control.run("take_reference", {})

    control.run("end_session", {})

    assert control.status()["control"]["no_reference"] == ""


@pytest.fixture
def waiting(tmp_path: Path) -> RunControl:
    """Controls of a run whose clock goes on by 10 s at each look, and whose camera opens."""
    now_s = iter(range(0, 1000, 10))
    return RunControl("sim", folder=tmp_path, clock=lambda: next(now_s))


def state_of(control: RunControl) -> tuple[str, str]:
    status = control.status()
    return status["state"], status["message"]


def test_status_tells_when_the_first_frame_is_expected(waiting: RunControl) -> None:
    assert waiting.status()["state"] == "connecting"

    waiting.show_progress(1, 60)
    waiting.show_progress(2, 60)

    assert "first frame in about" in waiting.status()["message"]


def test_status_follows_the_run_from_its_camera_to_its_end(waiting: RunControl) -> None:
    waiting.attach(Recorded(0), Pipeline(CalibratedRig(RIG), sheet_network))  # type: ignore[arg-type]

    assert "first frame" in waiting.status()["message"]

    waiting.add(moment(0))
    waiting.set_state("stalled", "no frame for 3 s")

    assert state_of(waiting) == ("stalled", "no frame for 3 s")

    waiting.add(moment(1))

    assert state_of(waiting) == ("running", "")

    waiting.end()

    assert state_of(waiting) == ("ended", "")


def test_snapshot_writes_picture_arrays_and_mesh(control: RunControl, tmp_path: Path) -> None:
    assert ".npz" in control.run("snapshot", {})
    assert files(tmp_path) == [".npz", ".ply", ".png"]

    with np.load(next(tmp_path.glob("*.npz"))) as arrays:
        np.testing.assert_array_equal(arrays["depth_m"], full_moment(29).result.depth_m)
        assert arrays["frame_number"] == 29


def test_second_snapshot_replaces_nothing(control: RunControl, tmp_path: Path) -> None:
    for _ in range(2):
        control.run("snapshot", {})
    assert len(files(tmp_path)) == 6


def test_session_is_saved_between_two_commands(control: RunControl, tmp_path: Path) -> None:
    control.run("save_session", {})

    assert control.status()["control"]["saving"]

    for number in range(30, 60):
        control.add(full_moment(number))
    control.run("end_session", {})
    shown = [each["frame"] for each in saved_moments(next(tmp_path.glob("session-*.html")))]

    assert shown[0] == 30
    assert set(shown) <= set(range(30, 60))


def test_session_that_stopped_is_told(control: RunControl, monkeypatch: pytest.MonkeyPatch) -> None:
    control.run("save_session", {})
    monkeypatch.setattr(SessionFile, "problem", "the session is full")

    assert "the session is full" in control.status()["warnings"]
    assert "the session is full" in control.run("end_session", {})
    assert control.status()["warnings"] == []


def test_average_changes_the_pipeline(control: RunControl) -> None:
    pipeline = Pipeline(CalibratedRig(RIG), sheet_network)
    control.attach(Recorded(0), pipeline)  # type: ignore[arg-type]
    control.run("average", {"frames": 4})

    assert pipeline.average == control.status()["control"]["average"] == 4


@pytest.mark.parametrize(
    ("command", "arguments", "reason"),
    [
        ("fly", {}, "no command"),
        ("average", {"frames": 0}, "1 to 1000"),
        ("average", {"frames": "x"}, "whole number"),
        ("take_reference", {"frames": "x"}, "whole number"),
        ("average", {"of": 3}, "does not take"),
        ("stop_recording", {}, "nothing is being recorded"),
        ("end_session", {}, "no session"),
        ("record", {"label": "cup"}, "live camera"),
        ("option", {"name": "laser_power", "value": 3}, "L515"),
    ],
)
def test_refused_command_says_why(
    control: RunControl, tmp_path: Path, command: str, arguments: dict[str, Any], reason: str
) -> None:
    with pytest.raises(NlosCamError, match=reason):
        control.run(command, arguments)
    assert files(tmp_path) == []


def test_commands_before_the_first_frame_say_to_wait(tmp_path: Path) -> None:
    for command in ("snapshot", "record", "take_reference"):
        with pytest.raises(NlosCamError, match="not running yet"):
            RunControl(folder=tmp_path).run(command, {})


def test_one_command_runs_at_a_time(control: RunControl) -> None:
    entered = Event()
    leave = Event()
    control.thread_start = lambda: entered.set() or leave.wait(60.0)
    thread = threading.Thread(target=control.run, args=("pause", {}))
    thread.start()

    assert entered.wait(60.0)

    with pytest.raises(NlosCamError, match="another command"):
        control.run("resume", {})
    leave.set()
    thread.join()

    assert control.pipeline.paused


def run(camera: FrameCamera, control: RunControl, pipeline: Pipeline | None = None) -> RunReport:
    pipeline = pipeline or Pipeline(CalibratedRig(RIG), sheet_network)
    return run_live(camera, pipeline, NullViewer(), stop=Event(), control=control, recorded=True)


def test_paused_run_reads_frames_and_reconstructs_none(tmp_path: Path) -> None:
    control = RunControl(folder=tmp_path)
    commands = {5: "pause", 15: "resume"}
    report = run(
        FrameCamera(30, lambda number: number in commands and control.run(commands[number], {})),
        control,
    )

    assert 14 <= report.frames <= 26
    assert report.dropped == 0


def test_run_ends_a_session_that_is_being_saved(tmp_path: Path) -> None:
    control = RunControl(folder=tmp_path)
    run(FrameCamera(30, lambda number: number == 5 and control.run("save_session", {})), control)

    assert control.status()["state"] == "ended"
    assert saved_moments(next(tmp_path.glob("session-*.html")))


def beside(command: threading.Thread) -> Callable[[int], None]:
    """Return what starts a command at the third frame, and lets later ones wait for it."""

    def act(number: int) -> None:
        if number == 3:
            command.start()
        elif number > 3:
            command.join(0.02)

    return act


def test_reference_is_taken_from_the_passing_frames(tmp_path: Path) -> None:
    control = RunControl(folder=tmp_path)
    benches = list[CalibratedRig]()
    outcomes = list[str]()
    control.bench.on_bench = benches.append
    command = threading.Thread(
        target=lambda: outcomes.append(control.run("take_reference", {"frames": 8}))
    )

    run(FrameCamera(200, beside(command), make=wall_frame, uri="sim"), control)
    command.join()

    assert "reference of 8 frames" in outcomes[0]

    (bench,) = benches
    measured = load_measured(next(tmp_path.glob("bench-*.toml")))

    np.testing.assert_array_equal(measured.reference.map_depth_m, bench.reference.map_depth_m)


ELSEWHERE = LidarPose(distance_m=0.25, yaw_deg=40.0, pitch_deg=2.0)


def frame_elsewhere(number: int) -> Frame:
    """Return a frame of a bare wall that is not where the paper's is."""
    pose = RIG.model_copy(update={"lidar": ELSEWHERE}).wall_from_lidar
    wall_m = wall_depth(pose, SMALL)
    noise_m = np.random.default_rng(number).normal(0.0, 5e-4, wall_m.shape)
    depth_m = np.where(wall_m < 0.6, wall_m + noise_m, np.nan).astype(np.float32)
    return replace(wall_frame(number), depth_m=depth_m)


@pytest.fixture
def taken(tmp_path: Path) -> tuple[str, Pipeline, MeasuredWall]:
    """Answer, pipeline and record of a reference in a run whose wall was not measured."""
    pipeline = Pipeline(CalibratedRig(RIG, notes=(NOT_MEASURED,)), sheet_network)
    pipeline.trained = load_record(shipped_folder("direct"))
    control = RunControl(folder=tmp_path)
    outcomes = list[str]()
    command = threading.Thread(
        target=lambda: outcomes.append(control.run("take_reference", {"frames": 8}))
    )
    run(FrameCamera(200, beside(command), make=frame_elsewhere, uri="l515"), control, pipeline)
    command.join()
    return outcomes[0], pipeline, load_measured(next(tmp_path.glob("bench-*.toml")))


def test_reference_gives_the_rig_of_a_run_without_a_record(
    taken: tuple[str, Pipeline, MeasuredWall],
) -> None:
    _, pipeline, measured = taken
    rig = pipeline.bench.rig

    assert rig.lidar.distance_m == pytest.approx(ELSEWHERE.distance_m, abs=5e-4)
    assert rig.lidar.yaw_deg == pytest.approx(ELSEWHERE.yaw_deg, abs=0.1)
    assert rig.lidar.pitch_deg == pytest.approx(ELSEWHERE.pitch_deg, abs=0.1)
    assert rig.pinhole == SMALL
    assert (rig.occluder, rig.object_box) == (RIG.occluder, RIG.object_box)
    assert rig == measured.record.rig


def test_reference_says_which_rig_is_used_and_assumed(
    taken: tuple[str, Pipeline, MeasuredWall],
) -> None:
    answer, pipeline, measured = taken
    (warning,) = pipeline.bench.warnings

    assert f"{1e3 * measured.record.distance_m:.1f} mm" in answer
    assert "occluder has not been measured" in warning
    assert "calibrate --occluder" in warning
    assert warning in answer
    assert "adapt" in answer, "the weights are of another rig"


def test_reference_with_an_occluder_gives_its_place() -> None:
    found = load_rig("wide-rig").occluder
    record: Any = SimpleNamespace(
        rig=RIG.model_copy(update={"name": "measured", "lidar": ELSEWHERE, "occluder": found}),
        occluder=OccluderRecord(source="detected", x_m=found.x_m, gap_m=found.z_min_m),
    )
    boxed = RIG.model_copy(update={"object_box": None})

    assert measured_rig(boxed, record) == record.rig.model_copy(update={"object_box": None})

    record.occluder = None

    assert measured_rig(boxed, record).occluder == RIG.occluder


def test_reference_with_something_in_the_way_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hidden = Mock(side_effect=CalibrationError("an object seems to be hidden; remove it"))
    monkeypatch.setattr("nlos_cam.live.run_commands.measure_bench", hidden)
    control = RunControl(folder=tmp_path)
    outcomes = list[Exception]()

    def take() -> None:
        try:
            control.run("take_reference", {"frames": 2})
        except NlosCamError as error:
            outcomes.append(error)

    command = threading.Thread(target=take)

    run(FrameCamera(60, beside(command), make=wall_frame, uri="sim"), control)
    command.join()

    assert "remove it" in str(outcomes[0])
    assert not list(tmp_path.iterdir())


def test_run_is_under_strain_while_a_command_waits(
    control: RunControl, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nlos_cam.live.control.COMMAND_WAIT_S", -1.0)
    strain = control.strain_of(Event())
    found = list[str]()
    control.thread_start = lambda: found.append(strain())
    control.run("pause", {})

    assert found == ["a command waits"]
    assert not strain()


def test_run_is_under_strain_once_it_drops_frames(control: RunControl) -> None:
    strain = control.strain_of(Event())
    for count in range(WARM_UP_FRAMES):  # the first ones are late anyway
        control.note_drops(count)
    for count in (0, 1, 3):
        control.note_drops(WARM_UP_FRAMES - 1 + count)
        assert not strain()
    control.note_drops(WARM_UP_FRAMES + 3)

    assert strain() == "frames are dropped"


def test_run_is_under_strain_when_it_is_to_stop(control: RunControl) -> None:
    stop = Event()
    stop.set()

    assert control.strain_of(stop)() == "the run ends"

    control.end()

    assert control.strain_of(Event())() == "the run ends"


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        ("average", {"frames": float("inf")}),
        ("average", {"frames": float("nan")}),
        ("average", {"frames": 10**400}),
        ("average", {"frames": 1.5}),
        ("average", {"frames": "three"}),
        ("average", {"frames": None}),
        ("average", {"frames": [1]}),
        ("average", {"frames": True}),
        ("take_reference", {"frames": 10**9}),
        ("take_reference", {"frames": -1}),
        ("take_reference", {"frames": 2.5}),
        ("record", {"label": "\ud800"}),
        ("record", {"label": "\x1b[2J"}),
        ("record", {"label": "x" * 1000}),
        ("record", {"\udcff": 1}),
        ("option", {"name": "\udcff", "value": 1}),
        ("option", {"name": "laser_power", "value": 1e308}),
        ("\ud800", {}),
    ],
)
def test_command_beyond_its_range_has_one_clear_answer(
    control: RunControl, command: str, arguments: dict[str, Any]
) -> None:
    with pytest.raises(NlosCamError) as caught:
        control.run(command, arguments)
    answer = str(caught.value)

    assert answer.isprintable()
    assert "unforeseen" not in answer
    assert len(answer) < 400


@pytest.mark.parametrize("command", ["snapshot", "save_session", "record"])
def test_command_says_that_its_folder_went_away(
    control: RunControl, command: str, tmp_path: Path
) -> None:
    tmp_path.rmdir()
    with pytest.raises(NlosCamError, match=r"folder|cannot be (written|recorded)"):
        control.run(command, {})

    assert control.status()["state"] == "running"


def test_reference_ends_with_the_run(control: RunControl, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.live.run_commands.POLL_S", 0.001)
    entered = Event()
    control.thread_start = entered.set
    answers: list[str] = []

    def measure() -> None:
        try:
            control.run("take_reference", {"frames": 5})
        except NlosCamError as error:
            answers.append(str(error))

    thread = threading.Thread(target=measure)
    thread.start()
    assert entered.wait(60.0)
    control.end()
    thread.join()

    assert "ended" in answers[0] or "the run ends" in answers[0]


def test_no_command_begins_while_the_run_ends(
    control: RunControl, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop() -> str:  # reading a recording back takes a minute, in which the page still answers
        with pytest.raises(NlosCamError, match="another command"):
            control.run("save_session", {})
        return "stopped"

    control.recording.recording = SimpleNamespace(problem="")  # type: ignore[assignment]
    monkeypatch.setattr(control.recording, "stop_recording", stop)
    control.end()
    control.recording.recording = None

    for command in ("save_session", "record", "snapshot", "take_reference"):
        with pytest.raises(NlosCamError, match="the run ends"):
            control.run(command, {})
    assert not control.saving.is_saving
    assert control.status()["control"]["commands"] == []


@contextmanager
def attached(
    control: RunControl, world: Any, clock: Any
) -> Generator[tuple[SimulatedCamera, Iterator[Frame]]]:
    """A simulated camera that a run's commands control, and the frames that pass them."""
    with SimulatedCamera("sim:noise", world, clock=clock) as camera:
        control.attach(camera, Pipeline(CalibratedRig(RIG), sheet_network))
        yield camera, control.watch(camera)


def test_recording_that_the_camera_ended_is_called_lost(
    tmp_path: Path, noise_world: Any, hurried_clock: Any
) -> None:
    wall = RIG, WallFile(path="wall.toml", sha256="0" * 64)
    control = RunControl(folder=tmp_path, wall=wall)
    with attached(control, noise_world(), hurried_clock()) as (camera, frames):
        next(frames)
        camera.counts["duplicate"] = 4  # before the recording
        control.run("record", {})
        for _ in range(10):
            next(frames)
        camera._end_recording("the camera fell silent")
        during = control.status()
        answer = control.run("stop_recording", {})

    assert "fell silent" in during["warnings"][0]
    assert "fell silent" in answer
    sidecar = load_sidecar(next(tmp_path.glob("*.json")))
    assert sidecar.state == "lost"
    assert sidecar.wall == wall[1]
    assert sidecar.summary
    assert "duplicate" not in sidecar.summary.events


def test_recording_is_not_read_back_in_a_hurry(
    tmp_path: Path, noise_world: Any, hurried_clock: Any
) -> None:
    control = RunControl(folder=tmp_path)
    with attached(control, noise_world(), hurried_clock()) as (_, frames):
        control.run("record", {})
        for _ in range(10):
            next(frames)
        control.hurry.set()
        answer = control.run("stop_recording", {})

    assert "not read back" in answer
    assert load_sidecar(next(tmp_path.glob("*.json"))).state == "interrupted"


def test_recording_without_a_frame_is_in_no_folder(control: RunControl, tmp_path: Path) -> None:
    nothing = SimpleNamespace(
        path=tmp_path / "live.bag", problem="", add=Mock(), stop=lambda _: "nothing was recorded"
    )
    control.recording.recording = nothing  # type: ignore[assignment]
    control._run.on_frame.append(nothing.add)

    assert control.run("stop_recording", {}) == "nothing was recorded"


def test_page_says_that_a_recording_has_no_room(
    tmp_path: Path, noise_world: Any, hurried_clock: Any
) -> None:
    control = RunControl(folder=tmp_path)
    with attached(control, noise_world(), hurried_clock()) as (_, frames):
        next(frames)
        control.run("record", {})
        before = control.status()
        control.recording.recording._recording._free = lambda _: 0
        for _ in range(40):
            next(frames)
        during = control.status()
        answer = control.run("stop_recording", {})

    assert before["warnings"] == []
    assert "the recording has ended" in during["warnings"][0]
    assert during["recording"]["seconds"] < 1.1
    assert "the disk is full" in answer
    assert control.status()["warnings"] == []


def test_page_lists_the_last_files_and_keeps_all(tmp_path: Path) -> None:
    files = WrittenFiles()
    for number in range(20):
        path = tmp_path / f"{number}.npz"
        path.touch()
        files.note(path)

    assert files.newest == [f"{number}.npz" for number in range(8, 20)]
    assert files["0.npz"] == tmp_path / "0.npz"
