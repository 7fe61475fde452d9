"""Subjects of an evaluation: objects before the simulated sensor, as maps that the weights take, and notes on them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from nlos_calibration.rig import load_rig
from nlos_models import CheckpointRecord, Recipe
from small_maps import SmallDataset, small_maps

from nlos_cam.camera.simulated_world import World
from nlos_cam.dataset import TEST_SEED, TRAINING_SEED, DatasetPlan, procedural_images
from nlos_cam.errors import SceneError
from nlos_cam.evaluate import QUIET, HeldOutObjects, as_map_set, baseline_answers, baselines, echoes_of, reconstruct_all
from nlos_cam.evaluate.subjects import notes_about, rendered_objects, rig_of, seeded_objects, sense, truth_of
from nlos_cam.frames import maps_from_frame
from nlos_cam.objects import CATEGORIES, benchmark_objects, image_from_depth, object_box, object_depth, unseen_objects
from nlos_cam.render import MultiBounce, SceneFile

RIG = load_rig("paper-rig")
BOX = object_box(RIG)
PLAN = DatasetPlan(RIG, TEST_SEED)
RECORD = CheckpointRecord(rig_name=RIG.name, rig_checksum=RIG.checksum)
ELSEWHERE = replace(PLAN, rig=RIG.model_copy(update={"name": "elsewhere"}))
JUDGED = HeldOutObjects("some", ["cup 1", "hat 2"], ["cup", "hat"], small_maps(2, 0), PLAN)


@pytest.fixture(scope="module")
def echoes() -> list[MultiBounce]:
    seen: list[tuple[int, int]] = []
    made = echoes_of(seeded_objects(TEST_SEED, 2, BOX), RIG, lambda *at: seen.append(at))
    assert seen == [(1, 2), (2, 2)]
    return made


def test_seeded_objects_are_those_of_their_seeds() -> None:
    subjects = seeded_objects(TEST_SEED + 1, 2, BOX)
    for k, subject in enumerate(subjects):
        category, depth_m = object_depth(TEST_SEED + 1 + k, BOX)
        assert subject.category == category
        assert category in subject.name
        np.testing.assert_array_equal(subject.depth_m, depth_m)
        np.testing.assert_array_equal(truth_of(subjects, BOX)[k], image_from_depth(depth_m, BOX))


def test_test_set_has_54_visible_objects_of_18_categories() -> None:
    subjects = benchmark_objects(BOX)
    truth = truth_of(subjects, BOX)
    assert truth.shape == (54, 64, 64)
    assert len({subject.name for subject in subjects}) == 54
    assert len({subject.category for subject in subjects}) == 18
    assert (truth > 0).any((1, 2)).all()


def test_sense_repeats_and_matches_simulated_camera(echoes: list[MultiBounce]) -> None:
    first, second = sense(echoes, RIG), sense(echoes, RIG)
    world = World(SceneFile(name="any", rig=RIG), echoes, [None, None])
    for k in range(2):
        np.testing.assert_array_equal(first[k].depth_m, second[k].depth_m)
        frame = maps_from_frame(world.images(k).frame(RIG.pinhole))
        np.testing.assert_array_equal(first[k].intensity, frame.intensity)


def test_sense_averages_noise_down_with_frames(echoes: list[MultiBounce]) -> None:
    quiet, mean = (sense(echoes[:1], RIG, QUIET, frames=frames)[0] for frames in (1, 3))
    np.testing.assert_allclose(quiet.depth_m, mean.depth_m, atol=1e-6)  # every frame without noise is alike
    np.testing.assert_allclose(quiet.intensity, mean.intensity, rtol=1e-6)
    noisy = (sense(echoes[:1], RIG, frames=frames)[0].intensity for frames in (1, 4))
    one, four = (float(np.abs(some - quiet.intensity)[quiet.intensity > 5].mean()) for some in noisy)
    assert 0 < four < 0.75 * one


def test_reconstruct_all_takes_one_object_at_a_time(echoes: list[MultiBounce]) -> None:
    maps, batches = as_map_set(sense(echoes, RIG), np.zeros((2, 64, 64), np.float32)), list[int]()

    def middle(depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
        assert intensity.shape == depth_m.shape
        batches.append(len(depth_m))
        return np.nan_to_num(depth_m[:, :, 8:72])

    np.testing.assert_array_equal(reconstruct_all(middle, maps), np.nan_to_num(maps.depth_m[:, :, 8:72]))  # type: ignore[arg-type]
    assert batches == [1, 1]


def test_fresh_objects_are_those_of_test_seeds() -> None:
    judged = rendered_objects(RIG, 1)
    np.testing.assert_array_equal(judged.maps.image, truth_of(seeded_objects(TEST_SEED, 1, BOX), BOX))
    assert judged.maps.depth_m.shape == (1, 64, 80)
    assert (len(judged.names), judged.plan) == (1, PLAN)


def test_second_set_is_of_other_kinds_in_the_same_poses() -> None:
    kinds, unseen = benchmark_objects(BOX), unseen_objects(BOX)
    assert [one.pose for one in unseen] == [one.pose for one in kinds]
    names = {one.category for one in unseen}
    assert (len(unseen), len(names), names & CATEGORIES.keys()) == (54, 18, set())
    assert min(int(np.isfinite(one.depth_m).sum()) for one in unseen) > 150


def test_rig_of_weights_that_is_missing_is_asked_for() -> None:
    assert rig_of(RECORD) == RIG
    with pytest.raises(SceneError, match=r"'my bench'.*--rig"):
        rig_of(RECORD.model_copy(update={"rig_name": "my bench"}))


def test_guesses_without_nearest_take_mean_of_training_images(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(baselines, "NEIGHBOURS", 3)
    images, among = baseline_answers(JUDGED, None, nearest=False)
    assert (set(images), among) == ({"all_background", "mean_object"}, None)
    mean = procedural_images(TRAINING_SEED, 3, BOX).astype(np.float32).mean(0)
    np.testing.assert_allclose(images["mean_object"][1], mean, atol=1e-3)


def test_notes_name_other_rigs_and_categories_left_out() -> None:
    recipe = Recipe(task="vae", objects=4, held_out=2, epochs=1, batch=2, learning_rate=1e-3, left_out=["hat", "car"])
    training = SmallDataset(JUDGED.maps, ELSEWHERE)
    training.folder = Path("train")
    assert notes_about(RECORD, JUDGED, SmallDataset(JUDGED.maps, PLAN)) == []
    other_rig, left_out = notes_about(
        RECORD.model_copy(update={"vae_recipe": recipe}), replace(JUDGED, plan=ELSEWHERE), training
    )
    assert ("paper-rig" in other_rig, "hat" in left_out, "car" in left_out) == (True, True, False)
    (other_training,) = notes_about(RECORD, JUDGED, training)
    assert "train" in other_training
