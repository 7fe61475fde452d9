import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from measured_walls import HEIGHT, WIDTH, exact_wall
from nlos_calibration.geometry import normal_from_angles, wall_from_plane
from nlos_calibration.reference import BareWall
from nlos_calibration.wall_record import MeasuredWall

from nlos_cam.view.images import BACKGROUND_RGB, SATURATED_RGB
from nlos_cam.view.wall_drawing import (
    ALL_IS_WELL,
    MAX_POINTS,
    NOT_WATCHED,
    OFF_WALL_M,
    bench_drawings,
    calibration_text,
    every_nth,
    outline_m,
    wall_names,
    wall_pictures,
    wall_points_m,
)

SHAPE = HEIGHT, WIDTH
NOTHING = np.full(SHAPE, np.nan, np.float32)
PATHS = {
    f"bench/measured/{name}"
    for name in ("footprint", "distance", "distance/end", "axis", "axis/end", "frame", "points")
}


def reference_of(wall: MeasuredWall) -> BareWall:
    assert wall.reference is not None
    return wall.reference


def points(drawing: Any) -> np.ndarray:
    return np.array(drawing.positions.as_arrow_array().to_pylist())


def with_record(wall: MeasuredWall, **fields: Any) -> MeasuredWall:
    return dataclasses.replace(wall, record=wall.record.model_copy(update=fields))


@given(st.integers(1, 700), st.integers(1, 700), st.integers(1, 9000))
def test_every_nth_keeps_about_as_many_as_allowed(height: int, width: int, most: int) -> None:
    kept = np.zeros((height, width), np.bool_)[every_nth((height, width), most)]
    assert 1 <= kept.size <= most
    if min(height, width) >= 50 and most >= 50:
        assert kept.size > min(most, height * width) / 8


def test_wall_outline_is_closed_finite_and_on_the_wall() -> None:
    wall = exact_wall()
    outline, extent = outline_m(wall), wall.record.rig.wall
    points_m = wall_points_m(wall.record, reference_of(wall))[..., :2].reshape(-1, 2)
    assert (points_m.min(axis=0) > outline.min(axis=0) - 0.01).all()
    assert (points_m.max(axis=0) < outline.max(axis=0) + 0.01).all()
    np.testing.assert_array_equal(outline[0], outline[-1])
    assert (outline >= [extent.x_min_m - 1e-6, extent.y_min_m - 1e-6]).all()
    assert (outline <= [extent.x_max_m + 1e-6, extent.y_max_m + 1e-6]).all()
    pose = wall_from_plane(normal_from_angles(np.radians(75.0), 0.0), 0.2)
    oblique = outline_m(with_record(wall, wall_from_lidar=pose.tolist(), yaw_deg=75.0, facing_deg=75.0))
    assert len(oblique) > 3
    assert np.isfinite(oblique).all()
    assert oblique[:, 0].max() == pytest.approx(extent.x_max_m, abs=0.5)
    far = extent.model_copy(update={"x_min_m": -1.0, "x_max_m": -0.9})
    past = with_record(wall, rig=wall.record.rig.model_copy(update={"wall": far}))
    assert len(outline_m(past)) == 0
    assert "bench/measured/footprint" not in dict(bench_drawings(past))


def test_bench_drawings_label_distance_and_angle() -> None:
    drawings = dict(bench_drawings(exact_wall()))
    assert set(drawings) == PATHS
    assert drawings["bench/measured/distance/end"].labels.as_arrow_array().to_pylist() == ["200.0 mm"]
    assert drawings["bench/measured/axis/end"].labels.as_arrow_array().to_pylist() == ["45.0°"]
    np.testing.assert_allclose(points(drawings["bench/measured/distance/end"]), [[0.0, 0.0, 0.0]], atol=1e-6)
    np.testing.assert_allclose(points(drawings["bench/measured/axis/end"]), [[0.2, 0.0, 0.0]], atol=1e-6)


@pytest.mark.parametrize("without", ["reference", "returns"])
def test_bench_drawings_without_depth_have_no_points(without: str) -> None:
    wall = exact_wall(reference=None)
    if without == "returns":
        wall = exact_wall(depth_m=NOTHING, depth_std_m=NOTHING, ir=NOTHING, inliers=np.zeros(SHAPE, np.bool_))
    assert set(dict(bench_drawings(wall))) == PATHS - {"bench/measured/points"}
    pictures = wall_pictures(wall)
    assert bool(pictures) == (without == "returns")
    assert all((pictures[name] == BACKGROUND_RGB).all() for name in ("residual", "noise") if pictures)
    assert wall_names(exact_wall(reference=None), None).pictures() == []


def test_bench_drawings_leave_out_holes_and_strays() -> None:
    depth_m = reference_of(exact_wall()).depth_m.copy()
    chance = np.random.default_rng(0).random(SHAPE)
    depth_m[chance < 0.6], depth_m[chance > 0.9] = np.nan, 2.0
    wall = exact_wall(depth_m=depth_m)
    drawn_m = points(dict(bench_drawings(wall))["bench/measured/points"])
    near = np.abs(wall_points_m(wall.record, reference_of(wall))[..., 2]) <= OFF_WALL_M
    assert 0 < len(drawn_m) <= MAX_POINTS
    assert 0 < near.sum() < depth_m.size / 2
    assert np.isfinite(drawn_m).all()
    assert np.abs(drawn_m[:, 2]).max() <= OFF_WALL_M


def test_saturated_pixels_are_marked_in_bench_and_picture() -> None:
    saturated = np.zeros(SHAPE, np.float32)
    saturated[31, 17] = 0.1
    wall = exact_wall(saturated=saturated)
    marked_m = points(dict(bench_drawings(wall))["bench/measured/saturated"])
    np.testing.assert_allclose(marked_m, [wall_points_m(wall.record, reference_of(wall))[31, 17]], atol=1e-6)
    is_marked = (wall_pictures(wall)["saturated"] == SATURATED_RGB).all(axis=-1)
    assert np.argwhere(is_marked).tolist() == [[31, 17]]


def test_saturated_pixel_survives_thinning() -> None:
    shape = 480, 641
    saturated = np.zeros(shape, np.float32)
    saturated[301, 17] = 1.0
    large = reference_of(exact_wall()).intrinsics.scaled(641, 480)
    blank = np.full(shape, 0.3, np.float32)
    fields = {"depth_m": blank, "depth_std_m": blank, "ir": blank, "saturated": saturated}
    wall = exact_wall()
    reference = dataclasses.replace(reference_of(wall), **fields, inliers=blank > 0, intrinsics=large)
    picture = wall_pictures(dataclasses.replace(wall, reference=reference))["saturated"]
    assert picture.shape == (240, 321, 3)
    assert np.argwhere((picture == SATURATED_RGB).all(axis=-1)).tolist() == [[150, 8]]


def test_wall_names_state_their_scales() -> None:
    names = wall_names(exact_wall(), 0.3)
    assert "30 cm" in names.difference
    assert "±2 mm" in names.residual
    assert "0.5 mm" in names.noise
    assert wall_names(exact_wall(), None).difference == ""


def test_calibration_text_shows_warnings_before_the_summary() -> None:
    record = exact_wall().record.model_copy(update={"reference": "wall.npz", "reference_sha256": "0" * 64})
    calm, alarmed = calibration_text(record), calibration_text(record, ["the lidar has moved", "it is warm"])
    assert ALL_IS_WELL in calm
    assert "WARNING" not in calm
    assert ALL_IS_WELL not in alarmed
    assert "> - the lidar has moved\n> - it is warm" in alarmed
    assert alarmed.index("it is warm") < alarmed.index("| distance |")  # visible without scrolling
    unwatched = calibration_text(exact_wall().record)
    assert NOT_WATCHED in unwatched
    assert ALL_IS_WELL not in unwatched
