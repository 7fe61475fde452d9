"""Recordings of known objects as the second stage of an adaptation."""

import json
import shutil
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nlos_calibration import Rig
from nlos_models import load_reconstructor, load_record, shipped_folder, silhouette_iou

from nlos_cam.adapt import Adaptation, adapt, calibration_spread, find_recordings
from nlos_cam.adapt.plan import Pace, Plan, Stage
from nlos_cam.adapt.recordings import MIN_OBJECTS, Transfer, parts_of
from nlos_cam.adapt.run import _start_checksum  # pyright: ignore[reportPrivateUsage]
from nlos_cam.bench import load_bench
from nlos_cam.dataset import open_dataset
from nlos_cam.evaluate import reconstruct_all
from nlos_cam.files import cache_folder
from nlos_cam.reconstruct import align_all
from nlos_cam.render import SensorModel

RIG = '[rig]\nbase = "{base}"\n[rig.lidar]\ndistance_m = 0.205\n'
OBJECT = '[motion]\nposes = 1\n[object]\ncategory = "{name}"\n'
OBJECTS = "bowl", "cup", "rocket"


def no_bench(_camera: object) -> Any:
    raise AssertionError("nothing is opened to list recordings")


def test_no_object_is_in_two_parts() -> None:
    labels = [f"object-{number:02d}" for number in range(20)]

    for count in range(MIN_OBJECTS, len(labels)):
        parts = parts_of(labels[:count])
        assert sorted(label for part in parts.values() for label in part) == labels[:count]
        assert all(parts.values())


def test_recordings_without_a_label_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "one.bag").touch()
    said: list[str] = []

    assert find_recordings(tmp_path, no_bench, said.append) is None
    assert "one.bag" in said[0]
    assert find_recordings(tmp_path / "none", no_bench, said.append) is None


@pytest.mark.parametrize(("after", "kept"), [(0.51, True), (0.5, False), (0.4, False)])
def test_only_a_better_fit_is_kept(after: float, kept: bool, tmp_path: Path) -> None:
    figures = [{"silhouette_iou": {"value": value}} for value in (0.5, after)]

    assert Transfer(tmp_path, {}, 3, *figures).is_better is kept


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


def job_with_network(folder: Path, rig: Rig) -> Adaptation:
    """Return a job whose network is there already: the shipped one."""
    job = Adaptation(rig, calibration_spread(None), folder, workers=1)
    network = folder / "stage-1" / "network"
    shutil.copytree(shipped_folder(), network)
    sums = (network / "SHA256SUMS").read_text().splitlines()
    names = "checkpoint.json", "direct.safetensors", "network.onnx"
    kept = [line for line in sums if line.endswith(names)]
    (network / "SHA256SUMS").write_text("\n".join(kept) + "\n")
    for path in network.iterdir():
        if path.name not in {*names, "SHA256SUMS"}:
            path.unlink()
    Plan(
        rig_checksum=rig.checksum,
        start=_start_checksum(job),
        spread=calibration_spread(None),
        sensor=SensorModel(),
        seed=0,
        pace=Pace(objects_per_s=1.0, samples_per_s=1.0),
        stages=(Stage(minutes=1.0, objects=300, epochs=2, steps=3),),
    ).save(folder)
    return job


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
    found = find_recordings(bench.folder / "recordings", bench.for_camera, print)
    assert found is not None
    job = job_with_network(tmp_path / "work", bench.rig)

    with pytest.raises(KeyboardInterrupt):
        adapt(Adaptation(**{**vars(job), "recordings": found}), 1.0, measure, tracked=until_judged)

    (folder,) = (job.folder / "stage-1").glob("recordings-*")
    fitted = load_record(folder / "network")
    assert len(fitted.runs) > 1
    assert [len(open_dataset(folder / "parts" / part)) for part in parts_of([])] == [8, 8, 1]
    before, after = (
        json.loads((folder / name / "figures.json").read_text())["silhouette_iou"]["value"]
        for name in ("before", "after")
    )
    assert 0.2 < before != after > 0.2
