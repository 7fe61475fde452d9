"""Subjects of an evaluation before the simulated sensor, notes on them, and baselines that need no
network.
"""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from nlos_calibration import LidarPose, load_rig
from nlos_models import CheckpointRecord
from nlos_models.training import MapSet, VaeRecipe
from small_maps import SmallDataset, small_maps

from nlos_cam.camera.simulated_world import World
from nlos_cam.dataset import (
    TEST_SEED,
    TRAINING_SEED,
    DatasetPlan,
    Objects,
    RigSpread,
    procedural_images,
)
from nlos_cam.dataset.samples import make_samples
from nlos_cam.dataset.shards import shard_path, store
from nlos_cam.errors import SceneError
from nlos_cam.evaluate import (
    QUIET,
    HeldOutObjects,
    as_map_set,
    baseline_answers,
    baselines,
    echoes_of,
    reconstruct_all,
)
from nlos_cam.evaluate import subjects as module
from nlos_cam.evaluate.baselines import (
    answers_with_nearest,
    mean_image,
    training_maps,
    trivial_answers,
)
from nlos_cam.evaluate.subjects import notes_about, rig_of, seeded_objects, sense, truth_of
from nlos_cam.frames import LidarMaps, maps_from_frame
from nlos_cam.objects import (
    CATEGORIES,
    benchmark_objects,
    image_from_depth,
    object_box,
    object_depth,
    unseen_objects,
)
from nlos_cam.reconstruct import MapAlignment
from nlos_cam.render import MultiBounce, SceneFile

RIG = load_rig("paper-rig")
BOX = object_box(RIG)
PLAN = DatasetPlan(RIG, TEST_SEED)
RECORD = CheckpointRecord(rig_name=RIG.name, rig_checksum=RIG.checksum)
ELSEWHERE = replace(PLAN, rig=RIG.model_copy(update={"name": "elsewhere"}))
JUDGED = HeldOutObjects(
    "some", ["cup 1", "hat 2"], ["cup", "hat"], small_maps(2, 0), PLAN, [PLAN.rig] * 2
)


@pytest.fixture(scope="module")
def echoes() -> list[MultiBounce]:
    seen: list[tuple[int, int]] = []
    made = echoes_of(seeded_objects(TEST_SEED, 2, BOX), RIG, lambda *at: seen.append(at))
    assert seen == [(1, 2), (2, 2)]
    return made


def test_seeded_objects_are_those_of_their_seeds_and_second_set_is_of_other_kinds_in_the_same_poses() -> (
    None
):
    seeded = seeded_objects(TEST_SEED, 2, BOX)
    for k, subject in enumerate(seeded):
        category, depth_m = object_depth(TEST_SEED + k, BOX)
        assert subject.category == category
        assert category in subject.name
        np.testing.assert_array_equal(subject.depth_m, depth_m)
        np.testing.assert_array_equal(truth_of(seeded, BOX)[k], image_from_depth(depth_m, BOX))
    judged = module.rendered_objects(RIG, 1)
    np.testing.assert_array_equal(judged.maps.image, truth_of(seeded[:1], BOX))
    assert judged.maps.depth_m.shape == (1, 64, 80)
    assert (len(judged.names), judged.plan) == (1, PLAN)
    kinds = benchmark_objects(BOX)
    unseen = unseen_objects(BOX)
    assert [one.pose for one in unseen] == [one.pose for one in kinds]
    names = {one.category for one in unseen}
    assert (len(unseen), len(names), names & CATEGORIES.keys()) == (54, 18, set())
    assert min(int(np.isfinite(one.depth_m).sum()) for one in unseen) > 150


def test_each_object_of_a_dataset_of_many_rigs_is_aligned_from_its_own(tmp_path: Path) -> None:
    plan = DatasetPlan(
        RIG, 0, accuracy="draft", spread=RigSpread(place_m=0.005, angle_deg=2), objects_per_rig=2
    )
    samples = make_samples(plan, range(3))
    store(shard_path(tmp_path, 0), samples, plan.provenance, "")
    found = module.dataset_objects(tmp_path)
    assert found.benches == [plan.bench_of(seed)[0] for seed in range(3)]
    assert found.benches[0] == found.benches[1] != found.benches[2]
    aligned = module.network_input(found.maps, None, found.benches, RECORD)
    for n, bench in enumerate(found.benches):
        seen = LidarMaps(
            samples["depth_m"][n], samples["intensity"][n], np.isfinite(samples["depth_m"][n])
        )
        wanted = MapAlignment(bench, RIG).align(seen)
        np.testing.assert_array_equal(aligned.depth_m[n], wanted.depth_m)
        np.testing.assert_array_equal(aligned.intensity[n], wanted.intensity)
    (note,) = notes_about(RECORD, found, None)
    assert "a rig of its own" in note


def test_sense_repeats_matches_simulated_camera_and_averages_noise_down_with_frames(
    echoes: list[MultiBounce],
) -> None:
    first = sense(echoes, RIG)
    second = sense(echoes, RIG)
    world = World(SceneFile(name="any", rig=RIG), echoes, [None, None])
    for k in range(2):
        np.testing.assert_array_equal(first[k].depth_m, second[k].depth_m)
        frame = maps_from_frame(world.images(k).frame(RIG.pinhole))
        np.testing.assert_array_equal(first[k].intensity, frame.intensity)
    quiet, mean = (sense(echoes[:1], RIG, QUIET, frames=frames)[0] for frames in (1, 3))
    np.testing.assert_allclose(
        quiet.depth_m, mean.depth_m, atol=1e-6
    )  # every frame without noise is alike
    np.testing.assert_allclose(quiet.intensity, mean.intensity, rtol=1e-6)
    noisy = (sense(echoes[:1], RIG, frames=frames)[0].intensity for frames in (1, 4))
    one, four = (
        float(np.abs(some - quiet.intensity)[quiet.intensity > 5].mean()) for some in noisy
    )
    assert 0 < four < 0.75 * one


def test_reconstruct_all_takes_one_object_at_a_time(echoes: list[MultiBounce]) -> None:
    maps = as_map_set(sense(echoes, RIG), np.zeros((2, 64, 64), np.float32))
    network = Mock(
        spec=reconstruct_all, side_effect=lambda depth_m, _: np.nan_to_num(depth_m[:, :, 8:72])
    )
    np.testing.assert_array_equal(
        reconstruct_all(network, maps), np.nan_to_num(maps.depth_m[:, :, 8:72])
    )
    assert [part.shape for call in network.call_args_list for part in call.args] == [
        (1, 64, 80)
    ] * 4


def test_rig_of_weights_is_asked_for_where_missing_and_notes_name_other_rigs_and_categories_left_out() -> (
    None
):
    assert rig_of(RECORD) == RIG
    with pytest.raises(SceneError, match=r"'my bench'.*--rig"):
        rig_of(RECORD.model_copy(update={"rig_name": "my bench"}))
    recipe = VaeRecipe(
        task="vae",
        objects=4,
        held_out=2,
        epochs=1,
        batch=2,
        learning_rate=1e-3,
        left_out=["hat", "car"],
    )
    training = SmallDataset(JUDGED.maps, ELSEWHERE)
    training.folder = Path("train")
    assert notes_about(RECORD, JUDGED, SmallDataset(JUDGED.maps, PLAN)) == []
    record = RECORD.model_copy(update={"vae_recipe": recipe})
    other_rig, left_out = notes_about(record, replace(JUDGED, plan=ELSEWHERE), training)
    assert ("paper-rig" in other_rig, "hat" in left_out, "car" in left_out) == (True, True, False)
    (other_training,) = notes_about(RECORD, JUDGED, training)
    assert "train" in other_training


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    return procedural_images(0, 12, BOX).astype(np.float32)


def _maps(images: np.ndarray, seed: int = 0) -> MapSet:
    """Maps from which the image can be told apart, with holes and noise."""
    generator = np.random.default_rng(seed)
    wide = np.pad(images.astype(np.float32), ((0, 0), (0, 0), (8, 8)))
    depth = wide + 0.01 * generator.standard_normal(wide.shape).astype(np.float32)
    depth[:, :5, :5] = np.nan
    return MapSet(depth.astype(np.float32), 50 * wide, images)


class Chunked(SimpleNamespace):
    """Training maps in parts of some size."""

    maps: MapSet
    size: int

    def __len__(self) -> int:
        return len(self.maps.image)

    def chunks(self) -> list[MapSet]:
        arrays = vars(self.maps).values()
        parts = range(0, len(self), self.size)
        return [MapSet(*(array[start : start + self.size] for array in arrays)) for start in parts]


def _guesses(
    sought: MapSet, training: MapSet, size: int = 12, **others: object
) -> dict[str, np.ndarray]:
    options = {"on_progress": lambda *_: None, **others}
    return answers_with_nearest(sought, Chunked(maps=training, size=size), **options)  # type: ignore[arg-type]


def test_baselines_answer_every_object(images: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(baselines, "NEIGHBOURS", 3)
    without_nearest, among = baseline_answers(JUDGED, None, nearest=False)
    assert (set(without_nearest), among) == ({"all_background", "mean_object"}, None)
    trained = procedural_images(TRAINING_SEED, 3, BOX).astype(np.float32)
    np.testing.assert_allclose(without_nearest["mean_object"][1], trained.mean(0), atol=1e-3)
    mean = mean_image(images.astype(np.float16))
    np.testing.assert_allclose(mean, images.mean(0), atol=1e-3)
    alone = trivial_answers(5, mean)
    guesses = _guesses(_maps(images[:5], seed=1), _maps(images))
    assert set(alone) == {"all_background", "mean_object"}
    assert set(guesses) == {*alone, "nearest_neighbour"}
    for guess in (*alone.values(), *guesses.values()):
        assert (guess.shape, guess.dtype) == ((5, 64, 64), np.float32)
    assert not guesses["all_background"].any()
    np.testing.assert_allclose(guesses["mean_object"][3], images.mean(0), atol=1e-3)


@pytest.mark.parametrize("size", [1, 5, 12])
def test_nearest_neighbour_is_found_in_any_chunk(images: np.ndarray, size: int) -> None:
    order = np.array([7, 2, 11, 0])
    told = list[tuple[int, int]]()
    sought = _maps(images[order], seed=1)
    guesses = _guesses(sought, _maps(images), size, on_progress=lambda *at: told.append(at))
    np.testing.assert_array_equal(guesses["nearest_neighbour"], images[order])
    assert (len(told), told[-1]) == (-(-12 // size), (12, 12))


@pytest.mark.parametrize("scale", [1e-6, 0.0])
def test_nearest_neighbour_weighs_channels_by_their_spread(
    images: np.ndarray, scale: float
) -> None:
    """A channel that never varies counts for nothing."""
    faint = [
        replace(maps, intensity=scale * maps.intensity)
        for maps in (_maps(images[:4], seed=1), _maps(images))
    ]
    np.testing.assert_array_equal(_guesses(*faint)["nearest_neighbour"], images[:4])


def test_training_maps_are_cached_by_what_determines_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    built: list[tuple[DatasetPlan, int, Path]] = []
    shapes = {"images": np.zeros((2, 64, 64), np.float16)}
    monkeypatch.setattr(baselines.data, "build_dataset", lambda *args, **_: built.append(args))
    monkeypatch.setattr(baselines.data, "open_dataset", lambda folder: folder)
    monkeypatch.setattr(baselines.data, "procedural_images", lambda *_: shapes["images"])
    monkeypatch.setattr(baselines, "NEIGHBOURS", 7)
    plan = DatasetPlan(RIG, TEST_SEED, objects=Objects(("cup",)))
    elsewhere = RIG.model_copy(update={"lidar": LidarPose(distance_m=0.3, yaw_deg=45)})
    for one in (plan, plan, replace(plan, rig=elsewhere), replace(plan, first_seed=5)):
        training_maps(one, tmp_path, 1, lambda *_: None)
    shapes["images"] = shapes["images"] + np.float16(0.5)
    training_maps(plan, tmp_path, 1, lambda *_: None)
    first, again, moved, other_seed, other_shapes = (folder for _, _, folder in built)
    assert first == again == other_seed
    assert len({first, moved, other_shapes}) == 3
    assert first.parent.parent == tmp_path
    assert built[0][1] == 7
    assert (built[0][0].first_seed, built[0][0].objects) == (TRAINING_SEED, Objects())
    assert {object_depth(seed, BOX)[0] for seed in range(baselines.FINGERPRINT_OBJECTS)} == set(
        CATEGORIES
    )
