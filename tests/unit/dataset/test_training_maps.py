"""Training maps of a recipe, in memory, streamed or packed, and the bare wall that difference maps
subtract.
"""

import json
import shutil
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock
from zlib import crc32

import numpy as np
import pytest
import torch
from fake_workers import samples_of
from nlos_calibration import Rig, load_rig
from nlos_models import CellNormal, load_record, shipped_folder
from nlos_models.training import MapBatch
from nlos_models.training.data import flip_some, subtract_bare_wall
from small_maps import SmallDataset, small_maps
from small_run import small_recipe

from nlos_cam.dataset import (
    DatasetPlan,
    Objects,
    RigRange,
    RigSpread,
    data_key,
    open_dataset,
    packing,
    training_maps,
)
from nlos_cam.dataset.packed import (
    CELLS,
    IMAGES,
    MAPS,
    PackedMaps,
    StoreOptions,
    map_noise,
    open_packed_maps,
)
from nlos_cam.dataset.packed_index import INDEX
from nlos_cam.dataset.plan import RECORDED
from nlos_cam.dataset.reader import Dataset, check_held_out
from nlos_cam.dataset.samples import Samples
from nlos_cam.dataset.shards import shard_path, store
from nlos_cam.dataset.training_maps import MapSplit, Streamed, read_maps, render_bare_wall
from nlos_cam.errors import RecordingError, SceneError, WorkersLostError
from nlos_cam.files import FileBusyError
from nlos_cam.frames import LidarMaps, maps_from_frame
from nlos_cam.reconstruct import WALL_GRID, MapAlignment
from nlos_cam.reconstruct.alignment import can_align
from nlos_cam.render import Scene, Sensor, SensorModel, render

PLAN = DatasetPlan(load_rig("paper-rig"), 0)
OTHER = replace(PLAN, rig=PLAN.rig.model_copy(update={"name": "other"}))
MANY = replace(PLAN, rigs=RigRange())
PLANS = {"many": MANY, "dim1": replace(PLAN, sensor=SensorModel(bare_wall_counts=30.0))}
"""Plans of datasets by their names."""
RECIPE = small_recipe(task="compressor", objects=4, held_out=2)
WALL = Path("wall.toml")


@pytest.fixture(autouse=True)
def _datasets(monkeypatch: pytest.MonkeyPatch) -> None:
    def opened(of: Path, *, color: bool, expected: bool = False) -> SmallDataset:
        assert not color
        plan = replace(PLAN, expected=True) if expected and of.name == "expected" else PLAN
        plan = PLANS.get(of.name, plan)
        plan = OTHER if "rig" in of.name else plan
        first_seed = 10 * crc32(of.name.removesuffix(" again").encode())
        return SmallDataset(small_maps(6, len(of.name)), plan, of, first_seed)

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


def test_read_maps_takes_first_objects_of_recipe() -> None:
    maps = _read()

    np.testing.assert_array_equal(maps.training.image, small_maps(6, 4).image[:4])
    np.testing.assert_array_equal(maps.held_out.image, small_maps(6, 5).image[:2])
    assert maps.limit_recipe(RECIPE) == RECIPE


def test_read_maps_limits_recipe_to_what_there_is() -> None:
    assert _read(held_out=400).limit_recipe(RECIPE).held_out == 6


def test_digest_of_read_maps_is_of_objects_and_rig() -> None:
    pairs = (("data", "other"), ("also", "other"), ("others", "other"), ("rig1", "rig2"))

    digests = [_read(*pair).digest for pair in pairs]

    assert digests[0] == digests[1]
    assert len(set(digests)) == 3


def test_digest_of_read_maps_is_of_sensor_and_held_out_maps() -> None:
    pairs = (("data", "other"), ("dim1", "other"), ("data", "dim1"))

    assert len({_read(*pair).digest for pair in pairs}) == 3


def test_digest_of_recordings_is_of_their_samples(tmp_path: Path) -> None:
    plan = replace(PLAN, accuracy=RECORDED)
    folder = _add(tmp_path / "labelled", 0, plan)
    before = data_key(open_dataset(folder))
    assert data_key(open_dataset(folder)) == before

    others = {**_samples(0), "intensity": _samples(5)["intensity"]}
    store(shard_path(folder, 0), others, plan.provenance, "")

    assert data_key(open_dataset(folder)) != before


@pytest.mark.parametrize(("data", "other"), [("many", "other"), ("data", "many")])
def test_maps_of_many_rigs_need_something_that_aligns_them(data: str, other: str) -> None:
    with pytest.raises(SceneError, match="--any-rig"):
        _read(data, other)
    with pytest.raises(SceneError, match="bare wall in common"):
        _read(data, other, WALL, maps="difference maps")


def _first_batch(data: str, seed: int, *, stream: bool) -> MapBatch:
    maps = _read(data, stream=stream, objects=6).training
    return next(iter(maps.batches(6, torch.Generator().manual_seed(seed))))


@pytest.mark.parametrize(("weights", "refused"), [("direct", False), ("any", True)])
def test_expected_maps_that_need_alignment_are_refused(weights: str, refused: bool) -> None:
    start = load_record(shipped_folder(weights))

    with pytest.raises(SceneError, match="--expected-maps") if refused else nullcontext():
        read_maps(RECIPE, Path("expected"), Path("other"), None, start=start)


streamed_or_not = pytest.mark.parametrize("stream", [False, True])


@streamed_or_not
def test_expected_maps_get_noise_anew_in_each_epoch(stream: bool) -> None:
    one = _first_batch("expected", 1, stream=stream)
    other = _first_batch("expected", 2, stream=stream)

    assert not torch.equal(one.intensity, other.intensity)


@streamed_or_not
def test_same_generator_draws_the_same_noise(stream: bool) -> None:
    one, same = (_first_batch("expected", 1, stream=stream) for _ in range(2))

    assert all(torch.equal(mine, its) for mine, its in zip(one[1:], same[1:], strict=True))


@streamed_or_not
def test_noise_has_its_stated_deviation_in_intensity_alone(stream: bool) -> None:
    noisy = _first_batch("expected", 1, stream=stream)
    plain = _first_batch("expecte*", 1, stream=stream)
    bright = plain.intensity > 10  # no noise is cut off at 0
    deviation = map_noise(PLAN).deviation(plain.intensity[bright])

    off = (noisy.intensity - plain.intensity)[bright] / deviation

    assert torch.equal(noisy.row, plain.row)
    torch.testing.assert_close(noisy.depth_m, plain.depth_m, equal_nan=True, rtol=0, atol=0)
    assert abs(float(off.mean())) < 0.05
    assert 0.95 < float(off.std()) < 1.05


@pytest.mark.parametrize(
    ("held_out", "wall", "word"),
    [
        ("other/../data", None, "--held-out"),
        ("data again", None, "6 objects of .* seeds"),
        ("other", WALL, r"wall\.toml"),
        ("other-rig", None, "rigs"),
    ],
)
def test_read_maps_refuses_what_does_not_fit(held_out: str, wall: Path | None, word: str) -> None:
    with pytest.raises(SceneError, match=word):
        _read("data", held_out, wall)


def test_rendered_bare_wall_cancels_a_frame_of_bare_wall() -> None:
    depth_m, intensity = render_bare_wall(PLAN, frames=8)
    sensor = Sensor(PLAN.rig, PLAN.sensor)
    images = sensor.expose(render(Scene(PLAN.rig)).multi, np.random.default_rng(99))
    maps = maps_from_frame(images.frame(PLAN.rig.pinhole))
    valid = maps.valid & ~np.isnan(depth_m)

    assert valid.mean() > 0.5
    assert abs(np.median((maps.depth_m - depth_m)[valid])) < 1e-3
    assert abs(np.median((maps.intensity - intensity)[valid])) < 0.05 * np.median(intensity[valid])
    assert np.median(depth_m[valid]) > 0.1


def test_bare_wall_has_the_pulse_of_the_samples() -> None:
    """Without it the gain, which makes up for the pulse, would saturate every cell."""
    plan = replace(PLAN, sensor=SensorModel(pulse_ns=1.0))

    _, intensity = render_bare_wall(plan, frames=8)
    _, instant = render_bare_wall(PLAN, frames=8)

    lit = np.isfinite(intensity) & (instant > 0)
    assert abs(np.median(intensity[lit] / instant[lit]) - 1) < 0.05


@pytest.mark.parametrize("plan", [replace(PLAN, spread=RigSpread(place_m=0.01)), MANY])
def test_bare_wall_of_many_rigs_is_refused(plan: DatasetPlan) -> None:
    with pytest.raises(SceneError, match="--wall"):
        render_bare_wall(plan)


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A measured wall; the rendered one has half its depth and intensity."""
    flat = np.zeros((64, 80), np.float32)
    reference = SimpleNamespace(map_depth_m=flat + 0.5, map_intensity=flat + 2)
    wall = SimpleNamespace(reference=reference)
    monkeypatch.setattr(training_maps, "render_bare_wall", lambda _: (flat + 0.25, flat + 1))
    monkeypatch.setattr(training_maps, "load_measured", lambda _: wall)
    return wall


@pytest.mark.usefixtures("measured")
@pytest.mark.parametrize(("wall", "depth_m", "intensity"), [(None, 0.25, 1.0), (WALL, 0.5, 2.0)])
def test_difference_maps_subtract_rendered_or_measured_wall(
    wall: Path | None, depth_m: float, intensity: float
) -> None:
    made = _read(wall=wall, maps="difference maps")

    assert (made.digest == _read(maps="difference maps").digest) == (wall is None)
    pairs = ((made.training.first(4), small_maps(6, 4)), (made.held_out, small_maps(6, 5)))
    for maps, raw in pairs:
        count = len(maps.image)
        seen = ~np.isnan(maps.depth_m)
        darker = (raw.intensity[:count] - maps.intensity)[seen]
        nearer_m = (raw.depth_m[:count] - maps.depth_m)[seen]
        np.testing.assert_allclose(darker, intensity)
        np.testing.assert_allclose(nearer_m, depth_m, rtol=1e-5)


def test_measured_wall_without_reference_is_refused(measured: SimpleNamespace) -> None:
    measured.reference = None

    with pytest.raises(SceneError, match=r"wall\.toml"):
        _read(wall=WALL, maps="difference maps")


@pytest.fixture
def bare() -> tuple[np.ndarray, ...]:
    """Depth and intensity of a bare wall."""
    generator = np.random.default_rng(0)
    return tuple(generator.random((64, 80), np.float32) for _ in range(2))


@pytest.fixture
def stream(bare: tuple[np.ndarray, ...]) -> Streamed:
    """Eight small maps as streamed."""
    maps = small_maps(8, 0)
    return Streamed(SmallDataset(maps, PLAN), maps.image, bare)


def _streamed_epoch(stream: Streamed) -> list[MapBatch]:
    return list(stream.batches(4, torch.Generator().manual_seed(3)))


def test_streamed_maps_equal_maps_in_memory(stream: Streamed, bare: tuple[np.ndarray, ...]) -> None:
    whole = subtract_bare_wall(small_maps(8, 0), *bare)

    for batch in _streamed_epoch(stream):
        parts = [torch.from_numpy(part)[batch.row] for part in (whole.depth_m, whole.intensity)]
        wanted = flip_some(parts, batch.mirrored)
        found = [batch.depth_m, batch.intensity]
        torch.testing.assert_close(found, wanted, rtol=0, atol=0, equal_nan=True)

    np.testing.assert_array_equal(stream.first(6).depth_m, whole.depth_m[:6])


def test_streamed_epoch_repeats_by_its_generator(stream: Streamed) -> None:
    for batch, same in zip(_streamed_epoch(stream), _streamed_epoch(stream), strict=True):
        assert torch.equal(batch.row, same.row)
        assert torch.equal(batch.mirrored, same.mirrored)


def test_streamed_epoch_holds_every_map_once(stream: Streamed) -> None:
    rows = torch.cat([batch.row for batch in _streamed_epoch(stream)])

    assert sorted(rows.tolist()) == list(range(8))


def test_first_streamed_maps_are_at_most_all(stream: Streamed) -> None:
    assert len(stream.first(99).image) == 8


def test_read_maps_streams_training_maps() -> None:
    assert isinstance(_read(stream=True, objects=6).training, Streamed)


def test_stream_holds_the_first_objects_of_its_recipe() -> None:
    images = _read(stream=True, objects=4).training.image

    np.testing.assert_array_equal(images, small_maps(6, 4).image[:4])


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


def _normalised(packed: PackedMaps, depth_m: np.ndarray, intensity: np.ndarray) -> np.ndarray:
    return packed.normal(torch.from_numpy(depth_m), torch.from_numpy(intensity)).half().numpy()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A dataset of one shard."""
    return _add(tmp_path / "a", 0)


@pytest.fixture
def store_folder(tmp_path: Path) -> Path:
    """Where packed maps are kept."""
    return tmp_path / "store"


def test_packed_maps_are_the_datasets_normalised(
    folder: Path, tmp_path: Path, store_folder: Path
) -> None:
    folders = [folder, _add(tmp_path / "b", 20)]
    wanted = dict[bytes, np.ndarray]()

    with open_packed_maps(folders, store_folder) as packed:
        assert len(packed) == 2 * SHARD
        for first in (0, 20):
            samples = _samples(first)
            normal = _normalised(packed, samples["depth_m"], samples["intensity"])
            keys = (image.tobytes() for image in samples["image"])
            wanted.update(zip(keys, normal, strict=True))
        maps, images = _epoch(packed, 1)

    assert len({image.tobytes() for image in images}) == 2 * SHARD

    for image, one in zip(images, maps, strict=True):
        np.testing.assert_array_equal(one, wanted[image.tobytes()])


VARIED = replace(PLAN, spread=RigSpread(angle_deg=40))


@pytest.fixture
def benches() -> list[Rig]:
    """The rigs of the varied dataset."""
    return [VARIED.bench_of(seed)[0] for seed in range(SHARD)]


@pytest.fixture
def seen(benches: list[Rig]) -> list[bool]:
    """Whether the one rig can see a rig's maps: some can, some not."""
    found = [can_align(bench, PLAN.rig) for bench in benches]
    assert 0 < sum(found) < SHARD
    return found


def test_maps_that_the_one_rig_cannot_see_are_left_out(
    tmp_path: Path, store_folder: Path, seen: list[bool]
) -> None:
    varied = _add(tmp_path / "varied", 0, VARIED)

    with open_packed_maps([varied], store_folder) as packed:
        assert len(packed) == sum(seen)


def test_held_out_maps_that_the_one_rig_cannot_see_are_left_out(
    tmp_path: Path, store_folder: Path, seen: list[bool]
) -> None:
    varied = _add(tmp_path / "varied", 0, VARIED)
    training = _add(tmp_path / "training", 100)

    with open_packed_maps([training], store_folder) as packed:
        assert len(packed.held_out(varied, SHARD - 1).image) == sum(seen[:-1])


@pytest.mark.parametrize(
    ("first", "plan", "why"),
    [
        (0, PLAN, "same folder"),
        (SHARD - 1, PLAN, "1 objects of .*held-out have the seeds"),
        (100, replace(PLAN, rig=PLAN.rig.model_copy(update={"object_box": None})), "be aligned"),
    ],
)
def test_held_out_maps_that_hold_nothing_out_are_refused(
    tmp_path: Path, store_folder: Path, first: int, plan: DatasetPlan, why: str
) -> None:
    training = _add(tmp_path / "training", 0)
    held_out = training if not first else _add(tmp_path / "held-out", first, plan)

    with (
        open_packed_maps([training], store_folder) as packed,
        pytest.raises(SceneError, match=why),
    ):
        packed.held_out(held_out, 2)


def test_frames_of_the_same_recordings_are_not_held_out(tmp_path: Path) -> None:
    plan = replace(PLAN, accuracy=RECORDED)
    training = open_dataset(_add(tmp_path / "training", 0, plan))
    others = _add(tmp_path / "others", 100, plan)
    same = _add(tmp_path / "same", 100, plan)
    store(shard_path(same, 100), {**_samples(100), **_maps_of(training)}, plan.provenance, "")

    check_held_out(training, open_dataset(others))
    with pytest.raises(SceneError, match=r"frames of .*same are in .*training"):
        check_held_out(training, open_dataset(same))


def _maps_of(dataset: Dataset) -> dict[str, np.ndarray]:
    maps = dataset.arrays()
    return {"depth_m": maps.depth_m, "intensity": maps.intensity, "image": maps.image}


def test_meshes_of_the_same_seeds_are_other_objects(tmp_path: Path, store_folder: Path) -> None:
    training = _add(tmp_path / "training", 0)
    meshes = Objects(categories=(), meshes=(("cup.obj", "0" * 64),))
    held_out = _add(tmp_path / "held-out", 0, replace(PLAN, objects=meshes))

    with open_packed_maps([training], store_folder) as packed:
        assert len(packed.held_out(held_out, 2).image) == 2


@pytest.mark.parametrize("shares", [(0.5, 0.5), (0.5, 0.0), (0.0, 0.5)])
def test_generic_shapes_of_the_same_seeds_are_refused(
    tmp_path: Path, shares: tuple[float, float]
) -> None:
    """Which they are follows from the seed alone, also between meshes."""
    plans = (
        replace(PLAN, objects=Objects(share_generic=shares[0])),
        replace(PLAN, objects=Objects((), (("cup.obj", "0" * 64),), share_generic=shares[1])),
    )
    both = [
        open_dataset(_add(tmp_path / name, 0, plan))
        for name, plan in zip(("training", "held-out"), plans, strict=True)
    ]

    with pytest.raises(SceneError, match="have the seeds") if all(shares) else nullcontext():
        check_held_out(*both)


@pytest.mark.parametrize(("plan", "kept"), [(PLAN, True), (MANY, False), (OTHER, False)])
def test_cells_of_weights_serve_maps_of_their_own_rig_alone(
    tmp_path: Path, store_folder: Path, plan: DatasetPlan, kept: bool
) -> None:
    normal = CellNormal()
    normal.median += 7.0
    record: Any = SimpleNamespace(rig_checksum=PLAN.rig.checksum)
    data = _add(tmp_path / "data", 0, plan)

    with open_packed_maps(
        [data], store_folder, StoreOptions(normal=normal, trained=record)
    ) as packed:
        assert torch.equal(packed.normal.median, normal.median) == kept


def test_store_with_the_cells_of_another_rig_is_refused(tmp_path: Path, store_folder: Path) -> None:
    normal = CellNormal()
    normal.median += 7.0
    record: Any = SimpleNamespace(rig_checksum=OTHER.rig.checksum)
    data = _add(tmp_path / "data", 0, MANY)
    with open_packed_maps([data], store_folder, StoreOptions(normal=normal)):
        pass  # as it was filled before such cells were dropped

    with (
        pytest.raises(SceneError, match="other weights: name another --store"),
        open_packed_maps([data], store_folder, StoreOptions(normal=normal, trained=record)),
    ):
        pass


DIM = SensorModel(bare_wall_counts=30.0)
KNOWN = RigSpread(place_m=0.001)


@pytest.mark.parametrize(
    ("plan", "counts"),
    [
        (PLAN, None),  # the simulated sensor's
        (replace(PLAN, sensor=DIM), 30.0),
        (replace(PLAN, sensor=DIM, spread=KNOWN, off_record=True), 30.0),
        (replace(PLAN, sensor=DIM, spread=KNOWN), None),  # aligned with the plan's rig
        (replace(MANY, sensor=DIM), None),
    ],
)
def test_record_names_the_light_of_the_maps(
    tmp_path: Path, store_folder: Path, plan: DatasetPlan, counts: float | None
) -> None:
    data = _add(tmp_path / "data", 0, plan)
    recipe = small_recipe(task="direct", objects=4, held_out=2)

    with open_packed_maps([data], store_folder) as packed:
        record = packed.record_run(recipe, tmp_path / "out", [])

    assert record.bare_wall_counts == counts
    assert record.rig is None  # it is packaged


def test_record_holds_a_rig_of_ones_own(tmp_path: Path, store_folder: Path) -> None:
    data = _add(tmp_path / "data", 0, OTHER)
    recipe = small_recipe(task="direct", objects=4, held_out=2)

    with open_packed_maps([data], store_folder) as packed:
        record = packed.record_run(recipe, tmp_path / "out", [])

    assert Rig.model_validate(record.rig) == OTHER.rig


def test_one_rig_on_the_wall_grid_makes_weights_for_it(tmp_path: Path, store_folder: Path) -> None:
    data = _add(tmp_path / "data", 0, PLAN)
    recipe = small_recipe(task="direct", objects=4, held_out=2)

    with open_packed_maps([data], store_folder, StoreOptions(maps_rig=WALL_GRID)) as packed:
        record = packed.record_run(recipe, tmp_path / "out", [])

    assert (record.rig_name, record.rig_checksum) == (PLAN.rig.name, WALL_GRID.checksum)
    assert Rig.model_validate(record.rig) == PLAN.rig


def test_datasets_of_two_sensors_are_refused(tmp_path: Path, store_folder: Path) -> None:
    folders = [_add(tmp_path / "a", 0), _add(tmp_path / "b", 100, PLANS["dim1"])]

    with (
        pytest.raises(SceneError, match="sensor"),
        open_packed_maps(folders, store_folder),
    ):
        pass


def test_run_that_begins_anew_sees_the_objects_that_are_there(
    tmp_path: Path, store_folder: Path
) -> None:
    data = _add(tmp_path / "data", 0)
    counts: list[int] = []
    for begins_anew in (False, False, True):
        with open_packed_maps([data], store_folder, StoreOptions(run="one ")) as packed:
            if begins_anew:
                packed.forget_run()
            counts.append(len(_epoch(packed, 1, batch=1)[0]))
        _add(data, 100)

    assert counts == [SHARD, SHARD, 2 * SHARD]


def test_maps_that_are_off_their_record_stay_as_they_are(
    tmp_path: Path, store_folder: Path
) -> None:
    off = _add(tmp_path / "off", 0, replace(VARIED, off_record=True))
    samples = _samples(0)

    with open_packed_maps([off], store_folder) as packed:
        normal = _normalised(packed, samples["depth_m"], samples["intensity"])
        wanted = dict(zip((one.tobytes() for one in samples["image"]), normal, strict=True))
        maps, images = _epoch(packed, 1)

    for image, one in zip(images, maps, strict=True):
        np.testing.assert_array_equal(one, wanted[image.tobytes()])


def test_maps_of_many_rigs_are_packed_as_the_one_rig_sees_them(
    tmp_path: Path, store_folder: Path, benches: list[Rig], seen: list[bool]
) -> None:
    varied = _add(tmp_path / "varied", 0, VARIED)
    samples = _samples(0)

    with open_packed_maps([varied], store_folder) as packed:
        maps, images = _epoch(packed, 1, 1)

    for row in np.flatnonzero(seen):
        depth_m = samples["depth_m"][row]
        one = LidarMaps(depth_m, samples["intensity"][row], np.isfinite(depth_m))
        aligned = MapAlignment(benches[row], PLAN.rig).align(one)
        found = maps[(images == samples["image"][row]).all((1, 2))]
        wanted = _normalised(packed, aligned.depth_m[None], aligned.intensity[None])
        np.testing.assert_array_equal(found, wanted)


COLOR = replace(PLAN, textures=("plain",))


def _add_in_color(folder: Path, plan: DatasetPlan, first: int = 0) -> Path:
    samples = _samples(first)
    painted = {name: np.stack([samples[name]] * 3, 1) for name in ("intensity", "image")}
    texture = np.array(["plain"] * SHARD, object)
    folder.mkdir()
    shard = {**samples, **painted, "texture": texture}
    store(shard_path(folder, first), shard, plan.provenance, "")
    return folder


def test_maps_in_color_are_packed_with_three_intensities(
    tmp_path: Path, store_folder: Path
) -> None:
    one = _add_in_color(tmp_path / "one", COLOR)

    with open_packed_maps([one], store_folder, StoreOptions(color=True)) as packed:
        maps, images = _epoch(packed, 1)
        held_out = packed.held_out(_add_in_color(tmp_path / "other", COLOR, 100), 2)

    assert held_out.intensity.shape == (2, 3, 64, 80)
    assert maps.shape[1:] == (4, 64, 80)
    assert images.shape[1:] == (3, 64, 64)


def test_maps_in_color_of_many_rigs_are_refused(tmp_path: Path, store_folder: Path) -> None:
    many = _add_in_color(tmp_path / "many", replace(COLOR, spread=RigSpread(angle_deg=1)))

    with pytest.raises(SceneError, match="without a spread"):
        open_packed_maps([many], store_folder, StoreOptions(color=True)).__enter__()


def test_new_shards_enter_new_epochs(folder: Path, store_folder: Path) -> None:
    with open_packed_maps([folder], store_folder) as packed:
        _epoch(packed, 1)
        _add(folder, 5)

        assert len(_epoch(packed, 2)[0]) == 10


def test_new_shards_of_held_out_objects_are_refused(
    folder: Path, tmp_path: Path, store_folder: Path
) -> None:
    held_out = _add(tmp_path / "held-out", 100)

    with open_packed_maps([folder], store_folder, StoreOptions(held_out=held_out)) as packed:
        _add(folder, 5)
        _epoch(packed, 1)
        _add(folder, 100)
        with pytest.raises(SceneError, match=r"5 objects of .*held-out have the seeds"):
            _epoch(packed, 2)


@pytest.mark.parametrize("sizes", ["known", "of a store before they were kept"])
def test_store_takes_the_rest_of_a_shard_that_grew(
    folder: Path, store_folder: Path, sizes: str
) -> None:
    with open_packed_maps([folder], store_folder) as packed:
        first = _epoch(packed, 1, 1)
    if sizes != "known":
        index = json.loads((store_folder / INDEX).read_text())
        del index["sizes"]
        (store_folder / INDEX).write_text(json.dumps(index))
    grown = {name: np.concatenate([of, _samples(5)[name]]) for name, of in _samples(0).items()}
    store(shard_path(folder, 0), grown, PLAN.provenance, "")

    with open_packed_maps([folder], store_folder) as packed:
        assert len(packed) == 10
        for one, other in zip(_epoch(packed, 1, 1), first, strict=True):
            np.testing.assert_array_equal(one, other)
        wanted = _normalised(packed, grown["depth_m"], grown["intensity"])
        found = _epoch(packed, 2, 1)[0]
        assert {maps.tobytes() for maps in found} == {maps.tobytes() for maps in wanted}
    with open_packed_maps([folder], store_folder) as packed:
        assert len(packed) == 10


def test_shard_that_grows_enters_the_next_epoch(folder: Path, store_folder: Path) -> None:
    with open_packed_maps([folder], store_folder) as packed:
        _epoch(packed, 1, 1)
        grown = {name: np.concatenate([of, _samples(5)[name]]) for name, of in _samples(0).items()}
        store(shard_path(folder, 0), grown, PLAN.provenance, "")

        assert len(_epoch(packed, 2, 1)[0]) == 10


def test_another_run_in_the_same_store_sees_all_objects(folder: Path, store_folder: Path) -> None:
    with open_packed_maps([folder], store_folder, StoreOptions(run="one ")) as packed:
        _epoch(packed, 1, 1)
        _add(folder, 5)
    with open_packed_maps([folder], store_folder, StoreOptions(run="one ")) as packed:
        assert len(_epoch(packed, 1, 1)[0]) == 5
    with open_packed_maps([folder], store_folder, StoreOptions(run="two ")) as packed:
        assert len(_epoch(packed, 1, 1)[0]) == 10


@pytest.mark.slow  # two processes start
def test_several_processes_pack_the_same_bytes(
    folder: Path, tmp_path: Path, store_folder: Path
) -> None:
    _add(folder, 5)
    _add(folder, 10)

    with (
        open_packed_maps([folder], store_folder) as alone,
        open_packed_maps([folder], tmp_path / "several", processes=2) as several,
    ):
        assert several.digest == alone.digest
        assert len(several) == 15
    for name in (MAPS, IMAGES):
        assert (tmp_path / "several" / name).read_bytes() == (store_folder / name).read_bytes()


def test_a_process_that_ends_while_it_packs_is_told(
    folder: Path, store_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _add(folder, 5)
    pool = Mock(**{"submit.side_effect": BrokenProcessPool})
    monkeypatch.setattr(packing, "ProcessPoolExecutor", lambda *_, **__: pool)

    with pytest.raises(WorkersLostError, match="lower --pack-workers"):
        open_packed_maps([folder], store_folder, processes=2).__enter__()

    pool.shutdown.assert_called_once_with(cancel_futures=True)


class _Pool:
    """Process pool that works in this process, and counts what it was asked for."""

    def __init__(self) -> None:
        self.asked = 0

    def submit(self, work: Callable[..., Any], *arguments: Any) -> Future[Any]:
        self.asked += 1
        done: Future[Any] = Future()
        done.set_result(work(*arguments))
        return done

    def shutdown(self, **_: bool) -> None:
        """End nothing."""


def test_processes_pack_a_few_shards_ahead(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [shard_path(_add(folder, first), first) for first in range(0, 100, SHARD)]
    pool = _Pool()
    monkeypatch.setattr(packing, "ProcessPoolExecutor", lambda *_, **__: pool)
    packer = packing.Packer.of(PLAN.rig, CellNormal(), with_counts=False)
    ahead = packing.AHEAD * 2

    with packing.packing(2) as opened:
        for number, (path, rows) in enumerate(
            zip(paths, opened.rows_of(packer, paths), strict=True), 1
        ):
            assert pool.asked <= number - 1 + ahead
            np.testing.assert_array_equal(rows[MAPS], packer.rows(path)[MAPS])

    assert pool.asked == len(paths)


def test_statistics_are_of_the_shards_that_the_first_epoch_sees(
    folder: Path, tmp_path: Path, store_folder: Path
) -> None:
    """A run that was killed before its first epoch finds more shards when it begins again."""
    with open_packed_maps([folder], store_folder, StoreOptions(shards=1)) as packed:
        alone = packed.digest
    _add(folder, 5)
    with open_packed_maps([folder], tmp_path / "again", StoreOptions(shards=1)) as packed:
        assert packed.digest == alone
    with open_packed_maps([folder], tmp_path / "more", StoreOptions(shards=2)) as packed:
        assert packed.digest != alone


def test_reopened_store_shows_an_epoch_again(folder: Path, store_folder: Path) -> None:
    with open_packed_maps([folder], store_folder) as packed:
        first = _epoch(packed, 1)
        _add(folder, 5)
        _epoch(packed, 2)
    with (store_folder / MAPS).open("ab") as file:
        file.write(b"left by an interruption")

    with open_packed_maps([folder], store_folder) as again:
        assert (len(again), again.digest) == (10, packed.digest)
        for one, other in zip(_epoch(again, 1), first, strict=True):
            np.testing.assert_array_equal(one, other)
        assert len(_epoch(again, 3)[0]) == 10


@pytest.fixture
def given(folder: Path, store_folder: Path) -> CellNormal:
    """A normalisation with which a store was made."""
    normal = CellNormal()
    normal.median += 0.5
    with open_packed_maps([folder], store_folder, StoreOptions(normal=normal)) as packed:
        assert torch.equal(packed.normal.median, normal.median)
    return normal


def test_store_keeps_the_normalisation_of_given_weights(
    folder: Path, store_folder: Path, given: CellNormal
) -> None:
    with open_packed_maps([folder], store_folder) as packed:
        assert torch.equal(packed.normal.median, given.median)


@pytest.mark.usefixtures("given")
def test_store_of_another_normalisation_is_refused(folder: Path, store_folder: Path) -> None:
    with pytest.raises(SceneError, match="name another --store"):
        open_packed_maps([folder], store_folder, StoreOptions(normal=CellNormal())).__enter__()


def _assert_refused(store: Path, dataset: Path, words: str, **options: Any) -> None:
    with pytest.raises(SceneError, match=words) as refused:
        open_packed_maps([dataset], store, StoreOptions(**options)).__enter__()

    assert "name another --store" in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.fixture
def begun(folder: Path, store_folder: Path) -> Path:
    """A store of the dataset `folder`."""
    with open_packed_maps([folder], store_folder) as packed:
        assert len(packed) == SHARD
    return store_folder


@pytest.mark.parametrize(
    ("plan", "words"),
    [
        (OTHER, "aligned with rig paper-rig"),
        (replace(PLAN, expected=True), "differ in: expected"),
        (replace(PLAN, first_seed=5), "differ in: first seed"),
        (replace(PLAN, sensor=SensorModel(ambient_counts=20)), "differ in: sensor"),
    ],
)
def test_store_of_a_dataset_that_was_built_again_is_refused(
    folder: Path, begun: Path, plan: DatasetPlan, words: str
) -> None:
    shutil.rmtree(folder)
    _add(folder, 0, plan)

    _assert_refused(begun, folder, words)


def test_store_that_is_aligned_with_another_rig_is_refused(folder: Path, begun: Path) -> None:
    _assert_refused(begun, folder, "aligned with rig paper-rig.*wall grid", maps_rig=WALL_GRID)


def test_store_of_other_objects_is_refused(tmp_path: Path, begun: Path) -> None:
    _assert_refused(begun, _add(tmp_path / "b", 20), "shard-000000000.h5 is another one")


def test_store_without_a_shard_knows_its_data(tmp_path: Path, folder: Path) -> None:
    """Statistics of the cells are taken before a shard is packed."""
    with open_packed_maps([folder], tmp_path / "store", StoreOptions(shards=1)) as packed:
        assert len(packed) == 0

    _assert_refused(tmp_path / "store", _add(tmp_path / "b", 20), "other data")


def test_store_of_recordings_that_were_labelled_again_is_refused(
    tmp_path: Path, store_folder: Path
) -> None:
    plan = replace(PLAN, accuracy=RECORDED)
    labelled = _add(tmp_path / "labelled", 0, plan)
    with open_packed_maps([labelled], store_folder):
        pass

    others = {**_samples(0), "intensity": _samples(5)["intensity"]}
    store(shard_path(labelled, 0), others, plan.provenance, "")

    _assert_refused(store_folder, labelled, "other data")


def test_store_goes_on_with_another_dataset_beside_its_own(
    folder: Path, tmp_path: Path, begun: Path
) -> None:
    folders = [_add(tmp_path / "b", 20), folder]

    with open_packed_maps(folders, begun) as packed:
        assert len(packed) == 2 * SHARD


def test_store_knows_its_dataset_in_another_place(
    folder: Path, tmp_path: Path, begun: Path
) -> None:
    moved = folder.rename(tmp_path / "moved")
    _add(moved, 5)

    with open_packed_maps([moved], begun) as packed:
        assert len(packed) == 2 * SHARD


@pytest.fixture
def old(folder: Path, begun: Path) -> Path:
    """The store as nlos-cam 0.2.0 wrote it: shards by their paths, and no origin."""
    shards = {str(path.resolve()): SHARD for path in folder.glob("shard-*.h5")}
    (begun / INDEX).write_text(json.dumps({"shards": shards, "epochs": {}}), encoding="utf-8")
    return begun


def test_old_store_goes_on_with_its_own_dataset(folder: Path, old: Path) -> None:
    _add(folder, 5)

    with open_packed_maps([folder], old) as packed:
        assert len(packed) == 2 * SHARD
    _assert_refused(old, folder, "aligned with rig paper-rig", maps_rig=WALL_GRID)


def test_old_store_of_another_dataset_is_refused(tmp_path: Path, old: Path) -> None:
    _assert_refused(old, _add(tmp_path / "b", 20), "other data")


def test_open_packed_maps_refuses_a_store_in_use(folder: Path, store_folder: Path) -> None:
    with (
        open_packed_maps([folder], store_folder),
        pytest.raises(FileBusyError, match="store is being written"),
    ):
        open_packed_maps([folder], store_folder).__enter__()


def test_store_is_free_again_after_an_error(folder: Path, store_folder: Path) -> None:
    with pytest.raises(ZeroDivisionError), open_packed_maps([folder], store_folder):
        raise ZeroDivisionError

    with open_packed_maps([folder], store_folder) as packed:
        assert len(packed) == SHARD


@pytest.mark.parametrize("name", [CELLS, INDEX, MAPS, IMAGES])
def test_damaged_store_is_refused(folder: Path, store_folder: Path, name: str) -> None:
    with open_packed_maps([folder], store_folder):
        file = store_folder / name
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])

    with pytest.raises(RecordingError, match=f"{name} is damaged"):
        open_packed_maps([folder], store_folder).__enter__()


@pytest.fixture
def expected(tmp_path: Path) -> Path:
    """A dataset of expected maps."""
    return _add(tmp_path / "b", 20, replace(PLAN, expected=True))


def test_exposed_maps_have_no_noise_to_draw(folder: Path, store_folder: Path) -> None:
    with open_packed_maps([folder], store_folder) as packed:
        assert packed.noise is None


def test_expected_maps_have_noise_to_draw(expected: Path, store_folder: Path) -> None:
    with open_packed_maps([expected], store_folder) as packed:
        assert packed.noise == map_noise(PLAN)


@pytest.mark.parametrize("kind", ["folder", "expected"])
def test_fewer_objects_than_a_batch_are_refused(
    request: pytest.FixtureRequest, store_folder: Path, kind: str
) -> None:
    with (
        open_packed_maps([request.getfixturevalue(kind)], store_folder) as packed,
        pytest.raises(RecordingError, match="fewer than a batch of 64"),
    ):
        next(packed.batches(64, torch.Generator()))


def test_exposed_and_expected_maps_together_are_refused(
    folder: Path, expected: Path, store_folder: Path
) -> None:
    with pytest.raises(SceneError, match="give one kind"):
        open_packed_maps([folder, expected], store_folder).__enter__()


def test_datasets_of_different_rigs_are_refused(
    folder: Path, tmp_path: Path, store_folder: Path
) -> None:
    other_rig = _add(tmp_path / "c", 0, OTHER)

    with pytest.raises(SceneError, match="different rigs"):
        open_packed_maps([folder, other_rig], store_folder).__enter__()
