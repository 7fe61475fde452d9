"""Samples: the maps of the objects of their seeds, seen with the rigs of their seeds; left out is left out."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from nlos_calibration.rig import load_rig

from nlos_cam.dataset import samples as dataset_samples
from nlos_cam.dataset.plan import DatasetPlan, Objects, RigSpread
from nlos_cam.dataset.samples import (
    Samples,
    hidden_object,
    joined,
    make_samples,
    objects_of,
    procedural_images,
    sense_object,
)
from nlos_cam.errors import SceneError
from nlos_cam.frames import LidarMaps
from nlos_cam.objects.depth_map import image_from_depth
from nlos_cam.objects.generators import CATEGORIES
from nlos_cam.objects.placement import object_depth
from nlos_cam.render.scene import Scene
from nlos_cam.render.sensor.model import SensorModel
from nlos_cam.render.sensor.sensor import Sensor

PLAN = DatasetPlan(load_rig("paper-rig"), 0, accuracy="draft")
BOX = PLAN.box


@pytest.fixture(scope="module")
def samples() -> Samples:
    return make_samples(PLAN, range(3))


def _assert_same(one: Samples, other: Samples) -> None:
    assert one.keys() == other.keys()
    for name, values in one.items():
        assert values.dtype == other[name].dtype
        np.testing.assert_array_equal(values, other[name])


def test_they_are_what_the_renderer_and_the_sensor_make_of_their_objects(samples: Samples) -> None:
    sensor = Sensor(PLAN.rig, PLAN.sensor)
    for seed in (0, 2):
        category, depth_m = object_depth(seed, BOX)
        sensed = sense_object(Scene(PLAN.rig, depth_m), sensor, seed, "draft")
        np.testing.assert_array_equal(samples["depth_m"][seed], sensed.depth_m)
        np.testing.assert_array_equal(samples["intensity"][seed], sensed.intensity)
        np.testing.assert_array_equal(samples["object_depth_m"][seed], depth_m)
        np.testing.assert_array_equal(samples["image"][seed], image_from_depth(depth_m, BOX).astype(np.float16))
        assert samples["category"][seed] == category
    np.testing.assert_array_equal(samples["image"], procedural_images(0, 3, BOX))
    np.testing.assert_array_equal(samples["scene"], [[0.2, 45.0, 0.0, 0.2, 0.1, 48.0]] * 3)


def test_they_are_the_same_however_they_are_cut(samples: Samples) -> None:
    _assert_same(joined([make_samples(PLAN, [0]), make_samples(PLAN, [1, 2])]), samples)


def test_the_noise_of_an_object_is_its_own() -> None:
    sensor, scene = Sensor(PLAN.rig, PLAN.sensor), Scene(PLAN.rig, object_depth(0, BOX)[1])
    first, again, other = (sense_object(scene, sensor, seed, "draft") for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.depth_m, again.depth_m)
    assert not np.array_equal(first.depth_m, other.depth_m, equal_nan=True)


def test_a_spread_changes_the_maps_and_is_told_but_not_the_object(samples: Samples) -> None:
    plan = replace(PLAN, spread=RigSpread(place_m=0.02, angle_deg=5, gain_share=0.2))
    spread = make_samples(plan, [1])
    np.testing.assert_array_equal(spread["object_depth_m"][0], samples["object_depth_m"][1])
    assert not np.array_equal(spread["depth_m"][0], samples["depth_m"][1], equal_nan=True)
    distance_m, yaw_deg, pitch_deg, x_m, gap_m, counts = spread["scene"][0]
    rig = PLAN.rig.model_copy(
        update={
            "lidar": PLAN.rig.lidar.model_copy(
                update={"distance_m": distance_m, "yaw_deg": yaw_deg, "pitch_deg": pitch_deg}
            ),
            "occluder": PLAN.rig.occluder and PLAN.rig.occluder.model_copy(update={"x_m": x_m, "z_min_m": gap_m}),
        }
    )
    sensor = Sensor(rig, SensorModel(bare_wall_counts=counts))
    sensed = sense_object(Scene(rig, samples["object_depth_m"][1]), sensor, 1, "draft")
    np.testing.assert_array_equal(spread["depth_m"][0], sensed.depth_m)
    np.testing.assert_array_equal(spread["intensity"][0], sensed.intensity)


def test_the_scene_that_is_rendered_has_the_plans_pulse_radiometry_and_jump(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Scene] = []

    def sense(scene: Scene, *_: object) -> LidarMaps:
        seen.append(scene)
        blank = np.zeros((64, 80), np.float32)
        return LidarMaps(blank, blank, blank > 0)

    monkeypatch.setattr(dataset_samples, "sense_object", sense)
    make_samples(replace(PLAN, sensor=SensorModel(pulse_ns=1.0), radiometry="lambertian", jump_m=0.5), [0])
    assert (seen[0].pulse_ns, seen[0].radiometry, seen[0].jump_m) == (1.0, "lambertian", 0.5)


def test_categories_that_are_left_out_never_come() -> None:
    kept = Objects.without(["hat", "boat", "cup"])
    drawn = {hidden_object(kept, seed, BOX)[0] for seed in range(150)}
    assert drawn == set(CATEGORIES) - {"hat", "boat", "cup"}


def test_backgrounds_fill_some_of_what_was_empty() -> None:
    alone = [hidden_object(Objects(), seed, BOX)[1] for seed in range(20)]
    beside = [hidden_object(Objects(backgrounds=0.5), seed, BOX)[1] for seed in range(20)]
    more = [np.isfinite(two).sum() > np.isfinite(one).sum() for one, two in zip(alone, beside, strict=True)]
    assert 3 < sum(more) < 17


@pytest.fixture
def meshes(tmp_path: Path) -> Path:
    (tmp_path / "sub").mkdir()
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "cube.stl")
    trimesh.creation.icosphere(subdivisions=1).export(tmp_path / "sub" / "ball.ply")
    return tmp_path


def test_a_folder_of_meshes_is_hidden_by_seed(meshes: Path) -> None:
    objects = objects_of(meshes)
    assert [name for name, _ in objects.meshes] == ["cube.stl", "sub/ball.ply"]
    found = [hidden_object(objects, seed, BOX) for seed in range(12)]
    assert {name for name, _ in found} == {"cube.stl", "sub/ball.ply"}
    np.testing.assert_array_equal(hidden_object(objects_of(meshes), 3, BOX)[1], found[3][1])
    assert make_samples(replace(PLAN, objects=objects), [0])["category"][0] == found[0][0]


def test_meshes_that_moved_are_the_same_and_those_that_changed_are_refused(meshes: Path) -> None:
    before = objects_of(meshes)
    moved = meshes.rename(meshes.with_name("moved"))
    assert objects_of(moved) == before
    trimesh.creation.box((1, 2, 1)).export(moved / "cube.stl")
    assert objects_of(moved) != before
    cubes = replace(before, folder=moved, meshes=before.meshes[:1])
    with pytest.raises(SceneError, match=r"cube\.stl changed since"):
        hidden_object(cubes, 0, BOX)


def test_meshes_without_their_folder_are_asked_for(meshes: Path) -> None:
    with pytest.raises(SceneError, match="name their folder with --objects"):
        hidden_object(replace(objects_of(meshes), folder=None), 0, BOX)


def test_reading_meshes_tells_how_far_it_is(meshes: Path) -> None:
    seen: list[tuple[int, int]] = []
    objects_of(meshes, lambda done, total: seen.append((done, total)))
    assert seen == [(1, 2), (2, 2)]


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are bytes here")
def test_a_mesh_whose_name_no_shard_can_hold_is_refused_before_anything_is_made(meshes: Path) -> None:
    (meshes / "cube.stl").rename(meshes / os.fsdecode(b"caf\xe9.stl"))
    with pytest.raises(SceneError, match=r"caf\\udce9\.stl' is not UTF-8: rename it"):
        objects_of(meshes)


def test_workers_do_not_wait_for_torch() -> None:
    program = "import sys, nlos_cam.dataset_samples; raise SystemExit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


def test_an_empty_folder_is_told(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="no meshes in"):
        objects_of(tmp_path)
