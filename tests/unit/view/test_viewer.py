from typing import Self

import pytest
from made_up_moments import moment

from nlos_cam.view.viewer import Moment, Viewers


class Noting:
    """Viewer that records its calls."""

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


def test_viewers_all_see_every_moment() -> None:
    some = Noting(), Noting("http://one"), Noting("http://two")
    with Viewers(some) as viewers:
        viewers.show(moment(7))
        assert viewers.address == "http://one"
    assert [each.noted for each in some] == [["entered", "frame 7", "left"]] * 3


def test_viewers_leave_none_open_if_one_cannot_begin() -> None:
    first = Noting()
    with pytest.raises(OSError, match="no room"), Viewers([first, Noting(fails=True)]):
        pass
    assert first.noted == ["entered", "left"]
