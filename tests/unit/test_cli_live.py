import json
import os
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import numpy as np
import pytest
from fake_doubter import FakeDoubter
from fake_wall import RIG, SERIAL, SMALL, write_wall

from nlos_cam.cli import live as commands
from nlos_cam.cli.main import main
from nlos_cam.frames import Frame
from nlos_cam.reconstruct.verdict import Verdict
from nlos_cam.view import web


def record_of(eats: str) -> SimpleNamespace:
    return SimpleNamespace(rig_name=RIG.name, rig_checksum=RIG.checksum, input=eats)


class FakeNetwork:
    runtime, record = "nothing at all", record_of("raw maps")

    def __call__(self, *_: np.ndarray) -> np.ndarray:
        return np.full((1, 64, 64), 0.5, np.float32)


class FakeCamera:
    intrinsics, rig, identity, incomplete, dropped = SMALL, None, {"serial": SERIAL}, 0, 0

    def __init__(self, uri: str, on_frame: Callable[[int], None]) -> None:
        self.uri, self._on_frame = uri, on_frame
        self.counts: Counter[str] = Counter()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def telemetry(self, _: str = "") -> Mapping[str, float]:
        return {}

    def __iter__(self) -> Iterator[Frame]:
        depth_m, ir = np.full((64, 80), 0.3, np.float32), np.full((64, 80), 9, np.uint8)
        for number in range(20):
            self._on_frame(number)
            yield Frame(depth_m, ir, ir, number / 1000, number, SMALL)


class Opened:
    """Notes how cameras were opened; `on_frame` runs before each frame."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, dict[str, Any]]] = []
        self.on_frame: Callable[[int], None] = lambda _: None
        self.on_open: Callable[[], None] = lambda: None

    def __call__(self, uri: str, **options: Any) -> FakeCamera:
        self.calls.append((uri, options))
        self.on_open()
        return FakeCamera(uri, self.on_frame)


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Opened]:
    opened = Opened()
    monkeypatch.setattr(commands, "open_camera", opened)
    monkeypatch.setattr(commands, "load_networks", lambda *_: FakeNetwork())
    monkeypatch.setattr(commands, "load_doubt", lambda *_: FakeDoubter())
    monkeypatch.chdir(tmp_path)
    before = signal.getsignal(signal.SIGINT)
    yield opened
    assert signal.getsignal(signal.SIGINT) == before


def told(capsys: pytest.CaptureFixture[str]) -> tuple[dict[str, Any], str]:
    """The JSON object that ends stdout, and stderr."""
    captured = capsys.readouterr()
    return json.loads(captured.out.splitlines()[-1]), captured.err


def interrupt_at(number: int) -> Callable[[int], None]:
    """Ctrl-C once frame `number` is wanted."""
    answered = threading.Event()

    def on_frame(wanted: int) -> None:
        if wanted == number:
            os.kill(os.getpid(), signal.SIGINT)
            answered.wait(0.5)  # until the loop has ended: a live camera gives no frame meanwhile

    return on_frame


@pytest.mark.usefixtures("opened")
def test_live_ends_with_one_object_that_scripts_depend_on(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["live", "--camera", "bag:fake", "--no-view", "--json"]) == 0
    report, _ = told(capsys)
    fields = ("frames", "fps", "dropped", "latency_ms", "stages_ms", "counts", "warnings")
    assert set(report) == {*fields, "stages_percentiles_ms", "verdicts", "stalled_s"}
    assert (report["frames"], report["dropped"]) == (20, 0)
    assert report["verdicts"] == {Verdict.SEEN.value: 20}
    assert set(report["latency_ms"]) == {"p50", "p95", "p99"}
    assert set(report["stages_ms"]) == {"delivery", "wait", "queue", "maps", "bench", "network", "doubt", "view"}


@pytest.mark.usefixtures("opened")
def test_live_tells_a_person_in_words(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["live", "--camera", "bag:fake", "--no-view"]) == 0
    assert "20 frames" in capsys.readouterr().out


def test_a_live_camera_is_not_waited_for(opened: Opened, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["live", "--camera", "sim", "--no-view", "--json"]) == 0
    report, _ = told(capsys)
    assert report["frames"] + report["dropped"] == 20
    assert [uri for uri, _ in opened.calls] == ["sim"]


def test_ctrl_c_keeps_the_report_and_says_130(opened: Opened, capsys: pytest.CaptureFixture[str]) -> None:
    opened.on_frame = interrupt_at(10)
    assert main(["live", "--camera", "bag:fake", "--no-view", "--json"]) == 130
    assert told(capsys)[0]["frames"] <= 10


def test_seconds_end_a_run(opened: Opened, capsys: pytest.CaptureFixture[str]) -> None:
    opened.on_frame = lambda number: threading.Event().wait(0.05 if number else 0.0)  # type: ignore[assignment]
    assert main(["live", "--camera", "sim", "--no-view", "--seconds", "0.2", "--json"]) == 0
    assert told(capsys)[0]["frames"] < 20


@pytest.mark.usefixtures("opened")
def test_the_address_of_the_view_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(web, "page_assets", dict)
    assert main(["live", "--camera", "bag:fake", "--json"]) == 0
    assert "http://127.0.0.1:" in told(capsys)[1]


def test_record_hands_a_recording_to_the_camera_and_replaces_nothing_unasked(
    opened: Opened,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    bag = tmp_path / "run.bag"
    arguments = ["live", "--camera", "sim", "--no-view", "--record", str(bag), "--json"]
    assert main(arguments) == 0
    assert opened.calls[-1][1]["recording"].path == bag
    bag.write_text("mine")
    assert main(arguments) == 1
    assert told(capsys)[0]["error"]["type"] == "OutputExistsError"
    assert main([*arguments, "--overwrite"]) == 0


@pytest.mark.usefixtures("opened")
def test_a_wall_other_than_the_networks_is_used_and_noted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_wall(tmp_path / "wall.toml")
    run = ["replay", "run.bag", "--out", "out", "--json"]
    assert main([*run, "--wall", "wall.toml"]) == 0
    assert "unlike the rig of the networks, this one has" in told(capsys)[1].replace("\n", " ")
    with np.load(tmp_path / "out" / "reconstruction.npz") as file:
        assert str(file["rig_name"]) == "measured"
    assert main([*run, "--wall", "none.toml", "--overwrite"]) == 4
    assert told(capsys)[0]["error"]["type"] == "RecordFileError"


def test_replay_writes_its_folder_and_one_object(opened: Opened, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", "run.bag", "--out", "out", "--json"]) == 0
    report, progress = told(capsys)
    assert set(report) == {"frames", "seconds", "out", "warnings", "verdicts"}
    assert (report["frames"], report["out"]) == (20, "out")
    assert "another" not in progress
    assert opened.calls == [("bag:run.bag", {"reader": "plain"})]
    assert main(["replay", "run.bag", "--out", "out"]) == 1
    assert main(["replay", "run.bag", "--out", "out", "--overwrite"]) == 0


def test_an_interrupted_replay_keeps_its_results(opened: Opened, capsys: pytest.CaptureFixture[str]) -> None:
    opened.on_frame = interrupt_at(10)
    assert main(["replay", "run.bag", "--out", "out", "--json"]) == 130
    report, _ = told(capsys)
    with np.load("out/reconstruction.npz") as file:
        assert len(file["depth_m"]) == report["frames"] <= 10


def test_replay_reads_as_asked(opened: Opened) -> None:
    assert main(["replay", "run.bag", "--out", "out", "--reader", "sdk"]) == 0
    assert opened.calls == [("bag:run.bag", {"reader": "sdk"})]
    assert main(["replay", "run.bag", "--reader", "quick"]) == 2


@pytest.mark.usefixtures("opened")
@pytest.mark.parametrize("option", ["--record", "--log"])
def test_a_recording_or_log_by_another_name_is_refused(option: str) -> None:
    assert main(["live", "--camera", "sim", "--no-view", option, "run.txt"]) == 2


@pytest.mark.usefixtures("opened")
def test_a_log_has_a_line_for_each_frame_and_replaces_nothing_unasked(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["live", "--camera", "bag:fake", "--no-view", "--log", "log.csv", "--json"]
    assert main(arguments) == 0
    frames = told(capsys)[0]["frames"]
    header, *lines = Path("log.csv").read_text(encoding="utf-8").splitlines()
    assert [int(line.split(",")[0]) for line in lines] == list(range(frames))
    assert {"latency_ms", "delivery_ms", "queue_ms", "network_ms", "dropped", "verdict"} <= set(header.split(","))
    assert main(arguments) == 1


@pytest.mark.parametrize("command", [("live", "--no-view", "--camera", "sim"), ("replay", "a.bag")])
def test_ctrl_c_while_a_camera_opens_begins_no_run(
    opened: Opened, capsys: pytest.CaptureFixture[str], command: tuple[str, ...]
) -> None:
    def swallow() -> None:
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)

    opened.on_open = swallow
    assert main([*command, "--json"]) == 130
    assert capsys.readouterr().out == ""


def test_a_budget_is_told_kept_or_not_and_chooses_the_mean_itself(
    opened: Opened, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(commands, "loader", lambda _: lambda _: FakeNetwork())
    arguments = ["live", "--camera", "bag:fake", "--no-view", "--json", "--budget-ms", "100000"]
    assert main(arguments) == 0
    report, said = told(capsys)
    assert report["budget"]["kept"] and "budget 100000 ms: " in said  # noqa: PT018  one law
    assert main([*arguments, "--average", "4"]) == 2
    assert len(opened.calls) == 1
