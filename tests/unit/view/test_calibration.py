import dataclasses
from typing import Any

import numpy as np
import pytest
from measured_walls import HEIGHT, WIDTH, exact_wall
from nlos_calibration import MeasuredWall, normal_from_angles, wall_from_plane

from nlos_cam.view.calibration import calibration_facts, outline_m, wall_pictures, wall_points_m
from nlos_cam.view.images import BACKGROUND_RGB, SATURATED_RGB

SHAPE = HEIGHT, WIDTH
NOTHING = np.full(SHAPE, np.nan, np.float32)


def with_record(wall: MeasuredWall, **fields: Any) -> MeasuredWall:
    return dataclasses.replace(wall, record=wall.record.model_copy(update=fields))


def test_wall_outline_is_closed_finite_and_on_the_wall() -> None:
    wall = exact_wall()
    outline, extent = outline_m(wall), wall.record.rig.wall
    points_m = wall_points_m(wall.record, wall.reference)[..., :2].reshape(-1, 2)
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


def test_wall_pictures_need_a_reference_and_are_dark_without_returns() -> None:
    assert wall_pictures(exact_wall(reference=None)) == {}
    dark = exact_wall(depth_m=NOTHING, depth_std_m=NOTHING, ir=NOTHING, inliers=np.zeros(SHAPE, np.bool_))
    pictures = wall_pictures(dark)
    assert all((pictures[name][1] == BACKGROUND_RGB).all() for name in ("wall_residual", "wall_noise"))
    titles = {name: title for name, (title, _) in wall_pictures(exact_wall()).items()}
    assert "±2 mm" in titles["wall_residual"]
    assert "0.5 mm" in titles["wall_noise"]


def test_saturated_pixel_survives_thinning() -> None:
    shape = 480, 641
    saturated = np.zeros(shape, np.float32)
    saturated[301, 17] = 1.0
    large = exact_wall().reference.intrinsics.scaled(641, 480)
    blank = np.full(shape, 0.3, np.float32)
    fields = {"depth_m": blank, "depth_std_m": blank, "ir": blank, "saturated": saturated}
    wall = exact_wall()
    reference = dataclasses.replace(wall.reference, **fields, inliers=blank > 0, intrinsics=large)
    picture = wall_pictures(dataclasses.replace(wall, reference=reference))["wall_saturated"][1]
    assert picture.shape == (240, 321, 3)
    assert np.argwhere((picture == SATURATED_RGB).all(axis=-1)).tolist() == [[150, 8]]


def test_calibration_facts_begin_with_the_verdict_and_note_a_missing_reference() -> None:
    record = exact_wall().record
    facts = calibration_facts(record)
    assert facts[0][:2] == ["verdict", record.verdict]
    assert any(row[0] == "distance" for row in facts)
    assert "drift is not watched" in facts[-1][1]
    whole = record.model_copy(update={"reference": "wall.npz", "reference_sha256": "0" * 64})
    assert "drift" not in calibration_facts(whole)[-1][1]
