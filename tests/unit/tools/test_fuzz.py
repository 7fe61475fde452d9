"""The fuzz of recordings: that it finds what is bad, and that it finds nothing in what there is."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

BAD_ACTIONS = """
import mmap, os, time
from pathlib import Path
from nlos_cam.errors import RecordingError

def act(path: Path, folder: Path) -> None:
    match path.read_text():
        case "crash": os.abort()
        case "exit": os._exit(0)
        case "hang": time.sleep(60)
        case "memory": bytearray((1 << 30) + (1 << 20))
        case "enough memory": mmap.mmap(-1, 900 << 20)
        case "unexpected": raise ValueError("nobody foresaw this")
        case "refused": raise RecordingError("foreseen")
        case "writes": (folder / "more").write_bytes(b"x")

ACTIONS = {"good": lambda path, folder: None, "bad": act}
"""
VERDICTS = {
    "crash": "crash",
    "exit": "crash",
    "hang": "hang",
    "memory": "memory",
    "enough memory": "done",
    "unexpected": "unexpected",
    "refused": "refused",
    "writes": "done",
    "whole": "done",
}
Tool = Callable[[str], ModuleType]


@pytest.mark.slow
def test_the_watch_notices_each_kind_of_harm_and_goes_on(tool: Tool, tmp_path: Path) -> None:
    actions, whole = tmp_path / "actions.py", tmp_path / "whole"
    actions.write_text(BAD_ACTIONS)
    whole.write_text("whole")
    found: dict[str, str] = {}
    with tool("fuzz").Watched(actions, whole, timeout_s=3.0) as watched:
        for name in VERDICTS:
            path = tmp_path / name
            path.write_text(name)
            found[name], told = watched.judge(path)
            assert told or found[name] == "done"
    assert found == VERDICTS


@pytest.mark.slow
def test_corruption_is_the_same_for_the_same_seed_and_every_way_is_taken(
    tool: Tool, noise_bags: dict[str, Path]
) -> None:
    module, content = tool("corruption"), noise_bags["packed"].read_bytes()
    taken = set[str]()
    for seed in range(60):
        ways, bad = module.corrupt(content, np.random.default_rng(seed))
        assert (ways, bad) == module.corrupt(content, np.random.default_rng(seed))
        assert bad != content
        taken |= set(ways.split("+"))
    assert taken == {way.__name__ for way in module.WAYS}


@pytest.mark.slow
def test_forty_corrupted_recordings_end_in_frames_or_a_line(
    tool: Tool, noise_bags: dict[str, Path], tmp_path: Path
) -> None:
    findings = tool("fuzz").fuzz(noise_bags, Path(str(tool("fuzz").__file__)), 40, 0, tmp_path)
    assert findings.bad == []
    assert set(findings.verdicts) <= {"done", "refused"}
    assert findings.refused_by["replay"] > 10
    assert findings.refused_by["repair"] < 30  # most of what replay refuses can be repaired
