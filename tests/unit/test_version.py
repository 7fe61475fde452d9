"""What a user cites: version and commit, in `--version`, `info`, records and reports."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from nlos_calibration import load_wall
from nlos_models import load_record
from nlos_models.records import UNCERTAINTY_RECORD, UncertaintyRecord

import nlos_cam
from nlos_cam.cli.main import main
from nlos_cam.commit import BUILT, commit_of
from nlos_cam.dataset import open_dataset, shard_origin
from nlos_cam.files import program_name, with_commit
from nlos_cam.info import describe
from nlos_cam.recording import load_sidecar
from nlos_cam.render import RENDERING_VERSION
from nlos_cam.report import Document

COMMIT = "0123456789abcdef0123456789abcdef01234567"
EARLIER = Path(__file__).parents[1] / "data" / "0.1.0"
Write = Callable[[str, str], Path]


@pytest.fixture
def answer(capsys: pytest.CaptureFixture[str]) -> Callable[..., dict]:
    """Run a command and return its JSON object."""

    def call(*words: object) -> dict:
        assert main([*map(str, words), "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    return call


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Write a file of a checkout; returns the package's folder."""
    (tmp_path / "nlos_cam").mkdir()
    (tmp_path / "pyproject.toml").touch()

    def make(name: str, text: str) -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        return tmp_path / "nlos_cam"

    return make


@pytest.mark.parametrize(
    "files",
    [
        {".git/HEAD": COMMIT},
        {".git/HEAD": "ref: refs/heads/main\n", ".git/refs/heads/main": f"{COMMIT}\n"},
        {
            ".git/HEAD": "ref: refs/heads/main\n",
            ".git/packed-refs": f"# pack-refs\n{'f' * 40} refs/heads/x\n{COMMIT} refs/heads/main\n",
        },
        {
            ".git": "gitdir: store/worktrees/one\n",
            "store/worktrees/one/HEAD": "ref: refs/heads/a/b\n",
            "store/worktrees/one/commondir": "../..\n",
            "store/refs/heads/a/b": COMMIT,
        },
        {f"nlos_cam/{BUILT}": f"{COMMIT}\n"},
    ],
    ids=["detached", "branch", "packed", "worktree", "built"],
)
def test_commit_is_found(write: Write, files: dict[str, str]) -> None:
    package = {write(name, text) for name, text in files.items()}.pop()
    assert commit_of(package) == COMMIT


@pytest.mark.parametrize("head", ["", "ref: refs/heads/gone\n", "ref: ../../secret\n", "main"])
def test_unknown_commit_is_left_out(write: Write, head: str) -> None:
    assert commit_of(write(".git/HEAD", head)) == ""
    assert with_commit("nlos-cam 1.0", "") == "nlos-cam 1.0"


def test_repository_around_an_installed_package_does_not_count(
    write: Write, tmp_path: Path
) -> None:
    package = write(".git/HEAD", COMMIT)
    (tmp_path / "pyproject.toml").unlink()

    assert commit_of(package) == ""


def test_info_without_a_file_names_versions_and_weights(answer: Callable[..., dict]) -> None:
    facts = answer("info")

    assert facts["program"] == program_name()
    assert facts["version"] == nlos_cam.__version__
    assert facts["rendering_version"] == RENDERING_VERSION
    assert sorted(facts["weights"]) == ["any", "direct", "paper", "wide"]


def test_report_names_the_program() -> None:
    assert program_name() in Document("title", "", []).as_html()


def test_wall_records_of_0_1_0_are_read() -> None:
    wall, occluder = (load_wall(EARLIER / f"{name}.toml") for name in ("wall", "occluder"))

    assert wall.verdict == occluder.verdict == "good"
    assert wall.occluder is None
    assert occluder.rig.occluder.x_m == pytest.approx(0.2, abs=1e-3)


def test_recording_of_0_1_0_names_its_program() -> None:
    sidecar = load_sidecar(EARLIER / "run.json")

    assert sidecar.versions["nlos-cam"] == "0.1.0"
    assert describe(EARLIER / "run.json", verify=True).made_by == "nlos-cam 0.1.0 capture"


def test_weights_record_of_0_1_0_is_read() -> None:
    record = load_record(EARLIER / "weights")

    assert [recipe.task for recipe in record.runs] == ["direct"]
    assert record.program == ""

    text = (EARLIER / "weights" / UNCERTAINTY_RECORD).read_text(encoding="utf-8")

    assert UncertaintyRecord.model_validate_json(text).recipe.task == "doubt"


@pytest.mark.parametrize("folder", ["replayed", "evaluation", "dataset"])
def test_folder_of_0_1_0_is_whole(folder: str) -> None:
    assert describe(EARLIER / folder, verify=True).problem == ""


def test_dataset_of_0_1_0_is_read_but_not_continued() -> None:
    stored = open_dataset(EARLIER / "dataset")
    today = replace(stored.plan, rendering_version=RENDERING_VERSION)

    assert stored.plan.rendering_version == 6 < RENDERING_VERSION
    assert stored.plan.differences(today) == ["rendering version"]
    assert stored.arrays().depth_m.shape == (1, 64, 80)
    assert shard_origin(EARLIER / "dataset" / "shard-000000000.h5")[0] == "0.1.0"


def test_surface_of_0_1_0_is_exported(answer: Callable[..., dict], tmp_path: Path) -> None:
    out = tmp_path / "made" / "here"
    answer("export", EARLIER / "replayed" / "reconstruction.npz", "--object", "ply", "--out", out)

    assert [*out.glob("*.ply")]
