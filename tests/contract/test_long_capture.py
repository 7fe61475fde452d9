"""Thirty seconds of `nlos-cam capture` as a person runs it; tools/long_capture.py does the same for ten minutes."""

import importlib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

SECONDS = 30
FRAMES = 900
pytestmark = pytest.mark.slow
MAX_GROWTH_MIB = 30.0
Long = tuple[dict[str, Any], list[Any], Path]


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(Path(__file__).parents[2] / "tools")
        return importlib.import_module("long_capture")


@pytest.fixture(scope="module")
def long(tool: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Long]:
    """Capture; returns its JSON, samples of its process, and the recording."""
    path = tmp_path_factory.mktemp("long") / "long.bag"
    told, looks = tool.capture(path, SECONDS, "sim:bare-wall", lambda _: None)
    yield told, looks, path
    path.unlink()  # close to a gigabyte


def test_long_capture_holds_every_frame_and_counts_gaps(long: Long) -> None:
    """A machine that is too busy to expose the world in time makes gaps, which are counted."""
    told = long[0]
    assert told["state"] == "complete"
    assert set(told["streams"].values()) == {told["frames"]}
    numbers = told["frames"] + told["dropped"]
    assert numbers >= FRAMES
    assert told["seconds"] == pytest.approx((numbers - 1) / 30, abs=0.01)


@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="reads memory as Linux tells it")
def test_long_capture_keeps_memory_flat(tool: ModuleType, long: Long) -> None:
    looks = long[1]
    assert len(looks) > SECONDS / 2
    warm = [look.memory_mib for look in looks if look.time_s >= tool.WARM_UP * looks[-1].time_s]
    assert max(warm) - warm[0] < MAX_GROWTH_MIB


def test_long_capture_reads_alike_with_both_readers(tool: ModuleType, long: Long) -> None:
    told, _, path = long
    plain, sdk = (tool.read(path, reader, int) for reader in tool.READERS)
    assert plain.frames == sdk.frames == told["frames"]
    assert plain.digest == sdk.digest
