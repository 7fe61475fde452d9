"""Commands without the extra "train": those of the base run, the others name the extra."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from nlos_models.errors import TRAIN

from nlos_cam.recording import SAMPLE

PROGRAM = f"""
import sys
sys.modules.update(dict.fromkeys({sorted(TRAIN | {"safetensors"})!r}))
if not {{"live", "demo", "capture", "calibrate"}} & {{*sys.argv}}:
    sys.modules["pyrealsense2"] = None
from nlos_cam.cli.main import main
sys.exit(main(sys.argv[1:]))
"""
"""A module that is None cannot be imported. Commands that open no camera do without the SDK,
too.
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "needs_it"),
    [
        ("live sim --no-view --seconds 1", False),
        ("demo --no-view --seconds 1", False),
        ("replay sample --out out", False),
        ("capture sim --frames 3 --out out.bag", False),
        ("calibrate --wall --camera sim:bare-wall --frames 20 --out wall.toml", False),
        ("render cup --out cup.npz", False),
        ("export sample --out out", False),
        ("train vae --recipe vae --out out", True),
        ("dataset build --count 1 --out out", True),
        ("render cup --backend torch --out cup.npz", True),
    ],
)
def test_command_runs_without_the_extra_or_names_it_in_one_line(
    tmp_path: Path, line: str, needs_it: bool
) -> None:
    command = [sys.executable, "-c", PROGRAM, *line.split()]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)

    assert done.returncode == needs_it, done.stderr

    if needs_it:
        (error,) = [line for line in done.stderr.splitlines() if "error:" in line]
        assert 'pip install "nlos-cam[train]"' in error
        assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("scenes", "sim:empty"),
        ("objects", "airplane"),
        ("objects --test", "cup-2"),
        ("rigs", "paper-rig"),
        ("recipes", "transfer"),
    ],
)
def test_list_has_a_name_and_a_line_for_each(
    kind: str, name: str, shown: Callable[..., Any]
) -> None:
    rows = [line.split(maxsplit=1) for line in shown(*kind.split()).out.splitlines() if line]

    assert name in {row[0] for row in rows}
    assert all(len(row) == 2 for row in rows)
    assert shown(*kind.split(), "--json").out.count('"description"') == len(rows)


def test_sample_recording_is_small() -> None:
    assert SAMPLE.stat().st_size <= 2_000_000
