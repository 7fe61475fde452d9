import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from threading import Event
from typing import Any

import pytest
from made_up_moments import RIG, full_moment, moment
from measured_walls import exact_wall
from view_streams import ask

from nlos_cam.errors import RecordingError
from nlos_cam.view.drawing import Drawing
from nlos_cam.view.rrd_file import RrdFile
from nlos_cam.view.viewer import Moment
from nlos_cam.view.web import RecordedView, WebViewer, whole_bytes


@pytest.fixture(autouse=True)
def no_assets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.view.web.page_assets", dict)


@pytest.fixture
def viewer() -> Iterator[WebViewer]:
    with WebViewer(RIG) as viewer:
        yield viewer
    with pytest.raises(ConnectionRefusedError):
        ask(viewer.address or "", "/")


def receive_until(viewer: WebViewer, *texts: bytes) -> None:
    """Read the stream as a browser until it holds these; the test's own time limit ends a wait in vain."""
    with closing(ask(viewer.address or "", "/live.rrd")) as answer:
        received = b""
        while not all(text in received for text in texts):
            chunk = answer.read1()
            assert chunk, "the stream ended"
            received += chunk
        assert received.startswith(b"RRF2")


def test_browser_receives_moments_shown_while_it_watches(viewer: WebViewer) -> None:
    viewer.show(moment(0))
    with closing(ask(viewer.address or "", "/live.rrd")) as answer:
        assert answer.read(4) == b"RRF2"
        for number in range(1, 4):
            viewer.show(moment(number))
            assert answer.read(2000)


def test_browsers_that_open_the_page_again_receive_everything(viewer: WebViewer) -> None:
    viewer.show(full_moment(0))
    for _ in range(3):
        receive_until(viewer, b"bench/wall", b"uncertainty")


def test_closing_viewer_ends_streams_that_are_still_read() -> None:
    with WebViewer(RIG) as viewer:
        answer = ask(viewer.address or "", "/live.rrd")
        viewer.show(moment(0))
        assert answer.read(4) == b"RRF2"
    answer.read()
    answer.close()


def test_showing_starts_no_thread_without_browser(viewer: WebViewer) -> None:
    for number in range(1000):
        viewer.show(moment(number))
    assert threading.active_count() <= 3


def test_each_browser_receives_a_measured_wall() -> None:
    with WebViewer(RIG, exact_wall()) as viewer:
        viewer.show(moment(0))
        for _ in range(2):
            receive_until(viewer, b"bench/measured/footprint")


class Starved:
    """Browser that takes what it is sent only when allowed."""

    def __init__(self) -> None:
        self.asked, self.let, self.taken = Event(), Event(), []

    def __call__(self, content: bytes) -> None:
        self.asked.set()
        if not self.let.wait(60.0):
            raise TimeoutError
        self.taken.append(content)


def test_nothing_is_drawn_for_a_browser_that_takes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn, drew_again, draw, browser = [], Event(), Drawing.draw, Starved()

    def noted(self: Drawing, each: Moment, **options: bool) -> None:
        drawn.append(each.frame.frame_number)
        draw(self, each, **options)
        if len(drawn) == 2:
            drew_again.set()

    monkeypatch.setattr(Drawing, "draw", noted)
    with WebViewer(RIG) as viewer:
        thread = threading.Thread(target=viewer._stream, args=(browser,))
        thread.start()
        viewer.show(full_moment(0))
        assert browser.asked.wait(60.0)
        for number in range(1, 500):
            viewer.show(moment(number))
        assert drawn == [0]
        browser.let.set()
        viewer.show(moment(500))
        assert drew_again.wait(60.0)
    thread.join(60.0)
    assert drawn[1] >= 499, "it receives the newest moment, and not those that it missed"
    assert len(browser.taken) == len(drawn)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    with RrdFile(tmp_path / "view.rrd", RIG, keeps_all=True) as view:
        for number in range(0, 30, 3):
            view.show(full_moment(number))
    return tmp_path / "view.rrd"


def test_each_browser_receives_the_whole_saved_file(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def assets(*, recorded: bool) -> dict[str, tuple[str, bytes]]:
        asked.append(recorded)
        return {"/": ("text/html", b"page")}

    monkeypatch.setattr("nlos_cam.view.web.page_assets", assets)
    with RecordedView(saved) as view:
        for _ in range(2):
            with closing(ask(view.address or "", "/live.rrd")) as answer:
                assert answer.read() == saved.read_bytes()
    assert asked == [True]


@pytest.mark.parametrize("share", [0.4, 0.55, 0.9])
def test_cut_saved_view_is_shown_as_far_as_it_is_whole(
    saved: Path, tmp_path: Path, share: float, chunks_of: Callable[[Path], list[Any]]
) -> None:
    content, cut = saved.read_bytes(), tmp_path / "cut.rrd"
    cut.write_bytes(content[: int(share * len(content))])
    with cut.open("rb") as file:
        whole = whole_bytes(file)
    assert 0 < whole < cut.stat().st_size
    cut.write_bytes(content[:whole])
    with pytest.warns(match="no footer"):
        assert 5 < len(chunks_of(cut)) <= len(chunks_of(saved))


def test_whole_bytes_of_whole_and_of_begun_files(saved: Path, tmp_path: Path) -> None:
    with saved.open("rb") as file:
        assert whole_bytes(file) == saved.stat().st_size
    (tmp_path / "begun.rrd").write_bytes(saved.read_bytes()[:20])
    with (tmp_path / "begun.rrd").open("rb") as file:
        assert whole_bytes(file) == 12


def test_recorded_view_refuses_other_files(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"none\.rrd"):
        RecordedView(tmp_path / "none.rrd")
    (tmp_path / "other.rrd").write_text("something else")
    with pytest.raises(RecordingError, match=r"other\.rrd.*--save-view"):
        RecordedView(tmp_path / "other.rrd")
