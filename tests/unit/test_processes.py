"""Files in the current folder that have the names of modules, and that no process of ours runs."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from nlos_cam.processes import (
    SAFE_PATH,
    child_environment,
    import_path,
    package_folder,
    safe_children,
)

POISONED = "multiprocessing", "nlos_cam", "numpy", "pickle", "selectors", "torch", "ray"
MARKER = "ran"
HEAD = """
import sys
import numpy as np
from nlos_calibration import load_rig
"""
PHYSICS_CHECK = f"""{HEAD}
import time
from nlos_cam.frames import LidarMaps
from nlos_cam.live import BackgroundPhysicsCheck
shape = 64, 80
maps = LidarMaps(np.full(shape, np.nan, np.float32), np.zeros(shape, np.float32),
                 np.zeros(shape, bool))
nothing = np.full((64, 64), np.nan, np.float32)
with BackgroundPhysicsCheck(load_rig("bare-wall"), accuracy="draft") as checks:
    checks.offer(1, maps, nothing)
    while checks.newest is None and not checks.ended:
        time.sleep(0.01)
    assert checks.newest is not None
"""
WORKERS = f"""{HEAD}
from collections import deque
from nlos_cam.dataset import DatasetPlan
from nlos_cam.dataset.worker import Worker
if __name__ == "__main__":
    plan = DatasetPlan(load_rig("paper-rig"), 0, accuracy="draft")
    left = deque([range(1)])
    worker = Worker(plan, left)
    assert worker.take(left) is not None
    worker.end()
"""
TORCH = """
from nlos_models.training.distributed import launch, open_fabric
from nlos_models.training.recipe import Recipe
import torch
def rank(fabric):
    return fabric.world_size
if __name__ == "__main__":
    recipe = Recipe.model_construct(batch=2, precision="32-true")
    assert launch(open_fabric(recipe, accelerator="cpu", devices=2), rank) == 2
"""
RAY = f"""{HEAD}
from nlos_cam.dataset import DatasetPlan, ray_farm
plan = DatasetPlan(load_rig("paper-rig"), 0, accuracy="draft")
assert len(dict(ray_farm("local")(plan, [range(1)]))) == 1
"""
SIMULATED = """
import nlos_cam
if __name__ == "__main__":
    with nlos_cam.open("sim:bare-wall") as camera:
        assert next(iter(camera)) is not None
"""
ENTRY = """
from nlos_cam.cli import run
if __name__ == "__main__":
    run()
"""


@pytest.fixture
def poisoned(tmp_path: Path) -> Path:
    """Current folder with files that leave a mark when they are run."""
    folder = tmp_path / "poisoned"
    folder.mkdir()
    for name in POISONED:
        (folder / f"{name}.py").write_text(
            f"open({str(folder / MARKER)!r}, 'a').write({name!r})\nraise SystemExit(66)\n"
        )
    return folder


def run_in(poisoned: Path, program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a script that lies elsewhere, with a poisoned current folder."""
    script = poisoned.parent / "user.py"
    script.write_text(program)
    path = os.pathsep.join(import_path())
    environment = {name: value for name, value in os.environ.items() if name != SAFE_PATH}
    return subprocess.run(
        [sys.executable, script, *arguments],
        cwd=poisoned,
        env={**environment, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "program",
    [
        pytest.param(PHYSICS_CHECK, id="physics check"),
        pytest.param(WORKERS, id="dataset workers"),
        pytest.param(TORCH, id="training processes"),
        pytest.param(RAY, id="ray workers"),
        pytest.param(SIMULATED, id="open"),
    ],
)
def test_child_runs_nothing_of_the_current_folder(program: str, poisoned: Path) -> None:
    ended = run_in(poisoned, program)

    assert ended.returncode == 0, ended.stderr
    assert not (poisoned / MARKER).exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        ("--version",),
        ("dataset", "build", "--count", "4", "--workers", "2", "--out", "made"),
        ("live", "sim:bare-wall", "--seconds", "2", "--no-view"),
    ],
    ids=" ".join,
)
def test_command_runs_nothing_of_the_current_folder(
    arguments: tuple[str, ...], poisoned: Path
) -> None:
    ended = run_in(poisoned, ENTRY, *arguments)

    assert ended.returncode == 0, ended.stderr
    assert not (poisoned / MARKER).exists()


def test_child_of_a_child_finds_the_package(poisoned: Path) -> None:
    ended = subprocess.run(
        [sys.executable, "-P", "-c", "import nlos_cam.processes"],
        cwd=poisoned,
        env=child_environment(),
        check=False,
    )

    assert ended.returncode == 0
    assert not (poisoned / MARKER).exists()


def test_import_path_leaves_out_the_current_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", ["", "/elsewhere"])
    assert import_path() == ["/elsewhere", str(package_folder())]


def test_safe_children_leave_this_process_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(SAFE_PATH, raising=False)
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    with pytest.raises(ZeroDivisionError), safe_children():  # noqa: PT012  an error leaves it too
        assert "" not in sys.path
        assert os.environ[SAFE_PATH] == "1"
        raise ZeroDivisionError

    assert sys.path[0] == ""
    assert SAFE_PATH not in os.environ
