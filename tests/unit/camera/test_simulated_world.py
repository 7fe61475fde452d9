from dataclasses import astuple
from pathlib import Path

import numpy as np
import pytest

from nlos_cam.camera import World, open_world, read_packaged, render_loop
from nlos_cam.camera.simulated_world import WORLDS
from nlos_cam.files import load_cached
from nlos_cam.render import SceneFile, SensedImages, bare_wall_scene, paper_scene

SCENE = """
name = "two poses"
rig = "paper-rig"
object = { category = "cup", seed = 1, size_m = 0.08 }
motion = { poses = 2, approach_m = 0.01 }
"""
WARMING = """
name = "warming"
rig = "bare-wall"
sensor.drift_m_per_celsius = 0.0005
sensor.warm_up = { from_celsius = 25.0, to_celsius = 45.0, time_constant_s = 600.0 }
"""


def _equal(one: SensedImages, other: SensedImages) -> bool:
    return all(map(np.array_equal, astuple(one), astuple(other)))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("world") / "scene.toml"
    path.write_text(SCENE, encoding="utf-8")
    return path


@pytest.fixture(autouse=True)
def _cache(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NLOS_CAM_CACHE", str(scene.with_name("cache")))


@pytest.fixture
def world(scene: Path) -> World:
    return open_world(str(scene))


def test_world_frame_is_a_function_of_its_number(
    world: World,
) -> None:
    first, second, again, later = (world.images(number) for number in (0, 1, 2, 7))

    assert _equal(world.images(7), later)
    assert not _equal(first, second)
    assert world.celsius(0) == world.celsius(1_000_000)
    assert not _equal(first, again)
    np.testing.assert_array_equal(first.confidence, again.confidence)

    both = (first.depth_z16 > 0) & (again.depth_z16 > 0)
    difference = first.depth_z16[both].astype(int) - again.depth_z16[both].astype(int)

    assert np.abs(difference).max() * 0.00025 < 0.05
    assert not np.array_equal(second.confidence, first.confidence)


def test_world_truth_is_the_object_at_half_the_scan(world: World) -> None:
    for number in range(4):
        expected = world.scene.scene_at(number % 2 + 0.5).object_depth_m
        np.testing.assert_array_equal(world.truth_depth_m(number), expected)


@pytest.mark.slow
def test_world_from_the_cache_equals_the_rendered_one(
    scene: Path, world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[int, int]] = []
    monkeypatch.setenv("NLOS_CAM_CACHE", str(tmp_path))
    fresh = open_world(str(scene), lambda done, total: seen.append((done, total)))

    assert seen == [(1, 2), (2, 2)]

    monkeypatch.setattr("nlos_cam.render.render_scan", lambda *_: pytest.fail("rendered again"))
    cached = open_world(str(scene), lambda done, total: seen.append((done, total)))

    assert len(seen) == 2

    for number in (0, 1, 5):
        assert _equal(cached.images(number), fresh.images(number))
        assert _equal(world.images(number), fresh.images(number))
    (entry,) = (tmp_path / "worlds").iterdir()

    assert entry.name.startswith(fresh.scene.checksum)

    other = tmp_path / "scene.toml"
    other.write_text(
        scene.read_text(encoding="utf-8") + "sensor = { dead_share = 0.5 }\n", encoding="utf-8"
    )
    harmed = open_world(str(other)).images(0)  # another sensor, the same rendering

    assert (harmed.depth_z16 > 0).sum() < 0.7 * (world.images(0).depth_z16 > 0).sum()


def test_world_warms_and_drifts_beyond_the_loop(tmp_path: Path) -> None:
    (tmp_path / "warming.toml").write_text(WARMING, encoding="utf-8")
    warming = open_world(str(tmp_path / "warming.toml"))
    numbers = (0, 18_000, 180_000)

    assert warming.scene.poses == 1

    after = [warming.celsius(number) for number in numbers]
    ldd = [celsius["ldd_temperature"] for celsius in after]

    assert ldd == pytest.approx([25.0, 45 - 20 / np.e, 45.0], abs=0.01)

    for celsius in after:
        assert set(celsius) == {
            f"{part}_temperature" for part in ("ldd", "mc", "ma", "apd", "humidity")
        }
        assert {name: celsius[name] - after[0][name] for name in celsius} == pytest.approx(
            dict.fromkeys(celsius, celsius["ldd_temperature"] - 25.0)
        )
    frames = [warming.images(number).frame(warming.rig.pinhole) for number in numbers]
    means_m = np.array([np.nanmean(frame.depth_m) for frame in frames])

    np.testing.assert_allclose(means_m - means_m[2], 0.0005 * (np.array(ldd) - 45), atol=2e-5)
    assert _equal(warming.images(18_000), warming.images(18_000))


def test_world_with_a_wide_pulse_survives_the_cache(world: World, tmp_path: Path) -> None:
    wide = tmp_path / "wide.toml"
    wide.write_text(SCENE + "sensor = { pulse_ns = 1.0 }\n", encoding="utf-8")
    rendered = open_world(str(wide))
    cached = open_world(str(wide))

    assert _equal(rendered.images(0), cached.images(0))
    assert not np.array_equal(rendered.images(0).ir, world.images(0).ir)


@pytest.mark.parametrize(
    "shipped",
    [pytest.param(paper_scene(), marks=pytest.mark.slow), bare_wall_scene()],
    ids=["paper", "bare-wall"],
)
def test_packaged_loop_equals_the_renderers(shipped: SceneFile) -> None:
    packaged = read_packaged(shipped)

    assert [len(part) for part in packaged] == [shipped.poses, shipped.poses]

    number = shipped.poses // 2
    (rendered,), (truth_m,) = render_loop(shipped, poses=[number])
    echoes = packaged[0][number]

    np.testing.assert_array_equal(packaged[1][number], truth_m)
    np.testing.assert_allclose(
        echoes.peak, rendered.peak, rtol=1e-4
    )  # processors contract sums differently
    np.testing.assert_allclose(
        echoes.runner_up, rendered.runner_up, rtol=1e-4, atol=1e-4 * rendered.peak.max()
    )
    assert (np.nan_to_num(echoes.path_m) == np.nan_to_num(rendered.path_m)).mean() > 0.999


def test_packaged_scenes_open_without_rendering_or_cache(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("NLOS_CAM_CACHE", str(tmp_path))
    monkeypatch.setattr("nlos_cam.render.render_scan", lambda *_: pytest.fail("rendered"))
    for name in ("", "bare-wall"):
        assert open_world(name).images(0).depth_z16.any()

    assert not list(tmp_path.iterdir())


def test_damaged_packaged_loop_counts_as_absent(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("nlos_cam.camera.simulated_world.WORLDS", tmp_path)

    assert read_packaged(paper_scene()) is None

    for content in (b"", b"damaged"):
        (tmp_path / f"{paper_scene().checksum}.npz").write_bytes(content)
        assert read_packaged(paper_scene()) is None


IN_SIGHT = """
name = "in sight"
object = { category = "cup", seed = 1, size_m = 0.2 }
rig.base = "bare-wall"
rig.object_box.x_min_m = 0.325
rig.object_box.x_max_m = 0.575
rig.object_box.y_min_m = -0.125
rig.object_box.y_max_m = 0.125
rig.object_box.z_near_m = 0.02
rig.object_box.z_far_m = 0.3
"""


def test_world_shows_an_object_in_sight_also_from_the_cache(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(IN_SIGHT, encoding="utf-8")
    rendered = open_world(str(tmp_path / "scene.toml"))
    cached = open_world(str(tmp_path / "scene.toml"))
    wall = rendered.without_object().images(0).depth_z16.astype(int)
    nearer = wall - rendered.images(0).depth_z16 > 200  # 5 cm

    assert nearer.mean() > 0.01
    assert _equal(rendered.images(0), cached.images(0))


def test_cached_world_of_an_earlier_version_is_made_again(
    scene: Path, world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The packaged loops are as earlier versions stored them: without the beams that are stopped."""
    monkeypatch.setenv("NLOS_CAM_CACHE", str(tmp_path))
    earlier = (WORLDS / f"{bare_wall_scene().checksum}.npz").read_bytes()
    entry = tmp_path / "worlds" / f"{world.scene.checksum}.npz"
    load_cached(entry, len, lambda: earlier)

    assert _equal(open_world(str(scene)).images(0), world.images(0))
