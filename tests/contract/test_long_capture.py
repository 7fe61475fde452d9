"""Thirty seconds of `nlos-cam capture`; tools/robustness/long_capture.py does the same for ten minutes."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import long_capture as tool
import pytest

SECONDS = 30
FRAMES = 900
pytestmark = pytest.mark.slow
MAX_GROWTH_MIB = 30.0
Long = tuple[dict[str, Any], list[Any], Path]


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Long]:
    """Capture, and return the JSON report, samples of the process, and the recording."""
    path = tmp_path_factory.mktemp("long") / "long.bag"
    report, looks = tool.capture(path, SECONDS, "sim:bare-wall", lambda _: None)
    yield report, looks, path
    path.unlink()  # close to a gigabyte


def test_long_capture_holds_every_frame_and_counts_gaps(long: Long) -> None:
    """On a machine too busy to expose the world in time there are gaps, which are counted."""
    report = long[0]
    assert report["state"] == "complete"
    assert set(report["streams"].values()) == {report["frames"]}
    numbers = report["frames"] + report["dropped"]
    assert numbers >= FRAMES
    assert report["seconds"] == pytest.approx((numbers - 1) / 30, abs=0.01)


@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="reads memory as Linux reports it")
def test_long_capture_keeps_memory_flat(long: Long) -> None:
    looks = long[1]
    assert len(looks) > SECONDS / 2
    warm = [look.memory_mib for look in looks if look.time_s >= tool.WARM_UP * looks[-1].time_s]
    assert max(warm) - warm[0] < MAX_GROWTH_MIB


def test_long_capture_reads_alike_with_both_readers(long: Long) -> None:
    report, _, path = long
    plain, sdk = (tool.read(path, reader, int) for reader in tool.READERS)
    assert plain.frames == sdk.frames == report["frames"]
    assert plain.digest == sdk.digest
