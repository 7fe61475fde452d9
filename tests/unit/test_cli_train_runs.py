"""A job knows the runs before it, and writes over no weights but its own."""

from pathlib import Path

import pytest
from nlos_calibration.rig import load_rig
from nlos_models.recipe import Recipe
from nlos_models.runs import job_of

from nlos_cam.cli.train import RunOptions
from nlos_cam.errors import OutputExistsError

RIG = load_rig("paper-rig")
VAE, OTHER = (
    Recipe(task="vae", seed=seed, objects=4, held_out=2, epochs=1, batch=2, learning_rate=1e-3) for seed in range(2)
)


def _options(out: Path) -> RunOptions:
    return RunOptions(Path("r.toml"), out, tensorboard=True)


def _finish(out: Path, *runs: Recipe) -> None:
    job = job_of(_options(out), runs[-1], RIG, list(runs[:-1]), "origin")
    out.mkdir()
    (out / "checkpoint.json").write_text(job.made({"held_out_loss": 1.5}).model_dump_json(), encoding="utf-8")


def test_a_job_records_its_run_after_those_before(tmp_path: Path) -> None:
    job = job_of(_options(tmp_path / "run"), OTHER, RIG, [VAE], "origin", None, tmp_path / "start")
    assert (job.record.vae_recipe, job.record.earlier) == (OTHER, [VAE])
    assert (job.record.rig_name, job.record.rig_checksum) == (RIG.name, RIG.checksum)
    assert (job.recipe, job.out, job.origin, job.tensorboard, job.compiled) == (
        OTHER,
        tmp_path / "run",
        "origin",
        True,
        False,
    )


def test_a_run_that_ended_may_be_run_again(tmp_path: Path) -> None:
    _finish(tmp_path / "run", VAE, OTHER)
    job_of(_options(tmp_path / "run"), OTHER, RIG, [VAE], "origin")


@pytest.mark.parametrize("runs", [(VAE,), (OTHER,), (OTHER, VAE)])
def test_weights_of_another_run_are_not_written_over(tmp_path: Path, runs: tuple[Recipe, ...]) -> None:
    _finish(tmp_path / "run", VAE, OTHER)
    with pytest.raises(OutputExistsError, match="holds weights that another run made: choose another --out"):
        job_of(_options(tmp_path / "run"), runs[-1], RIG, list(runs[:-1]), "origin")


def test_a_file_is_no_runs_folder(tmp_path: Path) -> None:
    (tmp_path / "run").touch()
    with pytest.raises(OutputExistsError, match="is a file, not a run's folder"):
        job_of(_options(tmp_path / "run"), VAE, RIG, [], "origin")


def test_the_weights_that_a_run_starts_from_are_not_written_over(tmp_path: Path) -> None:
    with pytest.raises(OutputExistsError, match="is where this run starts from"):
        job_of(_options(tmp_path / "run"), OTHER, RIG, [VAE], "origin", tmp_path / "x" / ".." / "run")
