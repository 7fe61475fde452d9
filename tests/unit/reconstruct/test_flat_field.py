"""The wall's reflectance and the lidar's ripples, as the bare wall's record shows them, are taken out
of a frame.
"""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nlos_calibration import Rig, load_rig

from nlos_cam.evaluate import sense
from nlos_cam.frames import LidarMaps
from nlos_cam.objects import object_box, object_depth
from nlos_cam.reconstruct import measured_counts
from nlos_cam.reconstruct.flat_field import FlatField
from nlos_cam.reconstruct.physics_check import UNEXPLAINED_EMPTY, check_reconstruction
from nlos_cam.render import Scene, SensorModel, render

HOME = load_rig("paper-rig")
RIG = HOME.model_copy(
    update={"lidar": HOME.lidar.model_copy(update={"distance_m": 0.24, "yaw_deg": 57.0})}
)
"""Its occluder fills more of the view than at home, and is brighter than the wall."""
QUIET = SensorModel(read_noise_counts=0.0, shot_noise=0.0, range_noise_m=0.0, range_noise_per_m=0.0)
ROUNDED_M = 0.0003
"""Depths are whole quarters of a millimeter."""
EMPTY = render(Scene(RIG)).multi
OBJECT = render(Scene(RIG, object_depth(700, object_box(RIG))[1])).multi


def bench_of(maps: LidarMaps, rig: Rig = RIG) -> Any:
    """A bench whose reference is of these maps."""
    reference = SimpleNamespace(map_depth_m=maps.depth_m, map_intensity=maps.intensity)
    return SimpleNamespace(rig=rig, reference=reference, range_offset_m=0.0)


def light_off(found: LidarMaps, wanted: LidarMaps) -> float:
    """Return the spread of the logarithm of the light over that which is wanted."""
    lit = (found.intensity > 4) & (wanted.intensity > 4)
    ratio = np.log(found.intensity[lit] / wanted.intensity[lit])
    return float(np.std(ratio))


def depth_off_m(found: LidarMaps, wanted: LidarMaps) -> float:
    """Return the typical difference (root mean square) of depths of the same echoes."""
    off_m = found.depth_m - wanted.depth_m
    same = np.abs(off_m) < 0.01
    assert same.mean() > 0.95
    return float(np.sqrt(np.mean(np.square(off_m[same]))))


def test_an_empty_bench_with_ripples_and_texture_is_explained() -> None:
    model = SensorModel(wall_texture=0.1, ripple_m=0.0015)
    bare = sense([EMPTY], RIG, model, frames=60)[0]
    seen = sense([EMPTY, EMPTY], RIG, model)[1]

    flat_field = FlatField(bench_of(bare))
    corrected = flat_field.as_rendered(flat_field.correct(seen))
    raw_score, score = (check_reconstruction(maps, None, RIG).score for maps in (seen, corrected))

    assert score < UNEXPLAINED_EMPTY / 5
    assert raw_score > UNEXPLAINED_EMPTY


def test_textured_wall_looks_uniform_also_behind_an_object() -> None:
    textured = QUIET.model_copy(update={"wall_texture": 0.1})
    bare = sense([EMPTY], RIG, textured, frames=30)[0]
    (plain,) = sense([OBJECT], RIG, QUIET)
    (seen,) = sense([OBJECT], RIG, textured)

    found = FlatField(bench_of(bare)).correct(seen)

    assert light_off(found, plain) < 0.3 * light_off(seen, plain)
    assert depth_off_m(found, seen) < ROUNDED_M


def test_ripples_of_the_lidar_are_taken_out_of_wall_and_echoes() -> None:
    rippled = QUIET.model_copy(update={"ripple_m": 0.0015, "range_offset_m": -0.004})
    bare = sense([EMPTY], RIG, rippled, frames=30)[0]
    (plain,) = sense([OBJECT], RIG, QUIET)
    (seen,) = sense([OBJECT], RIG, rippled)
    bench = bench_of(bare)
    bench.range_offset_m = 0.004
    corrected = replace(seen, depth_m=seen.depth_m + np.float32(0.004))  # as `correct_range` does

    found = FlatField(bench).correct(corrected)

    assert depth_off_m(found, plain) < ROUNDED_M
    assert depth_off_m(corrected, plain) > 3 * ROUNDED_M


def test_uniform_wall_is_left_as_it_is() -> None:
    sensor = SensorModel()
    bare = sense([EMPTY], RIG, sensor, frames=30)[0]
    (seen,) = sense([OBJECT], RIG, sensor)

    found = FlatField(bench_of(bare)).correct(seen)

    assert light_off(found, seen) < 0.01


def test_bench_without_a_reference_is_not_corrected() -> None:
    (seen,) = sense([OBJECT], RIG, SensorModel())
    bench: Any = SimpleNamespace(rig=RIG, reference=None, range_offset_m=0.0)

    assert FlatField(bench).correct(seen) is seen


@pytest.mark.parametrize("counts", [36.0, 60.0])
@pytest.mark.parametrize("texture", [0.0, 0.12])
def test_gain_is_of_the_wall_and_not_of_the_occluder(counts: float, texture: float) -> None:
    sensor = SensorModel(bare_wall_counts=counts, wall_texture=texture)
    bare = sense([EMPTY], RIG, sensor, frames=30)[0]

    found = measured_counts(RIG, bench_of(bare).reference, 0.0)

    # counts are whole numbers, and the wall's own mean is known to its texture over its cells
    assert found == pytest.approx(counts, rel=0.03)
    assert bare.intensity.max() > 1.2 * counts


def test_gain_is_not_known_where_hardly_a_cell_is_wall() -> None:
    bare = sense([EMPTY], RIG, SensorModel(), frames=2)[0]
    elsewhere = replace(bare, depth_m=bare.depth_m + np.float32(0.2))

    assert measured_counts(RIG, bench_of(elsewhere).reference, 0.0) is None
