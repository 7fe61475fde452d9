import json
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_doubter import FakeDoubter
from fake_wall import WallCamera, bare_wall, wall_frame, write_wall
from small_frames import FrameCamera, SheetNetwork, small_frame

from nlos_cam.cli.live import summary
from nlos_cam.cli.main import main
from nlos_cam.live.statistics import RunReport
from nlos_cam.reconstruct.verdict import Verdict

TIMES = {"p50": 1.04, "p95": 2.0, "p99": 3.06}
RECORDED, REPLAY = ["live", "--camera", "bag:fake", "--no-view"], ["replay", "run.bag", "--out", "out"]
SIMULATED, WALLED = ["live", "--camera", "sim", "--no-view"], [*REPLAY, "--overwrite", "--wall"]


class Opened:
    """Opener of `camera`, or of one with `count` frames that calls `on_frame` before each; keeps the calls."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, dict[str, Any]]] = []
        self.on_frame: Callable[[int], object] = lambda _: None
        self.on_open: Callable[[], None] = lambda: None
        self.count: int | None = 20
        self.camera: WallCamera | None = None
        self.network, self.doubter = SheetNetwork(), FakeDoubter()

    def __call__(self, uri: str, **options: Any) -> FrameCamera | WallCamera:
        self.calls.append((uri, options))
        self.on_open()
        quick: Any = {"uri": uri, "make": lambda number: replace(small_frame(number), timestamp_s=number / 1000)}
        return self.camera or FrameCamera(self.count, self.on_frame, **quick)

    def interrupt_at(self, number: int) -> None:
        """Press Ctrl-C at frame `number` of an endless camera."""
        self.count = None
        self.on_frame = lambda wanted: wanted == number and os.kill(os.getpid(), signal.SIGINT)


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Opened]:
    opened = Opened()
    monkeypatch.setattr("nlos_cam.camera.open_camera", opened)
    monkeypatch.setattr("nlos_cam.reconstruct.load_networks", lambda *_: opened.network)
    monkeypatch.setattr("nlos_cam.reconstruct.load_uncertainty", lambda *_: opened.doubter)
    monkeypatch.setattr("nlos_cam.live.replay.draw_contact_sheet", lambda path, *_: path.touch())  # takes a second
    monkeypatch.chdir(tmp_path)
    before = signal.getsignal(signal.SIGINT)
    yield opened
    assert signal.getsignal(signal.SIGINT) == before


@pytest.fixture
def walled(opened: Opened, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Opened:
    """Camera on a measured wall, wall.toml, that is moved for a while."""
    monkeypatch.setattr("nlos_cam.live.loop.os.cpu_count", lambda: 1)  # the network is given maps in order
    write_wall(tmp_path / "wall.toml", bare_wall())
    opened.camera, opened.doubter = WallCamera(100, moved=range(30, 60)), None
    return opened


Run = Callable[..., tuple[int, dict[str, Any], str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Exit code of a command with --json, the object that ends stdout, and stderr on one line."""

    def run(*arguments: str) -> tuple[int, dict[str, Any], str]:
        capsys.readouterr()
        code = main([*arguments, "--json"])
        captured = capsys.readouterr()
        lines = captured.out.splitlines() or ["{}"]
        return code, json.loads(lines[-1]), captured.err.replace("\n", " ")

    return run


@pytest.mark.usefixtures("opened")
def test_live_json_and_log_have_their_fields(run: Run) -> None:
    arguments = [*RECORDED, "--log", "log.csv"]
    code, report, _ = run(*arguments)
    assert code == 0
    fields = ("frames", "fps", "dropped", "latency_ms", "stages_ms", "counts", "warnings")
    assert set(report) == {*fields, "stages_percentiles_ms", "verdicts", "stalled_s", "quality", "camera_ms"}
    assert (report["frames"], report["dropped"]) == (20, 0)
    assert report["verdicts"] == {Verdict.SEEN.value: 20}
    assert set(report["latency_ms"]) == {"p50", "p95", "p99"}
    assert set(report["stages_ms"]) == {"delivery", "wait", "queue", "maps", "bench", "network", "doubt", "view"}
    header, *lines = Path("log.csv").read_text(encoding="utf-8").splitlines()
    assert [int(line.split(",")[0]) for line in lines] == list(range(20))
    assert {"latency_ms", "delivery_ms", "queue_ms", "network_ms", "dropped", "verdict"} <= set(header.split(","))
    assert run(*arguments)[0] == 1


def test_live_ends_with_a_live_camera_or_after_its_seconds(opened: Opened, run: Run) -> None:
    code, report, _ = run(*SIMULATED)
    assert (code, report["frames"] + report["dropped"]) == (0, 20)
    opened.on_frame = lambda number: threading.Event().wait(0.05 if number else 0.0)
    code, report, _ = run(*SIMULATED, "--seconds", "0.2")
    assert code == 0
    assert report["frames"] < 20
    assert [uri for uri, _ in opened.calls] == ["sim", "sim"]


@pytest.mark.usefixtures("opened")
def test_live_prints_the_address_of_its_view(run: Run) -> None:
    code, _, printed = run("live", "--camera", "bag:fake")
    assert code == 0
    assert "http://127.0.0.1:" in printed


def test_live_record_overwrites_only_when_asked(opened: Opened, tmp_path: Path, run: Run) -> None:
    bag = tmp_path / "run.bag"
    arguments = [*SIMULATED, "--record", str(bag)]
    assert run(*arguments)[0] == 0
    assert opened.calls[-1][1]["recording"].path == bag
    bag.write_text("mine")
    code, refused, _ = run(*arguments)
    assert (code, refused["error"]["type"]) == (1, "OutputExistsError")
    assert run(*arguments, "--overwrite")[0] == 0


@pytest.mark.usefixtures("opened")
def test_replay_on_a_wall_notes_that_the_rig_differs(tmp_path: Path, run: Run) -> None:
    write_wall(tmp_path / "wall.toml")
    code, _, printed = run(*WALLED, "wall.toml")
    assert code == 0
    assert "training rig" in printed
    with np.load(tmp_path / "out" / "reconstruction.npz") as file:
        assert str(file["rig_name"]) == "measured"
    code, refused, _ = run(*WALLED, "none.toml")
    assert (code, refused["error"]["type"]) == (4, "RecordFileError")


def test_replay_writes_its_folder_and_one_json_object(opened: Opened, run: Run) -> None:
    code, report, printed = run(*REPLAY)
    assert code == 0
    assert set(report) == {"frames", "seconds", "out", "warnings", "verdicts", "quality"}
    assert (report["frames"], report["out"]) == (20, "out")
    assert "training rig" not in printed
    assert run(*REPLAY)[0] == 1
    assert run(*REPLAY, "--overwrite", "--reader", "sdk")[0] == 0
    assert opened.calls == [("bag:run.bag", {"reader": "plain"}), ("bag:run.bag", {"reader": "sdk"})]


@pytest.mark.parametrize("command", [RECORDED, REPLAY])
def test_interrupted_command_keeps_its_results(opened: Opened, run: Run, command: list[str]) -> None:
    opened.interrupt_at(10)
    code, report, _ = run(*command)
    assert code == 130
    if command is REPLAY:
        with np.load("out/reconstruction.npz") as file:
            assert len(file["depth_m"]) == report["frames"]
    assert report["frames"] >= 1


@pytest.mark.parametrize("command", [SIMULATED, ["replay", "a.bag"]])
def test_interrupt_while_a_camera_opens_begins_no_run(opened: Opened, run: Run, command: list[str]) -> None:
    def swallow() -> None:
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)

    opened.on_open = swallow
    assert run(*command)[:2] == (130, {})


def test_live_budget_reports_whether_it_was_kept(opened: Opened, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.live.setting_loader", lambda *_: lambda _: opened.network)
    code, report, printed = run(*RECORDED, "--budget-ms", "100000")
    assert code == 0
    assert report["budget"]["kept"]
    assert "100000 ms" in printed


@pytest.mark.usefixtures("walled")
@pytest.mark.parametrize("command", [SIMULATED, REPLAY])
def test_command_prints_begin_and_end_of_a_warning_once(
    run: Run, monkeypatch: pytest.MonkeyPatch, command: list[str]
) -> None:
    monkeypatch.setattr("nlos_cam.live.frame_queue.QUEUE_FRAMES", 1000)
    code, report, printed = run(*command, "--wall", "wall.toml")
    assert code == 0
    [(warning, frames)] = report["warnings"].items()
    assert 0 < frames < 100
    assert printed.count("drifted") == 2
    assert printed.count(warning) >= 1


def test_average_is_over_as_many_frames_as_asked(walled: Opened) -> None:
    walled.camera = WallCamera(26)
    assert main([*WALLED, "wall.toml", "--average", "20"]) == 0
    mean_m = np.mean([wall_frame(number).depth_m for number in range(6, 26)], axis=0)
    np.testing.assert_allclose(walled.network.given[25], mean_m, atol=1e-6)  # NaN where NaN


def test_weights_of_difference_maps_need_a_wall(walled: Opened, run: Run) -> None:
    walled.camera, walled.network.record.input = WallCamera(21), "difference maps"
    assert run(*WALLED, "wall.toml")[0] == 0
    assert abs(np.nanmean(walled.network.given[20])) < 1e-3
    code, refused, _ = run(*SIMULATED)
    assert code == 1
    assert "--wall" in refused["error"]["message"]


def test_summary_has_a_sentence_per_fact_and_stages_if_verbose() -> None:
    latency_ms, stages = {"p50": 9.0, "p95": 14.0, "p99": 21.0}, {"wait": TIMES, "delivery": TIMES, "network": TIMES}
    plain = RunReport(10, 29.97, 0, latency_ms, {}, {}, stages_percentiles_ms=stages)
    assert len(summary(plain).splitlines()) == 2
    full = replace(
        plain,
        dropped=5,
        counts={"dropped_loop": 3, "dropped_camera": 2, "blank": 1},
        verdicts={"object seen": 7, "nothing there": 3},
        warnings={"the lidar has drifted": 4},
        stalled_s=1.25,
    )
    assert summary(full).splitlines()[2:] == [
        "Dropped 5 frames: 2 at the camera, 3 because processing was too slow",
        "Warning: 33% of the frames dropped, median latency 9 ms: close other programs, or give --budget-ms",
        "Object detected in 7 of 10 frames, nothing there in 3",
        "Irregular: 1 blank",
        "Stalled for 1.2 s without a frame",
        "Warning in 4 frames: the lidar has drifted",
    ]
    stages_lines = [line.split() for line in summary(plain, verbose=True).splitlines()[3:]]
    assert stages_lines == [[name, "1.0", "3.1"] for name in ("delivery", "network", "wait")]
