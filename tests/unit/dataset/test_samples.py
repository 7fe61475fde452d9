"""Dataset samples: maps of the objects of their seeds on the rigs of their seeds, in one color or
in three.
"""

import os
import sys
from dataclasses import replace
from pathlib import Path

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
    image_from_albedo,
    image_from_depth,
    object_depth,
    paint,
)
from nlos_cam.render import Scene, Sensor, SensorModel, Surface, render

RIG = load_rig("paper-rig")
PLAN = DatasetPlan(RIG, 0, accuracy="draft")
BOX = PLAN.box
COLOR = replace(PLAN, first_seed=40, textures=tuple(TEXTURES))
SILENT = SensorModel(
    range_noise_m=0.0, range_noise_per_m=0.0, read_noise_counts=0.0, shot_noise=0.0, dead_share=0.0
)
NOISY = Sensor(RIG, SensorModel())
QUIET = Sensor(RIG, SILENT)
GREY = np.full((64, 64, 3), 0.5, np.float32)
SHAPE = np.full(
    (64, 64), np.nan, np.float32
)  # a tilted slab without a corner, whose echo wins in many cells
SHAPE[8:56, 4:52] = np.linspace(0.14, 0.2, 48, dtype=np.float32)
SHAPE[:20, :20] = np.nan
PAINT = (
    np.random.default_rng(0).choice([0.25, 0.5, 1.0], (64, 64, 3)).astype(np.float32)
)  # exact in any order of sums


def test_samples_are_rendered_and_sensed_objects_of_their_seeds_in_any_pieces() -> None:
    samples = make_samples(PLAN, range(3))
    for seed in (0, 2):
        category, depth_m = object_depth(seed, BOX)
        sensed = sense_object(Scene(RIG, depth_m), NOISY, seed, "draft")
        np.testing.assert_array_equal(samples["depth_m"][seed], sensed.depth_m)
        np.testing.assert_array_equal(samples["intensity"][seed], sensed.intensity)
        np.testing.assert_array_equal(samples["object_depth_m"][seed], depth_m)
        np.testing.assert_array_equal(
            samples["image"][seed], image_from_depth(depth_m, BOX).astype(np.float16)
        )
        assert samples["category"][seed] == category
        other = sense_object(Scene(RIG, depth_m), NOISY, seed + 1, "draft")  # of another noise
        assert not np.array_equal(sensed.depth_m, other.depth_m, equal_nan=True)
    np.testing.assert_array_equal(samples["image"], procedural_images(0, 3, BOX))
    np.testing.assert_array_equal(samples["scene"], [[0.2, 45.0, 0.0, 0.2, 0.1, 48.0]] * 3)
    pieces = join_samples([make_samples(PLAN, [0]), make_samples(PLAN, [1, 2])])
    assert pieces.keys() == samples.keys()
    for name, values in pieces.items():
        assert values.dtype == samples[name].dtype
        np.testing.assert_array_equal(values, samples[name])


def test_samples_are_rendered_with_pulse_and_radiometry_of_plan(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[Scene] = []

    def sense(scene: Scene, *_: object, **_options: object) -> LidarMaps:
        seen.append(scene)
        blank = np.zeros((64, 80), np.float32)
        return LidarMaps(blank, blank, blank > 0)

    monkeypatch.setattr(dataset_samples, "sense_object", sense)
    make_samples(
        replace(PLAN, sensor=SensorModel(pulse_ns=1.0), radiometry="lambertian", jump_m=0.5), [0]
    )
    assert (seen[0].pulse_ns, seen[0].radiometry, seen[0].jump_m) == (1.0, "lambertian", 0.5)


def test_expected_maps_with_drawn_noise_have_the_law_of_exposures() -> None:
    """Means and deviations over exposures are those of expected maps to which the intensity's noise
    is added.
    """
    echoes = render(Scene(RIG, SHAPE), "draft").multi
    expected = NOISY.maps(echoes, None)
    exposures = [NOISY.maps(echoes, np.random.default_rng(k)) for k in range(60)]
    depth_m, intensity = (
        np.stack([getattr(one, name) for one in exposures]) for name in ("depth_m", "intensity")
    )
    assert np.nanmedian(np.abs(np.mean(depth_m, 0) - expected.depth_m)) < 0.2e-3
    assert np.median(np.abs(intensity.mean(0) - expected.intensity)) < 0.06
    normal = CellNormal()  # of spread 1
    normal.median[1] = torch.from_numpy(np.log1p(expected.intensity))
    maps = normal(
        *(torch.from_numpy(values[None]) for values in (expected.depth_m, expected.intensity))
    )
    torch.manual_seed(0)
    drawn = vary(normal, maps.expand(60, -1, -1, -1), map_noise(PLAN), None, None)
    assert torch.equal(drawn[:, 0], maps[:, 0].expand(60, -1, -1))
    counts = torch.expm1(drawn[:, 1] + normal.median[1])
    ratio = intensity.std(0) / counts.std(0, correction=0).numpy()
    assert 0.97 < np.nanmedian(ratio) < 1.03
    one = MapSet(
        *(
            each[None]
            for each in (expected.depth_m, expected.intensity, np.zeros((64, 64), np.float16))
        )
    )
    spread = np.stack([map_noise(PLAN).expose(one, seed).intensity[0] for seed in range(60)]).std(0)
    assert 0.97 < np.median((intensity.std(0) / spread)[~np.isnan(expected.depth_m)]) < 1.03
    np.testing.assert_array_equal(spread[np.isnan(expected.depth_m)], 0)


def test_expected_samples_differ_from_exposures_by_noise_alone_and_cells_without_a_return_do_not_vary() -> (
    None
):
    exposed, expected = (make_samples(replace(PLAN, expected=one), [3]) for one in (False, True))
    np.testing.assert_array_equal(exposed["image"], expected["image"])
    assert 0 < np.abs(exposed["intensity"] - expected["intensity"]).max() < 3
    painted, bare = (make_samples(replace(COLOR, expected=one), [3]) for one in (False, True))
    assert 0 < np.abs(painted["intensity"] - bare["intensity"]).max() < 3
    maps = InMemory(MapSet(bare["depth_m"], bare["intensity"], bare["image"]))
    (noisy,) = WithNoise(maps, map_noise(COLOR)).batches(1, torch.Generator().manual_seed(0))
    plain = torch.from_numpy(bare["intensity"])
    changed = (noisy.intensity != (plain.flip(-2) if noisy.mirrored else plain))[0]
    assert changed[:, ~noisy.depth_m[0].isnan()].any(1).all()
    assert not changed[:, noisy.depth_m[0].isnan()].any()
    reflectance = torch.ones(1, 64, 80)
    offset_m = torch.ones(1)
    assert not vary(
        CellNormal(), torch.zeros(1, 2, 64, 80), map_noise(PLAN), reflectance, offset_m
    ).any()


def test_expected_maps_of_textured_walls_are_refused() -> None:
    textured = Sensor(RIG, SensorModel(wall_texture=0.1))
    with pytest.raises(SceneError, match="expected maps"):
        textured.maps(render(Scene(RIG, SHAPE), "draft").multi, None)
    with pytest.raises(SceneError, match="drop --expected-maps"):
        replace(PLAN, sensor=SensorModel(wall_texture=0.1), expected=True).check()


def test_objects_leave_categories_out_and_get_backgrounds_and_generic_shapes_by_their_share() -> (
    None
):
    def drawn(objects: Objects, count: int = 60) -> list[tuple[str, Float32]]:
        return [hidden_object(objects, seed, BOX) for seed in range(count)]

    left_out = {"hat", "boat", "cup"}
    plain = drawn(Objects())
    assert {name for name, _ in drawn(Objects.without([*left_out]), 150)} == set(
        CATEGORIES
    ) - left_out
    pairs = zip(plain, drawn(Objects(backgrounds=0.5)), strict=True)
    assert (
        9
        < sum(np.isfinite(two).sum() > np.isfinite(one).sum() for (_, one), (_, two) in pairs)
        < 51
    )
    pairs = zip(plain, drawn(Objects(share_generic=0.5)), strict=True)
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


def test_objects_of_hides_meshes_of_a_folder_by_seed(meshes: Path) -> None:
    seen: list[tuple[int, int]] = []
    objects = objects_from_folder(meshes, lambda *at: seen.append(at))
    assert seen == [(1, 2), (2, 2)]
    assert [name for name, _ in objects.meshes] == ["cube.stl", "sub/ball.ply"]
    found = [hidden_object(objects, seed, BOX) for seed in range(12)]
    assert {name for name, _ in found} == {"cube.stl", "sub/ball.ply"}
    np.testing.assert_array_equal(
        hidden_object(objects_from_folder(meshes), 3, BOX)[1], found[3][1]
    )
    assert make_samples(replace(PLAN, objects=objects), [0])["category"][0] == found[0][0]


def test_meshes_are_identified_by_content_not_by_folder(meshes: Path) -> None:
    before = objects_from_folder(meshes)
    moved = meshes.rename(meshes.with_name("moved"))
    assert objects_from_folder(moved) == before
    trimesh.creation.box((1, 2, 1)).export(moved / "cube.stl")
    assert objects_from_folder(moved) != before
    with pytest.raises(SceneError, match=r"cube\.stl"):
        hidden_object(replace(before, folder=moved, meshes=before.meshes[:1]), 0, BOX)
    with pytest.raises(SceneError, match=moved.parent.name):
        objects_from_folder(moved.parent / "none")
    with pytest.raises(SceneError, match="--objects"):
        hidden_object(replace(before, folder=None), 0, BOX)


@pytest.mark.skipif(sys.platform != "linux", reason="file names are bytes here")
def test_objects_of_refuses_mesh_name_that_is_not_utf8(meshes: Path) -> None:
    (meshes / "cube.stl").rename(meshes / os.fsdecode(b"caf\xe9.stl"))
    with pytest.raises(SceneError, match="UTF-8"):
        objects_from_folder(meshes)


def _sensed(depth_m: Float32, albedo: Float32, sensor: Sensor, seed: int = 0) -> LidarMaps:
    return sense_color(Scene(RIG, depth_m, Surface(albedo)), sensor, seed, "draft")


@pytest.mark.slow
def test_swapped_colors_swap_intensities_and_keep_depth_and_mirrored_object_gives_mirrored_maps() -> (
    None
):
    before = _sensed(SHAPE, PAINT, QUIET)
    assert not np.array_equal(before.intensity[0], before.intensity[1])
    for order in ([0, 2, 1], [1, 2, 0], [2, 1, 0]):
        after = _sensed(SHAPE, PAINT[..., order], QUIET)
        np.testing.assert_array_equal(after.intensity, before.intensity[order])
        np.testing.assert_array_equal(after.depth_m, before.depth_m)
    mirrored = _sensed(SHAPE[::-1].copy(), PAINT[::-1], QUIET)
    valid = ~np.isnan(before.depth_m) & ~np.isnan(mirrored.depth_m[::-1])
    apart = np.abs(mirrored.intensity[:, ::-1] - before.intensity)[:, valid]
    assert (apart <= 1.0).mean() > 0.99  # rounding decides some ties between echoes


@pytest.mark.slow
def test_grey_object_is_sensed_as_in_one_color_and_each_exposure_has_its_own_noise_by_seed() -> (
    None
):
    scene = Scene(RIG, SHAPE, Surface(0.5))
    maps = _sensed(SHAPE, GREY, QUIET)
    alone = sense_object(scene, QUIET, 0, "draft")
    np.testing.assert_array_equal(maps.depth_m, alone.depth_m)
    for intensity in maps.intensity:
        np.testing.assert_array_equal(intensity, alone.intensity)
    one, again, other = (_sensed(SHAPE, GREY, NOISY, seed) for seed in (7, 7, 2))
    white = sense_object(
        scene, NOISY, 7, "draft"
    )  # the noise of the depth is that of the white exposure
    np.testing.assert_array_equal(one.depth_m, white.depth_m)
    np.testing.assert_array_equal(one.intensity, again.intensity)
    assert not np.array_equal(one.intensity, other.intensity)
    assert not np.array_equal(one.intensity[0], one.intensity[1])


@pytest.mark.slow
def test_exposures_match_rendered_colors_where_one_echo_wins() -> None:
    whole = render(Scene(RIG, SHAPE, Surface(PAINT)), "draft")
    for channel in range(3):
        alone = render(Scene(RIG, SHAPE, Surface(PAINT[..., channel])), "draft")
        same = (alone.depth_m == whole.depth_m) & (alone.intensity == alone.multi.peak)
        assert same.sum() > 100
        np.testing.assert_allclose(alone.intensity[same], whole.color[same, channel], rtol=1e-5)


def test_color_samples_are_painted_depth_samples_on_drawn_rig() -> None:
    plan = replace(
        COLOR, spread=RigSpread(place_m=0.02, angle_deg=5, gain_share=0.2), sensor=SILENT
    )
    made = make_samples(plan, [41])
    plain = make_samples(replace(plan, textures=()), [41])
    assert made["intensity"].shape == (1, 3, 64, 80)
    for name in ("object_depth_m", "seed", "scene", "category"):
        np.testing.assert_array_equal(made[name], plain[name])
    depth_m = hidden_object(plan.objects, 41, plan.box)[1]
    coat = paint(41, depth_m, plan.textures)
    assert made["texture"][0] == coat.texture
    np.testing.assert_array_equal(
        made["image"][0], image_from_albedo(coat.albedo, depth_m).astype(np.float16)
    )
    np.testing.assert_array_equal(
        made["image"], procedural_images(41, 1, plan.box, textures=plan.textures)
    )
    rig, model = plan.spread.draw(plan.rig, plan.sensor, 41)
    np.testing.assert_array_equal(made["scene"][0], scene_row(rig, model))
    sensor = Sensor(rig, model)
    in_color = sense_color(Scene(rig, depth_m, Surface(coat.albedo)), sensor, 41, "draft")
    for samples, maps in (
        (made, in_color),
        (plain, sense_object(Scene(rig, depth_m), sensor, 41, "draft")),
    ):
        np.testing.assert_array_equal(samples["depth_m"][0], maps.depth_m)
        np.testing.assert_array_equal(samples["intensity"][0], maps.intensity)
