"""Every script in examples/ does what it promises, on small inputs."""

import re
import runpy
import sys
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path

import pytest
import trimesh
from nlos_calibration import load_measured, load_rig

from nlos_cam.camera import open_world
from nlos_cam.dataset import DatasetPlan, build_dataset
from nlos_cam.dataset.samples import Samples, make_samples
from nlos_cam.render import load_scene

EXAMPLES = Path(__file__).parents[2] / "examples"
SCENE = (
    'name = "still"\nrig = "paper-rig"\nobject = { category = "cup", seed = 4, size_m = 0.17 }\n'
)
RIG = load_rig("paper-rig")
Run = Callable[..., str]
Record = Callable[[str, int], Path]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    made = tmp_path_factory.mktemp("examples")
    (made / "still.toml").write_text(SCENE, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(made)
        yield made


@pytest.fixture
def run(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run an example as a user would, in an empty folder; returns what it prints."""
    assert folder.is_dir()

    def call(name: str, *arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
        return capsys.readouterr().out

    return call


@pytest.fixture
def recording(folder: Path, recorded: Callable[..., Path]) -> Record:
    """Record the first frames of a scene."""
    return lambda name, frames: recorded(
        folder / f"{Path(name).stem}.bag", frames, open_world(name)
    )


def test_python_page_shows_the_example() -> None:
    page = EXAMPLES.parent / "docs" / "howto-python.md"
    code = (EXAMPLES / "live_depth.py").read_text(encoding="utf-8")

    assert f"```python\n{code}```" in page.read_text(encoding="utf-8")


@pytest.mark.slow
def test_live_depth_and_point_cloud_find_the_cup(run: Run, recording: Record, folder: Path) -> None:
    bag = recording("still.toml", 3)
    box = RIG.object_box

    assert box is not None

    lines = run("live_depth", f"bag:{bag}").splitlines()

    assert len(lines) == 3

    for line in lines:
        _, x_m, y_m, z_m = (float(figure) for figure in re.findall(r"-?[\d.]+", line))
        assert box.x_min_m < x_m < box.x_max_m
        assert abs(y_m) < 0.05
        assert box.z_near_m < z_m < box.z_far_m
    told = run("point_cloud", str(bag), "cup.ply")
    points = trimesh.load(folder / "cup.ply").vertices

    assert told == f"cup.ply: {len(points)} points of 3 frames\n"
    assert points[:, 2].min() >= box.z_near_m - 1e-6

    triangles = int(re.findall(r"(\d+) triangles", run("hidden_mesh", str(bag), "cup.glb"))[0])
    (mesh,) = trimesh.load_scene(folder / "cup.glb").geometry.values()

    assert len(mesh.faces) == triangles > 100


@pytest.mark.slow
def test_hide_and_seek_overlaps_more_than_chance(run: Run) -> None:
    overlap, off_mm = (
        int(figure) for figure in re.findall(r"(\d+)(?:%| mm)", run("hide_and_seek", "cup", "4"))
    )

    assert overlap > 40
    assert off_mm < 60


@pytest.mark.slow
def test_calibrate_bag_writes_readable_record(run: Run, recording: Record, folder: Path) -> None:
    assert run("calibrate_bag", str(recording("bare-wall", 6))).startswith(
        "200.0 mm to the wall, 45.00 degrees: good"
    )

    measured = load_measured(folder / "wall.toml")

    assert measured.record.frames == 6
    assert measured.reference is not None


@pytest.mark.slow
def test_judge_weights_prints_each_category(run: Run) -> None:
    counted = [
        re.fullmatch(r"\S+ +([01]\.\d\d) over (\d)", line)
        for line in run("judge_weights", "3").splitlines()
    ]
    assert sum(int(found[2]) for found in counted if found) == 3


def in_this_process(plan: DatasetPlan, pieces: Sequence[range]) -> Generator[tuple[range, Samples]]:
    for piece in pieces:
        yield piece, make_samples(plan, piece)


@pytest.mark.slow
def test_own_training_reduces_the_loss(run: Run, folder: Path) -> None:
    plan = DatasetPlan(RIG, 0, accuracy="draft")
    build_dataset(
        plan, 24, folder / "data", workers=1, on_progress=lambda *_: None, farm=in_this_process
    )
    losses = [float(line.split()[-1]) for line in run("own_training", "data", "3").splitlines()]

    assert len(losses) == 3
    assert losses[-1] < losses[0]


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda path: path.stem)
def test_example_scene_is_readable(path: Path) -> None:
    assert load_scene(path).poses >= 1


def test_every_example_script_is_run_here() -> None:
    text = Path(__file__).read_text(encoding="utf-8")
    assert [path.stem for path in EXAMPLES.glob("*.py") if f'run("{path.stem}"' not in text] == []
