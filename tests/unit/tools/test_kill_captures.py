"""Killed captures, with a small world in place of the wall."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

CAPTURE = """
import sys
from pathlib import Path
sys.path[:0] = [sys.argv[1], sys.argv[1] + "/fakes"]
from conftest import record_noise
record_noise(Path(sys.argv[2]), 10**9)
"""


@pytest.fixture
def kills(tool: Callable[[str], ModuleType]) -> ModuleType:
    return tool("kill_captures")


@pytest.mark.slow
@pytest.mark.parametrize("after_s", [1.0])
def test_every_chunk_of_a_killed_capture_is_recovered(
    kills: ModuleType, noise_world: Any, tmp_path: Path, after_s: float
) -> None:
    path = tmp_path / "killed.bag"
    command = [sys.executable, "-c", CAPTURE, str(Path(__file__).parents[2]), str(path)]
    kills.kill(subprocess.Popen(command), path, after_s)
    found = kills.examine(path, after_s, noise_world())
    assert found.good
    assert found.chunks_on_disk == found.chunks_recovered > 0
    assert min(found.frames_on_disk.values()) > 40


def test_the_count_of_what_is_on_disk_is_that_of_a_whole_recording(
    kills: ModuleType, noise_bags: dict[str, Path]
) -> None:
    for name in ("packed", "plain"):
        chunks = list(kills.chunks_in(noise_bags[name]))
        assert kills.frames_in(chunks) == {"depth": 40, "infrared": 40, "confidence": 40}
        unfinished = list(kills.chunks_in(noise_bags[f"{name}-unindexed"]))
        assert unfinished == chunks[:-1]


@pytest.mark.slow
def test_what_is_lost_or_wrong_is_not_good(kills: ModuleType, noise_bags: dict[str, Path], noise_world: Any) -> None:
    other_world = noise_world()
    found = kills.examine(noise_bags["packed-unindexed"], 1.0, other_world)
    assert found.frames_wrong > 0
    assert not found.good
