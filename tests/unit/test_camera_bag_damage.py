"""Whatever the bytes of a recording are, it is read or told in one line."""

import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nlos_cam.errors import RecordingError
from nlos_cam.recording.bag_container import MAX_BYTES
from nlos_cam.recording.bag_reader import BagFile
from nlos_cam.recording.playback import verify

ABSURD = b"\xff\xff\xff\xff"
SIZES = (b"size=", b"count=", b"chunk_count=", b"conn_count=", b"index_pos=", b"chunk_pos=")
"""Fields whose value says how much to read, or where."""


def _places(content: bytes, field: bytes) -> Iterator[int]:
    """Where the values of a field are."""
    at = -1
    while (at := content.find(field, at + 1)) >= 0:
        yield at + len(field)


def read_all(path: Path) -> None:
    """Everything that a recording can be asked for. Raises RecordingError."""
    verify(path)
    bag = BagFile(path)
    for place in bag.order(bag.streams):
        bag.sample(place.stream, place.index)
        bag.metadata(place.stream, place.index)
        bag.settings(place.time_ns)


@pytest.mark.parametrize("kind", ["noise_bag", "noise_bag_uncompressed"])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damage_is_told_in_one_line_or_does_not_matter(
    kind: str, seed: int, request: pytest.FixtureRequest, tool: Any, tmp_path: Path
) -> None:
    content, random = request.getfixturevalue(kind).read_bytes(), np.random.default_rng(seed)
    path = tmp_path / "damaged.bag"
    path.write_bytes(tool("corruption").corrupt(content, random)[1])
    told = f"{path} is fine"
    try:
        read_all(path)
    except RecordingError as error:
        told = str(error)
    assert told.startswith(str(path))
    assert "\n" not in told


@pytest.mark.parametrize("kind", ["noise_bag", "noise_bag_uncompressed"])
@pytest.mark.parametrize("field", SIZES)
def test_an_absurd_size_is_not_allocated(
    kind: str, field: bytes, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    content, path = request.getfixturevalue(kind).read_bytes(), tmp_path / "absurd.bag"
    for at in list(_places(content, field))[:3]:
        path.write_bytes(content[:at] + ABSURD + content[at + 4 :])
        tracemalloc.start()
        with pytest.raises(RecordingError):
            read_all(path)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 2 * MAX_BYTES
