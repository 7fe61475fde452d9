import importlib
import os
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

TOOLS = Path(__file__).parents[2] / "tools"
MB = 1_000_000


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("long_capture")


def test_looks_count_while_the_file_grows(tool: ModuleType) -> None:
    looks = [tool.Look(50.0 + second, 100.0, MB * min(second, 6)) for second in range(10)]
    recording = tool.while_recording(looks)
    assert [look.time_s for look in recording] == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]


def test_a_disk_that_paused_is_still_recorded_to(tool: ModuleType) -> None:
    looks = [tool.Look(second, 100.0, MB * written) for second, written in enumerate([1, 2, 2, 2, 5, 6, 6, 6])]
    assert len(tool.while_recording(looks)) == 5


def test_memory_is_judged_after_warming_up(tool: ModuleType) -> None:
    filling = [tool.Look(second, 10.0 * second, second) for second in range(12)]
    flat = [tool.Look(second, 200.0 + 2.0 * second / 60, second) for second in range(12, 61)]
    found = tool.memory(filling + flat)
    assert found.mib_per_minute == pytest.approx(2.0)
    assert found.most_mib == pytest.approx(202.0)
    assert found.median_mib == pytest.approx(201.2, abs=0.05)


@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="reads memory as Linux tells it")
def test_memory_is_the_processs_own(tool: ModuleType) -> None:
    before = tool.memory_mib(os.getpid())
    block = np.ones(64 * 2**20, np.uint8)
    assert tool.memory_mib(os.getpid()) - before == pytest.approx(64, abs=8)
    assert block.all()


def test_no_process_has_no_memory(tool: ModuleType) -> None:
    assert tool.memory_mib(2**22 + 1) is None


def test_both_readers_give_the_same_and_the_digest_sees_every_bit(tool: ModuleType, noise_bag: Path) -> None:
    seen: list[int] = []
    plain, sdk = (tool.read(noise_bag, reader, lambda: seen.append(1)) for reader in tool.READERS)
    assert plain.frames == sdk.frames == 20
    assert len(seen) == 40
    assert plain.digest == sdk.digest


def test_another_recording_has_another_digest(
    tool: ModuleType, noise_bag: Path, recorded: object, tmp_path: Path
) -> None:
    shorter = recorded(tmp_path / "shorter.bag", 19)
    assert tool.read(shorter, "plain", int).digest != tool.read(noise_bag, "plain", int).digest


def test_a_capture_that_fails_is_told(tool: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"exit code 3: .*no camera is called"):
        tool.capture(tmp_path / "a.bag", 1.0, "webcam", print)


def test_the_picture_is_drawn(tool: ModuleType, tmp_path: Path) -> None:
    looks = [tool.Look(second, 150.0, 30 * MB * second) for second in range(20)]
    tool.draw(looks, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes()[:4] == b"\x89PNG"
