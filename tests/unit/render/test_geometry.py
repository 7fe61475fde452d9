import numpy as np
import pytest
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.rig import Extent, LidarPose, Rig, load_rig

from nlos_cam.render import cast
from nlos_cam.render.geometry import (
    NO_OCCLUDER,
    SPEED_OF_LIGHT_M_PER_S,
    behind,
    gate_bins,
    occluder_edge,
    relay_cells,
)

BARE = load_rig("bare-wall")
PAPER = load_rig("paper-rig")


def _cells(rig: Rig) -> Intrinsics:
    return rig.pinhole.scaled(80, 64)


def _lidar(**pose: float) -> Rig:
    return BARE.model_copy(
        update={"lidar": LidarPose.model_validate({"distance_m": 0.2, "yaw_deg": 45.0} | pose)}
    )


@pytest.mark.parametrize("yaw_deg", [0.0, 15.0, 45.0, -45.0])
@pytest.mark.parametrize("pitch_deg", [0.0, 10.0])
def test_beams_land_on_the_wall_along_the_rays_of_their_pixels(
    yaw_deg: float, pitch_deg: float
) -> None:
    rig = _lidar(yaw_deg=yaw_deg, pitch_deg=pitch_deg)
    beams = cast(rig, _cells(rig))

    np.testing.assert_allclose(
        beams.laser_spot_m[beams.on_wall, 2],
        0,
        atol=1e-12,
    )

    pose = rig.wall_from_lidar
    back = (beams.laser_spot_m[beams.on_wall] - pose[:3, 3]) @ pose[:3, :3]
    rays = _cells(rig).rays().reshape(-1, 3)[beams.on_wall]

    np.testing.assert_allclose(back / back[:, 2:], rays, atol=1e-9)
    np.testing.assert_allclose(
        np.linalg.norm(back, axis=1),
        beams.length_m[beams.on_wall],
    )
    np.testing.assert_allclose(
        back[:, 2] / np.linalg.norm(back, axis=1), beams.cos_axis[beams.on_wall]
    )


def test_direct_return_scales_with_distance_and_receiver_cell() -> None:
    near, far = (
        cast(
            _lidar(distance_m=d),
            _cells(BARE),
        )
        for d in (0.15, 0.3)
    )
    both = near.on_wall & far.on_wall

    np.testing.assert_allclose(far.length_m[both], 2 * near.length_m[both])
    np.testing.assert_allclose(far.direct[both], near.direct[both] / 4)

    device = BARE.device.model_copy(update={"receiver_cell_m2": 3e-4})
    beams = cast(BARE, _cells(BARE))

    np.testing.assert_allclose(
        cast(
            BARE.model_copy(update={"device": device}),
            _cells(BARE),
        ).direct,
        3 * beams.direct,
    )

    fine = cast(BARE, BARE.pinhole.scaled(243, 195))
    coarse = cast(BARE, BARE.pinhole.scaled(81, 65))

    np.testing.assert_allclose(
        fine.direct.reshape(195, 243)[1::3, 1::3].ravel(), coarse.direct, rtol=1e-9
    )


def test_beams_end_at_the_wall_edge_and_at_the_occluder() -> None:
    small = BARE.model_copy(
        update={
            "wall": Extent(
                x_min_m=0,
                x_max_m=0.3,
                y_min_m=-0.1,
                y_max_m=0.1,
            )
        }
    )
    beams = cast(small, _cells(small))
    feet = beams.laser_spot_m[beams.on_wall]

    assert (np.abs(feet - (0.15, 0, 0)) <= (0.15, 0.1, 1e-9)).all()
    assert np.isnan(beams.length_m[~beams.on_wall]).all()

    beams = cast(PAPER, _cells(PAPER))
    free = cast(BARE, _cells(BARE))
    stopped = np.isfinite(beams.length_m) & ~beams.on_wall

    assert stopped.any()
    np.testing.assert_allclose(beams.laser_spot_m[stopped, 0], 0.2)
    assert (beams.laser_spot_m[stopped, 2] >= 0.1).all()

    reached = beams.on_wall

    np.testing.assert_allclose(beams.length_m[reached], free.length_m[reached])

    degrees = np.degrees(
        np.arctan2(
            beams.laser_spot_m[stopped, 0],
            0.2 - beams.laser_spot_m[stopped, 2],
        )
    )

    assert degrees.min() > 63


def test_direct_return_after_the_gate_is_not_received() -> None:
    gate_m = 0.8
    device = BARE.device.model_copy(update={"gate_s": gate_m / SPEED_OF_LIGHT_M_PER_S})
    beams = cast(BARE.model_copy(update={"device": device}), _cells(BARE))
    late = 2 * beams.length_m >= gate_m

    assert 0 < late.sum() < late.size
    assert (beams.direct[late] == 0).all()
    assert (beams.direct[~late] > 0).all()


def test_beams_met_takes_the_place_of_the_wall() -> None:
    beams = cast(BARE, _cells(BARE))
    met = beams.with_hits(
        BARE, np.array([7]), np.array([0.1]), np.array([0.5]), np.array([0.25]), 2 * np.pi
    )

    assert not met.on_wall[7]
    np.testing.assert_allclose(
        met.laser_spot_m[7],
        beams.lidar_m + 0.1 * beams.direction[7],
    )
    assert met.direct[7] == pytest.approx(
        0.25 * 0.5 * 1e-4 / (2 * np.pi * 0.01),
        rel=0.02,
    )

    others = np.arange(5120) != 7

    np.testing.assert_array_equal(met.direct[others], beams.direct[others])


@pytest.mark.parametrize(
    ("gate_m", "bins"),
    [(0.999, 100), (1.001, 101), (1e-6, 1)],
)
def test_gate_bins_begin_inside_the_gate(gate_m: float, bins: int) -> None:
    device = BARE.device.model_copy(update={"gate_s": gate_m / SPEED_OF_LIGHT_M_PER_S})
    assert gate_bins(device) == bins


def test_cast_is_cached_and_read_only() -> None:
    beams = cast(PAPER, _cells(PAPER))

    assert cast(PAPER, _cells(PAPER)) is beams

    with pytest.raises(ValueError, match="read-only"):
        beams.direct[0] = 1


LIDAR_M = np.array([0.0, 0.0, 0.2])


@pytest.mark.parametrize(
    ("columns", "rows"),
    [
        (80, 64),
        (40, 32),
        (1, 1),
        (7, 3),
    ],
)
def test_relay_cells_cover_the_wall_exactly(columns: int, rows: int) -> None:
    relay, wall = relay_cells(BARE, LIDAR_M, columns, rows), BARE.relay

    assert len(relay.x_m) == len(relay.y_m) == len(relay.length_m) == columns * rows

    area = (wall.x_max_m - wall.x_min_m) * (wall.y_max_m - wall.y_min_m)

    assert relay.cell_m2 * columns * rows == pytest.approx(area)
    assert relay.x_m.mean() == pytest.approx((wall.x_min_m + wall.x_max_m) / 2)
    assert relay.y_m.mean() == pytest.approx((wall.y_min_m + wall.y_max_m) / 2)
    assert (
        len(
            set(
                zip(
                    relay.x_m,
                    relay.y_m,
                    strict=True,
                )
            )
        )
        == columns * rows
    )
    assert relay.diagonal_m**2 >= 2 * relay.cell_m2 - 1e-15


def test_relay_cells_and_points_behind_the_edge_are_hidden() -> None:
    """From (0, 0.2) over the edge at (0.2, 0.1) the line of sight meets the wall at x = 0.4."""
    relay = relay_cells(PAPER, LIDAR_M, 80, 64)

    assert occluder_edge(PAPER) == (0.2, 0.1)

    hidden = relay.behind(occluder_edge(PAPER), LIDAR_M)

    np.testing.assert_array_equal(hidden, relay.x_m > 0.4)

    kept = relay.select(~hidden)

    assert len(kept.x_m) == len(kept.y_m) == len(kept.cos_lidar) == 64 * 64
    assert kept.cell_m2 == relay.cell_m2
    assert kept.diagonal_m == relay.diagonal_m
    assert occluder_edge(BARE) == NO_OCCLUDER
    assert not relay.behind(NO_OCCLUDER, LIDAR_M).any()
    assert relay.behind((0.2, 1e-6), LIDAR_M).sum() == (relay.x_m > 0.2).sum()

    x = np.array([0.4, 0.4, 0.1, 0.0])
    z = np.array([0.3, -0.1, 0.3, 0.3])

    np.testing.assert_array_equal(
        behind((0.2, 0.1), x, z, LIDAR_M),
        [True, False, False, False],
    )
