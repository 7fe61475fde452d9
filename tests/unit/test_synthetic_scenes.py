"""Synthetic walls, sheets, boards and drifting streams deviate from the truth by their
parameters.
"""

import numpy as np
import pytest
import synthetic_scenes as scenes
from nlos_calibration import (
    BareWall,
    BareWallStatistics,
    LidarPose,
    Occluder,
    load_rig,
    wall_depth,
)
from synthetic_walls import View

from nlos_cam.render import cast

PAPER = load_rig("paper-rig")
SMALL_PAPER = PAPER.pinhole.scaled(80, 60)
TINY = scenes.SMALL.scaled(80, 60)
POSE: scenes.WallPose = (0.2, 30.0, 0.0)


@pytest.mark.parametrize(
    ("yaw_deg", "pitch_deg", "x_m", "gap_m"), [(45.0, 0.0, 0.2, 0.1), (60.0, -9.0, 0.15, 0.07)]
)
def test_scene_rays_are_the_renderers(
    yaw_deg: float, pitch_deg: float, x_m: float, gap_m: float
) -> None:
    lidar = LidarPose(distance_m=0.2, yaw_deg=yaw_deg, pitch_deg=pitch_deg)
    rig = PAPER.model_copy(update={"lidar": lidar, "occluder": Occluder(x_m=x_m, z_min_m=gap_m)})
    beams = cast(rig, SMALL_PAPER)
    seen = View(rig.wall_from_lidar, SMALL_PAPER)
    depth_m = scenes.bench_depth(seen, scenes.Sheet(x_m, gap_m)).ravel()
    met = (
        np.isfinite(beams.length_m)
        & (beams.laser_spot_m[:, 0] < 2.0)
        & (np.abs(beams.laser_spot_m[:, 1]) < 1.5)
    )

    np.testing.assert_allclose(depth_m[met], (beams.length_m * beams.cos_axis)[met], rtol=1e-9)
    assert (~beams.on_wall & met).any()


@pytest.fixture
def truth_m() -> np.ndarray:
    return wall_depth(scenes.wall_from_lidar(POSE), TINY)


@pytest.fixture
def drawn() -> BareWall:
    return scenes.reference_of_wall(POSE, TINY, np.random.default_rng(0))


@pytest.fixture
def collected(drawn: BareWall, truth_m: np.ndarray) -> BareWall:
    """Reference collected from as many frames as the drawn one stands for."""
    generator = np.random.default_rng(1)
    statistics = BareWallStatistics(TINY)
    ir = np.full((60, 80), 40, np.uint8)
    cells = np.zeros((64, 80), np.float32)
    for _ in range(scenes.REFERENCE_FRAMES):
        depth_m = scenes.noisy_depth(truth_m, generator).astype(np.float32)
        statistics.add(depth_m, ir, cells, cells)
    return statistics.reference(drawn.inliers, serial="", settings={})


def test_drawn_reference_has_the_spread_of_a_collected_one(
    drawn: BareWall, collected: BareWall
) -> None:
    ratio = np.nanmean(drawn.depth_std_m / collected.depth_std_m)
    assert ratio == pytest.approx(1.0, abs=0.03)


def test_drawn_reference_has_the_arrays_of_a_collected_one(
    drawn: BareWall, collected: BareWall
) -> None:
    assert set(vars(drawn)) == set(vars(collected))
    for name in ("depth_m", "ir", "saturated", "map_depth_m"):
        assert getattr(drawn, name).dtype == getattr(collected, name).dtype
        assert getattr(drawn, name).shape == getattr(collected, name).shape


def test_multipath_is_longer_and_moves_and_a_sheet_is_nearer() -> None:
    stream = scenes.WallStream(POSE, TINY)
    depth_m = np.full(len(stream.pixels), 0.3)
    hide = scenes.multipath(stream.places, 0.6, 1)
    first = hide(depth_m, 0) - depth_m
    later = hide(depth_m, 10) - depth_m

    assert (first > 0.0).mean() == pytest.approx(0.6, abs=0.01)
    assert first[first > 0.0].min() >= 0.03 - 1e-9
    assert first.max() <= 0.4 + 1e-9
    assert ((first > 0.0) != (later > 0.0)).any()

    nearer = depth_m - scenes.occluding_sheet(stream.places, 0.5)(depth_m, 0)

    assert (nearer > 0.0).mean() == pytest.approx(0.5, abs=0.05)
    assert nearer[nearer > 0.0].min() >= 0.05
