from threading import Event

import numpy as np
from browser_page import Feed, share_changed, share_like, share_unlike, tab_middles
from made_up_moments import moment

from nlos_cam.view.viewer import Moment, NullViewer


def test_tabs_are_found_by_what_is_written_on_them_and_an_arrow_is_none() -> None:
    header = np.full((16, 300, 3), 12)
    for start, stop in ((10, 24), (29, 70), (90, 104), (108, 180), (230, 238)):
        header[4:12, start:stop] = 200
    assert tab_middles(header) == [38.5, 134.5] or np.allclose(tab_middles(header), [40, 136], atol=4)
    assert tab_middles(np.full((16, 300, 3), 12)) == []


def test_shares_are_of_the_region() -> None:
    image = np.zeros((10, 10, 3), int)
    image[:, :5] = 200, 100, 0
    assert share_like(image, (200, 100, 0)) == share_unlike(image, (0, 0, 0)) == 0.5
    assert share_changed(image, np.zeros_like(image), (slice(0, 10), slice(0, 5))) == 1.0


def test_a_feed_shows_moments_until_it_is_left() -> None:
    seen, third = [], Event()

    class Noting(NullViewer):
        def show(self, moment: Moment) -> None:
            seen.append(moment.frame.frame_number)
            if len(seen) == 3:
                third.set()

    with Feed(Noting(), moment):
        assert third.wait(10.0)
    assert seen[:3] == [0, 1, 2]
