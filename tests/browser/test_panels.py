"""The view's page in a headless Chromium, with made-up moments."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from browser_page import DEADLINE_S, Page
from made_up_moments import RIG, full_moment
from measured_walls import exact_wall

from nlos_cam.reconstruct.verdict import Verdict
from nlos_cam.view.rrd_file import RrdFile
from nlos_cam.view.web import RecordedView, WebViewer

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.timeout(6 * DEADLINE_S)]

VIEWS = {"Truth (simulated)", "Verdict", "Bench", "Depth"}
PATHS = {"verdict", "reconstruction", "uncertainty", "truth", "latency", "drops", "physics/score", "bench/hidden"}
WALL_PATHS = {"calibration", "lidar/difference", "bench/measured/footprint", "wall/residual"}
LEFT_PX, RIGHT_PX, SLIDER_PX = 300, 1050, 786
"""Left and right end of a recording's time on the page, and their distance from its top."""


@pytest.mark.parametrize("calibrated", [False, True])
def test_page_shows_every_view_and_each_new_moment(browser: Any, calibrated: bool) -> None:
    paths = {f"/{path}" for path in PATHS | (WALL_PATHS if calibrated else set())}
    with WebViewer(RIG, exact_wall() if calibrated else None) as viewer:
        for first in (0, 10):  # the page is opened again
            viewer.show(full_moment(first))
            page = Page(browser, viewer.address or "")
            page.wait_until(lambda page=page: paths <= set(page.frames()), "all of a moment has arrived")
            page.wait_until(lambda page=page: set(page.views()) >= VIEWS, "the layout is there")
            last = first + 5
            viewer.show(full_moment(last, Verdict.OUTSIDE))
            for path in ("/verdict", "/reconstruction", "/latency"):
                arrived = lambda page=page, path=path, last=last: page.frames()[path] == last  # noqa: E731
                page.wait_until(arrived, f"the next moment's {path}")
            assert not page.has_panicked()
            page.close()


def test_page_of_a_saved_view_goes_to_the_time_that_is_clicked(browser: Any, tmp_path: Path) -> None:
    with RrdFile(tmp_path / "view.rrd", RIG, keeps_all=True) as saved:
        for number in range(60):
            saved.show(replace(full_moment(number), published_s=10.0 * number))
    with RecordedView(tmp_path / "view.rrd") as view:
        page = Page(browser, view.address or "")
        page.wait_until(lambda: page.frames().get("/reconstruction") == 59, "the whole recording")
        page.wait_until(lambda: set(page.views()) >= VIEWS, "the layout is there")
        for low_s, share, high_s in ((450.0, 0.9, 590.0), (50.0, 0.2, 200.0)):

            def is_there(low_s: float = low_s, share: float = share, high_s: float = high_s) -> bool:
                page.page.mouse.click(LEFT_PX + share * (RIGHT_PX - LEFT_PX), SLIDER_PX)
                return low_s < page.cursor_s() < high_s

            page.wait_until(is_there, f"a time after {low_s} s is shown")
        page.close()
