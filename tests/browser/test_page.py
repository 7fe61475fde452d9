"""The view's page in a headless Chromium, with made-up moments."""

import os
import socket
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import pytest
from browser_page import DEADLINE_S, Page
from made_up_moments import RIG, full_moment, with_result
from measured_walls import exact_wall
from screenshots import UNDER_TEXT
from view_streams import ask

from nlos_cam.reconstruct import Verdict
from nlos_cam.view import PlaybackViewer, RecordedView, SessionFile, WebViewer
from nlos_cam.view.server import MAX_STREAMS

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.timeout(6 * DEADLINE_S)]

SIZES = (1280, 800), (390, 844)
LAYERS = {"depth", "truth", "error", "change", "residual", "lidar", "infrared"}
NAMES = {
    "relay wall",
    "lidar",
    "occluder",
    "object box",
    "hidden surface",
    "bounce 1",
    "bounce 2",
    "bounce 3",
}


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("calibrated", [False, True])
def test_page_shows_every_layer_name_and_new_moment(
    browser: Any, calibrated: bool, size: tuple[int, int]
) -> None:
    with WebViewer(RIG, exact_wall() if calibrated else None) as viewer:
        for first in (0, 10):  # the page is opened again
            viewer.show(full_moment(first))
            page = Page(browser, viewer.address or "", size).drawn()
            assert set(page.state()["arrays"]) >= LAYERS
            assert set(page.state()["labels"]) == NAMES
            assert page.state()["quads"] > 100
            viewer.show(full_moment(first + 5, Verdict.OUTSIDE))
            page.wait_until(
                lambda page=page, number=first + 5: page.state()["frame"] == number,
                "the next moment",
            )
            assert page.state()["headline"] == "Outside the trained range"
            viewer.show(full_moment(first + 6, Verdict.NOTHING))
            page.wait_until(lambda page=page: page.state()["quads"] == 0, "an empty bench")
            assert page.page.evaluate("document.documentElement.scrollWidth") <= size[0], (
                "nothing is beside the page"
            )
            assert page.errors == []
            page.close()
        page = Page(browser, viewer.address or "").drawn()
        page.page.click("#tabs button:nth-child(3)")
        assert ("distance" in page.page.inner_text("#facts")) == calibrated


def test_page_says_ended_and_comes_back_with_the_next_run(browser: Any) -> None:
    with WebViewer(RIG) as viewer:
        port = urlsplit(viewer.address).port
        viewer.show(full_moment(0))
        page = Page(browser, viewer.address or "").drawn()
    page.wait_until(lambda: page.state()["headline"] == "The run has ended", "the end")
    with WebViewer(RIG, port=port) as viewer:
        viewer.show(full_moment(3))
        page.wait_until(lambda: page.state()["frame"] == 3, "the next run")
        assert page.state()["headline"] == "Object seen"
        page.close()


def test_page_takes_the_token_of_the_next_run(browser: Any) -> None:
    controls: Any = SimpleNamespace(
        status=lambda: {"state": "running"}, run=lambda *_: "done", file=lambda _: None
    )
    with WebViewer(RIG, controls=controls) as viewer:
        port = urlsplit(viewer.address).port
        viewer.show(full_moment(0))
        page = Page(browser, viewer.address or "").drawn()
    with WebViewer(RIG, port=port, controls=controls) as viewer:
        viewer.show(full_moment(3))
        page.wait_until(lambda: page.state()["frame"] == 3, "the next run")
        page.page.evaluate("command('pause')")
        page.wait_until(lambda: page.page.evaluate("token") == "", "the token is forgotten")
        token = urlsplit(viewer.address).fragment
        with page.page.expect_event("load"):
            page.page.evaluate(f"void (location.hash = '{token}')")
        page.wait_until(lambda: page.state()["frame"] == 3, "the page is loaded again")
        assert page.page.evaluate("token") == token
        page.close()


def test_page_keeps_the_moments_of_a_new_reference(browser: Any) -> None:
    with WebViewer(RIG) as viewer:
        viewer.show(full_moment(0))
        page = Page(browser, viewer.address or "").drawn()
        viewer.show(full_moment(300))
        page.wait_until(lambda: page.state()["time_s"] == 10, "time passes")
        viewer.begin(RIG)
        for number in (400, 403):
            viewer.show(full_moment(number))
            page.wait_until(lambda n=number: page.state()["frame"] == n, "a moment of the new one")
        assert page.page.evaluate("kept.moments.map((each) => each.frame)") == [400, 403]
        page.close()


def test_plot_without_values_is_empty(browser: Any) -> None:
    with WebViewer(RIG) as viewer:
        viewer.show(replace(full_moment(0), celsius={}))
        page = Page(browser, viewer.address or "")
        page.page.evaluate(
            "window.texts = []; const write = CanvasRenderingContext2D.prototype.fillText;"
            " CanvasRenderingContext2D.prototype.fillText = function (text, ...at) {"
            " texts.push(text); return write.call(this, text, ...at); }; undefined"
        )
        page.drawn().page.click("#tabs button[data-panel='plots']")
        page.wait_until(lambda: page.page.evaluate("texts.length") > 0, "the plots")
        assert "Infinity" not in page.page.evaluate("texts")
        assert page.errors == []
        page.close()


def test_five_pages_and_one_that_never_reads_share_a_view(browser: Any) -> None:
    with WebViewer(RIG) as viewer, socket.socket() as deaf:
        viewer.show(full_moment(0))
        place = urlsplit(viewer.address or "")
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.connect((place.hostname, place.port))
        deaf.sendall(b"GET /stream HTTP/1.0\r\nHost: localhost\r\n\r\n")
        pages = [Page(browser, viewer.address or "") for _ in range(5)]
        for page in pages:
            page.drawn()
        for number in range(1, 60):
            viewer.show(full_moment(number, size=(480, 640)))
            time.sleep(0.02)
        for page in pages:
            page.wait_until(lambda page=page: page.state()["frame"] == 59, "the newest moment")
            page.close()


def test_refused_page_retries_and_a_hidden_one_makes_room(browser: Any) -> None:
    with WebViewer(RIG) as viewer:
        viewer.show(full_moment(0))
        watchers = [ask(viewer.address or "", "/stream") for _ in range(MAX_STREAMS)]
        page = Page(browser, viewer.address or "")
        page.wait_until(lambda: "watch already" in page.state().get("note", ""), "the refusal")
        watchers.pop().close()
        for number in range(1, 20):  # a stream notices with the next messages that its browser left
            viewer.show(full_moment(number, size=(480, 640)))
            time.sleep(0.1)
        page.drawn()
        for watcher in watchers:
            watcher.close()
        page.page.evaluate(
            "Object.defineProperty(document, 'hidden', { get: () => window.away, configurable: true"
            " });window.away = true; document.dispatchEvent(new Event('visibilitychange'))"
        )
        page.wait_until(
            lambda: "out of sight" in page.state()["status"].get("message", ""),
            "it leaves its stream",
        )
        viewer.show(full_moment(30))
        page.page.evaluate(
            "window.away = false; document.dispatchEvent(new Event('visibilitychange'))"
        )
        page.wait_until(lambda: page.state()["frame"] == 30, "it goes on when it is looked at")
        assert page.page.evaluate("kept.moments.length") > 1, "it keeps what it saw before"
        assert page.errors == []
        page.close()


def test_saved_session_plays_from_the_file_alone(browser: Any, tmp_path: Path) -> None:
    with SessionFile(tmp_path / "view.html", RIG, keeps_all=True) as session:
        for number in range(60):
            session.show(replace(full_moment(number), time_s=0.5 * number))
    page = Page(browser, (tmp_path / "view.html").as_uri()).drawn()
    play_through(page)
    assert page.hosts <= {None, ""}
    with page.page.expect_download() as download:
        page.page.click("#save")
    saved = Path(download.value.path()).read_text().splitlines()
    assert saved[0] == "row,column,depth_m,expected_error_m"
    assert len(saved) > 100
    page.close()


def test_served_session_knows_nothing_of_live_runs_there(browser: Any, tmp_path: Path) -> None:
    with SessionFile(tmp_path / "view.html", RIG, keeps_all=True) as session:
        for number in range(60):
            session.show(replace(full_moment(number), time_s=0.5 * number))
    with RecordedView(tmp_path / "view.html") as view:
        page = Page(browser, view.address or "").drawn()
        play_through(page)
        with page.page.expect_download():
            page.page.click("#save")
        for asked in ("localStorage.length", "document.cookie", "fetch('stream')"):
            refused = f"(async () => {{ try {{ await {asked}; return ''; }} catch (e) {{ return `${{e}}`; }} }})()"
            assert page.page.evaluate(refused), asked
        assert page.errors == []
        page.close()


def test_playback_plays_scrubs_and_changes_speed(browser: Any) -> None:
    with PlaybackViewer(RIG) as viewer:
        for number in range(60):
            viewer.show(replace(full_moment(number), time_s=0.5 * number))
        viewer.finish()
        page = Page(browser, viewer.address or "").drawn()
        page.wait_until(lambda: page.state()["end"] == pytest.approx(29.5), "the whole recording")
        play_through(page)
        for width, height in SIZES:
            page.page.set_viewport_size({"width": width, "height": height})
            assert page.page.evaluate(UNDER_TEXT) == []
        page.close()


def play_through(page: Page) -> None:
    """Scrub to the middle, play at eight times the speed to the end, and pause."""
    page.page.evaluate(
        "(t => { t.value = 15; t.dispatchEvent(new Event('input'));"
        " })(document.querySelector('#time'))"
    )
    page.wait_until(lambda: page.state()["frame"] == 30, "the frame at 15 s")
    page.page.select_option("#speed", "8")
    page.page.click("#play")
    page.wait_until(lambda: page.state()["at"] > 20, "it plays")
    page.wait_until(lambda: page.state()["frame"] == 59, "the last frame")
    if page.state()["playing"]:
        page.page.click("#play")
    assert not page.state()["playing"]


def resources() -> tuple[int, int, float]:
    """Return this process's OS threads, file descriptors, and resident memory in MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    threads, descriptors = (
        len(list(Path(f"/proc/self/{kind}").iterdir())) for kind in ("task", "fd")
    )
    return threads, descriptors, pages * os.sysconf("SC_PAGESIZE") / 2**20


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs /proc")
def test_watchers_that_come_and_go_leave_nothing_behind() -> None:
    with WebViewer(RIG) as viewer:
        viewer.show(full_moment(0, size=(480, 640)))

        def watch(number: int) -> None:
            with closing(ask(viewer.address or "", "/stream")) as answer:
                viewer.show(full_moment(number, size=(480, 640)))
                answer.read(50_000)

        for number in range(5):
            watch(number)
        threads, descriptors, memory_mib = settled()
        for number in range(30):
            watch(number)
        after = settled()
        assert after[0] <= threads
        assert after[1] <= descriptors
        assert after[2] < memory_mib + 8


def settled() -> tuple[int, int, float]:
    """Return the resources once no connection's thread is left, or after some time."""
    deadline_s = time.monotonic() + DEADLINE_S
    before = resources()
    while time.monotonic() < deadline_s:
        time.sleep(1.0)
        if (now := resources())[:2] == before[:2]:
            return now
        before = now
    return before


@pytest.mark.parametrize("size", [(1280, 720), (1366, 657), (1920, 1080), (390, 844)])
def test_no_text_lies_over_a_picture_however_many_warnings(
    browser: Any, size: tuple[int, int]
) -> None:
    with WebViewer(RIG) as viewer:
        viewer.show(with_result(full_moment(0), warnings=("a long warning about the bench",) * 12))
        page = Page(browser, viewer.address or "", size).drawn()
        assert page.page.evaluate(UNDER_TEXT) == []


@pytest.mark.parametrize("width", [390, 821, 900, 1180])
def test_no_caption_of_a_picture_is_cut(browser: Any, width: int) -> None:
    with WebViewer(RIG) as viewer:
        viewer.show(full_moment(0))
        page = Page(browser, viewer.address or "", (width, 800)).drawn()
        cut = page.page.evaluate(
            "[...document.querySelectorAll('figcaption, figure small')]"
            ".filter((each) => each.offsetParent && each.scrollWidth > each.clientWidth)"
            ".map((each) => each.textContent)"
        )
        assert cut == []
        page.close()


def test_legend_tells_the_lines_of_a_plot_apart_by_dashes(browser: Any) -> None:
    with WebViewer(RIG) as viewer:
        viewer.show(full_moment(0))
        page = Page(browser, viewer.address or "").drawn()
        page.page.click("#tabs button[data-panel='plots']")
        page.wait_until(lambda: page.page.query_selector("#plots .legend svg") is not None, "plots")
        dashes = page.page.evaluate(
            "[...document.querySelector('#plots .legend').querySelectorAll('path')]"
            ".map((each) => each.getAttribute('stroke-dasharray'))"
        )
        assert len(set(dashes)) == len(dashes) > 1
        page.close()


def test_color_bar_keeps_its_labels_apart_in_narrow_windows(browser: Any) -> None:
    with WebViewer(RIG) as viewer:
        viewer.show(full_moment(0))
        page = Page(browser, viewer.address or "").drawn()
        page.page.set_viewport_size({"width": 390, "height": 844})
        places = "[...document.querySelectorAll('#bar span')].map((each) => each.offsetLeft)"
        page.wait_until(lambda: len(set(page.page.evaluate(places))) == 5, "labels side by side")


def test_point_has_values_and_marks_in_every_map_and_a_distance(browser: Any) -> None:
    with WebViewer(RIG) as viewer:
        viewer.show(full_moment(0))
        page = Page(browser, viewer.address or "").drawn()
        box = page.page.query_selector("#found div").bounding_box()
        middle_px = box["y"] + 0.51 * box["height"]
        page.page.mouse.move(box["x"] + 0.32 * box["width"], middle_px)
        for part in ("depth 2", "truth", "wall x", "pixel row 32, column 20"):
            assert part in page.state()["readout"]
        assert (page.state()["marks"], page.state()["benchMarks"]) == (5, 1)

        page.page.keyboard.press("m")
        for share in (0.25, 0.4):
            page.page.mouse.click(box["x"] + share * box["width"], middle_px)
        assert "distance" in page.state()["readout"]
        page.page.keyboard.press("Escape")
        page.page.mouse.click(box["x"] + 0.3 * box["width"], middle_px)
        assert page.page.query_selector("#found.large") is not None
        assert page.errors == []


def test_ended_run_can_be_played_and_saved_and_nothing_else(browser: Any, tmp_path: Path) -> None:
    with WebViewer(RIG) as viewer:
        page = Page(browser, viewer.address or "")
        for number in range(12):
            viewer.show(with_result(full_moment(number), warnings=("hot",)))
            time.sleep(0.15)
        page.drawn()
        viewer.show(full_moment(20))
        page.wait_until(lambda: page.state()["frame"] == 20, "the last moment")
    page.wait_until(lambda: page.state()["headline"] == "The run has ended", "the end")
    assert page.page.inner_text("#warnings") == ""
    with page.page.expect_download() as download:
        page.page.click("#save-last")
    download.value.save_as(tmp_path / "session.html")
    page.page.click("#play-last")
    page.wait_until(lambda: page.state()["frame"] < 20, "it plays")
    page.close()
    saved = Page(browser, (tmp_path / "session.html").as_uri()).drawn()
    assert saved.errors == []


def test_page_of_a_killed_program_plays_what_it_saw(
    browser: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nlos_cam.view.web.ENDED", b"")
    with WebViewer(RIG) as viewer:
        viewer.show(full_moment(0))
        page = Page(browser, viewer.address or "").drawn()
        viewer.show(full_moment(20))
        page.wait_until(lambda: page.state()["frame"] == 20, "the last moment")
    page.wait_until(lambda: page.state()["headline"] == "No connection", "the loss")
    page.page.click("#play-last")
    page.wait_until(lambda: page.state()["frame"] < 20, "it plays")
    page.close()


def test_key_on_another_tab_shows_the_answer(browser: Any) -> None:
    control = {"commands": ["record", "pause"], "options": [], "average": 1}
    controls: Any = SimpleNamespace(
        status=lambda: {"state": "running", "control": control},
        run=lambda *_: "wrote snapshot.npz",
        file=lambda _: None,
    )
    with WebViewer(RIG, controls=controls) as viewer:
        viewer.show(full_moment(0))
        page = Page(browser, viewer.address or "").drawn()
        page.wait_until(lambda: page.page.query_selector("#snapshot") is not None, "the controls")
        page.page.click("#tabs button[data-panel='plots']")
        page.answer(lambda: page.page.keyboard.press("s"))
        assert page.page.is_visible("#answer")
        page.close()


def test_warning_is_spoken_once_however_its_numbers_change(browser: Any) -> None:
    with WebViewer(RIG) as viewer:
        viewer.show(with_result(full_moment(0), warnings=("moved by 19.95 mm",)))
        page = Page(browser, viewer.address or "").drawn()
        spoken = "Object seen. moved by 19.95 mm"
        page.wait_until(lambda: page.page.inner_text("#spoken") == spoken, "the warning")
        viewer.show(with_result(full_moment(5), warnings=("moved by 20.1 mm",)))
        page.wait_until(lambda: "20.1" in page.page.inner_text("#warnings"), "the next moment")
        page.page.wait_for_timeout(600)
        assert page.page.inner_text("#spoken") == spoken
        page.close()


def test_page_without_truth_shows_the_errors_in_its_place(browser: Any) -> None:
    with WebViewer(RIG) as viewer:
        real = full_moment(0)
        frame = replace(real.result.frame, truth_depth_m=None)
        viewer.show(with_result(real, frame=frame))
        page = Page(browser, viewer.address or "").drawn()
        assert page.page.inner_text("#truth figcaption").startswith("Uncertainty")
        assert not page.page.is_visible("#errors")
        page.close()
