import numpy as np
import pytest

from nlos_cam.reconstruct.verdict import Verdict
from nlos_cam.view.images import (
    BACKGROUND_RGB,
    BANNER_HEIGHT,
    BANNER_WIDTH,
    LOOKS,
    as_believed,
    banner_rgb,
    font,
    look_of,
    may_be_believed,
    note_rgba,
)

DOUBTED = [verdict for verdict in Verdict if verdict is not Verdict.SEEN]


def test_every_verdict_has_a_look_and_none_looks_believed_but_one() -> None:
    assert set(LOOKS) == set(Verdict)
    assert [verdict for verdict in Verdict if may_be_believed(verdict)] == [Verdict.SEEN]
    assert may_be_believed(None), "networks that do not tell are not doubted for it"
    assert all(look.rgb != LOOKS[Verdict.SEEN].rgb for verdict, look in LOOKS.items() if verdict is not Verdict.SEEN)


@pytest.mark.parametrize("verdict", [*Verdict, None])
def test_a_banner_is_in_its_verdicts_colour_and_its_words_fit(verdict: Verdict | None) -> None:
    banner = banner_rgb(verdict)
    assert banner.shape == (BANNER_HEIGHT, BANNER_WIDTH, 3)
    assert tuple(banner[40, 5]) == look_of(verdict).rgb
    ground = banner[0, -1]
    assert (banner[:, -20:] == ground).all(), "nothing is written up to the edge"
    assert (banner[:, 30:600] != ground).any()


def test_banners_differ() -> None:
    assert len({banner_rgb(verdict).tobytes() for verdict in (*Verdict, None)}) == len(Verdict) + 1


@pytest.mark.parametrize("verdict", DOUBTED)
def test_a_note_frames_the_picture_and_leaves_most_of_it_to_be_seen(verdict: Verdict) -> None:
    note = note_rgba(verdict)
    frame = np.concatenate([note[0], note[-1], note[:, 0], note[:, -1]])
    assert (frame == (*look_of(verdict).rgb, 255)).all()
    assert (note[..., 3] > 200).mean() < 0.25


def test_what_is_doubted_is_hatched_and_what_is_nothing_is_not() -> None:
    hatched = {verdict: bool((note_rgba(verdict)[20:200, 20:200, 3] > 0).any()) for verdict in DOUBTED}
    assert hatched == {verdict: verdict is not Verdict.NOTHING for verdict in DOUBTED}


def test_a_picture_under_a_note_keeps_its_place_and_loses_its_colour() -> None:
    rgb = np.full((64, 64, 3), BACKGROUND_RGB, np.uint8)
    rgb[10:20, 30:40] = 255, 160, 0
    assert as_believed(rgb, None) is as_believed(rgb, Verdict.SEEN) is rgb
    noted = as_believed(rgb, Verdict.NOTHING).astype(int)
    assert noted.shape == (512, 512, 3)
    inside, outside = noted[100, 300], noted[40, 40]
    assert inside.sum() > outside.sum() + 200
    assert np.ptp(inside) < 100


def test_the_font_has_the_size_asked_for() -> None:
    left, top, right, bottom = font(40).getbbox("nlos-cam")
    assert 20 < bottom - top < 60
    assert right - left > 2 * (bottom - top)
