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
    HELD_OUT_SEED,
    TEST_SEED,
    TRAINING_SEED,
    DatasetPlan,
    Labelled,
    Objects,
    RigRange,
    RigSpread,
    procedural_images,
    write_shards,
)
from nlos_cam.dataset.samples import make_samples
from nlos_cam.dataset.shards import shard_path, store
from nlos_cam.errors import FolderBusyError, SceneError
from nlos_cam.evaluate import (
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
    on_wall_grid,
    training_maps,
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
from nlos_cam.reconstruct import NUMBERS_COLUMN, MapAlignment
from nlos_cam.render import QUIET, MultiBounce, Scene, SceneFile, render

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
    return echoes_of(seeded_objects(TEST_SEED, 2, BOX), RIG, lambda *_: None)


def test_echoes_report_progress() -> None:
    progress: list[tuple[int, int]] = []

    echoes_of(seeded_objects(TEST_SEED, 2, BOX), RIG, lambda *at: progress.append(at))

    assert progress == [(1, 2), (2, 2)]


@pytest.mark.parametrize("k", range(2))
def test_seeded_objects_are_those_of_their_seeds(k: int) -> None:
    seeded = seeded_objects(TEST_SEED, 2, BOX)
    category, depth_m = object_depth(TEST_SEED + k, BOX)

    assert seeded[k].category == category
    assert category in seeded[k].name
    np.testing.assert_array_equal(seeded[k].depth_m, depth_m)
    np.testing.assert_array_equal(truth_of(seeded, BOX)[k], image_from_depth(depth_m, BOX))


def test_rendered_objects_are_seeded_objects() -> None:
    truth = truth_of(seeded_objects(TEST_SEED, 1, BOX), BOX)

    judged = module.rendered_objects(RIG, 1)

    np.testing.assert_array_equal(judged.maps.image, truth)
    assert judged.maps.depth_m.shape == (1, 64, 80)
    assert len(judged.names) == 1
    assert judged.plan == PLAN


def test_objects_are_rendered_with_the_pulse_of_the_sensor() -> None:
    # The sensor's gain makes up for what a pulse takes from the peaks: echoes without the pulse
    # would be too bright.
    sensor = QUIET.model_copy(update={"pulse_ns": 0.1})
    _, depth_m = object_depth(TEST_SEED, BOX)
    echoes = render(Scene(RIG, depth_m, pulse_ns=sensor.pulse_ns)).multi
    (seen,) = sense([echoes], RIG, sensor)

    judged = module.rendered_objects(RIG, 1, sensor=sensor)

    np.testing.assert_array_equal(judged.maps.intensity[0], seen.intensity)
    np.testing.assert_array_equal(judged.maps.depth_m[0], seen.depth_m)


def test_second_set_is_of_other_kinds_in_the_same_poses() -> None:
    unseen = unseen_objects(BOX)
    names = {one.category for one in unseen}

    assert [one.pose for one in unseen] == [one.pose for one in benchmark_objects(BOX)]
    assert len(unseen) == 54
    assert len(names) == 18
    assert names & CATEGORIES.keys() == set()


def test_objects_of_the_second_set_can_be_seen() -> None:
    assert min(int(np.isfinite(one.depth_m).sum()) for one in unseen_objects(BOX)) > 150


MANY_RIGS = DatasetPlan(
    RIG, 0, accuracy="draft", spread=RigSpread(place_m=0.005, angle_deg=2), objects_per_rig=2
)


@pytest.fixture(scope="module")
def of_many_rigs(tmp_path_factory: pytest.TempPathFactory) -> HeldOutObjects:
    """Three objects of a dataset of many rigs."""
    folder = tmp_path_factory.mktemp("rigs")
    samples = make_samples(MANY_RIGS, range(3))
    store(shard_path(folder, 0), samples, MANY_RIGS.provenance, "")
    return module.dataset_objects(folder)


def test_objects_of_a_dataset_have_the_rigs_of_its_plan(of_many_rigs: HeldOutObjects) -> None:
    first, same, other = of_many_rigs.benches

    assert of_many_rigs.benches == [MANY_RIGS.bench_of(seed)[0] for seed in range(3)]
    assert first == same != other


@pytest.mark.parametrize("n", range(3))
def test_each_object_of_many_rigs_is_aligned_from_its_own(
    of_many_rigs: HeldOutObjects, n: int
) -> None:
    sample = make_samples(MANY_RIGS, [n])
    depth_m = sample["depth_m"][0]
    seen = LidarMaps(depth_m, sample["intensity"][0], np.isfinite(depth_m))
    wanted = MapAlignment(of_many_rigs.benches[n], RIG).align(seen)

    aligned = module.network_input(of_many_rigs.maps, None, of_many_rigs.benches, RECORD)

    np.testing.assert_array_equal(aligned.depth_m[n], wanted.depth_m)
    np.testing.assert_array_equal(aligned.intensity[n], wanted.intensity)


def test_note_says_that_objects_have_rigs_of_their_own(of_many_rigs: HeldOutObjects) -> None:
    notes = notes_about(RECORD, of_many_rigs, None)
    any_rig = replace(of_many_rigs, plan=DatasetPlan(RIG, TEST_SEED, rigs=RigRange()))
    (other,) = notes_about(RECORD, any_rig, None)

    assert "a rig of its own" in notes[0]
    assert "a rig of its own" in other


def test_difference_maps_of_recordings_are_of_maps_as_recorded(tmp_path: Path) -> None:
    maps = small_maps(2, 0)
    recorded = replace(maps, depth_m=maps.depth_m + 1, intensity=maps.intensity + 2)
    truth_m = np.full((2, 64, 64), 0.2, np.float32)
    write_shards(Labelled(maps, recorded, truth_m, ("cup",) * 2, ("a",) * 2, RIG), tmp_path)
    objects = module.dataset_objects(tmp_path)
    flat = np.zeros((64, 80), np.float32)
    difference = RECORD.model_copy(update={"input": "difference maps"})

    np.testing.assert_array_equal(objects.input_of(RECORD, None).depth_m, maps.depth_m)
    less_flat = objects.input_of(difference, (flat, flat))
    np.testing.assert_array_equal(less_flat.depth_m, recorded.depth_m)


def test_sense_matches_simulated_camera(echoes: list[MultiBounce]) -> None:
    world = World(SceneFile(name="any", rig=RIG), echoes, [None, None])

    for k, sensed in enumerate(sense(echoes, RIG)):
        frame = maps_from_frame(world.images(k).frame(RIG.pinhole))
        np.testing.assert_array_equal(sensed.intensity, frame.intensity)


def test_frames_without_noise_are_alike(echoes: list[MultiBounce]) -> None:
    quiet, mean = (sense(echoes[:1], RIG, QUIET, frames=frames)[0] for frames in (1, 3))

    np.testing.assert_allclose(quiet.depth_m, mean.depth_m, atol=1e-6)
    np.testing.assert_allclose(quiet.intensity, mean.intensity, rtol=1e-6)


def test_frames_average_noise_down(echoes: list[MultiBounce]) -> None:
    quiet = sense(echoes[:1], RIG, QUIET, frames=1)[0].intensity
    noisy = (sense(echoes[:1], RIG, frames=frames)[0].intensity for frames in (1, 4))

    one, four = (float(np.abs(some - quiet)[quiet > 5].mean()) for some in noisy)

    assert 0 < four < 0.75 * one


def test_reconstruct_all_takes_one_object_at_a_time(echoes: list[MultiBounce]) -> None:
    def middle(depth_m: np.ndarray, _: object = None) -> np.ndarray:
        return np.nan_to_num(depth_m[:, :, 8:72])

    maps = as_map_set(sense(echoes, RIG), np.zeros((2, 64, 64), np.float32))
    network = Mock(spec=reconstruct_all, side_effect=middle)

    found = reconstruct_all(network, maps)

    shapes = [part.shape for call in network.call_args_list for part in call.args]

    np.testing.assert_array_equal(found, middle(maps.depth_m))
    assert shapes == [(1, 64, 80)] * 4


def test_rig_of_weights_is_known() -> None:
    assert rig_of(RECORD) == RIG


def test_rig_of_a_benchs_weights_is_in_their_record() -> None:
    own = RIG.model_copy(update={"name": "my bench"})
    record = CheckpointRecord(
        rig_name=own.name, rig_checksum=own.checksum, rig=own.model_dump(mode="json")
    )

    assert rig_of(record) == own


def test_unknown_rig_of_weights_is_asked_for() -> None:
    with pytest.raises(SceneError, match=r"'my bench'.*--rig"):
        rig_of(RECORD.model_copy(update={"rig_name": "my bench"}))


def test_note_says_that_objects_have_seeds_of_training() -> None:
    (note,) = notes_about(RECORD, replace(JUDGED, plan=DatasetPlan(RIG, 3)), None)

    assert "may have seen them" in note
    assert notes_about(RECORD, replace(JUDGED, plan=DatasetPlan(RIG, HELD_OUT_SEED)), None) == []


def test_notes_are_none_where_rigs_are_the_same() -> None:
    assert notes_about(RECORD, JUDGED, SmallDataset(JUDGED.maps, PLAN)) == []


@pytest.fixture
def elsewhere() -> SmallDataset:
    """Training maps of another rig."""
    training = SmallDataset(JUDGED.maps, ELSEWHERE)
    training.folder = Path("train")
    return training


def test_notes_name_other_rig_and_categories_left_out(elsewhere: SmallDataset) -> None:
    facts = {"objects": 4, "held_out": 2, "epochs": 1, "batch": 2, "learning_rate": 1e-3}
    recipe = VaeRecipe(task="vae", left_out=["hat", "car"], **facts)
    record = RECORD.model_copy(update={"vae_recipe": recipe})

    other_rig, left_out = notes_about(record, replace(JUDGED, plan=ELSEWHERE), elsewhere)

    assert "paper-rig" in other_rig
    assert "hat" in left_out
    assert "car" not in left_out


def test_note_names_training_maps_of_another_rig(elsewhere: SmallDataset) -> None:
    (note,) = notes_about(RECORD, JUDGED, elsewhere)

    assert "train" in note


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
    plan = SimpleNamespace(rigs=None)

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


def test_maps_of_many_rigs_are_compared_without_the_rigs_numbers() -> None:
    rig = load_rig("paper-rig")
    maps = MapSet(
        np.ones((2, 64, 80), np.float32),
        np.ones((2, 64, 80), np.float32),
        np.zeros((2, 64, 64), np.float32),
    )
    compared = on_wall_grid(maps, [rig, rig])

    assert np.isnan(compared.depth_m[:, :, NUMBERS_COLUMN]).all()
    assert np.isfinite(compared.depth_m[:, :, :NUMBERS_COLUMN]).any()
    assert np.isfinite(maps.depth_m).all()


def test_baselines_without_training_maps_are_two(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(baselines, "NEIGHBOURS", 3)
    trained = procedural_images(TRAINING_SEED, 3, BOX).astype(np.float32)

    answers, among = baseline_answers(JUDGED, None, nearest=False)

    assert (set(answers), among) == ({"all_background", "mean_object"}, None)
    np.testing.assert_allclose(answers["mean_object"][1], trained.mean(0), atol=1e-3)


def test_objects_of_a_dataset_are_not_their_own_neighbours(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(baselines, "NEIGHBOURS", 3)
    dataset = SimpleNamespace(plan=PLAN, seeds={TRAINING_SEED + 1, TRAINING_SEED + 3})
    objects = replace(JUDGED, dataset=dataset)
    trained = procedural_images(TRAINING_SEED + 6, 3, BOX).astype(np.float32)

    answers, _ = baseline_answers(objects, None, nearest=False)

    np.testing.assert_allclose(answers["mean_object"][1], trained.mean(0), atol=1e-3)


def test_training_maps_of_the_same_objects_are_refused(elsewhere: SmallDataset) -> None:
    objects = replace(JUDGED, dataset=elsewhere)
    opened = Mock(return_value=elsewhere)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module.data, "open_dataset", opened)
        with pytest.raises(SceneError, match="same folder"):
            baseline_answers(objects, Path("training"), nearest=True)


def test_whole_training_maps_are_read_beside_their_builder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(baselines, "NEIGHBOURS", 2)
    made = training_maps(replace(PLAN, accuracy="draft"), tmp_path, 1, lambda *_: None)
    busy = Mock(side_effect=FolderBusyError("another process"))
    monkeypatch.setattr(baselines.data, "build_dataset", busy)

    again = training_maps(replace(PLAN, accuracy="draft"), tmp_path, 1, lambda *_: None)

    assert again.folder == made.folder

    with pytest.raises(SceneError, match="--no-nearest"):
        training_maps(replace(PLAN, accuracy="draft"), tmp_path, 1, lambda *_: None, 7)


def test_baselines_are_empty_and_mean_images(images: np.ndarray) -> None:
    guesses = _guesses(_maps(images[:5], seed=1), _maps(images))

    assert not guesses["all_background"].any()
    np.testing.assert_allclose(guesses["mean_object"][3], images.mean(0), atol=1e-3)


@pytest.mark.parametrize("size", [1, 5, 12])
def test_nearest_neighbour_is_found_in_any_chunk(images: np.ndarray, size: int) -> None:
    order = np.array([7, 2, 11, 0])
    progress = list[tuple[int, int]]()
    sought = _maps(images[order], seed=1)

    guesses = _guesses(sought, _maps(images), size, on_progress=lambda *at: progress.append(at))

    np.testing.assert_array_equal(guesses["nearest_neighbour"], images[order])
    assert len(progress) == -(-12 // size)
    assert progress[-1] == (12, 12)


@pytest.mark.parametrize("scale", [1e-6, 0.0])
def test_nearest_neighbour_weighs_channels_by_their_spread(
    images: np.ndarray, scale: float
) -> None:
    """A channel that never varies counts for nothing."""
    both = (_maps(images[:4], seed=1), _maps(images))
    faint = [replace(maps, intensity=scale * maps.intensity) for maps in both]

    np.testing.assert_array_equal(_guesses(*faint)["nearest_neighbour"], images[:4])


class Builds:
    """Builds of training maps that make nothing."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.folder = folder
        self.images = np.zeros((2, 64, 64), np.float16)
        """Images of the training objects."""
        self.asked: list[tuple[DatasetPlan, int, Path]] = []
        """Plan, count and folder of each build."""
        patch.setattr(baselines.data, "build_dataset", lambda *args, **_: self.asked.append(args))
        patch.setattr(baselines.data, "open_dataset", lambda folder: folder)
        patch.setattr(baselines.data, "procedural_images", lambda *_: self.images)
        patch.setattr(baselines, "NEIGHBOURS", 7)

    def folder_of(self, plan: DatasetPlan) -> Path:
        training_maps(plan, self.folder, 1, lambda *_: None)
        return self.asked[-1][2]


@pytest.fixture
def builds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Builds:
    return Builds(tmp_path, monkeypatch)


CUPS = DatasetPlan(RIG, TEST_SEED, objects=Objects(("cup",)))


def test_training_maps_are_cached_by_rig_and_shapes(builds: Builds) -> None:
    lidar = LidarPose(distance_m=0.3, yaw_deg=45)
    moved = replace(CUPS, rig=RIG.model_copy(update={"lidar": lidar}))
    folders = {builds.folder_of(CUPS), builds.folder_of(moved)}
    builds.images = builds.images + np.float16(0.5)

    folders.add(builds.folder_of(CUPS))

    assert len(folders) == 3
    assert {folder.parent.parent for folder in folders} == {builds.folder}


@pytest.mark.parametrize("plan", [CUPS, replace(CUPS, first_seed=5)])
def test_training_maps_of_the_same_rig_are_found_again(builds: Builds, plan: DatasetPlan) -> None:
    assert builds.folder_of(CUPS) == builds.folder_of(plan)


def test_training_maps_are_of_training_objects(builds: Builds) -> None:
    builds.folder_of(CUPS)

    plan, count, _ = builds.asked[0]

    assert count == 7
    assert plan.first_seed == TRAINING_SEED
    assert plan.objects == Objects()


def test_fingerprint_covers_every_category() -> None:
    seeds = range(baselines.FINGERPRINT_OBJECTS)

    assert {object_depth(seed, BOX)[0] for seed in seeds} == set(CATEGORIES)
