import errno
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

import made_benches
import numpy as np
import pytest
import typer
from fake_uncertainty import FakeUncertainty
from fake_wall import WallCamera, bare_wall, wall_frame, write_wall
from made_up_moments import RIG, Recorded, full_moment
from nlos_calibration import load_measured
from nlos_models import shipped_folder
from small_frames import FrameCamera, SheetNetwork, small_frame
from view_streams import EVERYWHERE, ask

from nlos_cam.bench import write_weights
from nlos_cam.cli.live import summary
from nlos_cam.cli.main import main
from nlos_cam.cli.view import announce_view, opened_in_browser, saving, viewer_of
from nlos_cam.errors import NlosCamError
from nlos_cam.frames import Frame, maps_from_frame
from nlos_cam.live import RunControl
from nlos_cam.live.statistics import RunReport
from nlos_cam.reconstruct import CalibratedRig, OwnMaps, open_bench
from nlos_cam.reconstruct.consistency import COMPLETE, MapConsistency
from nlos_cam.reconstruct.verdict import Verdict
from nlos_cam.recording import WallFile
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
        self.uncertainty_model = FakeUncertainty()

    def __call__(self, uri: str, **options: Any) -> FrameCamera | WallCamera:
        self.calls.append((uri, options))
        self.on_open()
        return self.camera or FrameCamera(self.count, self.on_frame, make=quick_frame, uri=uri)


def quick_frame(number: int) -> Frame:
    return replace(small_frame(number), timestamp_s=number / 1000)


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Iterator[Opened]:
    opened = Opened()
    monkeypatch.setattr("nlos_cam.camera.open_camera", opened)
    monkeypatch.setattr("nlos_cam.reconstruct.load_networks", lambda *_: opened.network)
    monkeypatch.setattr(
        "nlos_cam.reconstruct.load_uncertainty", lambda *_: opened.uncertainty_model
    )
    # Small frames are no maps of a bench, which is not the question here.
    monkeypatch.setattr(MapConsistency, "examine", lambda *_: COMPLETE)
    # Drawing takes a second.
    monkeypatch.setattr("nlos_cam.replay.replay.draw_contact_sheet", lambda path, *_: path.touch())
    before = signal.getsignal(signal.SIGINT)
    yield opened
    assert signal.getsignal(signal.SIGINT) == before


@pytest.fixture
def walled(opened: Opened, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Opened:
    """Camera on a measured wall, wall.toml, that is moved for a while."""
    # One thread gives the network its maps in order.
    monkeypatch.setattr("nlos_cam.reconstruct.streaming.os.cpu_count", lambda: 1)
    write_wall(tmp_path / "wall.toml", bare_wall())
    opened.camera = WallCamera(100, moved=range(30, 60))
    opened.uncertainty_model = None
    return opened


Run = Callable[..., Any]


REPORT_FIELDS = {
    "frames",
    "fps",
    "dropped",
    "latency_ms",
    "stages_ms",
    "counts",
    "warnings",
    "stages_percentiles_ms",
    "verdicts",
    "stalled_s",
    "quality",
    "camera_ms",
}
STAGES = {"delivery", "wait", "queue", "maps", "bench", "network", "doubt", "view"}
COLUMNS = {"latency_ms", "delivery_ms", "queue_ms", "network_ms", "dropped", "verdict"}


@pytest.mark.usefixtures("opened")
def test_live_json_has_its_fields(run: Run) -> None:
    report = run(*RECORDED)

    assert set(report) == REPORT_FIELDS
    assert set(report["latency_ms"]) == {"p50", "p95", "p99"}
    assert set(report["stages_ms"]) == STAGES


@pytest.mark.usefixtures("opened")
def test_live_on_a_recording_reports_every_frame(run: Run) -> None:
    report = run(*RECORDED)

    assert report["frames"] == 20
    assert report["dropped"] == 0
    assert report["verdicts"] == {Verdict.SEEN.value: 20}


@pytest.mark.usefixtures("opened")
def test_live_log_has_a_line_per_frame_and_stays(run: Run) -> None:
    arguments = [*RECORDED, "--log", "log.csv"]
    run(*arguments)
    header, *lines = Path("log.csv").read_text(encoding="utf-8").splitlines()

    assert [int(line.split(",")[0]) for line in lines] == list(range(20))
    assert set(header.split(",")) >= COLUMNS

    run(*arguments, code=1)


@pytest.mark.usefixtures("opened")
def test_live_prints_the_address_of_its_view(run: Run) -> None:
    assert "http://127.0.0.1:" in run("live", "--camera", "bag:fake").err


def test_live_ends_with_a_live_camera(opened: Opened, run: Run) -> None:
    report = run(*SIMULATED)

    assert report["frames"] + report["dropped"] == 20
    assert [uri for uri, _ in opened.calls] == ["sim"]


def test_live_ends_after_its_seconds(opened: Opened, run: Run) -> None:
    opened.on_frame = lambda number: threading.Event().wait(0.05 if number else 0.0)
    assert run(*SIMULATED, "--seconds", "0.2")["frames"] < 20


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
    names = {file.name for file in Path("out").iterdir()}

    assert {"view.html", "replay.webm", "still-000000.png"} < names


def test_live_record_overwrites_only_when_asked(opened: Opened, run: Run) -> None:
    arguments = [*SIMULATED, "--record", "run.bag"]
    run(*arguments)

    assert opened.calls[-1][1]["recording"].path == Path("run.bag")

    Path("run.bag").write_text("mine")

    assert run(*arguments, code=1)["error"]["type"] == "OutputExistsError"

    run(*arguments, "--overwrite")


@pytest.mark.usefixtures("opened")
def test_live_record_takes_no_sidecar_of_another_recording(run: Run) -> None:
    Path("run.json").write_text("of another recording")

    assert run(*SIMULATED, "--record", "run.bag", code=1)["error"]["type"] == "OutputExistsError"


@pytest.mark.usefixtures("opened")
def test_replay_on_a_wall_notes_that_the_rig_differs(run: Run) -> None:
    write_wall(Path("wall.toml"))

    assert "aligned with their rig" in run(*WALLED, "wall.toml").err

    with np.load("out/reconstruction.npz") as file:
        assert str(file["rig_name"]) == "measured"

    assert run(*WALLED, "none.toml", code=4)["error"]["type"] == "RecordFileError"


@pytest.mark.usefixtures("opened")
def test_replay_notes_the_wall_of_the_recording(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    wall = WallFile(path="my bench/wall.toml", sha256="a" * 64)
    monkeypatch.setattr("nlos_cam.recording.recorded_wall", lambda _: wall)
    write_wall(Path("wall.toml"))

    note = "run.bag was recorded on the wall of my bench/wall.toml"
    assert note in run(*REPLAY).err
    assert note not in run(*WALLED, "wall.toml").err


def test_replay_writes_its_folder_and_one_json_object(opened: Opened, run: Run) -> None:
    report = run(*REPLAY)

    fields = {"frames", "seconds", "out", "warnings", "verdicts", "quality", "weights"}
    assert set(report) == fields
    assert report["frames"] == 20
    assert report["out"] == "out"
    assert "aligned with their rig" not in report.err

    run(*REPLAY, code=1)
    run(*REPLAY, "--overwrite")

    assert opened.calls == [("bag:run.bag", {})] * 2


@pytest.mark.usefixtures("opened")
def test_replay_suggests_a_command_with_its_options(run: Run) -> None:
    write_wall(Path("wall.toml"))
    run(*WALLED, "wall.toml", "--average", "3")
    text = Path("out/report.md").read_text(encoding="utf-8")

    assert "run.bag --wall wall.toml --average 3 --stills 6 --video" in text


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


@pytest.mark.usefixtures("walled")
@pytest.mark.parametrize("command", [SIMULATED, REPLAY])
def test_begin_and_end_of_a_warning_print_once(
    run: Run, monkeypatch: pytest.MonkeyPatch, command: list[str]
) -> None:
    monkeypatch.setattr("nlos_cam.reconstruct.frame_reader.QUEUE_FRAMES", 1000)
    monkeypatch.setattr("nlos_cam.reconstruct.summaries.ENDS_AFTER_FRAMES", 5)
    report = run(*command, "--wall", "wall.toml")
    # besides the note on the occluder, which holds for every frame
    [(warning, frames)] = [
        (text, count) for text, count in report["warnings"].items() if "occluder" not in text
    ]

    assert 0 < frames < 100
    assert report.err.count("drifted") == 2
    assert report.err.count(warning) >= 1


def test_average_is_over_as_many_frames_as_asked(walled: Opened) -> None:
    walled.camera = WallCamera(26)
    walled.network.record.rig_checksum = "of a rig that is not here"  # maps are left as they are

    assert main([*WALLED, "wall.toml", "--average", "20"]) == 0

    each = [maps_from_frame(wall_frame(number)) for number in range(6, 26)]
    mean_m = np.mean([maps.depth_m for maps in each], axis=0).astype(np.float32)
    bench = open_bench(Path("wall.toml"), WallCamera(1))
    wanted = OwnMaps(bench).correct(replace(each[0], depth_m=mean_m))

    # but for the drift, which is measured to a few hundredths of a millimetre
    np.testing.assert_allclose(walled.network.given[25], wanted.depth_m, atol=1e-4)


def test_weights_of_difference_maps_need_a_wall(walled: Opened, run: Run) -> None:
    walled.camera = WallCamera(21)
    walled.network.record.input = "difference maps"
    run(*WALLED, "wall.toml")

    assert abs(np.nanmean(walled.network.given[20])) < 1e-3
    assert "--wall" in run(*SIMULATED, code=1)["error"]["message"]


STAGE_TIMES = {"wait": TIMES, "delivery": TIMES, "network": TIMES}
PLAIN = RunReport(
    frames=10,
    fps=29.97,
    dropped=0,
    latency_ms={"p50": 9.0, "p95": 14.0, "p99": 21.0},
    stages_ms={},
    counts={},
    stages_percentiles_ms=STAGE_TIMES,
)


def test_summary_of_a_smooth_run_has_two_lines() -> None:
    assert len(summary(PLAIN).splitlines()) == 2


def test_summary_has_a_sentence_per_fact() -> None:
    report = replace(
        PLAIN,
        dropped=5,
        counts={"dropped_loop": 3, "dropped_camera": 2, "blank": 1},
        verdicts={"object seen": 7, "nothing there": 3},
        warnings={"the lidar has drifted": 4},
        stalled_s=1.25,
    )
    assert summary(report).splitlines()[2:] == [
        "Dropped 5 frames: 2 at the camera, 3 because processing was too slow",
        "Warning: 33% of the frames dropped, median latency 9 ms: close other programs",
        "Object seen in 7 of 10 frames, nothing there in 3",
        "Irregular: 1 blank",
        "Stalled for 1.2 s without a frame",
        "Warning in 4 frames: the lidar has drifted",
    ]


def test_verbose_summary_has_the_latencys_stages_first() -> None:
    lines = summary(PLAIN, verbose=True).splitlines()[3:]
    names = ("delivery", "network", "wait")

    assert [line.split() for line in lines] == [[name, "1.0", "3.1"] for name in names]


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "view.html"
    with SessionFile(path, RIG) as view:
        view.show(full_moment(0))
    return path


def test_view_plays_the_recording_of_the_package(run: Run) -> None:
    assert run("view", "sample", "--seconds", "0.1")["file"] == "sample"


def test_view_of_a_saved_session_ends_after_its_seconds(saved: Path) -> None:
    assert main(["view", str(saved), "--seconds", "0.1"]) == 0


def test_view_serves_a_saved_session_until_interrupted(
    saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fetched: list[bytes] = []

    def fetch_and_interrupt(text: str) -> None:
        address = re.search(r"http://\S+", text)[0]  # type: ignore[index]
        with closing(ask(address, "/")) as answer:
            fetched.append(answer.read())
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("nlos_cam.cli.view.say", fetch_and_interrupt)

    assert main(["view", str(saved)]) == 130
    head, body = saved.read_bytes().split(b"<script", 1)
    (answer,) = fetched
    # the page's storage, which a sandbox refuses, is replaced before its scripts run
    assert answer.startswith(head)
    assert answer.endswith(b"<script" + body)


@pytest.fixture
def taken(opened: Opened, monkeypatch: pytest.MonkeyPatch) -> list[Path | None]:
    """Folders of weights that were loaded."""
    folders: list[Path | None] = []

    def load(folder: Path | None = None) -> Any:
        folders.append(folder)
        return opened.network

    monkeypatch.setattr("nlos_cam.reconstruct.load_networks", load)
    return folders


def test_view_of_a_recording_takes_the_weights_of_its_bench(
    tmp_path: Path, opened: Opened, taken: list[Path | None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nlos_cam.calibrate.files.report_html", lambda *_: "report")
    opened.camera = WallCamera(3)
    write_wall(tmp_path / "wall.toml", bare_wall())
    bench = tmp_path / "bench"
    made_benches.write_wall(bench, load_measured(tmp_path / "wall.toml"))
    own = write_weights(bench, shipped_folder())
    words = ["view", "run.bag", "--seconds", "0.1"]

    assert main([*words, "--bench", str(bench)]) == 0
    assert main([*words, "--bench", str(bench), "--weights", str(shipped_folder("wide"))]) == 0
    assert taken == [own, shipped_folder("wide")]


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


def test_saved_view_that_fails_is_a_note_not_the_runs_end(
    tmp_path: Path, printed: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    error = OSError(errno.ENOSPC, "No space left")
    monkeypatch.setattr("nlos_cam.view.session_file.element", Mock(side_effect=error))
    with saving(NullViewer(), CalibratedRig(RIG), tmp_path / "view.html") as viewers:
        viewers.show(full_moment(0))
    [line] = printed

    assert "view.html ended early (No space left)" in line


def test_view_on_all_addresses_notes_who_can_see_it(printed: list[str]) -> None:
    serve(host=EVERYWHERE)
    line, note = printed

    assert "http://127.0.0.1:" in line
    assert "anyone" in note


def test_run_without_view_serves_nothing(printed: list[str]) -> None:
    serve(no_view=True, open_it=True)
    [line] = printed

    assert "http" not in line
    assert isinstance(viewer_of(RunControl(), no_view=True), NullViewer)


@pytest.mark.parametrize("place", [{"host": "127.0.0.1"}, {"port": 9090}])
def test_place_of_a_view_contradicts_no_view(place: dict[str, Any]) -> None:
    with pytest.raises(typer.BadParameter, match="--no-view"):
        viewer_of(RunControl(), no_view=True, **place)


@pytest.fixture
def taken_port(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Usual port of the view, where another program listens."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        for module in ("nlos_cam.view", "nlos_cam.view.web"):
            monkeypatch.setattr(f"{module}.PREFERRED_PORT", port)
        yield port


def test_view_moves_from_a_taken_port(printed: list[str], taken_port: int) -> None:
    serve()
    [line] = printed

    assert f"{taken_port} is taken" in line
    assert f"127.0.0.1:{taken_port}/" not in line


def test_view_at_a_given_port_that_is_taken_is_an_error(taken_port: int) -> None:
    with pytest.raises(NlosCamError, match="--view-port"):
        serve(port=taken_port)


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


@pytest.mark.parametrize(
    ("desktop", "answer", "opened"),
    [
        ({}, {"return_value": True}, False),
        ({"DISPLAY": ":0"}, {"return_value": True}, True),
        ({"DISPLAY": ":0"}, {"return_value": False}, False),
        ({"BROWSER": "lynx"}, {"side_effect": webbrowser.Error("no runnable browser")}, False),
    ],
)
def test_browser_opens_only_with_a_desktop(
    monkeypatch: pytest.MonkeyPatch, desktop: dict[str, str], answer: dict[str, Any], opened: bool
) -> None:
    monkeypatch.setattr("nlos_cam.cli.view.sys", SimpleNamespace(platform="linux"))
    monkeypatch.setattr("nlos_cam.cli.view.os.environ", desktop)
    monkeypatch.setattr("nlos_cam.cli.view.webbrowser.open", Mock(**answer))

    assert opened_in_browser("http://127.0.0.1:9090/") == opened
