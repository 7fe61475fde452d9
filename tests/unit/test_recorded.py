from collections.abc import Callable
from contextlib import closing
from http.client import HTTPConnection
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from made_up_moments import RIG, full_moment

from nlos_cam.errors import RecordingError
from nlos_cam.view import web
from nlos_cam.view.rrd_file import RrdFile
from nlos_cam.view.web import RecordedView, whole_bytes


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    with RrdFile(tmp_path / "view.rrd", RIG, keeps_all=True) as view:
        for number in range(0, 30, 3):
            view.show(full_moment(number))
    return tmp_path / "view.rrd"


def test_each_browser_gets_the_whole_file_and_its_end(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def assets(*, recorded: bool) -> dict[str, tuple[str, bytes]]:
        asked.append(web)
        return {"/": ("text/html", b"page")}

    monkeypatch.setattr(web, "page_assets", assets)
    with RecordedView(saved) as view:
        for _ in range(2):
            with closing(HTTPConnection(urlsplit(view.address or "").netloc, timeout=10.0)) as browser:
                browser.request("GET", "/live.rrd")
                with closing(browser.getresponse()) as answer:
                    assert answer.read() == saved.read_bytes()
    assert asked == [True]


@pytest.mark.parametrize("share", [0.4, 0.55, 0.9])
def test_of_a_file_that_a_kill_cut_all_that_is_whole_is_shown(
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


def test_a_whole_file_is_whole_and_one_that_has_hardly_begun_has_nothing(saved: Path, tmp_path: Path) -> None:
    with saved.open("rb") as file:
        assert whole_bytes(file) == saved.stat().st_size
    (tmp_path / "begun.rrd").write_bytes(saved.read_bytes()[:20])
    with (tmp_path / "begun.rrd").open("rb") as file:
        assert whole_bytes(file) == 12


def test_what_is_no_saved_view_is_told(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"none\.rrd cannot be read \(No such file"):
        RecordedView(tmp_path / "none.rrd")
    (tmp_path / "other.rrd").write_text("something else")
    with pytest.raises(RecordingError, match="is no saved view: make one with"):
        RecordedView(tmp_path / "other.rrd")
