"""The command `adapt`, up to where its work begins."""

from pathlib import Path
from typing import Any

import pytest


@pytest.mark.parametrize(
    ("bench", "why", "code"),
    [
        ("no-such-rig", "no-such-rig", 2),
        ("folder", "folder", 4),
        ("empty.toml", "empty.toml", 4),
        ("record.toml", "record.toml", 4),
    ],
)
def test_what_is_no_bench_is_said_in_one_line(run: Any, bench: str, why: str, code: int) -> None:
    Path("folder").mkdir()
    Path("empty.toml").touch()
    Path("record.toml").write_text("schema_version = 3\n")

    err = run("adapt", bench, code=code).err

    assert why in err
    assert "Traceback" not in err


def test_weights_from_elsewhere_are_not_replaced_unasked(run: Any, out: Path) -> None:
    (out / "weights").mkdir(parents=True)
    (out / "weights" / "SHA256SUMS").write_text("somebody's\n")

    assert "--overwrite" in run("adapt", "paper-rig", "--out", out, code=1).err
