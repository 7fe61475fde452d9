from typing import Self

import pytest
from made_up_moments import moment

from nlos_cam.view.viewer import Moment, NullViewer, Viewer, Viewers


class Noting:
    """A viewer that notes what befalls it."""

    def __init__(self, address: str | None = None, *, fails: bool = False) -> None:
        self.address, self.fails = address, fails
        self.noted: list[str] = []

    def __enter__(self) -> Self:
        if self.fails:
            raise OSError("no room")
        self.noted.append("entered")
        return self

    def __exit__(self, *_: object) -> None:
        self.noted.append("left")

    def show(self, shown: Moment) -> None:
        self.noted.append(f"frame {shown.frame.frame_number}")


def test_the_null_viewer_has_a_viewers_verbs_and_no_address() -> None:
    viewer: Viewer = NullViewer()
    with viewer as entered:
        assert entered is viewer
        assert entered.address is None
        entered.show(None)  # type: ignore[arg-type]


def test_several_viewers_see_all_of_it_and_the_first_address_is_theirs() -> None:
    some = Noting(), Noting("http://one"), Noting("http://two")
    with Viewers(some) as viewers:
        viewers.show(moment(7))
        assert viewers.address == "http://one"
    assert [each.noted for each in some] == [["entered", "frame 7", "left"]] * 3


def test_a_viewer_that_cannot_begin_leaves_none_behind() -> None:
    first = Noting()
    with pytest.raises(OSError, match="no room"), Viewers([first, Noting(fails=True)]):
        pass
    assert first.noted == ["entered", "left"]
