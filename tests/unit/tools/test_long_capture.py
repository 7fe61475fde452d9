import mmap
import os
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

MB = 1_000_000


@pytest.fixture
def long(tool: Callable[[str], ModuleType]) -> ModuleType:
    return tool("long_capture")


def test_looks_count_while_the_file_grows(long: ModuleType) -> None:
    looks = [long.Look(50.0 + second, 100.0, MB * min(second, 6)) for second in range(10)]
    recording = long.while_recording(looks)
    assert [look.time_s for look in recording] == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]


def test_a_disk_that_paused_is_still_recorded_to(long: ModuleType) -> None:
    looks = [long.Look(second, 100.0, MB * written) for second, written in enumerate([1, 2, 2, 2, 5, 6, 6, 6])]
    assert len(long.while_recording(looks)) == 5


def test_memory_is_judged_after_warming_up(long: ModuleType) -> None:
    filling = [long.Look(second, 10.0 * second, second) for second in range(12)]
    flat = [long.Look(second, 200.0 + 2.0 * second / 60, second) for second in range(12, 61)]
    found = long.memory(filling + flat)
    assert found.mib_per_minute == pytest.approx(2.0)
    assert found.most_mib == pytest.approx(202.0)
    assert found.median_mib == pytest.approx(201.2, abs=0.05)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="reads memory as Linux tells it")
def test_memory_is_the_processs_own(long: ModuleType) -> None:
    before = long.memory_mib(os.getpid())
    with mmap.mmap(-1, 64 * 2**20, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS) as block:  # never memory used before
        block.write(b"1" * len(block))
        assert long.memory_mib(os.getpid()) - before == pytest.approx(64, abs=8)


@pytest.mark.slow
def test_both_readers_give_the_same_and_the_digest_sees_every_bit(long: ModuleType, noise_bag: Path) -> None:
    seen: list[int] = []
    plain, sdk = (long.read(noise_bag, reader, lambda: seen.append(1)) for reader in long.READERS)
    assert plain.frames == sdk.frames == 20
    assert len(seen) == 40
    assert plain.digest == sdk.digest
