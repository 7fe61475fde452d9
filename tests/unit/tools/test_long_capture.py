from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture
def long(tool: Callable[[str], ModuleType]) -> ModuleType:
    return tool("long_capture")


def test_memory_is_judged_after_warming_up(long: ModuleType) -> None:
    filling = [long.Look(second, 10.0 * second, second) for second in range(12)]
    flat = [long.Look(second, 200.0 + 2.0 * second / 60, second) for second in range(12, 61)]
    found = long.memory(filling + flat)
    assert found.mib_per_minute == pytest.approx(2.0)
    assert found.most_mib == pytest.approx(202.0)
    assert found.median_mib == pytest.approx(201.2, abs=0.05)


@pytest.mark.slow
def test_both_readers_give_the_same_and_the_digest_sees_every_bit(long: ModuleType, noise_bag: Path) -> None:
    seen: list[int] = []
    plain, sdk = (long.read(noise_bag, reader, lambda: seen.append(1)) for reader in long.READERS)
    assert plain.frames == sdk.frames == 20
    assert len(seen) == 40
    assert plain.digest == sdk.digest
