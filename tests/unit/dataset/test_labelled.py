"""Labelled recordings as a dataset: maps of their frames, ground truth by label, shards that read
as written.
"""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from nlos_calibration import Rig, dump_toml, load_rig
from nlos_calibration.errors import CalibrationError
from nlos_models.training import MapSet
from small_frames import FrameCamera, sheet_network, small_frame
from small_run import small_recipe

from nlos_cam.camera import Recording, SimulatedCamera, World
from nlos_cam.dataset import (
    DatasetPlan,
    build_dataset,
    label_recordings,
    open_dataset,
    read_labelled,
    read_maps,
    training_maps,
    write_shards,
)
from nlos_cam.dataset import labelled as labelled_shards
from nlos_cam.dataset.build import SHARD
from nlos_cam.dataset.labelled import (
    RECORDED,
    Labelled,
    benchmark_depths,
    spread,
    spread_maps,
    truth_depth_m,
)
from nlos_cam.dataset.plan import move_lidar
from nlos_cam.dataset.shards import store
from nlos_cam.errors import DiskFullError, NlosCamError, RecordingError, SceneError
from nlos_cam.frames import LidarMaps, maps_from_frame
from nlos_cam.objects import benchmark_objects as fixed_set
from nlos_cam.objects import cell_centers_m, image_from_depth, object_box
from nlos_cam.reconstruct import Arrival, CalibratedRig, Pipeline, open_bench
from nlos_cam.recording import ReplayCamera, SidecarFile, sidecar_path
from nlos_cam.recording.sidecar import WallFile
from nlos_cam.render import Scene, SceneFile, render

RIG = load_rig("paper-rig")
BOX = object_box(RIG)
SLOPE = np.linspace(BOX.z_near_m, BOX.z_far_m, 4096, dtype=np.float32).reshape(64, 64)
KNOWN = {
    "slope": SLOPE,
    "half": np.where(np.arange(64) < 32, np.float32(0.2), np.float32(np.nan)) + 0 * SLOPE,
}
known = Mock(return_value=KNOWN)
CUP = np.full((64, 64), 0.2, np.float32)
BALL = trimesh.creation.icosphere(subdivisions=3)


def _sidecar(path: Path, rig: Rig | None = None, **facts: Any) -> Path:
    camera = ReplayCamera(path)
    camera.rig = rig or camera.rig
    SidecarFile(sidecar_path(path), camera, **facts)
    return path


def live_maps(
    recording: Path, bench: CalibratedRig, frames: int, *, difference: bool = False
) -> list[LidarMaps]:
    """Return the maps that a pipeline gives to networks of the bench's own rig, of those frames
    that are labelled.
    """
    pipeline = Pipeline(bench.afresh(), sheet_network, uses_difference=difference)
    with ReplayCamera(recording) as camera:
        prepared = [pipeline.prepare(Arrival(frame, 0.0, ()), lambda: 0.0, 0.0) for frame in camera]
    chosen = sorted(spread(len(prepared), frames))
    return [prepared[number].network_input for number in chosen]


def assert_same(found: MapSet, wanted: list[LidarMaps]) -> None:
    """Compare all bits of maps."""
    np.testing.assert_array_equal(found.depth_m, np.stack([one.depth_m for one in wanted]))
    np.testing.assert_array_equal(found.intensity, np.stack([one.intensity for one in wanted]))


Label = Callable[..., Path]


@pytest.fixture
def labelled(noise_bag: Path, tmp_path: Path) -> Label:
    """A recording of twenty frames of noise with a sidecar."""

    def make(name: str, label: str | None = "slope", **others: Any) -> Path:
        shutil.copy(noise_bag, path := tmp_path / f"{name}.bag")
        return _sidecar(path, label=label, **others)

    return make


@pytest.fixture
def paths(labelled: Label) -> list[Path]:
    """Two recordings, one of each known object."""
    return [labelled("a"), labelled("b", "half")]


def test_read_labelled_keeps_maps_as_recorded(paths: list[Path], noise_world: Any) -> None:
    world = noise_world()

    found = read_labelled(paths, known=known, frames=4)

    images = [world.images(number) for number in (2, 7, 12, 17)]
    frames = [maps_from_frame(one.frame(world.rig.pinhole)) for one in images]

    for name in ("depth_m", "intensity"):
        wanted = [getattr(maps, name) for maps in frames]
        np.testing.assert_array_equal(getattr(found.recorded, name)[:4], wanted)
    assert found.rig == RIG


def test_maps_of_a_recording_are_without_its_drift(
    paths: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    still = read_labelled(paths, known=known, frames=4)
    drifts_m = iter(np.linspace(0.0, 0.001, 20).tolist() * 2)
    monkeypatch.setattr(CalibratedRig, "follow", lambda *_: next(drifts_m))

    found = read_labelled(paths, known=known, frames=4)

    for name in ("maps", "recorded"):
        off_m = getattr(found, name).depth_m - getattr(still, name).depth_m
        assert float(np.nanmedian(off_m)) == pytest.approx(-0.001, abs=1e-6)


def test_a_recording_on_which_the_lidar_moved_is_refused(
    paths: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CalibratedRig, "moved", True)

    with pytest.raises(RecordingError, match=r"a\.bag: the lidar was not where"):
        read_labelled(paths, known=known)


def test_read_labelled_pairs_frames_with_truth_of_their_label(paths: list[Path]) -> None:
    found = read_labelled(paths, known=known, frames=4)

    assert found.label == ("slope",) * 4 + ("half",) * 4
    assert found.recording == ("a.bag",) * 4 + ("b.bag",) * 4

    for k, label in enumerate(found.label):
        image = image_from_depth(KNOWN[label], BOX).astype(np.float16)
        np.testing.assert_array_equal(found.object_depth_m[k], KNOWN[label])
        np.testing.assert_array_equal(found.maps.image[k], image)


def test_read_labelled_reports_progress(paths: list[Path]) -> None:
    progress = list[tuple[int, int]]()

    read_labelled(paths, known=known, frames=4, on_progress=lambda *at: progress.append(at))

    assert progress == [(1, 2), (2, 2)]


@given(st.integers(0, 1000), st.integers(1, 100))
def test_spread_chooses_different_frames_of_the_recording(count: int, wanted: int) -> None:
    chosen = spread(count, wanted)

    assert len(set(chosen)) == len(chosen) == min(count, wanted)
    assert set(chosen) <= set(range(count))


@given(st.integers(1, 1000), st.integers(1, 100))
def test_spread_chooses_frames_evenly(count: int, wanted: int) -> None:
    chosen = sorted(spread(count, wanted))

    # Mirrored at both ends: neither end is left out.
    gaps = np.diff([-chosen[0] - 1, *chosen, 2 * count - chosen[-1]])

    assert np.ptp(gaps) <= 2


@pytest.fixture
def corrected(labelled: Label) -> Path:
    """A recording whose sidecar names a wall record."""
    return labelled("a", wall=(RIG, WallFile(path="there/wall.toml", sha256="")))


@pytest.fixture
def wall(measured: Callable[..., Any], tmp_path: Path) -> Callable[..., Path]:
    """A wall record with these fields."""

    def write(**fields: Any) -> Path:
        path = tmp_path / "wall.toml"
        path.write_text(dump_toml(measured(**fields).record), encoding="utf-8")
        return path

    return write


def test_read_labelled_asks_for_the_wall_record_of_the_sidecar(corrected: Path) -> None:
    with pytest.raises(RecordingError, match=r"there/wall\.toml"):
        read_labelled([corrected], known=known)


def test_read_labelled_corrects_by_wall_record(corrected: Path, wall: Callable[..., Path]) -> None:
    record = wall(range_offset_m=0.004)
    with ReplayCamera(corrected) as camera:
        bench = open_bench(record, camera)

    found = read_labelled([corrected], known=known, wall=record, frames=2)

    assert found.rig.name == "measured"
    assert_same(found.maps, live_maps(corrected, bench, 2))
    assert np.nanmax(found.maps.depth_m - found.recorded.depth_m) > 0.0039


@pytest.fixture
def walled(measured: Callable[..., Any]) -> CalibratedRig:
    """A bench with a range offset, and the bare wall's record."""
    wall = measured(yaw_deg=45.0, pitch_deg=0.0, range_offset_m=0.004)
    return CalibratedRig(wall.record.rig, wall)


def test_labelled_maps_are_those_that_live_gives(
    labelled: Label, walled: CalibratedRig, tmp_path: Path
) -> None:
    recording = labelled("a", "cup-1")

    label_recordings(tmp_path, tmp_path / "data", wall=lambda _: walled, frames=3)

    found = open_dataset(tmp_path / "data")
    raw = found.as_recorded().arrays()
    assert_same(found.arrays(), live_maps(recording, walled, 3))
    assert np.nanmax(np.abs(found.arrays().depth_m - raw.depth_m)) > 0.004
    assert not np.array_equal(found.arrays().intensity, raw.intensity)


def test_labelled_maps_have_the_occluders_edge_repaired(tmp_path: Path, hurried_clock: Any) -> None:
    scene = SceneFile(name="off", rig=move_lidar(RIG, -0.002, 0.0, 0.0))
    world = World(scene, [render(Scene(scene.rig, KNOWN["half"]), "draft").multi], [None])
    recording = Recording(tmp_path / "off.bag", frames=2)
    with SimulatedCamera("sim:off", world, clock=hurried_clock(), recording=recording) as camera:
        assert len(list(camera)) >= 1
    path = _sidecar(tmp_path / "off.bag", RIG, label="slope")

    found = read_labelled([path], known=known, frames=2)

    assert_same(found.maps, live_maps(path, CalibratedRig(RIG), 2))
    assert not np.array_equal(found.maps.depth_m, found.recorded.depth_m)


def test_difference_maps_of_recordings_are_those_of_live(
    labelled: Label, walled: CalibratedRig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = labelled("a", "cup-1")
    for name in ("data", "other"):
        label_recordings(tmp_path, tmp_path / name, wall=lambda _: walled, frames=4)
    reference: Any = walled.reference
    bare = reference.map_depth_m, reference.map_intensity
    monkeypatch.setattr(training_maps, "measured_bare_wall", lambda _: bare)
    # both are of one recording, which training refuses
    monkeypatch.setattr(training_maps, "check_held_out", lambda *_: None)
    recipe = small_recipe(task="compressor", objects=4, held_out=4, maps="difference maps")

    found = read_maps(recipe, tmp_path / "data", tmp_path / "other", Path("wall.toml"))

    assert_same(found.held_out, live_maps(recording, walled, 4, difference=True))
    assert_same(found.training.first(4), live_maps(recording, walled, 4, difference=True))


def test_difference_maps_of_recordings_need_a_measured_wall(tmp_path: Path) -> None:
    for name, farther_m in (("data", 0.0), ("other", 0.001)):
        samples = _samples(4)
        maps = replace(samples.maps, depth_m=samples.maps.depth_m + np.float32(farther_m))
        write_shards(replace(samples, maps=maps), tmp_path / name)
    recipe = small_recipe(task="compressor", objects=4, held_out=4, maps="difference maps")

    with pytest.raises(SceneError, match="--wall"):
        read_maps(recipe, tmp_path / "data", tmp_path / "other", None)


def test_read_labelled_refuses_wall_record_of_another_size(
    corrected: Path, wall: Callable[..., Path]
) -> None:
    with pytest.raises(CalibrationError, match=r"80x60.*64x48"):
        read_labelled([corrected], known=known, wall=wall(width=80))


OWN = RIG.model_copy(update={"name": "own"})


@pytest.mark.parametrize(("rig", "used"), [(OWN, OWN), (load_rig("bare-wall"), RIG)])
def test_read_labelled_uses_the_rig_of_the_sidecar(labelled: Label, rig: Rig, used: Rig) -> None:
    path = _sidecar(labelled("a"), rig, label="slope")

    assert read_labelled([path], known=known, frames=1).rig == used


def test_read_labelled_refuses_sidecars_of_two_rigs(labelled: Label) -> None:
    paths = [
        _sidecar(labelled("a"), load_rig("bare-wall"), label="slope"),
        _sidecar(labelled("b"), OWN, label="slope"),
    ]

    with pytest.raises(RecordingError, match=r"a\.bag.*b\.bag"):
        read_labelled(paths, known=known)


@pytest.mark.parametrize(("label", "word"), [(None, "--label"), ("", "--label"), ("mug", "mug")])
def test_read_labelled_refuses_missing_or_unknown_label(
    labelled: Label, label: str | None, word: str
) -> None:
    path = labelled("a", label)

    with pytest.raises(RecordingError, match=rf"a\.bag.*{word}"):
        read_labelled([path], known=known)


def test_read_labelled_refuses_recording_without_sidecar(labelled: Label) -> None:
    path = labelled("a")
    sidecar_path(path).unlink()

    with pytest.raises(RecordingError, match=r"a\.json"):
        read_labelled([path], known=known)


@pytest.fixture
def dark(noise_world: Any, hurried_clock: Any, tmp_path: Path) -> Callable[[int], Path]:
    """A recording of four frames that are dark from some frame on."""

    def record(dark_from: int) -> Path:
        class Dark(noise_world):
            def images(self, number: int) -> Any:
                seen = super().images(number)
                seen.depth_z16[:] = 0 if number >= dark_from else seen.depth_z16
                return seen

        path = tmp_path / "dark.bag"
        recording = Recording(path, frames=4)
        with SimulatedCamera(
            "sim:dark", Dark(), clock=hurried_clock(), recording=recording
        ) as camera:
            assert len(list(camera)) >= 1
        return _sidecar(path, label="slope")

    return record


def test_dark_frames_are_skipped(dark: Callable[[int], Path]) -> None:
    assert len(read_labelled([dark(2)], known=known).label) == 2


def test_recording_of_dark_frames_alone_is_refused(dark: Callable[[int], Path]) -> None:
    path = dark(0)

    with pytest.raises(RecordingError, match=r"dark\.bag"):
        read_labelled([path], known=known)


IR = [np.full((64, 80), number, np.uint8) for number in range(6)]


def _truth(folder: Path, label: str = "mug", name: str = "F") -> np.ndarray:
    return truth_depth_m(folder / f"{name}.bag", label, RIG, {"cup-1": CUP})


def _write_truth(folder: Path, text: str) -> None:
    (folder / "mug.truth.toml").write_text(text, encoding="utf-8")


def test_truth_is_the_depth_map_of_the_label(tmp_path: Path) -> None:
    of_label = np.where(np.eye(64) > 0, np.float32(0.3), np.float32(np.nan))
    np.save(tmp_path / "cup-1.npy", of_label)

    np.testing.assert_array_equal(_truth(tmp_path, "cup-1"), of_label)


def test_depth_map_of_the_recording_goes_before_the_labels(tmp_path: Path) -> None:
    of_recording = np.full((64, 64), 0.25, np.float32)
    of_label = np.full((64, 64), 0.3, np.float32)
    np.save(tmp_path / "F.npy", of_recording)
    np.save(tmp_path / "cup-1.npy", of_label)

    np.testing.assert_array_equal(_truth(tmp_path, "cup-1"), of_recording)
    np.testing.assert_array_equal(_truth(tmp_path, "cup-1", name="G"), of_label)


def test_truth_without_files_is_the_test_object_of_the_label() -> None:
    assert _truth(Path("nowhere"), "cup-1") is CUP


def test_benchmark_depths_are_those_of_the_test_objects() -> None:
    things = fixed_set(BOX)
    cup = next(thing for thing in things if thing.name == "cup-2")

    depths_m = benchmark_depths(BOX)

    assert list(depths_m) == [thing.name for thing in things]
    np.testing.assert_array_equal(depths_m["cup-2"], cup.depth_m)


@pytest.mark.parametrize(("mesh", "named"), [("print.stl", 'file = "print.stl"'), ("mug.stl", "")])
def test_truth_of_mesh_stands_at_its_pose(tmp_path: Path, mesh: str, named: str) -> None:
    BALL.export(tmp_path / mesh)
    _write_truth(tmp_path, f"{named}\nsize_m = 0.1\nx_m = 0.05\ny_m = -0.03\nfront_m = 0.06\n")

    depth_m = _truth(tmp_path)

    x_m, y_m = cell_centers_m(BOX)
    rows, columns = np.nonzero(~np.isnan(depth_m))

    assert x_m[columns].mean() == pytest.approx(0.45 + 0.05, abs=0.002)
    assert y_m[rows].mean() == pytest.approx(-0.03, abs=0.002)
    assert np.ptp(x_m[columns]) == pytest.approx(0.1, abs=0.01)
    assert np.nanmin(depth_m) == pytest.approx(BOX.z_near_m + 0.06, abs=0.001)


def test_takes_of_one_mesh_have_poses_of_their_own(tmp_path: Path) -> None:
    BALL.export(tmp_path / "mug.stl")
    for take, x_m in (("mug-01", 0.0), ("mug-02", 0.05)):
        text = f"size_m = 0.1\nx_m = {x_m}\n"
        (tmp_path / f"{take}.truth.toml").write_text(text, encoding="utf-8")

    first, second = (_truth(tmp_path, name=take) for take in ("mug-01", "mug-02"))

    x_m, _ = cell_centers_m(BOX)
    middles_m = [x_m[np.nonzero(~np.isnan(depth_m))[1]].mean() for depth_m in (first, second)]
    assert middles_m[1] - middles_m[0] == pytest.approx(0.05, abs=0.002)


def test_truth_file_gives_a_category(tmp_path: Path) -> None:
    _write_truth(tmp_path, 'category = "cup"\nseed = 3\nsize_m = 0.15\n')

    assert np.isfinite(_truth(tmp_path)).any()


@pytest.mark.parametrize(
    ("text", "kind", "word"),
    [
        ("size = 0.1", RecordingError, r"mug\.truth\.toml"),
        ('category = "mug"', RecordingError, r"mug\.truth\.toml.*category"),
        ('category = "cup"\nsize_m = 50', RecordingError, r"mug\.truth\.toml.*size_m"),
        ('file = "none.stl"', RecordingError, r"mug\.truth\.toml.*none\.stl"),
        ("size_m 0.1", RecordingError, r"mug\.truth\.toml.*TOML"),
        ("size_m = 0.1", RecordingError, r"mug\.truth\.toml.*category"),
        ('category = "cup"\nx_m = 1.0', SceneError, "cup"),  # beside the object box
    ],
)
def test_truth_file_names_its_problem(
    tmp_path: Path, text: str, kind: type[NlosCamError], word: str
) -> None:
    _write_truth(tmp_path, text)

    with pytest.raises(kind, match=word):
        _truth(tmp_path)


def test_missing_truth_names_the_files_it_could_have(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"mug\.truth\.toml.*mug\.npy"):
        _truth(tmp_path)


def test_mesh_without_truth_file_is_refused(tmp_path: Path) -> None:
    BALL.export(tmp_path / "mug.stl")

    with pytest.raises(RecordingError, match=r"mug\.stl.*mug\.truth\.toml"):
        _truth(tmp_path)


def test_truth_of_another_size_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "mug.npy", np.full((32, 32), 0.2, np.float32))

    with pytest.raises(RecordingError, match=r"32, 32"):
        _truth(tmp_path)


def test_truth_behind_the_object_box_is_refused(tmp_path: Path) -> None:
    depth_m = np.full((64, 64), BOX.z_far_m, np.float32)
    depth_m[0] = 0.5
    np.save(tmp_path / "mug.npy", depth_m)

    with pytest.raises(RecordingError, match="64 of 4096 cells behind"):
        _truth(tmp_path)


@pytest.mark.parametrize("label", ["../mug", "a/mug"])
def test_label_that_leads_elsewhere_is_refused(tmp_path: Path, label: str) -> None:
    (tmp_path / "a").mkdir()
    np.save(tmp_path / "mug.npy", CUP)

    with pytest.raises(RecordingError, match=label):
        _truth(tmp_path / "a", label)


def test_two_truths_of_one_label_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "mug.npy", CUP)
    _write_truth(tmp_path, 'category = "cup"\n')

    with pytest.raises(RecordingError, match="mug"):
        _truth(tmp_path)


def _samples(count: int) -> Labelled:
    generator = np.random.default_rng(count)
    depth_m, intensity = generator.random((2, count, 64, 80), np.float32)
    depth_m[:, 0, 0] = np.nan
    truth_m = generator.uniform(0.12, 0.4, (count, 64, 64)).astype(np.float32)
    maps = MapSet(depth_m, intensity, truth_m.astype(np.float16))
    names = tuple(f"cup-{k}" for k in range(count))
    recorded = replace(maps, depth_m=maps.depth_m + 1, intensity=maps.intensity + 1)
    return Labelled(maps, recorded, truth_m, names, names, RIG)


@pytest.mark.parametrize("count", [3, SHARD + 7])
def test_labelled_shards_are_read_as_written(tmp_path: Path, count: int) -> None:
    """A larger dataset before them is replaced as a whole."""
    samples = _samples(count)
    write_shards(_samples(SHARD + 5), tmp_path)

    write_shards(samples, tmp_path)

    data = open_dataset(tmp_path)
    maps = data.arrays()
    for name in ("depth_m", "intensity", "image"):
        np.testing.assert_array_equal(getattr(maps, name), getattr(samples.maps, name))

    recorded = data.as_recorded().arrays()
    np.testing.assert_array_equal(recorded.depth_m, samples.recorded.depth_m)
    np.testing.assert_array_equal(recorded.intensity, samples.recorded.intensity)
    assert tuple(data.column("category")) == samples.label
    np.testing.assert_array_equal(data.column("object_depth_m"), samples.object_depth_m)


def test_labelled_shards_name_their_rig_but_not_its_gain(tmp_path: Path) -> None:
    write_shards(_samples(3), tmp_path)

    data = open_dataset(tmp_path)

    assert data.plan.rig == RIG
    assert data.plan.accuracy == RECORDED
    assert np.isnan(data.column("scene")).any(axis=0).sum() == 1


def test_labelled_shards_are_not_extended(tmp_path: Path) -> None:
    write_shards(_samples(3), tmp_path)

    with pytest.raises(RecordingError, match="--out"):
        build_dataset(DatasetPlan(RIG, 0), 4, tmp_path, workers=1, on_progress=lambda *_: None)


def test_labelled_shards_survive_an_error_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_shards(_samples(SHARD + 7), tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    full = Mock(side_effect=OSError("no space left"))
    monkeypatch.setattr("nlos_cam.files.atomic._flush_directory", full)

    with pytest.raises(OSError, match="no space"):
        write_shards(_samples(3), tmp_path)

    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_frames_are_spread_over_the_complete_ones() -> None:
    camera = FrameCamera(6, make=lambda number: replace(small_frame(number), ir=IR[number]))
    found = spread_maps(camera, 10, 3)

    assert [maps.intensity[0, 0] for maps in found] == [1, 3, 5]


def test_labelled_shards_survive_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "data"
    write_shards(_samples(SHARD + 7), out)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    stores = iter([store, Mock(side_effect=DiskFullError("full"))])
    monkeypatch.setattr(labelled_shards, "store", lambda *given: next(stores)(*given))  # noqa: PLW0108

    with pytest.raises(DiskFullError, match=str(out)):
        write_shards(_samples(SHARD + 9), out)

    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert list(tmp_path.iterdir()) == [out]
