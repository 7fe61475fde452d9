"""Each panel of the view in a headless Chromium, which is shown moments that were made up, one change at a time."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser_page import Feed, Page, Pixels, Region, share_changed, share_like, share_unlike
from made_up_moments import NOTHING, RIG, bump, full_moment
from measured_walls import exact_wall

from nlos_cam.reconstruct.verdict import Verdict
from nlos_cam.view.images import LOOKS
from nlos_cam.view.rrd_file import RrdFile
from nlos_cam.view.viewer import Moment
from nlos_cam.view.web import RecordedView, WebViewer

pytestmark = [pytest.mark.browser, pytest.mark.timeout(900)]

PAGE_RGB = (13, 16, 17)
BANNER: Region = slice(2, 90), slice(2, 740)
RECONSTRUCTION: Region = slice(125, 475), slice(5, 370)
UNCERTAINTY: Region = slice(125, 475), slice(378, 740)
BENCH: Region = slice(35, 475), slice(755, 1275)
TRUTH: Region = slice(512, 795), slice(5, 240)
DEPTH: Region = slice(512, 795), slice(248, 575)
LIGHT: Region = slice(512, 795), slice(584, 910)
PLOTS: Region = slice(512, 795), slice(920, 1275)
TIME: Region = slice(772, 800), slice(0, 1280)
SLIDER_PX = 300, 1050
"""From where to where a recording's time is dragged; its ends are a little beyond."""
LEAST = 0.01
"""The share of a panel that another moment changes."""
SCENE = full_moment(0, size=(96, 128))


def still(number: int) -> Moment:
    """A scene in which nothing moves but time."""
    frame = replace(SCENE.frame, frame_number=number, timestamp_s=number / 4)
    return replace(SCENE, frame=frame, published_s=number / 4)


def changed(**fields: Any) -> Moment:
    return replace(SCENE, **fields)


def seen(**fields: Any) -> Moment:
    return replace(SCENE, frame=replace(SCENE.frame, **fields))


CELLS = np.full((64, 64), 0.001, np.float32)
CHANGES: dict[str, tuple[Moment, list[Region]]] = {
    "verdict": (changed(verdict=Verdict.OUTSIDE), [BANNER, RECONSTRUCTION, BENCH]),
    "hidden": (
        changed(reconstruction=replace(SCENE.reconstruction, depth_m=bump(20))),
        [RECONSTRUCTION, UNCERTAINTY, BENCH],
    ),
    "uncertainty": (changed(reconstruction=replace(SCENE.reconstruction, uncertainty_m=CELLS)), [UNCERTAINTY]),
    "truth": (seen(truth_depth_m=NOTHING), [TRUTH]),
    "depth": (seen(depth_m=SCENE.frame.depth_m[::-1] * np.float32(0.4)), [DEPTH]),
    "infrared": (seen(ir=SCENE.frame.ir + 150), [LIGHT]),
    "latency": (changed(latency_s=0.2), [PLOTS]),
}


def is_drawn(image: Pixels) -> bool:
    """Whether every panel shows something."""
    lit = (RECONSTRUCTION, UNCERTAINTY, BENCH, TRUTH, DEPTH, LIGHT, PLOTS)
    green = share_like(image[BANNER], LOOKS[Verdict.SEEN].rgb) > 0.01
    return green and all(share_unlike(image[region], PAGE_RGB) > 0.005 for region in lit)


def differs(before: Pixels, regions: list[Region], now: Pixels) -> bool:
    """Whether all of these look different."""
    return all(share_changed(before, now, region) > LEAST / 4 for region in regions)


def is_alike(before: Pixels, regions: list[Region], now: Pixels) -> bool:
    """Whether none of these look different."""
    return not any(differs(before, [region], now) for region in regions)


def at(moment: Moment, number: int) -> Moment:
    frame = replace(moment.frame, frame_number=number, timestamp_s=number / 4)
    return replace(moment, frame=frame, published_s=number / 4)


def test_each_panel_changes_with_its_part_of_a_moment_and_a_page_opened_again_shows_it_all(browser: Any) -> None:
    with WebViewer(RIG) as viewer, Feed(viewer, still) as feed:
        page = Page(browser, viewer.address or "")
        before = page.until(is_drawn, "every panel is drawn")
        for what, (moment, regions) in CHANGES.items():
            feed.make = partial(at, moment)
            page.until(partial(differs, before, regions), f"{what} is seen")
            feed.make = still
            if PLOTS not in regions:  # which remember
                page.until(partial(is_alike, before, regions), "it is as before")
        for panel, tabs in ((DEPTH, 2), (LIGHT, 2), (PLOTS, 4)):
            for tab in range(1, tabs):
                page.open_tab(tab, panel, before)
                page.until(partial(differs, before, [panel]), f"tab {tab} is open")
        page.close()
        page = Page(browser, viewer.address or "")
        page.until(is_drawn, "every panel is drawn again")
        page.close()


def test_the_calibrated_view_shows_what_changed_and_the_calibration(browser: Any) -> None:
    with WebViewer(RIG, exact_wall()) as viewer, Feed(viewer, still) as feed:
        page = Page(browser, viewer.address or "")
        before = page.until(is_drawn, "every panel is drawn")
        wide = np.full((64, 80), -0.02, np.float32)
        nearer = replace(SCENE, difference=replace(SCENE.difference, depth_m=wide), warnings=("the lidar has moved",))
        feed.make = lambda number: at(nearer, number)
        page.until(
            lambda now: share_changed(before, now, LIGHT) > 0.2 and share_changed(before, now, PLOTS) > 0.002,
            "the change and the warning",
        )
        closed = before
        for tab in (1, 2, 3):
            before = page.look()
            page.open_tab(tab, BENCH, closed)
            page.until(
                lambda now, before=before: share_changed(before, now, BENCH) > 0.05, f"picture {tab} of the wall"
            )
        page.close()


def test_a_saved_view_is_gone_through_by_its_time(browser: Any, tmp_path: Path) -> None:
    """Ten minutes, of which the second half is doubted: playing alone would take five to get there."""
    with RrdFile(tmp_path / "view.rrd", RIG, keeps_all=True) as saved:
        for number in range(60):
            verdict = Verdict.SEEN if number < 30 else Verdict.OUTSIDE
            saved.show(replace(full_moment(number, verdict), published_s=10.0 * number))
    with RecordedView(tmp_path / "view.rrd") as view:
        page = Page(browser, view.address or "")
        page.until(lambda now: share_like(now[BANNER], LOOKS[Verdict.SEEN].rgb) > 0.01, "the beginning")
        assert share_unlike(page.look()[TIME], PAGE_RGB) > 0.005, "the panel of time is there"
        start, stop = SLIDER_PX
        for share, verdict in ((0.9, Verdict.OUTSIDE), (0.2, Verdict.SEEN)):
            page.click(start + share * (stop - start), 786)
            page.until(lambda now, verdict=verdict: share_like(now[BANNER], LOOKS[verdict].rgb) > 0.01, f"{verdict}")
        page.close()
