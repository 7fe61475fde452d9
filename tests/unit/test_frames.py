"""Frames to maps: which pixel falls in which cell, and the values of a cell; and running means of
maps.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nlos_calibration.geometry import Intrinsics

from nlos_cam.frames import (
    MAP_COLUMNS,
    MAP_ROWS,
    Frame,
    LidarMaps,
    MapMean,
    _edges,
    maps_from_frame,
)
from nlos_cam.render.sensor.sensor import cell_of_pixels

SIZES = [(480, 640), (240, 320), (768, 1024), (64, 80), (100, 90), (32, 40)]
PINHOLE = Intrinsics(640, 480, 457.0, 461.0, 319.5, 239.5)


def _frame(depth_m: np.ndarray, ir: np.ndarray | int = 10) -> Frame:
    counts = np.broadcast_to(np.uint8(ir), depth_m.shape).copy()
    confidence = np.full(depth_m.shape, 15, np.uint8)
    return Frame(depth_m.astype(np.float32), counts, confidence, 0.0, 0, PINHOLE)


def _maps(depth_m: np.ndarray, ir: np.ndarray | int = 10) -> LidarMaps:
    return maps_from_frame(_frame(depth_m, ir))


@pytest.mark.parametrize(
    ("pixels", "cells"), [(size[k], (MAP_ROWS, MAP_COLUMNS)[k]) for size in SIZES for k in (0, 1)]
)
def test_edges_give_pixels_to_cells_that_hold_their_centres(pixels: int, cells: int) -> None:
    edges = _edges(pixels, cells)

    assert edges[0] == 0
    assert edges[-1] == pixels
    assert len(edges) == cells + 1
    assert (np.diff(edges) >= 0).all()

    found = np.searchsorted(edges, np.arange(pixels), side="right") - 1

    assert found.tolist() == [int((k + 0.5) * cells / pixels) for k in range(pixels)]


@settings(max_examples=30, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**16), valid=st.integers(0, 60), values=st.sampled_from([1, 2, 5, 1000])
)
def test_median_equals_numpys_for_every_count_and_tie(seed: int, valid: int, values: int) -> None:
    generator = np.random.default_rng(seed)
    cells = np.full((64 * 80, 60), np.nan, np.float32)
    cells[:, :valid] = 0.2 + 0.001 * generator.integers(0, values, (64 * 80, valid))
    cells = generator.permuted(cells, axis=1)
    # 512 rows: every cell is 8 rows of 8 columns, four of its 64 pixels without a return
    whole = np.concatenate([cells, np.full((64 * 80, 4), np.nan, np.float32)], axis=1)
    depth = whole.reshape(64, 80, 8, 8).transpose(0, 2, 1, 3).reshape(512, 640)
    maps = _maps(depth)
    expected = (
        np.median(cells[:, :, None][~np.isnan(cells)].reshape(64 * 80, valid), axis=1)
        if valid
        else np.nan
    )

    np.testing.assert_allclose(maps.depth_m.ravel(), expected, rtol=1e-6)


def test_intensity_is_the_mean_over_samples_near_the_median() -> None:
    depth = np.full((512, 640), 0.5)
    ir = np.full((512, 640), 20, np.uint8)
    depth[:8, :3] = 0.8
    ir[:8, :3] = 200  # another winner in 24 of the first cell's 64 pixels
    depth[0, 7] = 0.509
    ir[0, 7] = 60
    depth[1, 7] = 0.511
    ir[1, 7] = 240
    maps = _maps(depth, ir)

    assert maps.depth_m[0, 0] == np.float32(0.5)
    assert maps.intensity[0, 0] == pytest.approx((38 * 20 + 60) / 39)
    assert maps.intensity[0, 1] == 20


def test_two_balanced_winners_give_an_intensity() -> None:
    depth = np.full((512, 640), 0.4)
    ir = np.full((512, 640), 10, np.uint8)
    depth[:, ::2] = 0.8
    ir[:, ::2] = 30
    maps = _maps(depth, ir)

    assert maps.valid.all()
    assert ((maps.depth_m >= np.float32(0.4)) & (maps.depth_m <= np.float32(0.8))).all()
    assert ((maps.intensity >= 10) & (maps.intensity <= 30)).all()


@pytest.mark.parametrize("nothing", [np.nan, 0.0, -0.1, np.inf, -np.inf])
def test_invalid_depth_does_not_count_in_a_cell(nothing: float) -> None:
    depth = np.full((480, 640), 0.5)
    ir = np.full((480, 640), 10, np.uint8)
    depth[::2] = nothing
    ir[::2] = 255
    depth[:15, :8] = nothing  # two whole cells
    maps = _maps(depth, ir)

    assert maps.depth_m.shape == maps.intensity.shape == maps.valid.shape == (MAP_ROWS, MAP_COLUMNS)
    assert maps.depth_m.dtype == maps.intensity.dtype == np.float32
    np.testing.assert_array_equal(np.argwhere(~maps.valid), [[0, 0], [1, 0]])
    np.testing.assert_array_equal(maps.depth_m, np.where(maps.valid, np.float32(0.5), np.nan))
    np.testing.assert_array_equal(maps.intensity, np.where(maps.valid, 10, 0))


@settings(max_examples=15, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**16), size=st.sampled_from(SIZES[:4]), share=st.floats(0, 1))
def test_maps_stay_within_the_range_of_the_frame(
    seed: int, size: tuple[int, int], share: float
) -> None:
    generator = np.random.default_rng(seed)
    depth = generator.uniform(0.1, 9, size).astype(np.float32)
    depth[generator.random(size) < share] = np.nan
    ir = generator.integers(0, 256, size, np.uint8)
    maps = _maps(depth, ir)

    np.testing.assert_array_equal(maps.valid, ~np.isnan(maps.depth_m))
    assert (maps.intensity[~maps.valid] == 0).all()

    if maps.valid.any():
        assert np.nanmin(depth) <= np.nanmin(maps.depth_m)
        assert np.nanmax(maps.depth_m) <= np.nanmax(depth)

    assert maps.intensity.max() <= 255


@pytest.mark.parametrize("size", SIZES[:3])
def test_simulated_sensor_spreads_cells_as_maps_gather_them(size: tuple[int, int]) -> None:
    cell = cell_of_pixels(size, (MAP_ROWS, MAP_COLUMNS)).reshape(size)
    maps = _maps(cell + 1)

    np.testing.assert_array_equal(maps.depth_m.ravel(), np.arange(MAP_ROWS * MAP_COLUMNS) + 1)


def noise(number: int, valid_share: float = 0.8) -> LidarMaps:
    """Make maps as of a device: depth in quarters of a millimetre, and no return here and there."""
    generator = np.random.default_rng(number)
    depth_m = (0.00025 * generator.integers(1, 40_000, (64, 80))).astype(np.float32)
    depth_m[generator.random((64, 80)) > valid_share] = np.nan
    valid = ~np.isnan(depth_m)
    return LidarMaps(
        depth_m, np.where(valid, generator.uniform(1, 255, (64, 80)), 0.0).astype(np.float32), valid
    )


def mean_of(maps: list[LidarMaps]) -> LidarMaps:
    """Compute the mean by its definition."""
    valid = np.stack([each.valid for each in maps])
    count = valid.sum(axis=0)
    seen = valid.any(axis=0)
    depth_m = np.stack([each.depth_m for each in maps]).astype(np.float64).sum(axis=0, where=valid)
    intensity = (
        np.stack([each.intensity for each in maps]).astype(np.float64).sum(axis=0, where=valid)
    )
    depth_m, intensity = (
        np.where(seen, total / np.maximum(count, 1), np.nan) for total in (depth_m, intensity)
    )
    return LidarMaps(depth_m.astype(np.float32), np.nan_to_num(intensity).astype(np.float32), seen)


def assert_equal(one: LidarMaps, other: LidarMaps) -> None:
    np.testing.assert_array_equal(one.depth_m, other.depth_m)
    np.testing.assert_array_equal(one.intensity, other.intensity)
    np.testing.assert_array_equal(one.valid, other.valid)
    assert one.depth_m.dtype == one.intensity.dtype == np.float32


@pytest.mark.parametrize("frames", [1, 2, 5])
@pytest.mark.parametrize("valid_share", [1.0, 0.5, 0.05])
def test_map_mean_is_over_the_last_valid_values(frames: int, valid_share: float) -> None:
    mean = MapMean(frames)
    given = [noise(number, valid_share) for number in range(12)]
    for number, maps in enumerate(given):
        found = mean.add(maps)
        assert_equal(found, mean_of(given[max(0, number + 1 - frames) : number + 1]))
        assert frames > 1 or found is maps


def test_map_mean_accumulates_no_error() -> None:
    mean = MapMean(7)
    given = [noise(number) for number in range(50)]
    for turn in range(4000):
        found = mean.add(given[turn % 50])

    assert_equal(found, mean_of([given[turn % 50] for turn in range(3993, 4000)]))


def test_map_mean_neither_changes_nor_keeps_its_input() -> None:
    mean = MapMean(2)
    maps = noise(3)
    again = noise(3)
    first = mean.add(maps)
    kept = first.depth_m.copy()
    maps.depth_m[:] = 9.0
    mean.add(noise(4))

    np.testing.assert_array_equal(first.depth_m, kept)
    assert_equal(mean.add(noise(5)), mean_of([noise(4), noise(5)]))
    np.testing.assert_array_equal(kept, again.depth_m)


def test_images_of_two_shapes_are_refused() -> None:
    whole = _frame(np.ones((480, 640)))
    frame = replace(whole, ir=np.zeros((240, 320), np.uint8))

    with pytest.raises(ValueError, match=r"\(240, 320\)"):
        maps_from_frame(frame)


def test_depth_in_float64_is_the_same_as_in_float32() -> None:
    frame = _frame(np.linspace(0.2, 2.0, 480 * 640).reshape(480, 640))
    wide = replace(frame, depth_m=frame.depth_m.astype(np.float64))

    np.testing.assert_array_equal(maps_from_frame(wide).depth_m, maps_from_frame(frame).depth_m)
