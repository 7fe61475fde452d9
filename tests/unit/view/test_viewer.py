from collections.abc import Callable
from threading import Event, Thread
from typing import Self

import pytest
from made_up_moments import moment

from nlos_cam.view.viewer import Latest, Moment, NullViewer, Viewer, Viewers


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


def test_null_viewer_is_a_viewer_without_address() -> None:
    viewer: Viewer = NullViewer()
    with viewer as entered:
        assert entered is viewer
        assert entered.address is None
        entered.show(None)  # type: ignore[arg-type]


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


def test_latest_gives_a_late_reader_the_newest_value() -> None:
    slot = Latest[str]()
    for value in "abc":
        slot.put(value)
    newest = slot.after(0, 1.0)
    assert newest == (3, "c")
    assert slot.after(3, 0.0) is None


def read_in_threads(slot: Latest[int], count: int, act: Callable[[], None]) -> list[tuple[int, int] | None]:
    """Values that waiting readers find when the slot is acted upon."""
    found: list[tuple[int, int] | None] = []
    readers = [Thread(target=lambda: found.append(slot.after(0, 60.0))) for _ in range(count)]
    for reader in readers:
        reader.start()
    act()
    for reader in readers:
        reader.join(60.0)
    return found


def test_latest_wakes_a_waiting_reader() -> None:
    slot = Latest[int]()
    assert read_in_threads(slot, 1, lambda: slot.put(7)) == [(1, 7)]


def test_latest_wakes_every_reader_with_nothing_when_closed() -> None:
    slot = Latest[int]()
    assert read_in_threads(slot, 3, slot.close) == [None] * 3
    slot.put(1)
    assert slot.after(0, 0.0) is None


def test_latest_prefers_a_value_that_comes_soon() -> None:
    slot, read = Latest[str](), Event()
    slot.put("there")

    def put_more() -> None:
        number = 0
        while not read.wait(0.005):
            slot.put(f"fresh {number}")
            number += 1

    writer = Thread(target=put_more)
    writer.start()
    before = slot.after(0, 0.0)
    newest = slot.fresh(0, 60.0, 0.0)
    read.set()
    writer.join(60.0)
    assert before is not None
    assert newest is not None
    assert newest[0] > before[0]


def test_latest_takes_the_value_that_is_there_if_none_comes() -> None:
    slot = Latest[str]()
    slot.put("there")
    assert slot.fresh(0, 0.01, 0.0) == (1, "there")
    assert slot.fresh(1, 60.0, 0.01) is None
