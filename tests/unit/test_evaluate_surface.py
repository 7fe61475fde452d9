"""Size and detail against shapes whose size and detail are known; where an error is put there."""

from itertools import pairwise

import numpy as np
import pytest
from nlos_calibration.rig import ObjectBox, load_rig

from nlos_cam.evaluate.metrics import curve, detail_per_cm, rank_correlation, surface_cm2, where_the_error_is
from nlos_cam.objects.depth_map import object_box

BOX: ObjectBox = object_box(load_rig("paper-rig"))
PITCH_CM = 25 / 64


def plate(side: int, v: float = 0.6, start: int = 10) -> np.ndarray:
    image = np.zeros((1, 64, 64), np.float32)
    image[:, start : start + side, start : start + side] = v
    return image


@pytest.mark.parametrize("side", [4, 20, 64])
def test_a_square_plate_has_its_area_and_four_edges(side: int) -> None:
    image, edge_cm = plate(side, start=0), side * PITCH_CM
    assert surface_cm2(image, BOX)[0] == pytest.approx(edge_cm**2)
    assert detail_per_cm(image, BOX)[0] == pytest.approx(4 / edge_cm)


def test_holes_and_steps_add_detail_and_slopes_do_not() -> None:
    whole, holed, stepped = plate(20), plate(20), plate(20)
    holed[:, 15:20, 15:20] = 0
    stepped[:, 20:30, 10:30] += 0.1  # 31 mm
    sloping = plate(20)
    sloping[:, 10:30, 10:30] += np.linspace(0, 0.3, 20, dtype=np.float32)
    base = detail_per_cm(whole, BOX)[0]
    assert detail_per_cm(holed, BOX)[0] > base
    assert detail_per_cm(stepped, BOX)[0] == pytest.approx(base + 20 * PITCH_CM / (20 * PITCH_CM) ** 2)
    assert detail_per_cm(sloping, BOX)[0] == pytest.approx(base)


def test_nothing_has_no_size_and_no_detail() -> None:
    empty = np.zeros((1, 64, 64), np.float32)
    assert surface_cm2(empty, BOX)[0] == 0
    assert np.isnan(detail_per_cm(empty, BOX)[0])


def test_a_box_twice_as_wide_has_twice_the_surface() -> None:
    wide = BOX.model_copy(update={"x_max_m": BOX.x_min_m + 2 * (BOX.x_max_m - BOX.x_min_m)})
    assert surface_cm2(plate(9), wide)[0] == pytest.approx(2 * surface_cm2(plate(9), BOX)[0])


def test_a_curve_holds_every_object_once_and_follows_the_error() -> None:
    like = np.random.default_rng(0).random(54)
    bins = curve(like, 10 * like)
    assert sum(one.objects for one in bins) == 54
    assert all(one.high <= following.low for one, following in pairwise(bins))
    assert all(10 * one.low <= one.error.value <= 10 * one.high for one in bins)
    assert len(curve(like[:2], like[:2])) == 2


def test_a_rank_correlation_is_of_the_order_alone() -> None:
    like = np.random.default_rng(1).random(54)
    assert rank_correlation(like, np.exp(9 * like)).value == pytest.approx(1)
    assert rank_correlation(like, -(like**3)).value == pytest.approx(-1)
    none = rank_correlation(like, np.random.default_rng(2).random(54))
    assert none.low < 0 < none.high
    coarse = np.round(4 * like)  # equal values have one rank, whatever order they come in
    assert rank_correlation(coarse, coarse**3).value == pytest.approx(1)
    order = np.random.default_rng(3).permutation(54)
    assert rank_correlation(coarse[order], like[order]).value == pytest.approx(rank_correlation(coarse, like).value)
    with_gaps = np.where(like > 0.9, np.nan, like)
    assert rank_correlation(like, with_gaps).value == pytest.approx(1)
    assert rank_correlation(like, np.ones(54)).value is None
    assert rank_correlation(like[:2], like[:2]).value is None


@pytest.mark.parametrize(
    ("at", "zone"),
    [((20, 20), "core"), ((10, 20), "rim inside"), ((8, 20), "rim outside"), ((50, 50), "far background")],
)
def test_an_error_is_found_where_it_is(at: tuple[int, int], zone: str) -> None:
    truth = plate(20)
    image = truth.copy()
    image[0][at] += 0.2
    zones = where_the_error_is(image, truth)
    assert zones[zone].share_of_error == pytest.approx(1)
    assert sum(one.share_of_pixels for one in zones.values()) == pytest.approx(1)
    assert zones["core"].share_of_pixels == pytest.approx(16**2 / 64**2)


def test_perfection_has_no_error_anywhere_and_an_empty_truth_is_far_background() -> None:
    assert {zone.share_of_error for zone in where_the_error_is(plate(9), plate(9)).values()} == {None}
    empty = np.zeros((1, 64, 64), np.float32)
    assert where_the_error_is(plate(9), empty)["far background"].share_of_error == pytest.approx(1)
