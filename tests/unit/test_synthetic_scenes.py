"""Synthetic walls, sheets, boards and drifting streams deviate from the truth by their
parameters.
"""

import numpy as np
import pytest
import synthetic_scenes as scenes
import synthetic_walls
from nlos_calibration import BOARDS, BareWallStatistics, LidarPose, Occluder, load_rig, wall_depth

from nlos_cam.render import cast

RIG = load_rig("bare-wall")
PAPER = load_rig("paper-rig")
PINHOLE = RIG.pinhole
A4 = BOARDS["a4"]
SMALL_BARE = PINHOLE.scaled(80, 60)
SMALL_PAPER = PAPER.pinhole.scaled(80, 60)
TINY = scenes.SMALL.scaled(80, 60)
POSE: scenes.WallPose = (0.2, 30.0, 0.0)


@pytest.mark.parametrize("bend_deg", [-20.0, -1.0, 1.0, 20.0])
@pytest.mark.parametrize("direction_rad", [0.0, 1.0, 2.5])
def test_bent_wall_is_one_plane_on_either_side_of_a_fold(
    bend_deg: float, direction_rad: float
) -> None:
    seen = synthetic_walls.view(0.2, 20.0, 5.0, SMALL_BARE)
    depth_m, main = synthetic_walls.bent(seen, bend_deg, 0.4, direction_rad)
    _, other = synthetic_walls.bent(seen, bend_deg, 0.6, direction_rad)
    assert main is seen
    assert np.degrees(np.arccos(other.pose[2, :3] @ seen.pose[2, :3])) == pytest.approx(
        abs(bend_deg)
    )
    first = depth_m == seen.depth_m
    assert first.mean() == pytest.approx(0.6, abs=0.03)
    fold = first[:, 1:] != first[:, :-1]
    assert fold.any()
    assert np.abs(np.diff(depth_m, axis=1))[fold].max() < 0.01


def test_scenes_are_off_the_wall_by_their_parameters() -> None:
    seen = synthetic_walls.view(0.2, 30.0, 0.0, SMALL_BARE)
    away = -(SMALL_BARE.rays() @ seen.pose[2, :3])

    def height_m(depth_m: np.ndarray) -> np.ndarray:
        return 0.2 - depth_m * away

    assert np.allclose(
        np.unique(height_m(synthetic_walls.stepped(seen, 0.004, 0.3)).round(9)), [0.0, 0.004]
    )
    assert np.allclose(
        np.unique(height_m(synthetic_walls.window(seen, 0.01)).round(9)), [-0.01, 0.0]
    )
    assert (height_m(synthetic_walls.window(seen, 0.01)) < -0.005).mean() == pytest.approx(
        0.5, abs=0.1
    )
    assert np.abs(height_m(synthetic_walls.curved(seen, 1.0))).max() > 0.002
    assert synthetic_walls.patch(seen, 0.25).mean() == pytest.approx(0.25, abs=0.03)
    ripples_m = synthetic_walls.rippled(seen, 0.001, 4.0, np.random.default_rng(0)) - seen.depth_m
    assert np.abs(ripples_m).max() == pytest.approx(0.001, rel=0.01)


@pytest.mark.parametrize(
    ("yaw_deg", "pitch_deg", "x_m", "gap_m"), [(45.0, 0.0, 0.2, 0.1), (60.0, -9.0, 0.15, 0.07)]
)
def test_scene_rays_are_the_renderers(
    yaw_deg: float, pitch_deg: float, x_m: float, gap_m: float
) -> None:
    lidar = LidarPose(distance_m=0.2, yaw_deg=yaw_deg, pitch_deg=pitch_deg)
    rig = PAPER.model_copy(update={"lidar": lidar, "occluder": Occluder(x_m=x_m, z_min_m=gap_m)})
    beams = cast(rig, SMALL_PAPER)
    seen = synthetic_walls.View(rig.wall_from_lidar, SMALL_PAPER)
    depth_m = scenes.bench_depth(seen, scenes.Sheet(x_m, gap_m)).ravel()
    met = (
        np.isfinite(beams.length_m)
        & (beams.laser_spot_m[:, 0] < 2.0)
        & (np.abs(beams.laser_spot_m[:, 1]) < 1.5)
    )
    np.testing.assert_allclose(depth_m[met], (beams.length_m * beams.cos_axis)[met], rtol=1e-9)
    assert (~beams.on_wall & met).any()


def test_tilted_sheet_is_at_its_parameters() -> None:
    seen = synthetic_walls.view(0.2, 45.0, 0.0, SMALL_PAPER)
    occluding_sheet = scenes.Sheet(
        lean_deg=10.0, twist_deg=-5.0, edge_deg=4.0, height_m=0.05, bottom_m=-0.03, top_m=0.04
    )
    depth_m = scenes.bench_depth(seen, occluding_sheet)
    bare_m = scenes.bench_depth(seen, None)
    on = depth_m < bare_m
    x, y, z = (
        seen.pose[:3, 3] + (SMALL_PAPER.rays() * depth_m[..., np.newaxis])[on] @ seen.pose[:3, :3].T
    ).T
    lean, twist, edge = np.tan(np.radians([10.0, -5.0, 4.0]))
    assert np.allclose(x, 0.2 + lean * (z - 0.1) + twist * y)
    above_m = z - 0.1 - edge * y
    assert on.sum() > 50
    assert above_m.min() >= -1e-9
    assert above_m.max() <= 0.05
    assert -0.03 <= y.min() <= y.max() <= 0.04


def test_sheet_mixes_only_pixels_on_its_edge() -> None:
    seen = synthetic_walls.view(0.2, 45.0, 0.0, SMALL_PAPER)
    occluding_sheet = scenes.Sheet(gap_m=0.103)
    sharp = scenes.bench_depth(seen, occluding_sheet)
    mixed = scenes.bench_depth(seen, occluding_sheet, beams=9)
    off = np.abs(mixed - sharp) > 0.01
    assert off.sum(axis=1).max() == 1
    assert off.any()


def test_ball_is_round() -> None:
    seen = synthetic_walls.view(0.2, 45.0, 0.0, SMALL_PAPER)
    depth_m = scenes.ball(seen, (0.15, 0.01, 0.12), 0.04)
    hit = np.isfinite(depth_m)
    points = (
        seen.pose[:3, 3]
        + (SMALL_PAPER.rays()[hit] * depth_m[hit][:, np.newaxis]) @ seen.pose[:3, :3].T
    )
    assert hit.sum() > 100
    assert np.allclose(np.linalg.norm(points - [0.15, 0.01, 0.12], axis=1), 0.04)


def test_paper_and_toner_have_their_counts() -> None:
    """Without a spot: the falloff of a bare wall, its brightest pixel at the gain, toner at its
    albedo.
    """
    seen = synthetic_walls.View(RIG.wall_from_lidar, PINHOLE)
    light = scenes.Illumination(spot_mm=0.0)
    away = scenes.Placement(50.0)
    placed = scenes.at_near_edge(A4, seen)
    bare, with_board = (scenes.clean_infrared(A4, seen, where, light) for where in (away, placed))
    assert bare.max() == pytest.approx(48.0)
    points = seen.pinhole.rays() * seen.depth_m[..., np.newaxis]
    length_m = np.linalg.norm(points, axis=-1)
    lit = seen.depth_m < 2.0
    inverse_cube = bare[lit] * length_m[lit] ** 3
    np.testing.assert_allclose(inverse_cube, inverse_cube[0], rtol=1e-3)
    albedo = with_board[bare > 1.0] / bare[bare > 1.0]
    assert albedo.min() == pytest.approx(scenes.TONER, abs=1e-3)
    assert albedo.max() == pytest.approx(1.0, abs=1e-3)


def test_board_placement_is_at_its_parameters() -> None:
    placed = scenes.Placement(0.2, 0.03, 0.0, scale=0.97, stretch=1.01)
    middle = np.array([*(size * 0.5e-3 for size in A4.size_mm), 1.0])
    np.testing.assert_allclose(
        placed.wall_from_board(A4) @ middle, [0.2, 0.03, 0.0, 1.0], atol=1e-12
    )
    across = placed.wall_from_board(A4)[:2, 0]
    down = placed.wall_from_board(A4)[:2, 1]
    assert np.linalg.norm(across) / np.linalg.norm(down) == pytest.approx(1.01)
    assert np.linalg.norm(across) * np.linalg.norm(down) == pytest.approx(0.97**2)
    assert down[1] < 0.0  # the sheet's y runs down the wall


def test_frames_have_the_lidars_noise_and_saturate() -> None:
    clean = np.full((40, 50), 25.0)
    frames = scenes.infrared_frames(clean, np.random.default_rng(0), 50).astype(float)
    assert frames.mean() == pytest.approx(25.0, abs=0.05)
    assert frames.std() == pytest.approx(np.sqrt(0.7**2 + 0.09 * 25.0 + 1.0 / 12.0), rel=0.02)
    assert scenes.infrared_frames(np.full((2, 2), 400.0), np.random.default_rng(0), 1).max() == 255


def test_reference_matches_one_collected_from_frames() -> None:
    generator = np.random.default_rng(0)
    drawn = scenes.reference_of_wall(POSE, TINY, generator)
    collected = BareWallStatistics(TINY)
    truth_m = wall_depth(scenes.wall_from_lidar(POSE), TINY)
    cells = np.zeros((64, 80), np.float32)
    for _ in range(scenes.REFERENCE_FRAMES):
        collected.add(
            scenes.noisy_depth(truth_m, generator).astype(np.float32),
            np.full((60, 80), 40, np.uint8),
            cells,
            cells,
        )
    wall = collected.reference(drawn.inliers, serial="", settings={})
    for reference in (drawn, wall):
        pulls = (
            (reference.depth_m - truth_m)
            / (0.0005 + 0.002 * truth_m)
            * np.sqrt(scenes.REFERENCE_FRAMES)
        )
        assert np.nanstd(pulls) == pytest.approx(1.0, abs=0.05)
    assert np.nanmean(drawn.depth_std_m / wall.depth_std_m) == pytest.approx(1.0, abs=0.03)
    assert set(vars(drawn)) == set(vars(wall))
    for name in ("depth_m", "ir", "saturated", "map_depth_m"):
        assert getattr(drawn, name).dtype == getattr(wall, name).dtype
        assert getattr(drawn, name).shape == getattr(wall, name).shape


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
