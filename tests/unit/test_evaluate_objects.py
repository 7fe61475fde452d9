"""Test objects in front of the simulated sensor: the same bits each time, less noise with more frames or none."""

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.camera.simulated_world import World
from nlos_cam.dataset.build import TEST_SEED
from nlos_cam.evaluate.subjects import QUIET, as_map_set, echoes_of, reconstruct_all, seeded_objects, sense, truth_of
from nlos_cam.frames import maps_from_frame
from nlos_cam.objects.benchmark import test_set
from nlos_cam.objects.depth_map import image_from_depth, object_box
from nlos_cam.objects.placement import object_depth
from nlos_cam.render.renderer import MultiBounce
from nlos_cam.render.scene_file import SceneFile

RIG = load_rig("paper-rig")
BOX = object_box(RIG)


@pytest.fixture(scope="module")
def echoes() -> list[MultiBounce]:
    return echoes_of(seeded_objects(TEST_SEED, 2, BOX), RIG, lambda *_: None)


def test_seeded_objects_are_those_of_their_seeds_and_progress_is_told() -> None:
    subjects = seeded_objects(TEST_SEED + 1, 2, BOX)
    for k, subject in enumerate(subjects):
        category, depth_m = object_depth(TEST_SEED + 1 + k, BOX)
        assert subject.category == category
        assert category in subject.name
        np.testing.assert_array_equal(subject.depth_m, depth_m)
    seen: list[tuple[int, int]] = []
    echoes_of(subjects, RIG, lambda done, total: seen.append((done, total)))
    assert seen == [(1, 2), (2, 2)]
    np.testing.assert_array_equal(truth_of(subjects, BOX)[1], image_from_depth(subjects[1].depth_m, BOX))


def test_the_test_set_is_54_objects_of_18_categories_that_can_be_judged_on() -> None:
    subjects = test_set(BOX)
    truth = truth_of(subjects, BOX)
    assert truth.shape == (54, 64, 64)
    assert len({subject.name for subject in subjects}) == 54
    assert len({subject.category for subject in subjects}) == 18
    assert (truth > 0).any((1, 2)).all()


def test_sensing_is_repeatable_and_is_what_the_simulated_camera_delivers(echoes: list[MultiBounce]) -> None:
    first, second = sense(echoes, RIG), sense(echoes, RIG)
    world = World(SceneFile(name="any", rig=RIG), echoes, [None, None])
    for k in range(2):
        np.testing.assert_array_equal(first[k].depth_m, second[k].depth_m)
        frame = maps_from_frame(world.images(k).frame(RIG.pinhole))
        np.testing.assert_array_equal(first[k].intensity, frame.intensity)


def test_more_frames_come_nearer_to_no_noise_as_their_root(echoes: list[MultiBounce]) -> None:
    def off(frames: int) -> float:
        noisy = sense(echoes[:1], RIG, frames=frames)[0].intensity
        bright = quiet.intensity > 5
        return float(np.abs(noisy - quiet.intensity)[bright].mean())

    quiet = sense(echoes[:1], RIG, QUIET)[0]
    assert 0 < off(4) < 0.75 * off(1)


def test_a_quiet_sensor_gives_every_frame_alike(echoes: list[MultiBounce]) -> None:
    one, mean = sense(echoes[:1], RIG, QUIET)[0], sense(echoes[:1], RIG, QUIET, frames=3)[0]
    np.testing.assert_allclose(one.depth_m, mean.depth_m, atol=1e-6)
    np.testing.assert_allclose(one.intensity, mean.intensity, rtol=1e-6)


class Echo:
    """A reconstructor that answers with the middle of the depth map."""

    runtime = "none"

    def __init__(self) -> None:
        self.batches: list[int] = []

    def __call__(self, depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
        assert intensity.shape == depth_m.shape
        self.batches.append(len(depth_m))
        return np.nan_to_num(depth_m[:, :, 8:72])


def test_objects_are_reconstructed_one_at_a_time_in_order(echoes: list[MultiBounce]) -> None:
    maps = as_map_set(sense(echoes, RIG), np.zeros((2, 64, 64), np.float32))
    reconstructor = Echo()
    made = reconstruct_all(reconstructor, maps)  # type: ignore[arg-type]
    assert reconstructor.batches == [1, 1]
    np.testing.assert_array_equal(made, np.nan_to_num(maps.depth_m[:, :, 8:72]))
