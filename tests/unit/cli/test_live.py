import os
import re
import signal
import socket
import threading
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import typer
from fake_uncertainty import FakeUncertainty
from fake_wall import WallCamera, bare_wall, wall_frame, write_wall
from made_up_moments import RIG, Recorded, full_moment
from small_frames import FrameCamera, SheetNetwork, small_frame
from view_streams import EVERYWHERE, ask

from nlos_cam.cli.live import summary
from nlos_cam.cli.main import main
from nlos_cam.cli.view import announce_view, opened_in_browser, viewer_of
from nlos_cam.errors import NlosCamError
from nlos_cam.live import RunControl
from nlos_cam.live.statistics import RunReport
from nlos_cam.reconstruct.verdict import Verdict
from nlos_cam.view import NullViewer, SessionFile

TIMES = {"p50": 1.04, "p95": 2.0, "p99": 3.06}
RECORDED = ["live", "--camera", "bag:fake", "--no-view"]
REPLAY = ["replay", "run.bag", "--out", "out"]
SIMULATED = ["live", "--camera", "sim", "--no-view"]
WALLED = [*REPLAY, "--overwrite", "--wall"]


class Opened:
    """Opener of `camera`, or of one with `count` frames that calls `on_frame` before each; keeps
    the calls.
    """

    def __init__(self) -> None:
        self.calls: list[tuple[str, dict[str, Any]]] = []
        self.on_frame: Callable[[int], object] = lambda _: None
        self.on_open: Callable[[], None] = lambda: None
        self.count: int | None = 20
        self.camera: Recorded | WallCamera | None = None
        self.network = SheetNetwork()
        self.doubter = FakeUncertainty()

    def __call__(self, uri: str, **options: Any) -> FrameCamera | WallCamera:
        self.calls.append((uri, options))
        self.on_open()
        quick: Any = {
            "uri": uri,
            "make": lambda number: replace(small_frame(number), timestamp_s=number / 1000),
        }
        return self.camera or FrameCamera(self.count, self.on_frame, **quick)


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Iterator[Opened]:
    opened = Opened()
    monkeypatch.setattr("nlos_cam.camera.open_camera", opened)
    monkeypatch.setattr("nlos_cam.reconstruct.load_networks", lambda *_: opened.network)
    monkeypatch.setattr("nlos_cam.reconstruct.load_uncertainty", lambda *_: opened.doubter)
    monkeypatch.setattr(
        "nlos_cam.live.replay.draw_contact_sheet", lambda path, *_: path.touch()
    )  # takes a second
    before = signal.getsignal(signal.SIGINT)
    yield opened
    assert signal.getsignal(signal.SIGINT) == before


@pytest.fixture
def walled(opened: Opened, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Opened:
    """Camera on a measured wall, wall.toml, that is moved for a while."""
    monkeypatch.setattr(
        "nlos_cam.live.loop.os.cpu_count", lambda: 1
    )  # the network is given maps in order
    write_wall(tmp_path / "wall.toml", bare_wall())
    opened.camera = WallCamera(100, moved=range(30, 60))
    opened.doubter = None
    return opened


Run = Callable[..., Any]


@pytest.mark.usefixtures("opened")
def test_live_json_and_log_have_their_fields(run: Run) -> None:
    arguments = [*RECORDED, "--log", "log.csv"]
    report = run(*arguments)
    fields = ("frames", "fps", "dropped", "latency_ms", "stages_ms", "counts", "warnings")
    assert set(report) == {
        *fields,
        "stages_percentiles_ms",
        "verdicts",
        "stalled_s",
        "quality",
        "camera_ms",
    }
    assert (report["frames"], report["dropped"]) == (20, 0)
    assert report["verdicts"] == {Verdict.SEEN.value: 20}
    assert set(report["latency_ms"]) == {"p50", "p95", "p99"}
    assert set(report["stages_ms"]) == {
        "delivery",
        "wait",
        "queue",
        "maps",
        "bench",
        "network",
        "doubt",
        "view",
    }
    header, *lines = Path("log.csv").read_text(encoding="utf-8").splitlines()
    assert [int(line.split(",")[0]) for line in lines] == list(range(20))
    assert {"latency_ms", "delivery_ms", "queue_ms", "network_ms", "dropped", "verdict"} <= set(
        header.split(",")
    )
    run(*arguments, code=1)
    assert "http://127.0.0.1:" in run("live", "--camera", "bag:fake").err


def test_live_ends_with_a_live_camera_or_after_its_seconds(opened: Opened, run: Run) -> None:
    report = run(*SIMULATED)
    assert report["frames"] + report["dropped"] == 20
    opened.on_frame = lambda number: threading.Event().wait(0.05 if number else 0.0)
    assert run(*SIMULATED, "--seconds", "0.2")["frames"] < 20
    assert [uri for uri, _ in opened.calls] == ["sim", "sim"]


def test_live_saves_its_view_and_overwrites_only_when_asked(opened: Opened, run: Run) -> None:
    opened.camera = Recorded(12)
    arguments = [*RECORDED, "--save-view", "view.html"]
    assert "open view.html" in run(*arguments).err
    assert Path("view.html").stat().st_size > 10_000
    run(*arguments, code=1)
    run(*arguments, "--overwrite")


@pytest.mark.slow
def test_replay_saves_view_stills_and_video(opened: Opened, run: Run) -> None:
    opened.camera = Recorded(12)
    run(*REPLAY, "--save-view", "--stills", "2", "--video")
    assert {"view.html", "replay.webm", "still-000000.png"} < {
        file.name for file in Path("out").iterdir()
    }


def test_live_record_overwrites_only_when_asked(opened: Opened, run: Run) -> None:
    arguments = [*SIMULATED, "--record", "run.bag"]
    run(*arguments)
    assert opened.calls[-1][1]["recording"].path == Path("run.bag")
    Path("run.bag").write_text("mine")
    assert run(*arguments, code=1)["error"]["type"] == "OutputExistsError"
    run(*arguments, "--overwrite")


@pytest.mark.usefixtures("opened")
def test_replay_on_a_wall_notes_that_the_rig_differs(run: Run) -> None:
    write_wall(Path("wall.toml"))
    assert "training rig" in run(*WALLED, "wall.toml").err
    with np.load("out/reconstruction.npz") as file:
        assert str(file["rig_name"]) == "measured"
    assert run(*WALLED, "none.toml", code=4)["error"]["type"] == "RecordFileError"


def test_replay_writes_its_folder_and_one_json_object(opened: Opened, run: Run) -> None:
    report = run(*REPLAY)
    assert set(report) == {"frames", "seconds", "out", "warnings", "verdicts", "quality"}
    assert (report["frames"], report["out"]) == (20, "out")
    assert "training rig" not in report.err
    run(*REPLAY, code=1)
    run(*REPLAY, "--overwrite")
    assert opened.calls == [("bag:run.bag", {})] * 2


@pytest.mark.parametrize("command", [RECORDED, REPLAY])
def test_interrupted_command_keeps_its_results(
    opened: Opened, run: Run, command: list[str]
) -> None:
    opened.count = None
    opened.on_frame = lambda number: number == 10 and os.kill(os.getpid(), signal.SIGINT)
    report = run(*command, code=130)
    if command is REPLAY:
        with np.load("out/reconstruction.npz") as file:
            assert len(file["depth_m"]) == report["frames"]
    assert report["frames"] >= 1


@pytest.mark.parametrize("command", [SIMULATED, ["replay", "a.bag"]])
def test_interrupt_while_a_camera_opens_begins_no_run(
    opened: Opened, run: Run, command: list[str]
) -> None:
    def swallow() -> None:
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)

    opened.on_open = swallow
    assert run(*command, code=130) == {}


def test_live_budget_reports_whether_it_was_kept(
    opened: Opened, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nlos_cam.live.setting_loader", lambda *_: lambda _: opened.network)
    report = run(*RECORDED, "--budget-ms", "100000")
    assert report["budget"]["kept"]
    assert "100000 ms" in report.err


@pytest.mark.usefixtures("walled")
@pytest.mark.parametrize("command", [SIMULATED, REPLAY])
def test_begin_and_end_of_a_warning_print_once(
    run: Run, monkeypatch: pytest.MonkeyPatch, command: list[str]
) -> None:
    monkeypatch.setattr("nlos_cam.live.frame_queue.QUEUE_FRAMES", 1000)
    report = run(*command, "--wall", "wall.toml")
    [(warning, frames)] = report["warnings"].items()
    assert 0 < frames < 100
    assert report.err.count("drifted") == 2
    assert report.err.count(warning) >= 1


def test_average_is_over_as_many_frames_as_asked(walled: Opened) -> None:
    walled.camera = WallCamera(26)
    walled.network.record.rig_checksum = "of a rig that is not here"  # maps are left as they are
    assert main([*WALLED, "wall.toml", "--average", "20"]) == 0
    mean_m = np.mean([wall_frame(number).depth_m for number in range(6, 26)], axis=0)
    np.testing.assert_allclose(walled.network.given[25], mean_m, atol=1e-6)  # NaN where NaN


def test_weights_of_difference_maps_need_a_wall(walled: Opened, run: Run) -> None:
    walled.camera = WallCamera(21)
    walled.network.record.input = "difference maps"
    run(*WALLED, "wall.toml")
    assert abs(np.nanmean(walled.network.given[20])) < 1e-3
    assert "--wall" in run(*SIMULATED, code=1)["error"]["message"]


def test_summary_has_a_sentence_per_fact_and_stages_if_verbose() -> None:
    latency_ms = {"p50": 9.0, "p95": 14.0, "p99": 21.0}
    stages = {"wait": TIMES, "delivery": TIMES, "network": TIMES}
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
        (
            "Warning: 33% of the frames dropped, median latency 9 ms: close other programs, or give"
            " --budget-ms"
        ),
        "Object detected in 7 of 10 frames, nothing there in 3",
        "Irregular: 1 blank",
        "Stalled for 1.2 s without a frame",
        "Warning in 4 frames: the lidar has drifted",
    ]
    stages_lines = [line.split() for line in summary(plain, verbose=True).splitlines()[3:]]
    assert stages_lines == [[name, "1.0", "3.1"] for name in ("delivery", "network", "wait")]


def test_view_serves_saved_view_until_interrupted_or_its_seconds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fetched: list[bytes] = []

    def fetch_and_interrupt(text: str) -> None:
        with closing(ask(re.search(r"http://\S+", text)[0], "/")) as answer:  # type: ignore[index]
            fetched.append(answer.read())
        os.kill(os.getpid(), signal.SIGINT)

    with SessionFile(saved := tmp_path / "view.html", RIG) as view:
        view.show(full_moment(0))
    assert main(["view", str(saved), "--seconds", "0.1"]) == 0
    monkeypatch.setattr("nlos_cam.cli.view.say", fetch_and_interrupt)
    assert main(["view", str(saved)]) == 130
    assert fetched == [saved.read_bytes()]


@pytest.fixture
def printed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    lines: list[str] = []
    monkeypatch.setattr("nlos_cam.cli.view.say", lambda text, **_: lines.append(text))
    return lines


def serve(
    *,
    no_view: bool = False,
    host: str | None = None,
    port: int | None = None,
    open_it: bool = False,
) -> None:
    """Serve a view with these options, print where, and end it."""
    with viewer_of(RunControl(), no_view=no_view, host=host, port=port) as viewer:
        announce_view(viewer, host=host, port=port, open_it=open_it)


def test_view_on_all_addresses_notes_who_can_see_it_and_no_view_serves_nothing(
    printed: list[str],
) -> None:
    serve(host=EVERYWHERE)
    serve(no_view=True, open_it=True)
    line, note, without = printed
    assert "http://127.0.0.1:" in line
    assert "anyone" in note
    assert "http" not in without
    assert isinstance(viewer_of(RunControl(), no_view=True), NullViewer)
    for place in ({"host": "127.0.0.1"}, {"port": 9090}):
        with pytest.raises(typer.BadParameter, match="--no-view"):
            viewer_of(RunControl(), no_view=True, **place)


def test_view_moves_from_a_taken_port_unless_asked_for(
    printed: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        for module in ("nlos_cam.view", "nlos_cam.view.web"):
            monkeypatch.setattr(f"{module}.PREFERRED_PORT", port)
        serve()
        [line] = printed
        assert f"{port} is taken" in line
        assert f"127.0.0.1:{port}/" not in line
        with pytest.raises(NlosCamError, match="--view-port"):
            serve(port=port)


@pytest.mark.parametrize("opens", [True, False])
def test_view_opens_a_browser_or_notes_that_it_cannot(
    printed: list[str], monkeypatch: pytest.MonkeyPatch, opens: bool
) -> None:
    asked: list[str] = []
    monkeypatch.setattr(
        "nlos_cam.cli.view.opened_in_browser", lambda address: asked.append(address) or opens
    )
    serve(open_it=True)
    assert asked[0].startswith("http://127.0.0.1:")
    assert ["browser" in line for line in printed[1:]] == [True] * (not opens)


def test_opened_in_browser_only_with_a_desktop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.cli.view.sys", SimpleNamespace(platform="linux"))
    for desktop, answer, opened in (
        ({}, {"return_value": True}, False),
        ({"DISPLAY": ":0"}, {"return_value": True}, True),
        ({"DISPLAY": ":0"}, {"return_value": False}, False),
        ({"BROWSER": "lynx"}, {"side_effect": webbrowser.Error("no runnable browser")}, False),
    ):
        monkeypatch.setattr("nlos_cam.cli.view.os.environ", desktop)
        monkeypatch.setattr("nlos_cam.cli.view.webbrowser.open", Mock(**answer))
        assert opened_in_browser("http://127.0.0.1:9090/") == opened
