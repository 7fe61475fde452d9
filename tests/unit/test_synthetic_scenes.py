"""Synthetic walls, sheets, boards and drifting streams deviate from the truth by their
parameters.
"""

import numpy as np
import pytest
import synthetic_scenes as scenes
import synthetic_walls as walls
from nlos_calibration import (
    BOARDS,
    BareWall,
    BareWallStatistics,
    LidarPose,
    Occluder,
    load_rig,
    wall_depth,
)
from synthetic_walls import View, view

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
    seen = view(0.2, 20.0, 5.0, SMALL_BARE)
    depth_m, main = walls.bent(seen, bend_deg, 0.4, direction_rad)
    _, other = walls.bent(seen, bend_deg, 0.6, direction_rad)

    assert main is seen

    turn_deg = np.degrees(np.arccos(other.pose[2, :3] @ seen.pose[2, :3]))

    assert turn_deg == pytest.approx(abs(bend_deg))

    first = depth_m == seen.depth_m

    assert first.mean() == pytest.approx(0.6, abs=0.03)

    fold = first[:, 1:] != first[:, :-1]

    assert fold.any()
    assert np.abs(np.diff(depth_m, axis=1))[fold].max() < 0.01


OBLIQUE = view(0.2, 30.0, 0.0, SMALL_BARE)


def heights_m(depth_m: np.ndarray) -> np.ndarray:
    """Return the heights of depths over the oblique wall."""
    return 0.2 + depth_m * (SMALL_BARE.rays() @ OBLIQUE.pose[2, :3])


def test_step_is_as_high_as_it_says() -> None:
    found_m = heights_m(walls.stepped(OBLIQUE, 0.004, 0.3))
    assert np.allclose(np.unique(found_m.round(9)), [0.0, 0.004])


def test_half_of_a_window_is_behind_its_frame() -> None:
    found_m = heights_m(walls.window(OBLIQUE, 0.01))

    assert np.allclose(np.unique(found_m.round(9)), [-0.01, 0.0])
    assert (found_m < -0.005).mean() == pytest.approx(0.5, abs=0.1)


def test_curved_wall_is_off_the_plane() -> None:
    assert np.abs(heights_m(walls.curved(OBLIQUE, 1.0))).max() > 0.002


def test_patch_has_its_share_of_the_view() -> None:
    assert walls.patch(OBLIQUE, 0.25).mean() == pytest.approx(0.25, abs=0.03)


def test_ripples_have_their_amplitude() -> None:
    rippled_m = walls.rippled(OBLIQUE, 0.001, 4.0, np.random.default_rng(0))
    ripples_m = rippled_m - OBLIQUE.depth_m

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
    seen = View(rig.wall_from_lidar, SMALL_PAPER)
    depth_m = scenes.bench_depth(seen, scenes.Sheet(x_m, gap_m)).ravel()
    met = (
        np.isfinite(beams.length_m)
        & (beams.laser_spot_m[:, 0] < 2.0)
        & (np.abs(beams.laser_spot_m[:, 1]) < 1.5)
    )

    np.testing.assert_allclose(depth_m[met], (beams.length_m * beams.cos_axis)[met], rtol=1e-9)
    assert (~beams.on_wall & met).any()


def test_tilted_sheet_is_at_its_parameters() -> None:
    seen = view(0.2, 45.0, 0.0, SMALL_PAPER)
    occluding_sheet = scenes.Sheet(
        lean_deg=10.0, twist_deg=-5.0, edge_deg=4.0, height_m=0.05, bottom_m=-0.03, top_m=0.04
    )
    depth_m = scenes.bench_depth(seen, occluding_sheet)
    bare_m = scenes.bench_depth(seen, None)
    on = depth_m < bare_m
    points = (SMALL_PAPER.rays() * depth_m[..., np.newaxis])[on]
    x, y, z = (seen.pose[:3, 3] + points @ seen.pose[:3, :3].T).T
    lean, twist, edge = np.tan(np.radians([10.0, -5.0, 4.0]))

    assert np.allclose(x, 0.2 + lean * (z - 0.1) + twist * y)

    above_m = z - 0.1 - edge * y

    assert on.sum() > 50
    assert above_m.min() >= -1e-9
    assert above_m.max() <= 0.05
    assert -0.03 <= y.min() <= y.max() <= 0.04


def test_sheet_mixes_only_pixels_on_its_edge() -> None:
    seen = view(0.2, 45.0, 0.0, SMALL_PAPER)
    occluding_sheet = scenes.Sheet(gap_m=0.103)
    sharp = scenes.bench_depth(seen, occluding_sheet)
    mixed = scenes.bench_depth(seen, occluding_sheet, beams=9)
    off = np.abs(mixed - sharp) > 0.01

    assert off.sum(axis=1).max() == 1
    assert off.any()


def test_ball_is_round() -> None:
    seen = view(0.2, 45.0, 0.0, SMALL_PAPER)
    depth_m = scenes.ball(seen, (0.15, 0.01, 0.12), 0.04)
    hit = np.isfinite(depth_m)
    seen_m = SMALL_PAPER.rays()[hit] * depth_m[hit][:, np.newaxis]
    points_m = seen.pose[:3, 3] + seen_m @ seen.pose[:3, :3].T
    radius_m = np.linalg.norm(points_m - [0.15, 0.01, 0.12], axis=1)

    assert hit.sum() > 100
    assert np.allclose(radius_m, 0.04)


def test_paper_and_toner_have_their_counts() -> None:
    """Without a spot: the falloff of a bare wall, its brightest pixel at the gain, toner at its
    albedo.
    """
    seen = View(RIG.wall_from_lidar, PINHOLE)
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


@pytest.mark.parametrize("name", ["drawn", "collected"])
def test_reference_is_as_noisy_as_a_mean_of_its_frames(
    request: pytest.FixtureRequest, truth_m: np.ndarray, name: str
) -> None:
    reference = request.getfixturevalue(name)
    std_m = (0.0005 + 0.002 * truth_m) / np.sqrt(scenes.REFERENCE_FRAMES)

    assert np.nanstd((reference.depth_m - truth_m) / std_m) == pytest.approx(1.0, abs=0.05)


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
