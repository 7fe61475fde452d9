"""Maps of any bench on one grid of the relay wall: seen cells agree, unseen ones have no return."""

from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from nlos_calibration import Rig, load_rig
from nlos_calibration.arrays import Float32
from nlos_models import load_record, shipped_folder

from nlos_cam.errors import SceneError
from nlos_cam.frames import LidarMaps
from nlos_cam.objects import benchmark_objects, object_box
from nlos_cam.reconstruct import (
    WALL_GRID,
    CalibratedRig,
    MapAlignment,
    Pipeline,
    grid_refusal,
    is_wall_grid,
)
from nlos_cam.reconstruct.alignment import can_align
from nlos_cam.reconstruct.wall_grid import NUMBERS_COLUMN, numbers_column, rig_numbers
from nlos_cam.render import QUIET, Scene, Sensor, render

HOME = load_rig("paper-rig")
THING = benchmark_objects(object_box(HOME))[4].depth_m


def rig(box_up_m: float = 0.0, **lidar: float) -> Rig:
    box = object_box(HOME)
    moved = {"y_min_m": box.y_min_m + box_up_m, "y_max_m": box.y_max_m + box_up_m}
    changes: dict[str, Any] = {
        "lidar": HOME.lidar.model_copy(update=lidar),
        "object_box": box.model_copy(update=moved),
    }
    return HOME.model_copy(update=changes)


NEAR = rig(distance_m=0.16)
TURNED = rig(yaw_deg=35.0, distance_m=0.23)


def resized() -> Rig:
    box = object_box(HOME)
    return HOME.model_copy(
        update={"object_box": box.model_copy(update={"z_far_m": box.z_far_m + 0.05})}
    )


def on_grid(bench: Rig, depth_m: Float32 | None = None) -> LidarMaps:
    seen = Sensor(bench, QUIET).maps(render(Scene(bench, depth_m), "draft").multi, None)
    return MapAlignment(bench, WALL_GRID).align(seen)


def cells_of(*maps: LidarMaps) -> Any:
    both = np.logical_and.reduce([one.valid for one in maps])
    both[:, NUMBERS_COLUMN] = False
    return both


def test_grid_is_known_by_its_checksum() -> None:
    assert is_wall_grid(Rig.model_validate(WALL_GRID.model_dump()))
    assert not is_wall_grid(HOME)


@pytest.mark.parametrize("bench", [NEAR, TURNED], ids=["near", "turned"])
def test_bare_walls_agree_where_both_benches_see(bench: Rig) -> None:
    home, there = on_grid(HOME), on_grid(bench)
    both = cells_of(home, there)

    assert both.sum() > 500
    off_m = np.abs(home.depth_m - there.depth_m)[both]
    assert np.quantile(off_m, 0.98) < 1e-3
    log_ratio = np.log(there.intensity[both] / home.intensity[both])
    assert np.quantile(np.abs(log_ratio - np.median(log_ratio)), 0.95) < 0.08  # but for the gain


@pytest.mark.parametrize("bench", [NEAR, TURNED], ids=["near", "turned"])
def test_echoes_of_an_object_agree_within_two_bins(bench: Rig) -> None:
    bare, home, there = on_grid(HOME), on_grid(HOME, THING), on_grid(bench, THING)
    both = cells_of(home, there, bare)
    echo = both & (home.depth_m > bare.depth_m + 0.02) & (there.depth_m > bare.depth_m + 0.02)

    assert echo.sum() > 100
    off_m = np.abs(home.depth_m - there.depth_m)[echo]
    assert np.median(off_m) < HOME.device.bin_m


def test_what_a_bench_does_not_see_has_no_return() -> None:
    near, home = on_grid(NEAR), on_grid(HOME)

    assert 0.2 < home.valid.mean() < 0.8
    # nearer to the wall the lidar sees farther past the occluder's edge
    assert (
        near.valid.any(axis=0)[:-1].nonzero()[0].max()
        > home.valid.any(axis=0)[:-1].nonzero()[0].max()
    )


def test_numbers_of_the_mirrored_rig_are_mirrored() -> None:
    tilted = numbers_column(rig_numbers(rig(0.005, pitch_deg=1.5)))
    mirrored = numbers_column(rig_numbers(rig(-0.005, pitch_deg=-1.5)))

    np.testing.assert_array_equal(mirrored, tilted[::-1])
    assert not np.array_equal(mirrored, tilted)


def test_numbers_stand_in_the_last_column() -> None:
    column = on_grid(TURNED).depth_m[:, NUMBERS_COLUMN]

    np.testing.assert_array_equal(column, numbers_column(rig_numbers(TURNED)))


def test_frame_without_a_return_stays_empty() -> None:
    nothing = np.full((64, 80), np.nan, np.float32)
    dark = LidarMaps(nothing, np.zeros_like(nothing), np.zeros(nothing.shape, bool))

    for frame in (WALL_GRID, rig(distance_m=0.205)):
        assert not MapAlignment(TURNED, frame).align(dark).valid.any()


@pytest.mark.parametrize(
    ("bench", "why"),
    [
        (HOME.model_copy(update={"occluder": None}), "occluder"),
        (HOME.model_copy(update={"object_box": None}), "no object box"),
        (resized(), "another size"),
        (HOME, ""),
    ],
)
def test_refusal_names_what_the_grid_needs(bench: Rig, why: str) -> None:
    refusal = grid_refusal(bench)

    assert why in refusal
    assert bool(refusal) == bool(why)


def test_pipeline_refuses_a_bench_that_its_weights_cannot_see() -> None:
    trained = load_record(shipped_folder()).model_copy(update={"rig_checksum": WALL_GRID.checksum})
    bare = CalibratedRig(HOME.model_copy(update={"occluder": None}))

    with pytest.raises(SceneError, match="choose others with --weights"):
        Pipeline(bare, Mock(), trained=trained)


def test_rig_without_an_occluder_cannot_be_aligned() -> None:
    bare = HOME.model_copy(update={"occluder": None})

    assert not can_align(bare, WALL_GRID)
    with pytest.raises(SceneError, match="no occluder"):
        rig_numbers(bare)


def test_numbers_of_the_papers_rig_are_of_about_one_unit() -> None:
    assert np.all(np.abs(rig_numbers(HOME)) <= 1.5)


@pytest.mark.parametrize(
    ("place", "name", "change"),
    [(0, "distance_m", 0.01), (1, "yaw_deg", 4.0), (5, "pitch_deg", 0.4)],
)
def test_a_number_follows_its_own_length_or_angle(place: int, name: str, change: float) -> None:
    moved = rig(**{name: getattr(HOME.lidar, name) + change})
    rise = rig_numbers(moved) - rig_numbers(HOME)

    assert rise[place] == pytest.approx(0.2, rel=1e-3)
    assert np.delete(rise, place) == pytest.approx(np.zeros(6), abs=1e-6)
