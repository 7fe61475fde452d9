"""What weights are judged on: fresh objects on their rig, maps as they eat them, and what a reader must know."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from nlos_calibration.rig import load_rig
from nlos_models.checkpoint import CheckpointRecord
from nlos_models.recipe import Recipe
from small_maps import SmallDataset, small_maps

from nlos_cam.dataset import build
from nlos_cam.errors import SceneError
from nlos_cam.evaluate import baselines, subjects
from nlos_cam.evaluate.subjects import (
    Judged,
    as_eaten,
    bare_wall_for,
    fresh_objects,
    guesses,
    notes_on,
    rig_of,
    seeded_objects,
    stored_objects,
    truth_of,
)

RIG = load_rig("paper-rig")
PLAN = build.DatasetPlan(RIG, build.TEST_SEED)
RECORD = CheckpointRecord(rig_name=RIG.name, rig_checksum=RIG.checksum)
DIFFERENCE = RECORD.model_copy(update={"input": "difference maps"})
ELSEWHERE = replace(PLAN, rig=RIG.model_copy(update={"name": "elsewhere"}))
JUDGED = Judged("some", ["cup 1", "hat 2"], ["cup", "hat"], small_maps(2, 0), PLAN)


def test_fresh_objects_are_those_of_the_test_seeds() -> None:
    judged = fresh_objects(RIG, 1)
    truth = truth_of(seeded_objects(build.TEST_SEED, 1, PLAN.box), PLAN.box)
    np.testing.assert_array_equal(judged.maps.image, truth)
    assert judged.maps.depth_m.shape == (1, 64, 80)
    assert (len(judged.names), judged.plan) == (1, PLAN)
    assert "1 random" in judged.what


def test_stored_objects_are_those_of_the_dataset(monkeypatch: pytest.MonkeyPatch) -> None:
    class Kept(SmallDataset):
        def column(self, name: str) -> np.ndarray:
            return {"category": np.array(["cup", "hat"], object), "seed": np.array([7, 8])}[name]

    monkeypatch.setattr(build, "open_dataset", lambda _: Kept(JUDGED.maps, ELSEWHERE))
    judged = stored_objects(Path("held-out"))
    assert (judged.names, judged.categories, judged.plan) == (["cup 7", "hat 8"], ["cup", "hat"], ELSEWHERE)
    assert judged.maps is JUDGED.maps


def test_a_rig_that_is_not_at_hand_is_asked_for() -> None:
    assert rig_of(RECORD) == RIG
    with pytest.raises(SceneError, match=r"for the rig 'my bench', which is not at hand .*--rig"):
        rig_of(RECORD.model_copy(update={"rig_name": "my bench"}))


def test_raw_maps_are_eaten_as_they_are_and_want_no_wall() -> None:
    assert bare_wall_for(RECORD, PLAN) is None
    assert as_eaten(JUDGED.maps, None) is JUDGED.maps
    with pytest.raises(SceneError, match=r"leave out --wall"):
        bare_wall_for(RECORD, PLAN, Path("wall.toml"))


def test_difference_maps_are_less_the_measured_wall_if_one_is_named_else_the_rendered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    walls = [(np.full((64, 80), depth, np.float32), np.ones((64, 80), np.float32)) for depth in (0.1, 0.2)]
    monkeypatch.setattr(subjects, "render_bare_wall", lambda _: walls[0])
    monkeypatch.setattr(subjects, "measured_bare_wall", lambda _: walls[1])
    for wall, depth_m in ((None, 0.1), (Path("wall.toml"), 0.2)):
        eaten = as_eaten(JUDGED.maps, bare_wall_for(DIFFERENCE, PLAN, wall))
        seen = ~np.isnan(JUDGED.maps.depth_m)
        np.testing.assert_allclose((JUDGED.maps.depth_m - eaten.depth_m)[seen], depth_m, atol=1e-6)
        np.testing.assert_allclose((JUDGED.maps.intensity - eaten.intensity)[seen], 1.0, atol=1e-5)


def test_the_nearest_is_looked_for_in_the_training_set_that_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    training = SmallDataset(JUDGED.maps, PLAN)
    monkeypatch.setattr(build, "open_dataset", lambda _: training)
    images, among = guesses(JUDGED, Path("train"), nearest=True)
    assert among is training
    np.testing.assert_array_equal(images["nearest_neighbour"], JUDGED.maps.image)


def test_without_the_nearest_nothing_is_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(baselines, "NEIGHBOURS", 3)
    monkeypatch.setattr(baselines, "training_maps", lambda *_: pytest.fail("rendered"))
    images, among = guesses(JUDGED, None, nearest=False)
    assert (set(images), among) == ({"all_background", "mean_object"}, None)
    mean = build.procedural_images(build.TRAINING_SEED, 3, PLAN.box).astype(np.float32).mean(0)
    np.testing.assert_allclose(images["mean_object"][1], mean, atol=1e-3)


def test_a_reader_is_told_of_other_rigs_and_of_kinds_that_were_left_out() -> None:
    recipe = Recipe(task="vae", objects=4, held_out=2, epochs=1, batch=2, learning_rate=1e-3, left_out=["hat", "car"])
    training = SmallDataset(JUDGED.maps, ELSEWHERE)
    training.folder = Path("train")
    assert notes_on(RECORD, JUDGED, SmallDataset(JUDGED.maps, PLAN)) == []
    told = notes_on(RECORD.model_copy(update={"vae_recipe": recipe}), replace(JUDGED, plan=ELSEWHERE), training)
    assert ["trained for the rig paper-rig" in told[0], "never shown hat" in told[1], len(told)] == [True, True, 2]
    (other,) = notes_on(RECORD, JUDGED, training)
    assert "nearest neighbour is of train, whose maps are of another rig" in other
