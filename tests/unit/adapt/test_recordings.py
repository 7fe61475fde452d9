"""Recordings of known objects as the second stage of an adaptation."""

import json
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from made_adaptations import finish_network, job_in
from nlos_calibration import load_rig
from nlos_models import load_reconstructor, load_record, shipped_folder, silhouette_iou
from nlos_models.training import MapSet, unwatched

from nlos_cam.adapt import adapt, find_recordings
from nlos_cam.adapt.recordings import (
    MIN_OBJECTS,
    Part,
    Recordings,
    Transfer,
    are_enough,
    fit_to_recordings,
    parts_of,
    write_parts,
)
from nlos_cam.adapt.report import transfer_words
from nlos_cam.bench import load_bench
from nlos_cam.dataset import Labelled, open_dataset, untracked, write_shards
from nlos_cam.errors import RecordingError
from nlos_cam.evaluate import reconstruct_all
from nlos_cam.files import cache_folder
from nlos_cam.reconstruct import align_all

RIG = '[rig]\nbase = "{base}"\n[rig.lidar]\ndistance_m = 0.205\n'
OBJECT = '[motion]\nposes = 1\n[object]\ncategory = "{name}"\n'
OBJECTS = "bowl", "cup", "rocket"
HOME = load_rig("paper-rig")


def no_bench(_camera: object) -> Any:
    raise AssertionError("nothing is opened to list recordings")


def record_at_home(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Put recordings of just enough objects into a folder, made on the home rig."""

    def sidecar_of(path: Path) -> Any:
        return SimpleNamespace(label=path.stem, rig=HOME)

    monkeypatch.setattr("nlos_cam.adapt.recordings.load_sidecar", sidecar_of)
    folder.mkdir(exist_ok=True)
    for number in range(MIN_OBJECTS):
        (folder / f"object-{number}.bag").touch()


def test_no_object_is_in_two_parts() -> None:
    labels = [f"object-{number:02d}" for number in range(20)]

    for count in range(MIN_OBJECTS, len(labels)):
        parts = parts_of(labels[:count])
        assert sorted(label for part in parts.values() for label in part) == labels[:count]
        assert all(parts.values())


def test_recordings_without_a_label_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "one.bag").touch()
    said: list[str] = []

    assert find_recordings(tmp_path, HOME, no_bench, said.append) is None
    assert "one.bag" in said[0]
    assert find_recordings(tmp_path / "none", HOME, no_bench, said.append) is None


@pytest.mark.parametrize(("moved_m", "found"), [(0.0, True), (0.0005, True), (0.003, False)])
def test_recordings_of_a_bench_that_moved_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moved_m: float, found: bool
) -> None:
    record_at_home(monkeypatch, tmp_path)
    lidar = HOME.lidar.model_copy(update={"distance_m": HOME.lidar.distance_m + moved_m})
    now = HOME.model_copy(update={"lidar": lidar})
    said: list[str] = []

    recordings = find_recordings(tmp_path, now, no_bench, said.append)

    assert (recordings is not None) is found
    assert any("calibrated again" in line for line in said) is not found


@pytest.mark.parametrize(
    ("start", "after", "kept"),
    [(0.45, 0.51, True), (0.45, 0.5, False), (0.45, 0.4, False), (0.6, 0.51, False)],
)
def test_only_a_better_fit_is_kept(start: float, after: float, kept: bool, tmp_path: Path) -> None:
    figures = [{"silhouette_iou": {"value": value}} for value in (start, 0.5, after)]

    assert Transfer(tmp_path, {}, 3, *figures).is_better is kept


@pytest.mark.parametrize(("loss", "kept"), [(-0.05, True), (0.09, True), (0.2, False)])
def test_a_fit_that_costs_much_in_simulation_is_not_kept(
    loss: float, kept: bool, tmp_path: Path
) -> None:
    figures = [{"silhouette_iou": {"value": value}} for value in (0.3, 0.4, 0.5)]
    parts = {"adaptation": ["bowl"], "validation": ["hat"], "judged": ["cup"]}
    fit = Transfer(tmp_path, parts, 3, *figures, simulated_loss=loss)

    assert fit.is_better is kept
    assert "fitted to recordings of 1 objects" in transfer_words(fit)
    assert ("worse on simulated objects" in transfer_words(fit)) is not kept


def test_recordings_in_another_box_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = HOME.object_box
    assert box is not None
    aside = box.model_copy(update={"x_min_m": box.x_min_m + 0.03, "x_max_m": box.x_max_m + 0.03})
    now = HOME.model_copy(update={"object_box": aside})
    record_at_home(monkeypatch, tmp_path)
    said: list[str] = []

    assert find_recordings(tmp_path, now, no_bench, said.append) is None
    assert all("object box have moved" in line for line in said[:MIN_OBJECTS])


def test_recordings_made_meanwhile_are_not_taken_for_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is made of three recordings bears their name, also where there are four by then."""
    record_at_home(monkeypatch, tmp_path)
    listed = find_recordings(tmp_path, HOME, no_bench, print)
    assert listed is not None

    (tmp_path / "one-more.bag").touch()

    again = find_recordings(tmp_path, HOME, no_bench, print)
    assert again is not None
    assert len(again.by_label) == len(listed.by_label) + 1
    assert again.digest != listed.digest


def test_a_mesh_elsewhere_counts_for_the_digest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "recordings"
    record_at_home(monkeypatch, folder)
    (folder / "object-0.truth.toml").write_text('file = "../mesh.stl"\n', encoding="utf-8")

    def digest() -> str:
        found = find_recordings(folder, HOME, no_bench, print)
        assert found is not None
        return found.digest

    (tmp_path / "mesh.stl").write_bytes(b"one")
    before = digest()
    assert digest() == before

    (tmp_path / "mesh.stl").write_bytes(b"another")
    assert digest() != before


def test_a_recording_without_a_truth_stops_before_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = job_in(tmp_path / "work", HOME)
    found = Recordings(tmp_path, {"cup": [tmp_path / "cup.bag"]}, no_bench, "0" * 12)
    no_truth = Mock(side_effect=RecordingError("no file describes it"))
    training = Mock()
    monkeypatch.setattr("nlos_cam.adapt.run.write_parts", no_truth)
    monkeypatch.setattr("nlos_cam.adapt.run._train_network", training)

    with pytest.raises(RecordingError, match="describes"):
        adapt(replace(job, recordings=found), 1.0, measure)

    training.assert_not_called()


def test_recordings_of_one_frame_are_left_out_before_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = Recordings(
        tmp_path, {label: [Path(label)] for label in list(OBJECTS)[:3]}, no_bench, "0" * 12
    )
    monkeypatch.setattr(
        "nlos_cam.dataset.read_labelled", lambda paths, **_: labelled_of(paths[0].name, 1)
    )

    assert not are_enough(write_parts(found, tmp_path / "parts", untracked))


def labelled_of(label: str, frames: int) -> Labelled:
    """Return frames of an object as they are read from recordings."""
    generator = np.random.default_rng([frames, len(label)])
    depth_m, intensity = generator.random((2, frames, 64, 80), np.float32)
    images = generator.random((frames, 64, 64), np.float32).astype(np.float16)
    maps = MapSet(depth_m, intensity, images)
    truth_m = np.zeros((frames, 64, 64), np.float32)
    return Labelled(maps, maps, truth_m, (label,) * frames, ("a.bag",) * frames, HOME)


def test_all_frames_of_validation_choose_the_epoch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those that the recipe has no room for would be whole objects."""
    counts: dict[Part, int] = {"adaptation": 4, "validation": 60}
    parts = {part: tmp_path / part for part in counts}
    for part, folder in parts.items():
        write_shards(labelled_of(part, counts[part]), folder)
    run_transfer = Mock()
    monkeypatch.setattr("nlos_models.training.run_transfer", run_transfer)

    fit_to_recordings(shipped_folder(), parts, tmp_path / "out", "cpu", unwatched)

    _, run, _, _, training, held_out = run_transfer.call_args.args
    assert (len(training.image), len(held_out.image)) == (4, 60)
    assert (run.recipe.objects, run.recipe.held_out) == (4, 60)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def empty(path: Path) -> None:
    for shard in path.parent.iterdir():
        shard.unlink()


@pytest.mark.parametrize("damage", [cut, Path.unlink, empty])
def test_damaged_parts_of_recordings_are_written_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: Callable[[Path], None]
) -> None:
    labels = list(OBJECTS)
    found = Recordings(tmp_path, {label: [Path(label)] for label in labels}, no_bench, "0" * 12)

    def read(paths: list[Path], **_: object) -> Labelled:
        read_parts.append([path.name for path in paths])
        return labelled_of(paths[0].name, 150)

    read_parts: list[list[str]] = []
    monkeypatch.setattr("nlos_cam.dataset.read_labelled", read)
    folders = write_parts(found, tmp_path / "parts", untracked)
    written = {path: path.read_bytes() for path in (tmp_path / "parts").rglob("*.h5")}
    write_parts(found, tmp_path / "parts", untracked)
    assert len(read_parts) == len(folders) == len(parts_of(labels))

    damage(folders["validation"] / "shard-000000000.h5")
    write_parts(found, tmp_path / "parts", untracked)

    assert read_parts[len(folders) :] == [parts_of(labels)["validation"]]
    assert {path: path.read_bytes() for path in (tmp_path / "parts").rglob("*.h5")} == written


def record_bench(run: Callable[..., Any]) -> Path:
    """Measure a simulated bench, and record three objects on it."""
    scenes = {
        "bare": RIG.format(base="bare-wall"),
        "empty": RIG.format(base="paper-rig"),
        **{name: OBJECT.format(name=name) + RIG.format(base="paper-rig") for name in OBJECTS},
    }
    for name, text in scenes.items():
        Path(f"{name}.toml").write_text(f'name = "{name}"\n{text}', encoding="utf-8")
    run("calibrate", "--wall", "--camera", "sim:bare.toml", "--frames", "20", "--bench", "bench")
    run("calibrate", "--occluder", "bench", "--camera", "sim:empty.toml", "--frames", "20")

    folder = Path("bench/recordings")
    folder.mkdir()
    for name in OBJECTS:
        take = "--frames", "10", "--label", name, "--out", folder / f"{name}.bag"
        run("capture", f"sim:{name}.toml", "--bench", "bench", *take)
        (folder / f"{name}.truth.toml").write_text(f'category = "{name}"\n', encoding="utf-8")
    return Path("bench")


def measure(weights: Path | None, folder: Path, objects: Path | None) -> None:
    """Measure weights on recordings; nothing on test objects."""
    iou = 0.0
    if objects:
        opened = open_dataset(objects)
        network = load_reconstructor(weights, cache_folder() / "onnx")
        maps = align_all(opened.arrays(), opened.benches(), network.record)
        iou = float(np.mean(silhouette_iou(reconstruct_all(network, maps), maps.image)))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "figures.json").write_text(json.dumps({"silhouette_iou": {"value": iou}}))


@contextmanager
def until_judged(description: str) -> Generator[Callable[[int, int], None]]:
    """Stop when the transfer is done: the rest has tests of its own."""
    if "judged)" in description and "rendering" in description:
        raise KeyboardInterrupt
    yield lambda _done, _total: None


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_recordings_in_a_bench_fit_the_network_to_them(run: Any, tmp_path: Path) -> None:
    bench = load_bench(record_bench(run))
    found = find_recordings(bench.folder / "recordings", bench.rig, bench.for_camera, print)
    assert found is not None
    job = job_in(tmp_path / "work", bench.rig)
    finish_network(job.folder)

    with pytest.raises(KeyboardInterrupt):
        adapt(replace(job, recordings=found), 1.0, measure, tracked=until_judged)

    (folder,) = (job.folder / "stage-1").glob("recordings-*")
    fitted = load_record(folder / "network")
    assert len(fitted.runs) > 1
    assert [len(open_dataset(folder / "parts" / part)) for part in parts_of([])] == [8, 8, 1]
    before, after = (
        json.loads((folder / name / "figures.json").read_text())["silhouette_iou"]["value"]
        for name in ("before", "after")
    )
    assert 0.2 < before != after > 0.2
