"""Labelled recordings as a dataset: maps of their frames, ground truth by label, shards that read
as written.
"""

import shutil
from collections.abc import Callable
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

from nlos_cam.camera import Recording, SimulatedCamera
from nlos_cam.dataset import DatasetPlan, build_dataset, open_dataset, read_labelled, write_shards
from nlos_cam.dataset import labelled as labelled_shards
from nlos_cam.dataset.build import SHARD
from nlos_cam.dataset.labelled import RECORDED, Labelled, benchmark_depths, spread, truth_depth_m
from nlos_cam.dataset.shards import store
from nlos_cam.errors import DiskFullError, NlosCamError, RecordingError, SceneError
from nlos_cam.frames import maps_from_frame
from nlos_cam.objects import benchmark_objects as fixed_set
from nlos_cam.objects import cell_centers_m, image_from_depth, object_box
from nlos_cam.recording import ReplayCamera, SidecarFile, sidecar_path
from nlos_cam.recording.sidecar import WallFile

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


Label = Callable[..., Path]


@pytest.fixture
def labelled(noise_bag: Path, tmp_path: Path) -> Label:
    """A recording of twenty frames of noise with a sidecar."""

    def make(name: str, label: str | None = "slope", **others: Any) -> Path:
        shutil.copy(noise_bag, path := tmp_path / f"{name}.bag")
        return _sidecar(path, label=label, **others)

    return make


def test_read_labelled_pairs_frames_with_truth_of_their_label(
    labelled: Label, noise_world: Any
) -> None:
    progress = list[tuple[int, int]]()
    world = noise_world()
    paths = [labelled("a"), labelled("b", "half")]
    found = read_labelled(paths, known=known, frames=4, on_progress=lambda *at: progress.append(at))
    frames = [
        maps_from_frame(world.images(number).frame(world.rig.pinhole)) for number in (2, 7, 12, 17)
    ]
    np.testing.assert_array_equal(found.maps.depth_m[:4], [maps.depth_m for maps in frames])
    np.testing.assert_array_equal(found.maps.intensity[:4], [maps.intensity for maps in frames])
    assert found.label == ("slope",) * 4 + ("half",) * 4
    assert found.recording == ("a.bag",) * 4 + ("b.bag",) * 4
    assert found.rig == RIG
    for k, label in enumerate(found.label):
        np.testing.assert_array_equal(found.object_depth_m[k], KNOWN[label])
        np.testing.assert_array_equal(
            found.maps.image[k], image_from_depth(KNOWN[label], BOX).astype(np.float16)
        )
    assert progress == [(1, 2), (2, 2)]


@given(st.integers(0, 1000), st.integers(1, 100))
def test_spread_chooses_frames_evenly(count: int, wanted: int) -> None:
    chosen = sorted(spread(count, wanted))
    assert len(chosen) == min(count, wanted)
    assert set(chosen) <= set(range(count))
    gaps = np.diff([-chosen[0] - 1, *chosen, 2 * count - chosen[-1]]) if chosen else np.zeros(1)
    assert np.ptp(gaps) <= 2  # mirrored at both ends: neither end is left out


def test_read_labelled_corrects_by_wall_record(
    labelled: Label, measured: Callable[..., Any], tmp_path: Path
) -> None:
    def wall(**fields: Any) -> Path:
        (path := tmp_path / "wall.toml").write_text(
            dump_toml(measured(**fields).record), encoding="utf-8"
        )
        return path

    path = labelled("a", wall=(RIG, WallFile(path="there/wall.toml", sha256="")))
    with pytest.raises(RecordingError, match=r"there/wall\.toml"):
        read_labelled([path], known=known)
    plain = read_labelled([labelled("b")], known=known, frames=2)
    corrected = read_labelled([path], known=known, wall=wall(range_offset_m=0.004), frames=2)
    assert corrected.rig.name == "measured"
    np.testing.assert_allclose(corrected.maps.depth_m, plain.maps.depth_m + 0.004, atol=1e-6)
    np.testing.assert_array_equal(corrected.maps.intensity, plain.maps.intensity)
    with pytest.raises(CalibrationError, match=r"80x60.*64x48"):
        read_labelled([path], known=known, wall=wall(width=80))


def test_read_labelled_uses_the_one_rig_of_the_sidecars(labelled: Label) -> None:
    own = RIG.model_copy(update={"name": "own"})
    bare = load_rig("bare-wall")
    for rig, used in ((own, own), (bare, RIG)):
        path = _sidecar(labelled("a"), rig, label="slope")
        assert read_labelled([path], known=known, frames=1).rig == used
    other = _sidecar(labelled("b"), own, label="slope")
    with pytest.raises(RecordingError, match=r"a\.bag.*b\.bag"):
        read_labelled([path, other], known=known)


@pytest.mark.parametrize(("label", "word"), [(None, "--label"), ("", "--label"), ("mug", "mug")])
def test_read_labelled_refuses_missing_or_unknown_label(
    labelled: Label, label: str | None, word: str
) -> None:
    path = labelled("a", label)
    with pytest.raises(RecordingError, match=rf"a\.bag.*{word}"):
        read_labelled([path], known=known)
    sidecar_path(path).unlink()
    with pytest.raises(RecordingError, match="a"):
        read_labelled([path], known=known)


@pytest.mark.parametrize("dark_from", [2, 0])
def test_dark_frames_are_skipped(
    noise_world: Any, hurried_clock: Any, tmp_path: Path, dark_from: int
) -> None:
    class Dark(noise_world):
        def images(self, number: int) -> Any:
            seen = super().images(number)
            seen.depth_z16[:] = 0 if number >= dark_from else seen.depth_z16
            return seen

    path = tmp_path / "dark.bag"
    with SimulatedCamera(
        "sim:dark", Dark(), clock=hurried_clock(), recording=Recording(path, frames=4)
    ) as camera:
        assert len(list(camera)) >= 1
    _sidecar(path, label="slope")
    if dark_from:
        assert len(read_labelled([path], known=known).label) == dark_from
    else:
        with pytest.raises(RecordingError, match=r"dark\.bag"):
            read_labelled([path], known=known)


def _truth(folder: Path, label: str = "mug", name: str = "F") -> np.ndarray:
    return truth_depth_m(folder / f"{name}.bag", label, RIG, {"cup-1": CUP})


def _write_truth(folder: Path, text: str) -> None:
    (folder / "mug.truth.toml").write_text(text, encoding="utf-8")


def test_truth_is_depth_map_of_recording_then_of_label_then_its_test_object(tmp_path: Path) -> None:
    np.save(
        tmp_path / "cup-1.npy",
        of_label := np.where(np.eye(64) > 0, np.float32(0.3), np.float32(np.nan)),
    )
    np.testing.assert_array_equal(_truth(tmp_path, "cup-1"), of_label)
    np.save(tmp_path / "F.npy", of_recording := np.full((64, 64), 0.25, np.float32))
    np.testing.assert_array_equal(_truth(tmp_path, "cup-1"), of_recording)
    np.testing.assert_array_equal(_truth(tmp_path, "cup-1", name="G"), of_label)
    assert _truth(Path("nowhere"), "cup-1") is CUP
    objects = benchmark_depths(BOX)
    assert list(objects) == [thing.name for thing in fixed_set(BOX)]
    np.testing.assert_array_equal(
        objects["cup-2"], next(o.depth_m for o in fixed_set(BOX) if o.name == "cup-2")
    )


@pytest.mark.parametrize("named", [True, False])
def test_truth_of_mesh_stands_at_its_pose(tmp_path: Path, named: bool) -> None:
    BALL.export(tmp_path / ("print.stl" if named else "mug.stl"))
    file = 'file = "print.stl"\n' if named else ""
    _write_truth(tmp_path, f"{file}size_m = 0.1\nx_m = 0.05\ny_m = -0.03\nfront_m = 0.06\n")
    depth_m = _truth(tmp_path)
    (x_m, y_m) = cell_centers_m(BOX)
    rows, columns = np.nonzero(~np.isnan(depth_m))
    assert x_m[columns].mean() == pytest.approx(0.45 + 0.05, abs=0.002)
    assert y_m[rows].mean() == pytest.approx(-0.03, abs=0.002)
    assert np.ptp(x_m[columns]) == pytest.approx(0.1, abs=0.01)
    assert np.nanmin(depth_m) == pytest.approx(BOX.z_near_m + 0.06, abs=0.001)


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
    _write_truth(tmp_path, 'category = "cup"\nseed = 3\nsize_m = 0.15\n')
    assert np.isfinite(_truth(tmp_path)).any()
    _write_truth(tmp_path, text)
    with pytest.raises(kind, match=word):
        _truth(tmp_path)


def test_truth_is_refused_where_files_are_missing_doubled_elsewhere_or_of_another_size(
    tmp_path: Path,
) -> None:
    with pytest.raises(RecordingError, match=r"mug\.truth\.toml.*mug\.npy"):
        _truth(tmp_path)
    (tmp_path / "a").mkdir()
    BALL.export(tmp_path / "a" / "mug.stl")
    with pytest.raises(RecordingError, match=r"mug\.stl.*mug\.truth\.toml"):
        _truth(tmp_path / "a")
    np.save(tmp_path / "mug.npy", np.full((32, 32), 0.2, np.float32))
    with pytest.raises(RecordingError, match=r"32, 32"):
        _truth(tmp_path)
    np.save(tmp_path / "mug.npy", CUP)
    for label in ("../mug", "a/mug"):
        with pytest.raises(RecordingError, match=label):
            _truth(tmp_path / "a", label)
    _write_truth(tmp_path, 'category = "cup"\n')
    with pytest.raises(RecordingError, match="mug"):
        _truth(tmp_path)


def _samples(count: int) -> Labelled:
    generator = np.random.default_rng(count)
    depth_m, intensity = generator.random((2, count, 64, 80), np.float32)
    depth_m[:, 0, 0] = np.nan
    truth_m = generator.uniform(0.12, 0.4, (count, 64, 64)).astype(np.float32)
    names = tuple(f"cup-{k}" for k in range(count))
    return Labelled(
        MapSet(depth_m, intensity, truth_m.astype(np.float16)), truth_m, names, names, RIG
    )


@pytest.mark.parametrize("count", [3, SHARD + 7])
def test_labelled_shards_are_read_as_written_and_not_extended(tmp_path: Path, count: int) -> None:
    write_shards(
        _samples(SHARD + 5), tmp_path
    )  # a larger dataset, which the next replaces as a whole
    write_shards(samples := _samples(count), tmp_path)
    maps = (data := open_dataset(tmp_path)).arrays()
    plan = data.plan
    for name in ("depth_m", "intensity", "image"):
        np.testing.assert_array_equal(getattr(maps, name), getattr(samples.maps, name))
    assert tuple(data.column("category")) == samples.label
    np.testing.assert_array_equal(data.column("object_depth_m"), samples.object_depth_m)
    assert np.isnan(data.column("scene")).any(axis=0).sum() == 1  # the gain is not known
    assert (plan.rig, plan.accuracy) == (RIG, RECORDED)
    with pytest.raises(RecordingError, match="--out"):
        build_dataset(DatasetPlan(RIG, 0), 4, tmp_path, workers=1, on_progress=lambda *_: None)


def test_labelled_shards_survive_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "data"
    stores = iter([store, Mock(side_effect=DiskFullError("full"))])
    write_shards(_samples(SHARD + 7), out)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    monkeypatch.setattr(labelled_shards, "store", lambda *given: next(stores)(*given))  # noqa: PLW0108  another each time
    with pytest.raises(DiskFullError, match=str(out)):
        write_shards(_samples(SHARD + 9), out)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert list(tmp_path.iterdir()) == [out]
