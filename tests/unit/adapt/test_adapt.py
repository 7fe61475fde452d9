"""Adaptation to a bench, stopped and resumed."""

import json
import shutil
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from made_adaptations import finish_network, job_in
from nlos_calibration import Rig, load_rig
from nlos_models import (
    NETWORK_ONNX,
    CheckpointRecord,
    DirectNetwork,
    load_network,
    shipped_folder,
    training,
)
from nlos_models.errors import CheckpointError, TrainingError
from nlos_models.training.checkpoints import save_direct
from nlos_models.training.recipe import DirectSize

from nlos_cam.adapt import NETWORK_FILE, Adaptation, adapt, calibration_spread, install, verdicts
from nlos_cam.adapt.job import is_whole
from nlos_cam.adapt.plan import load_plan
from nlos_cam.adapt.run import FIGURES, _all_cores, _figures, _with_first_start
from nlos_cam.dataset import HELD_OUT_SEED, DatasetPlan, build_dataset, ignore, untracked
from nlos_cam.errors import RecordingError, SceneError
from nlos_cam.files import FileBusyError, claim
from nlos_cam.reconstruct import weights_for
from nlos_cam.render import RENDERING_VERSION

AFTER_THE_NETWORK = "judged"
CORES = 1, 2, 3, 8, 64


@contextmanager
def until_judged(description: str) -> Generator[Callable[[int, int], None]]:
    """Stop the adaptation when its network is trained: the rest has tests of its own."""
    if AFTER_THE_NETWORK in description:
        raise KeyboardInterrupt
    yield lambda _done, _total: None


def no_figures(_weights: Path | None, folder: Path, _objects: Path | None = None) -> None:
    """Measure nothing."""
    folder.mkdir(exist_ok=True)
    (folder / "figures.json").write_text("{}")


def stopping_after(steps: int) -> training.Watch:
    """Return a watch that stops a run after some of its steps."""

    @contextmanager
    def watch(
        running: training.Running, _recipe: training.Recipe, _name: str
    ) -> Generator[training.Running]:
        asked: list[None] = []

        def stop() -> bool:
            asked.append(None)
            return len(asked) >= steps

        yield replace(running, stop=stop)

    return watch


def bench_elsewhere() -> Rig:
    """Return a rig that is not the start weights': their cells would not do."""
    rig = load_rig("paper-rig")
    lidar = rig.lidar.model_copy(update={"distance_m": 0.25, "yaw_deg": 40.0})
    return rig.model_copy(update={"name": "elsewhere", "lidar": lidar})


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_stopped_adaptation_goes_on_to_the_same_weights(tmp_path: Path) -> None:
    rig = bench_elsewhere()
    network = Path("stage-1", "network", "direct.safetensors")
    whole = job_in(tmp_path / "whole", rig)
    broken = job_in(tmp_path / "broken", rig)

    with pytest.raises(KeyboardInterrupt):
        adapt(whole, 1.0, no_figures, tracked=until_judged)
    for steps in (2, 3):
        with pytest.raises(KeyboardInterrupt):
            adapt(broken, 1.0, no_figures, watch=stopping_after(steps))
    with pytest.raises(KeyboardInterrupt):
        adapt(broken, 1.0, no_figures, tracked=until_judged)

    assert (broken.folder / network).read_bytes() == (whole.folder / network).read_bytes()
    cells = load_network(whole.folder / network.parent)[0].normal.median[0]
    assert float(cells.median()) > 0.02 + float(load_network()[0].normal.median[0].median())


def test_other_start_weights_are_not_ignored(tmp_path: Path) -> None:
    rig = load_rig("paper-rig")
    job = job_in(tmp_path / "work", rig)
    others = tmp_path / "others"
    others.mkdir()
    (others / NETWORK_FILE).write_bytes(b"other weights")
    finish_network(job.folder)

    with pytest.raises(SceneError, match="other start weights"):
        adapt(replace(job, start=others), 1.0, no_figures)


def test_work_goes_on_from_the_weights_that_it_began_from(tmp_path: Path) -> None:
    job = job_in(tmp_path / "work", load_rig("wide-rig"))  # from `direct`

    assert weights_for(job.rig).name == "wide"
    assert _with_first_start(job).start_folder.name == "direct"


def test_two_adaptations_in_one_folder_are_one_too_many(tmp_path: Path) -> None:
    job = job_in(tmp_path / "work", load_rig("paper-rig"))

    with claim(job.folder, inside=True), pytest.raises(FileBusyError):
        adapt(job, 1.0, no_figures)


def test_a_bench_that_was_calibrated_again_is_refused(tmp_path: Path) -> None:
    rig = load_rig("paper-rig")
    job = job_in(tmp_path / "work", rig)
    lidar = rig.lidar.model_copy(update={"distance_m": rig.lidar.distance_m + 0.01})
    moved = rig.model_copy(update={"lidar": lidar})

    with pytest.raises(SceneError, match=r"calibrated again.*--overwrite"):
        adapt(replace(job, rig=moved), 1.0, no_figures)


def test_objects_of_another_renderer_are_not_gone_on_with(tmp_path: Path) -> None:
    job = job_in(tmp_path / "work", load_rig("paper-rig"))
    plan = load_plan(job.folder)
    assert plan
    plan.model_copy(update={"rendering_version": RENDERING_VERSION - 1}).save(job.folder)

    with pytest.raises(SceneError, match=r"renderer differs.*--overwrite"):
        adapt(job, 1.0, no_figures)


def test_a_bench_calibrated_again_begins_again_when_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = job_in(tmp_path / "work", load_rig("paper-rig"))
    finish_network(job.folder)
    for name in ("objects", "held-out"):
        build_dataset(DatasetPlan(job.rig, 0), 1, job.folder / name, workers=1, on_progress=ignore)

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    # the pace is measured on objects of the new rig
    monkeypatch.setattr("nlos_cam.adapt.pace.PACE_OBJECTS", 1)
    monkeypatch.setattr("nlos_cam.adapt.pace.PACE_STEPS", 1)
    with pytest.raises(KeyboardInterrupt):
        adapt(replace(job, rig=bench_elsewhere(), begin_again=True), 1.0, stop)

    found = load_plan(job.folder)
    assert found is not None
    assert found.rig_checksum == bench_elsewhere().checksum
    assert not list(job.folder.glob("stage-*"))


def test_packed_maps_of_a_whole_network_are_removed(tmp_path: Path) -> None:
    """A kill between the two would leave gigabytes, which nothing reads again."""
    job = job_in(tmp_path / "work", load_rig("paper-rig"))
    finish_network(job.folder)
    packed = job.folder / "stage-1" / "packed"
    packed.mkdir()

    with pytest.raises(KeyboardInterrupt):
        adapt(job, 1.0, no_figures, tracked=until_judged)

    assert not packed.exists()


def damage(path: Path) -> None:
    """Change a byte of a file in its middle."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def test_network_with_a_damaged_file_is_not_whole(tmp_path: Path) -> None:
    job = job_in(tmp_path / "work", load_rig("paper-rig"))
    finish_network(job.folder)
    network = job.folder / "stage-1" / "network"
    assert is_whole(network, NETWORK_ONNX)

    damage(network / NETWORK_FILE)

    assert not is_whole(network, NETWORK_ONNX)


def test_damaged_weights_are_not_installed(tmp_path: Path) -> None:
    made = Path(shutil.copytree(shipped_folder(), tmp_path / "made"))
    target = tmp_path / "weights"
    install(made, target)
    before = (target / NETWORK_FILE).read_bytes()

    damage(made / NETWORK_FILE)

    with pytest.raises(CheckpointError, match=f"{NETWORK_FILE} is missing or damaged"):
        install(made, target)
    assert (target / NETWORK_FILE).read_bytes() == before


@pytest.mark.parametrize("content", ["", '{"silhouette_iou": {"val', "{}", "[]"])
def test_damaged_figures_are_measured_again(tmp_path: Path, content: str) -> None:
    whole = {"silhouette_iou": {"value": 0.5}}
    measured: list[Path] = []

    def measure(_weights: Path | None, folder: Path, _objects: Path | None) -> None:
        measured.append(folder)
        folder.mkdir(exist_ok=True)
        (folder / FIGURES).write_text(json.dumps(whole), encoding="utf-8")

    assert _figures(measure, None, tmp_path) == _figures(measure, None, tmp_path) == whole
    (tmp_path / FIGURES).write_text(content, encoding="utf-8")

    assert _figures(measure, None, tmp_path) == whole
    assert len(measured) == 2


def whole_stage(folder: Path) -> Path:
    """Return a stage with the shipped weights as its own: network, uncertainty and all."""
    finish_network(folder)
    for name in ("uncertainty", "weights"):
        shutil.copytree(shipped_folder(), folder / "stage-1" / name)
    return folder / "stage-1"


@pytest.mark.parametrize("name", [NETWORK_FILE, "quality.json"])
def test_damaged_weights_of_a_stage_are_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    job = job_in(tmp_path / "work", load_rig("paper-rig"))
    stage = whole_stage(job.folder)
    plan = load_plan(job.folder)
    assert plan
    monkeypatch.setattr(verdicts, "_fit_quality", Mock())
    damage(stage / "weights" / name)

    verdicts.train_uncertainty(job, plan, stage, untracked, None)

    assert (stage / "weights" / name).read_bytes() == (shipped_folder() / name).read_bytes()


def test_held_out_objects_are_made_whole_for_the_uncertainty(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the network is whole, for which they were rendered."""
    job = job_in(tmp_path / "work", load_rig("paper-rig"))
    stage = whole_stage(job.folder)
    shutil.rmtree(stage / "weights")
    damage(stage / "uncertainty" / NETWORK_FILE)
    plan = load_plan(job.folder)
    assert plan
    made: list[tuple[str, int]] = []

    def build(plan: DatasetPlan, _count: int, folder: Path, **_: object) -> None:
        made.append((folder.name, plan.first_seed))

    monkeypatch.setattr("nlos_cam.dataset.build_dataset", build)

    with pytest.raises(RecordingError, match="no dataset"):
        verdicts.train_uncertainty(job, plan, stage, untracked, None)

    assert dict(made)["held-out"] == HELD_OUT_SEED
    assert not (stage / "uncertainty" / NETWORK_FILE).exists()


@pytest.mark.parametrize("cores", CORES)
def test_rendering_then_training_take_all_cores(
    cores: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One after the other: a thread that waits for a core on which objects are rendered makes all
    the others wait.
    """
    monkeypatch.setattr("os.cpu_count", lambda: cores)
    before = torch.get_num_threads()

    job = Adaptation(load_rig("paper-rig"), calibration_spread(None), tmp_path)
    with _all_cores():
        threads = torch.get_num_threads()

    assert job.workers == threads == cores
    assert torch.get_num_threads() == before


def test_start_weights_of_another_size_stop_before_rendering(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = DirectSize(features=8, width=16, blocks=1, token=8, mixers=0)
    recipe = training.DirectRecipe(
        task="direct", objects=4, held_out=4, epochs=1, batch=4, learning_rate=1e-3, direct=small
    )
    rig = load_rig("paper-rig")
    record = CheckpointRecord.of([recipe], (rig.name, rig.checksum))
    save_direct(tmp_path / "small", DirectNetwork(small), record)
    build = Mock()
    monkeypatch.setattr("nlos_cam.dataset.build_dataset", build)
    job = Adaptation(rig, calibration_spread(None), tmp_path / "work", tmp_path / "small")

    with pytest.raises(TrainingError, match="not a part of the recipe"):
        adapt(job, 1.0, no_figures)

    build.assert_not_called()
