"""Commands without the extra "train": those of the base run, the others name the extra."""

import subprocess
import sys
from pathlib import Path

import pytest
from nlos_models.errors import TRAIN

from nlos_cam.cli.main import main
from nlos_cam.recording import SAMPLE

PROGRAM = f"""
import sys
sys.modules.update(dict.fromkeys({sorted(TRAIN | {"safetensors"})!r}))
from nlos_cam.cli.main import main
sys.exit(main(sys.argv[1:]))
"""
"""A module that is None cannot be imported."""


def _run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", PROGRAM, *arguments], cwd=folder, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "line",
    [
        "live sim --no-view --seconds 1",
        "live sim --no-view --seconds 1 --budget-ms 500",
        "demo --no-view --seconds 1",
        "replay sample --out out",
        "capture sim --frames 3 --out out.bag",
        "calibrate --wall --camera sim:bare-wall --frames 20 --out wall.toml",
        "render cup --out cup.npz",
        "export sample --out out",
    ],
)
def test_command_runs_without_the_extra(tmp_path: Path, line: str) -> None:
    done = _run(tmp_path, *line.split())
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "line",
    [
        "train vae --recipe vae --out out",
        "dataset build --count 1 --out out",
        "render cup --backend torch --out cup.npz",
    ],
)
def test_command_of_the_extra_names_it_in_one_line(tmp_path: Path, line: str) -> None:
    done = _run(tmp_path, *line.split())
    assert done.returncode == 1
    (line,) = [line for line in done.stderr.splitlines() if "error:" in line]
    assert 'pip install "nlos-cam[train]"' in line
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("kind", ["scenes", "objects", "rigs", "recipes"])
def test_list_has_a_name_and_a_line_for_each(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([kind]) == 0
    rows = [line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines() if line]
    names = {"scenes": "sim:empty", "objects": "airplane", "rigs": "paper-rig", "recipes": "transfer"}
    assert names[kind] in {row[0] for row in rows}
    assert all(len(row) == 2 for row in rows)
    assert main([kind, "--json"]) == 0
    assert capsys.readouterr().out.count('"description"') == len(rows)


def test_sample_recording_is_small() -> None:
    assert SAMPLE.stat().st_size <= 2_000_000
