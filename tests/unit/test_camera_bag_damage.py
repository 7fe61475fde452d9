"""Whatever the bytes of a recording are, it is read or told in one line."""

import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nlos_cam.camera.bag_container import MOST_BYTES
from nlos_cam.camera.bag_file import BagFile
from nlos_cam.camera.replay import verify
from nlos_cam.errors import RecordingError

ABSURD = (0xFFFFFFFF, 0x7FFFFFFF, 0x10000000, 0, 1)
SIZES = (b"size=", b"count=", b"chunk_count=", b"conn_count=", b"index_pos=", b"chunk_pos=")
"""Fields whose value says how much to read, or where."""


def damaged(content: bytes, random: np.random.Generator) -> bytes:
    """One kind of damage, at random."""
    found, at = bytearray(content), int(random.integers(13, max(len(content), 14)))
    end = at + int(random.integers(1, 400))
    match random.integers(6):
        case 0:
            del found[at:]
        case 1:
            found[at:end] = bytes(len(found[at:end]))
        case 2:
            found[at:end] = random.bytes(len(found[at:end]))
        case 3:
            del found[at:end]
        case 4:
            found[at : at + 4] = int(random.choice(ABSURD)).to_bytes(4, "little")
        case _:
            field = SIZES[random.integers(len(SIZES))]
            places = list(_places(content, field)) or [at]
            at = places[random.integers(len(places))]
            found[at : at + 4] = int(random.choice(ABSURD)).to_bytes(4, "little")
    return bytes(found)


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
    kind: str, seed: int, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    random = np.random.default_rng(seed)
    content = request.getfixturevalue(kind).read_bytes()
    for _ in range(random.integers(1, 4)):
        content = damaged(content, random)
    path = tmp_path / "damaged.bag"
    path.write_bytes(content)
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
        path.write_bytes(content[:at] + ABSURD[0].to_bytes(4, "little") + content[at + 4 :])
        tracemalloc.start()
        with pytest.raises(RecordingError):
            read_all(path)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 2 * MOST_BYTES
