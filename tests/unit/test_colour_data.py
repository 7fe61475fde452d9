"""Maps in colour: laws of the four exposures, and shards that a stop leaves whole."""

from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam import colour_data
from nlos_cam.colour_data import build_colour, build_shard, read_colour, sense_colour
from nlos_cam.colour_objects import colour_object
from nlos_cam.dataset import DatasetPlan
from nlos_cam.errors import RecordingError
from nlos_cam.frames import Float32, maps_from_frame
from nlos_cam.render.renderer import render
from nlos_cam.render.scene import Scene
from nlos_cam.render.sensor import Sensor
from nlos_cam.render.sensor_model import SensorModel
from nlos_cam.render.surface import Surface

RIG = load_rig("paper-rig")
QUIET = SensorModel(range_noise_m=0.0, range_noise_per_m=0.0, read_noise_counts=0.0, shot_noise=0.0, dead_share=0.0)
PLAN = DatasetPlan(RIG, 40, accuracy="draft")


@pytest.fixture(scope="module")
def quiet() -> Sensor:
    return Sensor(RIG, QUIET)


@pytest.fixture(scope="module")
def noisy() -> Sensor:
    return Sensor(RIG, SensorModel())


@pytest.fixture(scope="module")
def shape() -> Float32:
    """A tilted slab without its upper left corner, so large and near that its light wins in many cells."""
    depth_m = np.full((64, 64), np.nan, np.float32)
    depth_m[8:56, 4:52] = np.linspace(0.14, 0.2, 48, dtype=np.float32)
    depth_m[:20, :20] = np.nan
    return depth_m


@pytest.fixture(scope="module")
def painted() -> Float32:
    """Every albedo is a multiple of 1/8, so that the mean of three is the same in any order."""
    return np.random.default_rng(0).choice([0.25, 0.5, 1.0], (64, 64, 3)).astype(np.float32)


@pytest.mark.parametrize("order", [(0, 2, 1), (1, 2, 0), (2, 1, 0)])
def test_exchanging_colours_exchanges_intensities_and_leaves_the_depth(
    quiet: Sensor, shape: Float32, painted: Float32, order: tuple[int, int, int]
) -> None:
    before = sense_colour(shape, painted, quiet, 0, "draft")
    after = sense_colour(shape, painted[..., order], quiet, 0, "draft")
    np.testing.assert_array_equal(after.intensity, before.intensity[list(order)])
    np.testing.assert_array_equal(after.depth_m, before.depth_m)
    assert not np.array_equal(before.intensity[0], before.intensity[1])


def test_a_grey_object_looks_as_it_does_in_one_colour(quiet: Sensor, shape: Float32) -> None:
    maps = sense_colour(shape, np.full((64, 64, 3), 0.5), quiet, 0, "draft")
    echoes = render(Scene(RIG, shape, Surface(0.5)), "draft").multi
    alone = maps_from_frame(quiet.expose(echoes, np.random.default_rng(0)).frame(RIG.pinhole))
    np.testing.assert_array_equal(maps.depth_m, alone.depth_m)
    for intensity in maps.intensity:
        np.testing.assert_array_equal(intensity, alone.intensity)


def test_exposures_agree_with_the_renderers_own_colour_where_one_echo_wins_in_all(
    shape: Float32, painted: Float32
) -> None:
    whole = render(Scene(RIG, shape, Surface(painted)), "draft")
    assert whole.colour is not None
    for channel in range(3):
        alone = render(Scene(RIG, shape, Surface(painted[..., channel])), "draft")
        same = (alone.depth_m == whole.depth_m) & (alone.intensity == alone.multi.peak)
        assert same.sum() > 100
        np.testing.assert_allclose(alone.intensity[same], whole.colour[same, channel], rtol=1e-5)


def test_each_exposure_has_noise_of_its_own_and_the_seed_decides_it(noisy: Sensor, shape: Float32) -> None:
    grey = np.full((64, 64, 3), 0.5)
    one, again, other = (sense_colour(shape, grey, noisy, seed, "draft") for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.intensity, again.intensity)
    assert not np.array_equal(one.intensity, other.intensity)
    assert not np.array_equal(one.intensity[0], one.intensity[1])


def test_a_mirrored_object_is_seen_as_mirrored_maps(quiet: Sensor, shape: Float32, painted: Float32) -> None:
    straight = sense_colour(shape, painted, quiet, 0, "draft")
    mirrored = sense_colour(shape[::-1].copy(), painted[::-1], quiet, 0, "draft")
    valid = ~np.isnan(straight.depth_m) & ~np.isnan(mirrored.depth_m[::-1])
    apart = np.abs(mirrored.intensity[:, ::-1] - straight.intensity)[:, valid]
    assert (apart <= 1.0).mean() > 0.99  # rounding decides some ties between echoes


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("colour")
    for start in (40, 42):
        build_shard(PLAN, folder / f"colour-{start:09d}.h5", range(start, start + 2))
    return folder


@pytest.fixture
def built(shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(colour_data, "SHARD", 2)
    copytree(shards, tmp_path, dirs_exist_ok=True)
    return tmp_path


def test_shards_hold_the_objects_of_their_seeds(built: Path, noisy: Sensor) -> None:
    maps, rig = read_colour(built)
    assert rig == RIG
    assert maps.depth_m.shape == (4, 64, 80)
    assert maps.intensity.shape == (4, 3, 64, 80)
    assert maps.image.shape == (4, 3, 64, 64)
    third = colour_object(42, PLAN.box)
    np.testing.assert_array_equal(maps.image[2], third.image.astype(np.float16))
    again = sense_colour(third.depth_m, third.albedo, noisy, 42, "draft")
    np.testing.assert_array_equal(maps.depth_m[2], again.depth_m)
    np.testing.assert_array_equal(maps.intensity[2], again.intensity)


def test_what_is_there_is_not_made_again(built: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in built.iterdir()}
    (built / "colour-000000044.part").write_bytes(b"cut short")
    seen: list[tuple[int, int]] = []
    build_colour(PLAN, 4, built, workers=1, on_progress=lambda done, total: seen.append((done, total)))
    assert seen == [(4, 4)]
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_another_plan_and_a_broken_shard_are_refused(built: Path) -> None:
    other = DatasetPlan(RIG, 41, accuracy="draft")
    with pytest.raises(RecordingError, match="another rig, seed or accuracy"):
        build_colour(other, 4, built, workers=1, on_progress=lambda *_: None)
    (built / "colour-000000042.h5").write_bytes(b"not HDF5")
    with pytest.raises(RecordingError, match="cannot be read as a shard"):
        read_colour(built)


def test_a_folder_without_colour_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no dataset in colour"):
        read_colour(tmp_path)
