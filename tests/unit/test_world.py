"""The simulated camera's world: numbers to bits, loops, and a cache that changes nothing."""

from pathlib import Path

import numpy as np
import pytest

from nlos_cam.camera import world as module
from nlos_cam.camera.world import World, open_world
from nlos_cam.errors import SceneError
from nlos_cam.render.sensor import SensedImages

SCENE = """
name = "two poses"
rig = "paper-rig"
object = { category = "cup", seed = 1 }
motion = { poses = 2, approach_m = 0.1 }
"""
NAMES = ("depth_z16", "ir", "confidence")


def _equal(one: SensedImages, other: SensedImages) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in NAMES)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("world")


@pytest.fixture(scope="module")
def scene(folder: Path) -> Path:
    (folder / "scene.toml").write_text(SCENE, encoding="utf-8")
    return folder / "scene.toml"


@pytest.fixture(autouse=True)
def _cache(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NLOS_CAM_CACHE", str(folder / "cache"))


@pytest.fixture
def world(scene: Path) -> World:
    return open_world(str(scene))


def test_a_number_is_a_frame_to_the_bit(world: World) -> None:
    later = world.images(7)
    assert _equal(world.images(7), later)
    assert not _equal(world.images(0), world.images(1))


def test_the_loop_begins_again_with_other_noise(world: World) -> None:
    first, again = world.images(0), world.images(2)
    assert not _equal(first, again)
    np.testing.assert_array_equal(first.confidence, again.confidence)
    both = (first.depth_z16 > 0) & (again.depth_z16 > 0)
    difference = first.depth_z16[both].astype(int) - again.depth_z16[both].astype(int)
    assert np.abs(difference).max() * 0.00025 < 0.05
    assert not np.array_equal(world.images(1).confidence, first.confidence)


def test_the_truth_is_what_stood_there_in_the_middle_of_the_scan(world: World) -> None:
    for number in range(4):
        truth = world.truth_depth_m(number)
        expected = world.scene.scene_at(number % 2 + 0.5).object_depth_m
        assert truth is not None
        np.testing.assert_array_equal(truth, expected)


def test_a_cached_world_is_the_rendered_one(
    scene: Path, world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[int, int]] = []
    monkeypatch.setenv("NLOS_CAM_CACHE", str(tmp_path))
    fresh = open_world(str(scene), lambda done, total: seen.append((done, total)))
    assert seen == [(1, 2), (2, 2)]
    monkeypatch.setattr(module, "render_scan", lambda *_: pytest.fail("rendered again"))
    cached = open_world(str(scene), lambda done, total: seen.append((done, total)))
    assert len(seen) == 2
    for number in (0, 1, 5):
        assert _equal(cached.images(number), fresh.images(number))
        assert _equal(world.images(number), fresh.images(number))
    assert [path.name for path in (tmp_path / "worlds").iterdir()] == [f"{fresh.scene.checksum}.npz"]


def test_the_same_scene_with_another_sensor_is_not_rendered_again(
    scene: Path, world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "render_scan", lambda *_: pytest.fail("rendered again"))
    other = tmp_path / "scene.toml"
    other.write_text(scene.read_text(encoding="utf-8") + "sensor = { dead_share = 0.5 }\n", encoding="utf-8")
    harmed = open_world(str(other)).images(0)
    assert (harmed.depth_z16 > 0).sum() < 0.7 * (world.images(0).depth_z16 > 0).sum()


def test_a_pulse_of_some_width_is_kept_with_the_direct_return_mixed_in(tmp_path: Path) -> None:
    wide = tmp_path / "wide.toml"
    wide.write_text(SCENE.replace("poses = 2", "poses = 1") + "sensor = { pulse_ns = 1.0 }\n", encoding="utf-8")
    rendered, cached = open_world(str(wide)), open_world(str(wide))
    assert _equal(rendered.images(0), cached.images(0))
    plain = tmp_path / "plain.toml"
    plain.write_text(SCENE.replace("poses = 2", "poses = 1"), encoding="utf-8")
    assert not np.array_equal(rendered.images(0).ir, open_world(str(plain)).images(0).ir)


def test_a_bare_wall_hides_nothing() -> None:
    world = open_world("bare-wall")
    assert world.truth_depth_m(0) is None
    assert world.truth_depth_m(11) is None
    assert world.rig.occluder is None
    assert not _equal(world.images(0), world.images(1))


def test_a_scene_that_is_not_there_is_a_scene_error(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"none\.toml"):
        open_world(str(tmp_path / "none.toml"))
