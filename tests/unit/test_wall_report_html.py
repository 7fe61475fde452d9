import re
from html import unescape

import pytest

from nlos_cam.calibrate.report import bullets, page, pairs, pictured, range_bar, table
from nlos_cam.calibrate.report_maps import Picture

HOSTILE = "<script>alert(\"1\")</script> & 'x'"


@pytest.mark.parametrize(
    "made",
    [
        page(HOSTILE, HOSTILE, []),
        pictured(Picture(HOSTILE, HOSTILE)),
        pictured(Picture(HOSTILE, HOSTILE, b"png")),
        table([(HOSTILE, HOSTILE)], (HOSTILE, HOSTILE)),
        pairs({HOSTILE: HOSTILE}),
        bullets(HOSTILE, [HOSTILE]),
        range_bar(HOSTILE, 1.0, (0.0, 2.0), 0.1, "cm", 3.0),
    ],
)
def test_text_is_never_markup(made: str) -> None:
    assert "<script" not in made
    assert unescape(made).count(HOSTILE) >= 2


def test_a_page_may_hold_dollars_and_braces() -> None:
    made = page("$title", "{under}", ["<p>$body ${style}</p>"])
    assert "<title>$title</title>" in made
    assert "{under}" in made
    assert "<p>$body ${style}</p>" in made


def test_a_picture_without_pixels_is_its_words() -> None:
    assert "<img" not in pictured(Picture("title", "words"))
    assert "src='data:image/png;base64,cG5n'" in pictured(Picture("title", "words", b"png"))


def test_a_list_of_nothing_is_nothing() -> None:
    assert not bullets("Note", [])


def marker_and_range(value: float) -> tuple[float, float, float]:
    """Where the marker, and both ends of the range from 15 to 30 are."""
    drawn = range_bar("distance", value, (15.0, 30.0), 0.1, "cm", 45.0)
    marker = re.search(r"M ([\d.]+) ", drawn)
    allowed = re.search(r"x='([\d.]+)' y='14' width='([\d.]+)' height='14' class='allowed'", drawn)
    assert marker is not None
    assert allowed is not None
    return float(marker[1]), float(allowed[1]), float(allowed[1]) + float(allowed[2])


def test_the_marker_is_where_the_value_is() -> None:
    for value, ends in ((15.0, 1), (30.0, 2)):
        places = marker_and_range(value)
        assert places[0] == pytest.approx(places[ends], abs=0.2)
    at, low, high = marker_and_range(22.5)
    assert at == pytest.approx((low + high) / 2.0, abs=0.2)
    assert marker_and_range(60.0)[0] == marker_and_range(45.0)[0] < 680.0
    assert marker_and_range(-5.0)[0] == marker_and_range(0.0)[0] > 0.0


@pytest.mark.parametrize(
    ("value", "told", "drawn"),
    [
        (14.85, "too small", "outside"),
        (14.95, "inside", "inside"),
        (30.05, "inside", "inside"),
        (31.0, "too large", "outside"),
    ],
)
def test_a_bar_says_whether_the_value_is_inside(value: float, told: str, drawn: str) -> None:
    made = range_bar("distance", value, (15.0, 30.0), 0.1, "cm", 45.0)
    assert f"{value:.1f} cm, {told} (15 to 30 cm)" in made
    assert f"class='{drawn}'" in made
