"""Verdict on weights for a bench, by the distance of its rig from theirs."""

from types import SimpleNamespace
from typing import Any

import pytest
from nlos_calibration import Rig, load_rig
from nlos_models import ANY, load_record, shipped_folder

from nlos_cam.reconstruct import WALL_GRID, grid_of, shipped_iou, weights_for, weights_serve

RIG = load_rig("paper-rig")


def trained(rig: Rig = RIG, *, known: bool = False) -> Any:
    record = rig.model_dump(mode="json") if known else None
    return SimpleNamespace(
        rig_name=rig.name, rig_checksum=rig.checksum, rig=record, input="raw maps"
    )


def posed(**changes: float) -> Rig:
    lidar = RIG.lidar.model_copy(update=changes)
    return RIG.model_copy(update={"name": "measured", "lidar": lidar})


@pytest.mark.parametrize(
    ("rig", "service"),
    [
        (RIG, "trained for it"),
        (posed(distance_m=0.2001), "trained for it"),
        (posed(distance_m=0.206, yaw_deg=46.0), "near"),
        (posed(yaw_deg=60.0), "far"),
        (posed(distance_m=0.30, yaw_deg=15.0), "not"),
    ],
)
def test_service_falls_with_the_distance_of_the_rigs(rig: Rig, service: str) -> None:
    verdict = weights_serve(rig, trained(), expected_iou=0.61, bench="mine")

    assert verdict.service == service
    assert verdict.serve == (service in {"trained for it", "near"})
    assert ("adapt mine" in verdict.sentence) == (service != "trained for it")
    assert ("0.61" in verdict.sentence) == (service != "trained for it")


def with_box_moved(**by_m: float) -> Rig:
    box = RIG.object_box
    assert box is not None
    sides = {f"{axis}_{end}": by_m[axis] for axis in by_m for end in ("min_m", "max_m")}
    moved = {side: getattr(box, side) + off_m for side, off_m in sides.items()}
    return RIG.model_copy(update={"object_box": box.model_copy(update=moved)})


def with_focal_length(px: float) -> Rig:
    return RIG.model_copy(update={"intrinsics": RIG.intrinsics.model_copy(update={"fx": px})})


def with_wall_to(y_max_m: float) -> Rig:
    return RIG.model_copy(update={"wall": RIG.wall.model_copy(update={"y_max_m": y_max_m})})


@pytest.mark.parametrize(
    ("rig", "service"),
    [
        (with_box_moved(x=1e-6), "trained for it"),
        (with_box_moved(x=0.004), "near"),
        (with_box_moved(x=0.03), "far"),
        (with_box_moved(x=-0.05), "far"),
        (with_box_moved(y=0.1), "far"),
        (with_focal_length(700.0), "far"),
        (with_wall_to(0.15), "not"),
        (with_wall_to(0.2), "near"),
        (RIG.model_copy(update={"occluder": None}), "far"),
    ],
)
def test_box_view_wall_and_occluder_count_too(rig: Rig, service: str) -> None:
    assert weights_serve(rig, trained()).service == service


def with_gap(gap_m: float, **lidar: float) -> Rig:
    occluder = RIG.occluder
    assert occluder is not None
    wider = occluder.model_copy(update={"z_min_m": gap_m})
    return posed(**{"distance_m": 0.203, **lidar}).model_copy(update={"occluder": wider})


@pytest.mark.parametrize(
    ("rig", "name"),
    [
        (RIG, "direct"),
        (with_gap(0.108), "direct"),
        (load_rig("wide-rig"), "wide"),
        (with_gap(0.133), "wide"),
        (with_gap(0.139, yaw_deg=63.0), "wide"),
        (posed(yaw_deg=60.0), "direct"),
        (posed(distance_m=0.25, yaw_deg=30.0), "any"),
        (posed(distance_m=0.34), "any"),
        (load_rig("bare-wall"), "direct"),
    ],
)
def test_bench_gets_the_weights_that_serve_it_best(rig: Rig, name: str) -> None:
    assert weights_for(rig).name == name


@pytest.mark.parametrize(
    "rig",
    [
        posed(pitch_deg=10.0),
        with_box_moved(x=0.04),
        with_box_moved(y=0.1),
        with_focal_length(700.0),
    ],
)
def test_differences_whose_cost_is_not_known_have_no_figure(rig: Rig) -> None:
    assert shipped_iou(RIG, shipped_folder()) == pytest.approx(0.79)
    assert shipped_iou(posed(pitch_deg=1.0), shipped_folder()) == pytest.approx(0.79)
    assert shipped_iou(rig, shipped_folder()) is None


@pytest.mark.parametrize(
    ("present_iou", "is_advised"), [(None, True), (0.6, True), (0.66, False), (0.75, False)]
)
def test_adapting_is_advised_only_where_it_is_expected_to_help(
    present_iou: float | None, is_advised: bool
) -> None:
    verdict = weights_serve(
        posed(distance_m=0.22), trained(), expected_iou=0.66, present_iou=present_iou
    )

    assert verdict.adapting_helps is is_advised
    assert ("nlos-cam adapt" in verdict.sentence) is is_advised
    assert "expected silhouette IoU 0.66" in verdict.sentence


def test_shipped_weights_for_any_rig_know_todays_grid() -> None:
    assert grid_of(load_record(shipped_folder(ANY)))


def test_weights_that_hold_their_rig_are_known_later() -> None:
    bench = posed(distance_m=0.25, yaw_deg=30.0)
    again = posed(distance_m=0.2502, yaw_deg=30.02)

    assert weights_serve(again, trained(bench, known=True)).service == "trained for it"
    assert weights_serve(again, trained(bench)).service == "not"


def test_weights_for_any_rig_serve_one_in_their_range() -> None:
    verdict = weights_serve(posed(distance_m=0.25, yaw_deg=30.0), trained(WALL_GRID))

    assert verdict.serve
    assert "adapt" in verdict.sentence


def test_weights_for_any_rig_say_which_number_is_beyond() -> None:
    verdict = weights_serve(posed(distance_m=0.34), trained(WALL_GRID))

    assert verdict.service == "far"
    assert "distance 0.34 m" in verdict.sentence


@pytest.mark.parametrize(
    ("rig", "what"),
    [
        (with_gap(0.3), "gap 0.3 m"),
        (with_gap(0.03), "gap 0.03 m"),
        (posed(pitch_deg=10.0), "pitch 10 degrees"),
        (with_box_moved(y=0.1), "box moved up by 0.1 m"),
        (with_box_moved(x=0.1), "box moved along the wall by 0.1 m"),
        (with_wall_to(0.15), "its wall ends"),
        (with_gap(0.2), "the lidar sees into the object box"),
    ],
)
def test_each_number_of_a_rig_can_be_beyond_training(rig: Rig, what: str) -> None:
    verdict = weights_serve(rig, trained(WALL_GRID))

    assert verdict.service == "far"
    assert what in verdict.sentence


def test_rigs_at_the_end_of_a_range_are_within_it() -> None:
    end = posed(distance_m=0.3009, yaw_deg=75.1)

    assert weights_serve(end, trained(WALL_GRID)).service == "near"


def test_weights_for_any_rig_need_an_occluder() -> None:
    bare = posed().model_copy(update={"occluder": None})

    assert weights_serve(bare, trained(WALL_GRID)).service == "not"


def test_weights_for_any_rig_that_went_on_for_one_know_it() -> None:
    bench = posed(distance_m=0.25, yaw_deg=30.0)
    adapted = trained(WALL_GRID)
    adapted.rig = bench.model_dump(mode="json")

    assert weights_serve(bench, adapted).service == "trained for it"
    again = posed(distance_m=0.253, yaw_deg=30.0)
    assert weights_serve(again, adapted).service == "near"
    assert weights_serve(posed(yaw_deg=60.0), adapted).service == "far"
