import threading
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from threading import Event
from typing import Any

import pytest
from made_up_moments import RIG, full_moment, moment
from measured_walls import exact_wall
from view_streams import ask, messages

from nlos_cam.errors import RecordingError
from nlos_cam.view import PlaybackViewer, RecordedView, SessionFile, WebViewer
from nlos_cam.view.messages import MomentPacker


@pytest.fixture
def viewer() -> Iterator[WebViewer]:
    with WebViewer(RIG) as viewer:
        yield viewer
    with pytest.raises(ConnectionRefusedError):
        ask(viewer.address or "", "/")


def frames(viewer: WebViewer | PlaybackViewer) -> Iterator[dict[str, Any]]:
    """Yield the messages that a browser receives."""
    with closing(ask(viewer.address or "", "/stream")) as answer:
        yield from messages(answer)


def test_browsers_receive_bench_status_and_the_newest_moment(viewer: WebViewer) -> None:
    viewer.show(full_moment(7))
    for _ in range(3):  # the page is opened again, while no new moment comes
        found = {}
        for each in frames(viewer):
            found[each["kind"]] = each
            if len(found) == 4:
                break
        assert set(found) == {"hello", "bench", "status", "moment"}
        assert found["moment"]["frame"] == 7
        assert found["bench"]["rig"] == RIG.name


def test_bench_is_sent_again_once_it_was_measured() -> None:
    with WebViewer() as viewer:
        received = frames(viewer)
        assert next(each for each in received if each["kind"] == "status")["state"] == "running"
        viewer.begin(RIG)
        assert "calibration" not in next(each for each in received if each["kind"] == "bench")
        viewer.begin(RIG, exact_wall())
        measured = next(each for each in received if each["kind"] == "bench")
        assert measured["calibration"][0][0] == "verdict"
        assert "wall_residual" in measured["arrays"]
        received.close()


def test_leaving_ends_streams_with_the_word_ended() -> None:
    with WebViewer(RIG) as viewer:
        received = frames(viewer)
        next(received)
    assert list(received)[-1]["state"] == "ended"


def test_nothing_is_packed_without_browser(viewer: WebViewer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MomentPacker, "pack", lambda *_, **__: pytest.fail("packed"))
    for number in range(1000):
        viewer.show(moment(number))
    assert threading.active_count() <= 4


class Starved:
    """Browser that takes what it is sent only when allowed."""

    def __init__(self) -> None:
        self.asked, self.let, self.taken = Event(), Event(), []

    def __call__(self, content: bytes) -> None:
        if b"moment" in content:
            self.asked.set()
            if not self.let.wait(60.0):
                raise TimeoutError
        self.taken.append(content)


def test_slow_browser_skips_to_the_newest_moment() -> None:
    browser = Starved()
    with WebViewer(RIG) as viewer:
        thread = threading.Thread(target=viewer._stream, args=(browser,))
        thread.start()
        viewer.show(full_moment(0))
        assert browser.asked.wait(60.0)
        for number in range(1, 500):
            viewer.show(moment(number))
        assert any(each.get("frame") == 499 for each in frames(viewer)), "another browser is not kept waiting"
        browser.let.set()
    thread.join(60.0)
    assert sum(b"moment" in content for content in browser.taken) < 10


class Scripted:
    """Controls that record what they were asked."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, Mapping[str, Any]]] = []

    def status(self) -> dict[str, Any]:
        return {"state": "stalled", "camera": "sim"}

    def run(self, command: str, arguments: Mapping[str, Any]) -> str:
        self.asked.append((command, arguments))
        return "done"


def test_page_controls_with_the_token_of_the_address() -> None:
    controls = Scripted()
    with WebViewer(RIG, controls=controls) as viewer:
        address, _, token = (viewer.address or "").partition("#")
        assert next(each for each in frames(viewer) if each["kind"] == "status")["state"] == "stalled"
        for sent, status in ((token, 200), ("", 403)):
            body = '{"command": "average", "frames": 4}'
            with closing(ask(address, "/command", method="POST", body=body, X_Token=sent)) as answer:
                assert answer.status == status
    assert controls.asked == [("average", {"frames": 4})]


def test_page_is_whole_and_names_no_other_address(viewer: WebViewer) -> None:
    with closing(ask(viewer.address or "", "/")) as answer:
        page = answer.read().decode()
    assert "class Bench" in page
    assert "class Pictures" in page
    assert "src=" not in page
    assert "http" not in page.replace("http-equiv", "")


def test_playback_keeps_every_moment_for_every_browser() -> None:
    with PlaybackViewer(RIG) as viewer:
        for number in range(70):
            viewer.show(full_moment(number))
        viewer.finish()
        for _ in range(2):
            times_s: list[float] = []
            for each in frames(viewer):
                times_s += each.get("times_s", [])
                if len(times_s) == 70:
                    break
            assert times_s == pytest.approx([number / 30 for number in range(70)], abs=1e-3)


def test_recorded_view_serves_the_file_as_its_page(tmp_path: Path) -> None:
    with SessionFile(tmp_path / "view.html", RIG, keeps_all=True) as session:
        session.show(full_moment(0))
    with RecordedView(tmp_path / "view.html") as view, closing(ask(view.address or "", "/")) as answer:
        assert answer.read() == (tmp_path / "view.html").read_bytes()


@pytest.mark.parametrize(
    ("content", "advice"), [(None, "cannot be read"), (b"something else", "--save-view"), (b"RRF2 old", "rerun")]
)
def test_recorded_view_refuses_other_files(tmp_path: Path, content: bytes | None, advice: str) -> None:
    if content is not None:
        (tmp_path / "other.rrd").write_bytes(content)
    with pytest.raises(RecordingError, match=rf"other\.rrd.*{advice}"):
        RecordedView(tmp_path / "other.rrd")
