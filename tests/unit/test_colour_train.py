"""Training in colour as a command runs it: checkpoints that load, and sets that do not belong together."""

from pathlib import Path

import pytest
from nlos_calibration.rig import load_rig
from nlos_models.checkpoint import load_pipeline, load_vae, save_vae
from nlos_models.errors import CheckpointError
from nlos_models.recipe import Recipe
from nlos_models.res_vae import ResVae

from nlos_cam.colour_data import build_shard
from nlos_cam.colour_train import train_compressor, train_vae
from nlos_cam.dataset import DatasetPlan
from nlos_cam.errors import SceneError

pytestmark = pytest.mark.usefixtures("narrow_networks")

RIG = load_rig("paper-rig")
FACTS = {"colour": True, "objects": 2, "held_out": 2, "epochs": 1, "batch": 2, "learning_rate": 1e-3}
VAE, COMPRESSOR = (Recipe.model_validate({"task": task, **FACTS}) for task in ("vae", "compressor"))


def _ignore(done: int, total: int) -> None:
    assert done <= total


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    build_shard(DatasetPlan(RIG, 40, accuracy="draft"), folder / "colour-000000040.h5", range(40, 42))
    return folder


@pytest.fixture(scope="module")
def vae(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("vae")
    figures = train_vae(VAE, RIG, folder, _ignore)
    assert load_vae(folder)[1].figures == figures
    return folder


def test_both_steps_leave_a_pipeline_that_loads(vae: Path, data: Path, tmp_path: Path) -> None:
    figures = train_compressor(COMPRESSOR, vae, data, data, tmp_path, _ignore)
    _, record = load_pipeline(tmp_path)
    assert record.figures == figures
    assert (record.vae_recipe, record.compressor_recipe) == (VAE, COMPRESSOR)
    assert (record.rig_name, record.rig_checksum) == (RIG.name, RIG.checksum)
    assert load_vae(tmp_path)[1] == record


def test_a_vae_of_depth_is_refused(vae: Path, data: Path, tmp_path: Path) -> None:
    record = load_vae(vae)[1]
    of_depth = record.model_copy(update={"vae_recipe": VAE.model_copy(update={"colour": False})})
    save_vae(tmp_path, ResVae(), of_depth)
    with pytest.raises(CheckpointError, match="holds a VAE of depth images"):
        train_compressor(COMPRESSOR, tmp_path, data, data, tmp_path / "out", _ignore)


def test_a_dataset_of_another_size_and_one_of_another_rig_are_refused(vae: Path, data: Path, tmp_path: Path) -> None:
    more = COMPRESSOR.model_copy(update={"objects": 3})
    with pytest.raises(SceneError, match="holds 2 objects, the recipe asks for 3"):
        train_compressor(more, vae, data, data, tmp_path, _ignore)
    other = RIG.model_copy(update={"name": "other"})
    build_shard(DatasetPlan(other, 40, accuracy="draft"), tmp_path / "colour-000000040.h5", range(40, 42))
    with pytest.raises(SceneError, match="different rigs"):
        train_compressor(COMPRESSOR, vae, data, tmp_path, tmp_path / "out", _ignore)
