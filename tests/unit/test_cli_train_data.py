"""What `train` reads: the maps a recipe asks for, and the bare wall that difference maps are formed from."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from nlos_calibration.rig import load_rig
from nlos_models.recipe import Recipe
from small_maps import small_maps

from nlos_cam import dataset
from nlos_cam.cli import train_data
from nlos_cam.cli.train_data import RecipeChoice, measured_bare_wall, read_maps, render_bare_wall
from nlos_cam.errors import SceneError
from nlos_cam.frames import maps_from_frame
from nlos_cam.render.renderer import render
from nlos_cam.render.scene import Scene
from nlos_cam.render.sensor import Sensor

PLAN = dataset.DatasetPlan(load_rig("paper-rig"), 0)
RECIPE = Recipe(task="compressor", objects=4, held_out=2, epochs=1, batch=2, learning_rate=1e-3)


def test_a_recipe_of_another_task_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "r.toml"
    path.write_text('task = "vae"\nobjects = 4\nheld_out = 2\nepochs = 2\nbatch = 2\nlearning_rate = 1e-3\n')
    with pytest.raises(SceneError, match="a recipe for 'vae', not 'transfer'"):
        RecipeChoice(path).read("transfer")
    assert RecipeChoice(path, budget=0.5, objects=3).read("vae").objects == 3


def test_a_recipe_takes_the_first_objects_of_larger_sets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset, "read", lambda folder: (small_maps(6, len(folder.name)), PLAN))
    maps = read_maps(RECIPE, Path("data"), Path("other"), None)
    np.testing.assert_array_equal(maps.training.image, small_maps(6, 4).image[:4])
    np.testing.assert_array_equal(maps.held_out.image, small_maps(6, 5).image[:2])


def test_less_the_rendered_bare_wall_a_bare_walls_own_frame_is_noise_about_nothing() -> None:
    depth_m, intensity = render_bare_wall(PLAN, frames=8)
    sensor = Sensor(PLAN.rig, PLAN.sensor)
    images = sensor.expose(render(Scene(PLAN.rig)).multi, np.random.default_rng(99))
    maps = maps_from_frame(images.frame(PLAN.rig.pinhole))
    seen = maps.valid & ~np.isnan(depth_m)
    assert seen.mean() > 0.5
    assert abs(np.median((maps.depth_m - depth_m)[seen])) < 1e-3
    assert abs(np.median((maps.intensity - intensity)[seen])) < 0.05 * np.median(intensity[seen])
    assert np.median(depth_m[seen]) > 0.1


def test_the_measured_bare_wall_is_the_references(monkeypatch: pytest.MonkeyPatch) -> None:
    reference = SimpleNamespace(map_depth_m=np.ones((64, 80)), map_intensity=np.zeros((64, 80)))
    monkeypatch.setattr(train_data, "load_measured", lambda _: SimpleNamespace(reference=reference))
    depth_m, intensity = measured_bare_wall(Path("wall.toml"))
    assert depth_m is reference.map_depth_m
    assert intensity is reference.map_intensity
    monkeypatch.setattr(train_data, "load_measured", lambda _: SimpleNamespace(reference=None))
    with pytest.raises(SceneError, match=r"wall\.toml has no reference"):
        measured_bare_wall(Path("wall.toml"))


@pytest.mark.parametrize("wall", [None, Path("wall.toml")])
def test_difference_maps_are_less_the_measured_wall_if_one_is_named_else_the_rendered(
    monkeypatch: pytest.MonkeyPatch, wall: Path | None
) -> None:
    def bare(intensity: float) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
        return lambda _: (np.zeros((64, 80), np.float32), np.full((64, 80), intensity, np.float32))

    monkeypatch.setattr(dataset, "read", lambda _: (small_maps(4, 0), PLAN))
    monkeypatch.setattr(train_data, "render_bare_wall", bare(1.0))
    monkeypatch.setattr(train_data, "measured_bare_wall", bare(2.0))
    recipe = RECIPE.model_copy(update={"maps": "difference maps"})
    made, raw = read_maps(recipe, Path("data"), Path("other"), wall), small_maps(4, 0)
    seen = ~np.isnan(raw.depth_m)
    for maps, count in ((made.training.first(4), 4), (made.held_out, 2)):
        np.testing.assert_allclose((raw.intensity[:count] - maps.intensity)[seen[:count]], 2.0 if wall else 1.0)
