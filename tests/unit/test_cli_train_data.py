"""What `train` reads: the maps a recipe asks for, and the bare wall that difference maps are formed from."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from nlos_calibration.rig import load_rig
from nlos_models.data import MapBatch, less_bare_wall
from nlos_models.recipe import Recipe
from small_maps import SmallDataset, small_maps

from nlos_cam.dataset import build, training_maps
from nlos_cam.dataset.training_maps import Streamed, measured_bare_wall, read_maps, render_bare_wall
from nlos_cam.errors import SceneError
from nlos_cam.frames import maps_from_frame
from nlos_cam.render.renderer import render
from nlos_cam.render.scene import Scene
from nlos_cam.render.sensor.sensor import Sensor

PLAN = build.DatasetPlan(load_rig("paper-rig"), 0)
RECIPE = Recipe(task="compressor", objects=4, held_out=2, epochs=1, batch=2, learning_rate=1e-3)


def test_a_recipe_takes_the_first_objects_of_larger_sets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build, "open_dataset", lambda of, **_: SmallDataset(small_maps(6, len(of.name)), PLAN))
    maps = read_maps(RECIPE, Path("data"), Path("other"), None)
    np.testing.assert_array_equal(maps.training.image, small_maps(6, 4).image[:4])
    np.testing.assert_array_equal(maps.held_out.image, small_maps(6, 5).image[:2])


def test_maps_of_other_objects_or_of_another_rig_have_another_digest(monkeypatch: pytest.MonkeyPatch) -> None:
    def digest(seed: int, name: str) -> str:
        plan = replace(PLAN, rig=PLAN.rig.model_copy(update={"name": name}))
        monkeypatch.setattr(build, "open_dataset", lambda *_, **__: SmallDataset(small_maps(6, seed), plan))
        return read_maps(RECIPE, Path("data"), Path("other"), None).digest

    assert digest(1, "a") == digest(1, "a")
    assert len({digest(1, "a"), digest(2, "a"), digest(1, "b")}) == 3


def test_a_record_tells_how_many_objects_there_were_to_judge_by(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build, "open_dataset", lambda of, **_: SmallDataset(small_maps(6, len(of.name)), PLAN))
    recipe = RECIPE.model_copy(update={"held_out": 400})
    assert read_maps(recipe, Path("data"), Path("other"), None).told(recipe).held_out == 6
    assert read_maps(RECIPE, Path("data"), Path("other"), None).told(RECIPE) == RECIPE


def test_a_dataset_to_be_judged_by_what_it_teaches_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build, "open_dataset", lambda of, **_: SmallDataset(small_maps(6, len(of.name)), PLAN))
    with pytest.raises(SceneError, match="give --held-out a dataset of other objects"):
        read_maps(RECIPE, Path("data"), Path("other/../data"), None)


def test_a_wall_for_raw_maps_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build, "open_dataset", lambda of, **_: SmallDataset(small_maps(6, len(of.name)), PLAN))
    with pytest.raises(SceneError, match=r"wall\.toml would do nothing: leave --wall out"):
        read_maps(RECIPE, Path("data"), Path("other"), Path("wall.toml"))


def test_maps_of_two_rigs_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def opened(folder: Path, *, colour: bool) -> SmallDataset:
        assert not colour
        return SmallDataset(small_maps(6, 0), replace(PLAN, rig=PLAN.rig.model_copy(update={"name": folder.name})))

    monkeypatch.setattr(build, "open_dataset", opened)
    with pytest.raises(SceneError, match="data and other were rendered for different rigs"):
        read_maps(RECIPE, Path("data"), Path("other"), None)


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
    monkeypatch.setattr(training_maps, "load_measured", lambda _: SimpleNamespace(reference=reference))
    depth_m, intensity = measured_bare_wall(Path("wall.toml"))
    assert depth_m is reference.map_depth_m
    assert intensity is reference.map_intensity
    monkeypatch.setattr(training_maps, "load_measured", lambda _: SimpleNamespace(reference=None))
    with pytest.raises(SceneError, match=r"wall\.toml has no reference"):
        measured_bare_wall(Path("wall.toml"))


@pytest.mark.parametrize("wall", [None, Path("wall.toml")])
def test_difference_maps_are_less_the_measured_wall_if_one_is_named_else_the_rendered(
    monkeypatch: pytest.MonkeyPatch, wall: Path | None
) -> None:
    def bare(intensity: float) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
        return lambda _: (np.zeros((64, 80), np.float32), np.full((64, 80), intensity, np.float32))

    monkeypatch.setattr(build, "open_dataset", lambda _, **__: SmallDataset(small_maps(4, 0), PLAN))
    monkeypatch.setattr(training_maps, "render_bare_wall", bare(1.0))
    monkeypatch.setattr(training_maps, "measured_bare_wall", bare(2.0))
    recipe = RECIPE.model_copy(update={"maps": "difference maps"})
    made, raw = read_maps(recipe, Path("data"), Path("other"), wall), small_maps(4, 0)
    seen = ~np.isnan(raw.depth_m)
    for maps, count in ((made.training.first(4), 4), (made.held_out, 2)):
        np.testing.assert_allclose((raw.intensity[:count] - maps.intensity)[seen[:count]], 2.0 if wall else 1.0)


def _by_row(batches: Iterable[MapBatch]) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """The maps of each sample, mirrored back."""
    found: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for batch in batches:
        for depth, intensity, row, mirrored in zip(
            batch.depth_m.numpy(), batch.intensity.numpy(), batch.row.tolist(), batch.mirrored.tolist(), strict=True
        ):
            found[row] = (depth[::-1], intensity[::-1]) if mirrored else (depth, intensity)
    return found


def test_a_stream_gives_the_maps_that_memory_does_differences_too_and_the_same_for_the_same_generator() -> None:
    maps, generator = small_maps(8, 0), np.random.default_rng(0)
    bare = tuple(generator.random((64, 80), np.float32) for _ in range(2))
    stream = Streamed(SmallDataset(maps, PLAN), maps.image, bare)
    whole, twice = (
        less_bare_wall(maps, *bare),
        [list(stream.batches(4, torch.Generator().manual_seed(3))) for _ in "ab"],
    )
    found = _by_row(twice[0])
    assert sorted(found) == list(range(8))
    for row, (depth_m, intensity) in found.items():
        np.testing.assert_array_equal(depth_m, whole.depth_m[row])
        np.testing.assert_array_equal(intensity, whole.intensity[row])
    for one, other in zip(*twice, strict=True):
        assert torch.equal(one.row, other.row)
        assert torch.equal(one.mirrored, other.mirrored)
    np.testing.assert_array_equal(stream.first(6).depth_m, whole.depth_m[:6])
    assert len(stream.first(99).image) == 8


def test_a_stream_is_of_all_of_a_dataset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build, "open_dataset", lambda _, **__: SmallDataset(small_maps(6, 0), PLAN))
    with pytest.raises(SceneError, match="a stream is of all: give --objects 6"):
        read_maps(RECIPE, Path("data"), Path("other"), None, stream=True)
    maps = read_maps(RECIPE.of_objects(6), Path("data"), Path("other"), None, stream=True)
    assert isinstance(maps.training, Streamed)


def test_no_bare_wall_is_rendered_for_rigs_that_differ() -> None:
    plan = replace(PLAN, spread=build.RigSpread(place_m=0.01))
    with pytest.raises(SceneError, match="differs from object to object"):
        render_bare_wall(plan)
