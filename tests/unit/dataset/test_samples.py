"""Dataset samples: maps of the objects of their seeds on the rigs of their seeds, in one color or
in three.
"""

import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
import trimesh
from nlos_calibration import load_rig
from nlos_calibration.arrays import Float32
from nlos_models import CellNormal
from nlos_models.training import InMemory, MapSet, WithNoise
from nlos_models.training.direct import vary

from nlos_cam.dataset import objects_from_folder, procedural_images
from nlos_cam.dataset import samples as dataset_samples
from nlos_cam.dataset.packed import map_noise
from nlos_cam.dataset.plan import DatasetPlan, Objects, RigSpread, scene_row
from nlos_cam.dataset.samples import (
    Samples,
    hidden_object,
    join_samples,
    make_samples,
    sense_color,
    sense_object,
)
from nlos_cam.errors import SceneError
from nlos_cam.frames import LidarMaps
from nlos_cam.objects import (
    CATEGORIES,
    TEXTURES,
    Coat,
    image_from_albedo,
    image_from_depth,
    object_depth,
    paint,
)
from nlos_cam.render import QUIET, Scene, Sensor, SensorModel, Surface, render

RIG = load_rig("paper-rig")
PLAN = DatasetPlan(RIG, 0, accuracy="draft")
BOX = PLAN.box
COLOR = replace(PLAN, first_seed=40, textures=tuple(TEXTURES))
NOISY = Sensor(RIG, SensorModel())
QUIETLY = Sensor(RIG, QUIET)
GREY = np.full((64, 64, 3), 0.5, np.float32)
# A tilted slab without a corner, whose echo wins in many cells.
SHAPE = np.full((64, 64), np.nan, np.float32)
SHAPE[8:56, 4:52] = np.linspace(0.14, 0.2, 48, dtype=np.float32)
SHAPE[:20, :20] = np.nan
# Exact in any order of sums.
PAINT = np.random.default_rng(0).choice([0.25, 0.5, 1.0], (64, 64, 3)).astype(np.float32)
GREY_SCENE = Scene(RIG, SHAPE, Surface(0.5))


@pytest.fixture(scope="module")
def three() -> Samples:
    """Samples of the seeds 0 to 2."""
    return make_samples(PLAN, range(3))


@pytest.mark.parametrize("seed", [0, 2])
def test_sample_is_the_sensed_object_of_its_seed(three: Samples, seed: int) -> None:
    category, depth_m = object_depth(seed, BOX)
    sensed = sense_object(Scene(RIG, depth_m), NOISY, seed, "draft")
    image = image_from_depth(depth_m, BOX).astype(np.float16)

    np.testing.assert_array_equal(three["depth_m"][seed], sensed.depth_m)
    np.testing.assert_array_equal(three["intensity"][seed], sensed.intensity)
    np.testing.assert_array_equal(three["object_depth_m"][seed], depth_m)
    np.testing.assert_array_equal(three["image"][seed], image)
    assert three["category"][seed] == category


@pytest.mark.parametrize("seed", [0, 2])
def test_noise_depends_on_the_seed(seed: int) -> None:
    scene = Scene(RIG, object_depth(seed, BOX)[1])

    sensed, other = (sense_object(scene, NOISY, noise, "draft") for noise in (seed, seed + 1))

    assert not np.array_equal(sensed.depth_m, other.depth_m, equal_nan=True)


def test_samples_have_procedural_images_and_facts_of_the_scene(three: Samples) -> None:
    np.testing.assert_array_equal(three["image"], procedural_images(0, 3, BOX))
    np.testing.assert_array_equal(three["scene"], [[0.2, 45.0, 0.0, 0.2, 0.1, 48.0]] * 3)


def test_samples_are_equal_in_any_pieces(three: Samples) -> None:
    pieces = join_samples([make_samples(PLAN, [0]), make_samples(PLAN, [1, 2])])

    assert pieces.keys() == three.keys()

    for name, values in pieces.items():
        assert values.dtype == three[name].dtype
        np.testing.assert_array_equal(values, three[name])


def test_samples_are_rendered_with_pulse_and_radiometry_of_plan(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[Scene] = []

    def sense(scene: Scene, *_: object, **_options: object) -> LidarMaps:
        seen.append(scene)
        blank = np.zeros((64, 80), np.float32)
        return LidarMaps(blank, blank, blank > 0)

    monkeypatch.setattr(dataset_samples, "sense_object", sense)
    sensor = SensorModel(pulse_ns=1.0)

    make_samples(replace(PLAN, sensor=sensor, radiometry="lambertian", jump_m=0.5), [0])

    assert seen[0].pulse_ns == 1.0
    assert seen[0].radiometry == "lambertian"
    assert seen[0].jump_m == 0.5


class Exposed(NamedTuple):
    """Maps of one scene: expected, and of 60 exposures."""

    expected: LidarMaps
    depth_m: Float32
    intensity: Float32


@pytest.fixture(scope="module")
def exposed() -> Exposed:
    echoes = render(Scene(RIG, SHAPE), "draft").multi
    exposures = [NOISY.maps(echoes, np.random.default_rng(k)) for k in range(60)]
    depth_m, intensity = (
        np.stack([getattr(one, name) for one in exposures]) for name in ("depth_m", "intensity")
    )
    return Exposed(NOISY.maps(echoes, None), depth_m, intensity)


def test_expected_maps_are_the_means_of_exposures(exposed: Exposed) -> None:
    off_m = np.abs(np.mean(exposed.depth_m, 0) - exposed.expected.depth_m)
    off_counts = np.abs(exposed.intensity.mean(0) - exposed.expected.intensity)

    assert np.nanmedian(off_m) < 0.2e-3
    assert np.median(off_counts) < 0.06


def test_noise_drawn_in_training_deviates_as_exposures(exposed: Exposed) -> None:
    expected = exposed.expected
    normal = CellNormal()  # of spread 1
    normal.median[1] = torch.from_numpy(np.log1p(expected.intensity))
    given = (torch.from_numpy(part[None]) for part in (expected.depth_m, expected.intensity))
    maps = normal(*given)
    torch.manual_seed(0)

    drawn = vary(normal, maps.expand(60, -1, -1, -1), map_noise(PLAN), None, None)

    counts = torch.expm1(drawn[:, 1] + normal.median[1])
    ratio = exposed.intensity.std(0) / counts.std(0, correction=0).numpy()

    assert torch.equal(drawn[:, 0], maps[:, 0].expand(60, -1, -1))
    assert 0.97 < np.nanmedian(ratio) < 1.03


def test_noise_of_a_map_set_deviates_as_exposures(exposed: Exposed) -> None:
    expected = exposed.expected
    empty = np.isnan(expected.depth_m)
    image = np.zeros((64, 64), np.float16)
    one = MapSet(*(part[None] for part in (expected.depth_m, expected.intensity, image)))

    drawn = [map_noise(PLAN).expose(one, seed).intensity[0] for seed in range(60)]

    spread = np.stack(drawn).std(0)
    ratio = exposed.intensity.std(0)[~empty] / spread[~empty]

    assert 0.97 < np.median(ratio) < 1.03
    np.testing.assert_array_equal(spread[empty], 0)


@pytest.mark.parametrize("plan", [PLAN, COLOR])
def test_expected_samples_differ_from_exposures_by_noise_alone(plan: DatasetPlan) -> None:
    noisy, expected = (make_samples(replace(plan, expected=one), [3]) for one in (False, True))

    np.testing.assert_array_equal(noisy["image"], expected["image"])
    assert 0 < np.abs(noisy["intensity"] - expected["intensity"]).max() < 3


def test_noise_of_expected_maps_varies_cells_with_a_return_alone() -> None:
    bare = make_samples(replace(COLOR, expected=True), [3])
    maps = InMemory(MapSet(bare["depth_m"], bare["intensity"], bare["image"]))

    (noisy,) = WithNoise(maps, map_noise(COLOR)).batches(1, torch.Generator().manual_seed(0))

    plain = torch.from_numpy(bare["intensity"])
    if noisy.mirrored:
        plain = plain.flip(-2)
    changed = (noisy.intensity != plain)[0]
    empty = noisy.depth_m[0].isnan()

    assert changed[:, ~empty].any(1).all()
    assert not changed[:, empty].any()


def test_variation_leaves_cells_without_a_return_alone() -> None:
    empty = torch.zeros(1, 2, 64, 80)
    reflectance = torch.ones(1, 64, 80)
    offset_m = torch.ones(1)

    assert not vary(CellNormal(), empty, map_noise(PLAN), reflectance, offset_m).any()


def test_sensor_refuses_expected_maps_of_a_textured_wall() -> None:
    textured = Sensor(RIG, SensorModel(wall_texture=0.1))

    with pytest.raises(SceneError, match="expected maps"):
        textured.maps(render(Scene(RIG, SHAPE), "draft").multi, None)


def test_plan_refuses_expected_maps_of_a_textured_wall() -> None:
    with pytest.raises(SceneError, match="drop --expected-maps"):
        replace(PLAN, sensor=SensorModel(wall_texture=0.1), expected=True).check()


def _drawn(objects: Objects, count: int = 60) -> list[tuple[str, Float32]]:
    """Return the category and depth map of the objects of the first seeds."""
    return [hidden_object(objects, seed, BOX) for seed in range(count)]


def test_objects_get_backgrounds_by_their_share() -> None:
    pairs = zip(_drawn(Objects()), _drawn(Objects(backgrounds=0.5)), strict=True)

    larger = sum(np.isfinite(two).sum() > np.isfinite(one).sum() for (_, one), (_, two) in pairs)

    assert 9 < larger < 51


def test_objects_become_generic_shapes_by_their_share() -> None:
    pairs = zip(_drawn(Objects()), _drawn(Objects(share_generic=0.5)), strict=True)

    others = [
        two[0]
        for one, two in pairs
        if one[0] != two[0] or not np.array_equal(one[1], two[1], equal_nan=True)
    ]

    assert 18 < len(others) < 42
    assert not set(others) & set(CATEGORIES)


@pytest.fixture
def meshes(tmp_path: Path) -> Path:
    (tmp_path / "sub").mkdir()
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "cube.stl")
    trimesh.creation.icosphere(subdivisions=1).export(tmp_path / "sub" / "ball.ply")
    return tmp_path


def test_objects_from_folder_are_its_meshes(meshes: Path) -> None:
    progress: list[tuple[int, int]] = []

    objects = objects_from_folder(meshes, BOX, on_progress=lambda *at: progress.append(at))

    assert progress == [(1, 2), (2, 2)]
    assert [name for name, _ in objects.meshes] == ["cube.stl", "sub/ball.ply"]


def test_meshes_of_a_folder_are_hidden_by_seed(meshes: Path) -> None:
    objects = objects_from_folder(meshes, BOX)

    found = _drawn(objects, 12)

    assert {name for name, _ in found} == {"cube.stl", "sub/ball.ply"}

    again = hidden_object(objects_from_folder(meshes, BOX), 3, BOX)

    np.testing.assert_array_equal(again[1], found[3][1])
    assert make_samples(replace(PLAN, objects=objects), [0])["category"][0] == found[0][0]


def test_meshes_are_identified_by_content_not_by_folder(meshes: Path) -> None:
    before = objects_from_folder(meshes, BOX)
    moved = meshes.rename(meshes.with_name("moved"))

    assert objects_from_folder(moved, BOX) == before

    trimesh.creation.box((1, 2, 1)).export(moved / "cube.stl")

    assert objects_from_folder(moved, BOX) != before


def test_changed_mesh_is_refused(meshes: Path) -> None:
    before = objects_from_folder(meshes, BOX)
    trimesh.creation.box((1, 2, 1)).export(meshes / "cube.stl")

    with pytest.raises(SceneError, match=r"cube\.stl"):
        hidden_object(replace(before, meshes=before.meshes[:1]), 0, BOX)


def test_missing_folder_of_meshes_is_named(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=tmp_path.name):
        objects_from_folder(tmp_path / "none", BOX)


def test_meshes_without_their_folder_ask_for_it(meshes: Path) -> None:
    with pytest.raises(SceneError, match="--objects"):
        hidden_object(replace(objects_from_folder(meshes, BOX), folder=None), 0, BOX)


@pytest.mark.skipif(sys.platform != "linux", reason="file names are bytes here")
def test_objects_of_refuses_mesh_name_that_is_not_utf8(meshes: Path) -> None:
    (meshes / "cube.stl").rename(meshes / os.fsdecode(b"caf\xe9.stl"))
    with pytest.raises(SceneError, match="UTF-8"):
        objects_from_folder(meshes, BOX)


def _sensed(depth_m: Float32, albedo: Float32, sensor: Sensor, seed: int = 0) -> LidarMaps:
    return sense_color(Scene(RIG, depth_m, Surface(albedo)), sensor, seed, "draft")


@pytest.fixture(scope="module")
def painted() -> LidarMaps:
    """Maps of the painted slab without noise."""
    return _sensed(SHAPE, PAINT, QUIETLY)


@pytest.mark.slow
@pytest.mark.parametrize("order", [[0, 2, 1], [1, 2, 0], [2, 1, 0]])
def test_swapped_colors_swap_intensities_and_keep_depth(
    painted: LidarMaps, order: list[int]
) -> None:
    swapped = _sensed(SHAPE, PAINT[..., order], QUIETLY)

    assert not np.array_equal(painted.intensity[0], painted.intensity[1])
    np.testing.assert_array_equal(swapped.intensity, painted.intensity[order])
    np.testing.assert_array_equal(swapped.depth_m, painted.depth_m)


@pytest.mark.slow
def test_mirrored_object_gives_mirrored_maps(painted: LidarMaps) -> None:
    mirrored = _sensed(SHAPE[::-1].copy(), PAINT[::-1], QUIETLY)

    valid = ~np.isnan(painted.depth_m) & ~np.isnan(mirrored.depth_m[::-1])
    apart = np.abs(mirrored.intensity[:, ::-1] - painted.intensity)[:, valid]

    assert (apart <= 1.0).mean() > 0.99  # rounding decides some ties between echoes


@pytest.mark.slow
def test_grey_object_is_sensed_as_in_one_color() -> None:
    maps = _sensed(SHAPE, GREY, QUIETLY)

    alone = sense_object(GREY_SCENE, QUIETLY, 0, "draft")

    np.testing.assert_array_equal(maps.depth_m, alone.depth_m)

    for intensity in maps.intensity:
        np.testing.assert_array_equal(intensity, alone.intensity)


@pytest.mark.slow
def test_noise_of_the_depth_is_that_of_the_white_exposure() -> None:
    white = sense_object(GREY_SCENE, NOISY, 7, "draft")

    np.testing.assert_array_equal(_sensed(SHAPE, GREY, NOISY, 7).depth_m, white.depth_m)


@pytest.mark.slow
def test_each_exposure_has_its_own_noise_by_seed() -> None:
    one, again, other = (_sensed(SHAPE, GREY, NOISY, seed).intensity for seed in (7, 7, 2))

    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)
    assert not np.array_equal(one[0], one[1])


@pytest.mark.slow
def test_exposures_match_rendered_colors_where_one_echo_wins() -> None:
    whole = render(Scene(RIG, SHAPE, Surface(PAINT)), "draft")
    for channel in range(3):
        alone = render(Scene(RIG, SHAPE, Surface(PAINT[..., channel])), "draft")
        same = (alone.depth_m == whole.depth_m) & (alone.intensity == alone.multi.peak)
        assert same.sum() > 100
        np.testing.assert_allclose(alone.intensity[same], whole.color[same, channel], rtol=1e-5)


ON_DRAWN_RIG = replace(
    COLOR, spread=RigSpread(place_m=0.02, angle_deg=5, gain_share=0.2), sensor=QUIET
)


@pytest.fixture(scope="module")
def in_color() -> Samples:
    """Sample of the seed 41 on its drawn rig, in color."""
    return make_samples(ON_DRAWN_RIG, [41])


@pytest.fixture(scope="module")
def unpainted() -> Samples:
    """Sample of the same object and rig in one color."""
    return make_samples(replace(ON_DRAWN_RIG, textures=()), [41])


@pytest.fixture(scope="module")
def hidden_m() -> Float32:
    """Depth map of that object."""
    return hidden_object(ON_DRAWN_RIG.objects, 41, BOX)[1]


@pytest.fixture(scope="module")
def coat(hidden_m: Float32) -> Coat:
    """Paint of that object."""
    return paint(41, hidden_m, ON_DRAWN_RIG.textures)


@pytest.mark.parametrize("name", ["object_depth_m", "seed", "scene", "category"])
def test_color_sample_is_a_painted_depth_sample(
    in_color: Samples, unpainted: Samples, name: str
) -> None:
    np.testing.assert_array_equal(in_color[name], unpainted[name])


def test_color_sample_shows_the_paint_of_its_seed(
    in_color: Samples, hidden_m: Float32, coat: Coat
) -> None:
    image = image_from_albedo(coat.albedo, hidden_m).astype(np.float16)
    procedural = procedural_images(41, 1, BOX, textures=ON_DRAWN_RIG.textures)

    assert in_color["texture"][0] == coat.texture
    np.testing.assert_array_equal(in_color["image"][0], image)
    np.testing.assert_array_equal(in_color["image"], procedural)


def test_samples_on_drawn_rig_are_sensed_on_it(
    in_color: Samples, unpainted: Samples, hidden_m: Float32, coat: Coat
) -> None:
    rig, model = ON_DRAWN_RIG.spread.draw(RIG, ON_DRAWN_RIG.sensor, 41)
    sensor = Sensor(rig, model)
    painted = Scene(rig, hidden_m, Surface(coat.albedo))
    sensed = sense_color(painted, sensor, 41, "draft")
    alone = sense_object(Scene(rig, hidden_m), sensor, 41, "draft")

    np.testing.assert_array_equal(in_color["scene"][0], scene_row(rig, model))
    assert in_color["intensity"].shape == (1, 3, 64, 80)

    for samples, maps in ((in_color, sensed), (unpainted, alone)):
        np.testing.assert_array_equal(samples["depth_m"][0], maps.depth_m)
        np.testing.assert_array_equal(samples["intensity"][0], maps.intensity)
