"""Training maps of a recipe, in memory, streamed or packed, and the bare wall that difference maps
subtract.
"""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from fake_workers import samples_of
from nlos_calibration import load_rig
from nlos_models import CellNormal
from nlos_models.training import MapBatch
from nlos_models.training.data import flip_some, subtract_bare_wall
from small_maps import SmallDataset, small_maps
from small_run import small_recipe

from nlos_cam.dataset import DatasetPlan, RigSpread, training_maps
from nlos_cam.dataset.packed import (
    CELLS,
    IMAGES,
    INDEX,
    MAPS,
    PackedMaps,
    map_noise,
    open_packed_maps,
)
from nlos_cam.dataset.samples import Samples
from nlos_cam.dataset.shards import shard_path, store
from nlos_cam.dataset.training_maps import MapSplit, Streamed, read_maps, render_bare_wall
from nlos_cam.errors import RecordingError, SceneError
from nlos_cam.files import FileBusyError
from nlos_cam.frames import LidarMaps, maps_from_frame
from nlos_cam.reconstruct import MapAlignment
from nlos_cam.reconstruct.alignment import can_align
from nlos_cam.render import Scene, Sensor, render

PLAN = DatasetPlan(load_rig("paper-rig"), 0)
OTHER = replace(PLAN, rig=PLAN.rig.model_copy(update={"name": "other"}))
RECIPE = small_recipe(task="compressor", objects=4, held_out=2)
WALL = Path("wall.toml")


@pytest.fixture(autouse=True)
def _datasets(monkeypatch: pytest.MonkeyPatch) -> None:
    def opened(of: Path, *, color: bool, expected: bool = False) -> SmallDataset:
        assert not color
        plan = replace(PLAN, expected=True) if expected and of.name == "expected" else PLAN
        return SmallDataset(small_maps(6, len(of.name)), OTHER if "rig" in of.name else plan)

    monkeypatch.setattr(training_maps, "open_dataset", opened)


def _read(
    data: str = "data",
    other: str = "other",
    wall: Path | None = None,
    *,
    stream: bool = False,
    **changes: object,
) -> MapSplit:
    return read_maps(
        RECIPE.model_copy(update=changes), Path(data), Path(other), wall, stream=stream
    )


def test_read_maps_takes_first_objects_of_recipe_and_a_digest_of_objects_and_rig() -> None:
    maps = _read()
    np.testing.assert_array_equal(maps.training.image, small_maps(6, 4).image[:4])
    np.testing.assert_array_equal(maps.held_out.image, small_maps(6, 5).image[:2])
    assert maps.limit_recipe(RECIPE) == RECIPE
    assert _read(held_out=400).limit_recipe(RECIPE).held_out == 6  # all that there are
    pairs = (("data", "other"), ("also", "other"), ("others", "other"), ("rig1", "rig2"))
    digests = [_read(*pair).digest for pair in pairs]
    assert digests[0] == digests[1]
    assert len(set(digests)) == 3


@pytest.mark.parametrize("stream", [False, True])
def test_expected_maps_get_noise_anew_in_each_epoch(stream: bool) -> None:
    """Of its stated deviation, in the intensity alone; the same generator draws the same again."""

    def first(data: str, seed: int) -> MapBatch:
        batches = _read(data, stream=stream, objects=6).training.batches(
            6, torch.Generator().manual_seed(seed)
        )
        return next(iter(batches))

    one = first("expected", 1)
    other = first("expected", 2)
    same = first("expected", 1)
    plain = first("expecte*", 1)
    assert all(torch.equal(mine, its) for mine, its in zip(one[1:], same[1:], strict=True))
    assert torch.equal(one.row, plain.row)
    torch.testing.assert_close(one.depth_m, plain.depth_m, equal_nan=True, rtol=0, atol=0)
    bright = plain.intensity > 10  # no noise is cut off at 0
    off = (one.intensity - plain.intensity)[bright] / map_noise(PLAN).deviation(
        plain.intensity[bright]
    )
    assert abs(float(off.mean())) < 0.05
    assert 0.95 < float(off.std()) < 1.05
    assert not torch.equal(one.intensity, other.intensity)


@pytest.mark.parametrize(
    ("held_out", "wall", "stream", "word"),
    [
        ("other/../data", None, False, "--held-out"),
        ("other", WALL, False, r"wall\.toml"),
        ("other-rig", None, False, "rigs"),
        ("other", None, True, "--objects 6"),
    ],
)
def test_read_maps_refuses_what_does_not_fit(
    held_out: str, wall: Path | None, stream: bool, word: str
) -> None:
    with pytest.raises(SceneError, match=word):
        _read("data", held_out, wall, stream=stream)


def test_rendered_bare_wall_cancels_a_frame_of_bare_wall_of_the_one_rig() -> None:
    depth_m, intensity = render_bare_wall(PLAN, frames=8)
    images = Sensor(PLAN.rig, PLAN.sensor).expose(
        render(Scene(PLAN.rig)).multi, np.random.default_rng(99)
    )
    maps = maps_from_frame(images.frame(PLAN.rig.pinhole))
    valid = maps.valid & ~np.isnan(depth_m)
    assert valid.mean() > 0.5
    assert abs(np.median((maps.depth_m - depth_m)[valid])) < 1e-3
    assert abs(np.median((maps.intensity - intensity)[valid])) < 0.05 * np.median(intensity[valid])
    assert np.median(depth_m[valid]) > 0.1
    with pytest.raises(SceneError, match="--wall"):
        render_bare_wall(replace(PLAN, spread=RigSpread(place_m=0.01)))


@pytest.mark.parametrize("wall", [None, WALL])
def test_difference_maps_subtract_rendered_or_measured_wall(
    monkeypatch: pytest.MonkeyPatch, wall: Path | None
) -> None:
    flat = np.zeros((64, 80), np.float32)
    measured = SimpleNamespace(
        reference=SimpleNamespace(map_depth_m=flat + 0.5, map_intensity=flat + 2)
    )
    monkeypatch.setattr(training_maps, "render_bare_wall", lambda _: (flat + 0.25, flat + 1))
    monkeypatch.setattr(training_maps, "load_measured", lambda _: measured)
    made = _read(wall=wall, maps="difference maps")
    for maps, raw in (
        (made.training.first(4), small_maps(6, 4)),
        (made.held_out, small_maps(6, 5)),
    ):
        difference = raw.intensity[: len(maps.image)] - maps.intensity
        np.testing.assert_allclose(difference[~np.isnan(maps.depth_m)], 2.0 if wall else 1.0)
        nearer_m = (raw.depth_m[: len(maps.image)] - maps.depth_m)[~np.isnan(maps.depth_m)]
        np.testing.assert_allclose(nearer_m, 0.5 if wall else 0.25, rtol=1e-5)
    measured.reference = None
    with pytest.raises(SceneError, match=r"wall\.toml"):
        _read(wall=WALL, maps="difference maps")


def test_streamed_maps_equal_maps_in_memory() -> None:
    maps = small_maps(8, 0)
    generator = np.random.default_rng(0)
    bare = tuple(generator.random((64, 80), np.float32) for _ in range(2))
    stream = Streamed(SmallDataset(maps, PLAN), maps.image, bare)
    whole = subtract_bare_wall(maps, *bare)
    batches, again = (list(stream.batches(4, torch.Generator().manual_seed(3))) for _ in "ab")
    for batch, same in zip(batches, again, strict=True):
        wanted = [torch.from_numpy(part)[batch.row] for part in (whole.depth_m, whole.intensity)]
        found = [batch.depth_m, batch.intensity]
        wanted = flip_some(wanted, batch.mirrored)
        torch.testing.assert_close(found, wanted, rtol=0, atol=0, equal_nan=True)
        assert torch.equal(batch.row, same.row)
        assert torch.equal(batch.mirrored, same.mirrored)
    assert sorted(torch.cat([batch.row for batch in batches]).tolist()) == list(range(8))
    np.testing.assert_array_equal(stream.first(6).depth_m, whole.depth_m[:6])
    assert len(stream.first(99).image) == 8
    assert isinstance(_read(stream=True, objects=6).training, Streamed)


SHARD = 5


def _samples(first: int) -> Samples:
    """Return samples of five seeds with maps and images of full size, known from their seed."""
    noise = np.random.default_rng([first, 1])
    sizes = {"depth_m": (64, 80), "intensity": (64, 80), "image": (64, 64)}
    arrays = {name: noise.random((SHARD, *size), np.float32) for name, size in sizes.items()}
    arrays["depth_m"][:, 0, 0] = np.nan
    return {
        **samples_of(range(first, first + SHARD)),
        **arrays,
        "image": arrays["image"].astype(np.float16),
    }


def _add(folder: Path, first: int, plan: DatasetPlan = PLAN) -> Path:
    folder.mkdir(exist_ok=True)
    store(shard_path(folder, first), _samples(first), plan.provenance, "")
    return folder


def _epoch(packed: PackedMaps, seed: int, batch: int = 2) -> tuple[np.ndarray, np.ndarray]:
    parts = list(packed.batches(batch, torch.Generator().manual_seed(seed)))
    return tuple(np.concatenate([part[k].numpy() for part in parts]) for k in (0, 1))


def test_packed_maps_are_the_datasets_normalised(tmp_path: Path) -> None:
    folders = [_add(tmp_path / "a", 0), _add(tmp_path / "b", 20)]
    with open_packed_maps(folders, tmp_path / "store") as packed:
        assert len(packed) == 2 * SHARD
        wanted = dict[bytes, np.ndarray]()
        for first in (0, 20):
            samples = _samples(first)
            normal = packed.normal(
                *(torch.from_numpy(samples[name]) for name in ("depth_m", "intensity"))
            )
            normal = normal.half().numpy()
            wanted |= {
                image.tobytes(): one for image, one in zip(samples["image"], normal, strict=True)
            }
        maps, images = _epoch(packed, 1)
    assert len({image.tobytes() for image in images}) == 2 * SHARD
    for image, one in zip(images, maps, strict=True):
        np.testing.assert_array_equal(one, wanted[image.tobytes()])


def test_maps_of_many_rigs_are_packed_as_the_one_rig_sees_them_and_others_left_out(
    tmp_path: Path,
) -> None:
    varied = replace(PLAN, spread=RigSpread(angle_deg=40))
    benches = [varied.bench_of(seed)[0] for seed in range(SHARD)]
    seen = [can_align(bench, PLAN.rig) for bench in benches]
    assert 0 < sum(seen) < SHARD
    folder = _add(tmp_path / "a", 0, varied)
    samples = _samples(0)
    with open_packed_maps([folder], tmp_path / "store") as packed:
        assert len(packed) == sum(seen)
        maps, images = _epoch(packed, 1, 1)
        held_out = packed.held_out(folder, SHARD - 1)
    assert len(held_out.image) == sum(seen[:-1])
    for row in np.flatnonzero(seen):
        one = LidarMaps(
            samples["depth_m"][row], samples["intensity"][row], np.isfinite(samples["depth_m"][row])
        )
        aligned = MapAlignment(benches[row], PLAN.rig).align(one)
        wanted = packed.normal(
            *(torch.from_numpy(part[None]) for part in (aligned.depth_m, aligned.intensity))
        )
        found = maps[(images == samples["image"][row]).all((1, 2))]
        np.testing.assert_array_equal(found, wanted.half().numpy())


def test_maps_in_color_are_packed_with_three_intensities_of_one_rig(tmp_path: Path) -> None:
    plan = replace(PLAN, textures=("plain",))
    samples = _samples(0)
    painted = {name: np.stack([samples[name]] * 3, 1) for name in ("intensity", "image")}
    store_shard = {**samples, **painted, "texture": np.array(["plain"] * SHARD, object)}
    for name, made in (("one", plan), ("many", replace(plan, spread=RigSpread(angle_deg=1)))):
        (tmp_path / name).mkdir()
        store(shard_path(tmp_path / name, 0), store_shard, made.provenance, "")
    with open_packed_maps([tmp_path / "one"], tmp_path / "store", color=True) as packed:
        maps, images = _epoch(packed, 1)
        assert packed.held_out(tmp_path / "one", 2).intensity.shape == (2, 3, 64, 80)
    assert (maps.shape[1:], images.shape[1:]) == ((4, 64, 80), (3, 64, 64))
    with pytest.raises(SceneError, match="without a spread"):
        open_packed_maps([tmp_path / "many"], tmp_path / "other", color=True).__enter__()


def test_new_shards_enter_new_epochs_and_an_epoch_can_be_seen_again(tmp_path: Path) -> None:
    folder = _add(tmp_path / "a", 0)
    with open_packed_maps([folder], tmp_path / "store") as packed:
        first = _epoch(packed, 1)
        _add(folder, 5)
        assert len(_epoch(packed, 2)[0]) == 10
    with (tmp_path / "store" / MAPS).open("ab") as file:
        file.write(b"left by an interruption")
    with open_packed_maps([folder], tmp_path / "store") as again:
        assert (len(again), again.digest) == (10, packed.digest)
        for one, other in zip(_epoch(again, 1), first, strict=True):
            np.testing.assert_array_equal(one, other)
        assert len(_epoch(again, 3)[0]) == 10


def test_store_keeps_the_normalisation_of_given_weights(tmp_path: Path) -> None:
    folder = _add(tmp_path / "a", 0)
    store_folder = tmp_path / "store"
    given = CellNormal()
    given.median += 0.5
    with open_packed_maps([folder], store_folder, normal=given) as packed:
        assert torch.equal(packed.normal.median, given.median)
    with open_packed_maps([folder], store_folder) as packed:
        assert torch.equal(packed.normal.median, given.median)
    with (
        pytest.raises(SceneError, match="name another --store"),
        open_packed_maps([folder], store_folder, normal=CellNormal()),
    ):
        pass


def test_open_packed_maps_refuses_a_store_in_use(tmp_path: Path) -> None:
    folder = _add(tmp_path / "a", 0)
    store_folder = tmp_path / "store"
    with (
        open_packed_maps([folder], store_folder),
        pytest.raises(FileBusyError, match="store is being written"),
    ):
        open_packed_maps([folder], store_folder).__enter__()
    with pytest.raises(ZeroDivisionError), open_packed_maps([folder], store_folder):
        raise ZeroDivisionError
    with open_packed_maps([folder], store_folder) as packed:  # free again after an error
        assert len(packed) == SHARD


@pytest.mark.parametrize("name", [CELLS, INDEX, MAPS, IMAGES])
def test_damaged_store_is_refused(tmp_path: Path, name: str) -> None:
    folder = _add(tmp_path / "a", 0)
    with open_packed_maps([folder], tmp_path / "store"):
        file = tmp_path / "store" / name
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(RecordingError, match=f"{name} is damaged"):
        open_packed_maps([folder], tmp_path / "store").__enter__()


def test_expected_maps_have_noise_to_draw_and_mixed_datasets_or_too_few_objects_are_refused(
    tmp_path: Path,
) -> None:
    plain = _add(tmp_path / "a", 0)
    expected = _add(tmp_path / "b", 20, replace(PLAN, expected=True))
    for folder, wanted in ((plain, None), (expected, map_noise(PLAN))):
        with open_packed_maps([folder], tmp_path / f"store of {folder.name}") as packed:
            assert packed.noise == wanted
            with pytest.raises(RecordingError, match="fewer than a batch of 64"):
                next(packed.batches(64, torch.Generator()))
    other_rig = _add(tmp_path / "c", 0, OTHER)
    for other, word in ((expected, "give one kind"), (other_rig, "different rigs")):
        with pytest.raises(SceneError, match=word):
            open_packed_maps([plain, other], tmp_path / "store").__enter__()
