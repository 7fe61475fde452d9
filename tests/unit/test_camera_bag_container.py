import re
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag1 import Reader

from nlos_cam.errors import RecordingError
from nlos_cam.recording import bag_container
from nlos_cam.recording.bag_container import BagContainer


def contents(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Every message, by topic, through our eyes."""
    bag = BagContainer(path)
    return {
        topic: [(entry.time_ns, bytes(bag.raw(entry))) for entry in entries] for topic, entries in bag.entries.items()
    }


def expected(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    found: dict[str, list[tuple[int, bytes]]] = {}
    with Reader(path) as reader:
        for connection, time_ns, raw in reader.messages():
            found.setdefault(connection.topic, []).append((time_ns, bytes(raw)))
    return found


@pytest.mark.parametrize("kind", ["noise_bag", "noise_bag_uncompressed", "real_bag"])
def test_messages_are_those_that_rosbags_reads(kind: str, request: pytest.FixtureRequest) -> None:
    path = request.getfixturevalue(kind)
    assert contents(path) == expected(path)


@pytest.mark.parametrize("compression", ["LZ4", "BZ2"])
def test_each_compression_of_the_format_is_read(noise_bag: Path, rewritten: Any, compression: str) -> None:
    path = rewritten(lambda _, time_ns, raw: [(time_ns, raw)], compression=compression)
    assert contents(path) == contents(noise_bag)


def test_the_end_is_the_last_message(noise_bag: Path) -> None:
    assert BagContainer(noise_bag).end_ns == max(times[-1][0] for times in expected(noise_bag).values())


def test_no_more_is_unpacked_than_the_bound(noise_bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bag_container, "MAX_BYTES", 10_000)
    bag = BagContainer(noise_bag)
    with pytest.raises(RecordingError, match="a chunk of"):
        bag.read("/file_version", bag.entries["/file_version"][0])


def test_the_place_of_damage_is_told(noise_bag: Path, tmp_path: Path) -> None:
    content, path = noise_bag.read_bytes(), tmp_path / "damaged.bag"
    where = content.index(b"compression=lz4") + 1000
    path.write_bytes(content[:where] + bytes(100) + content[where + 100 :])
    bag = BagContainer(path)
    entry = bag.entries["/file_version"][0]
    with pytest.raises(RecordingError, match=rf"is damaged 0\.0 s into its 0\.\d s, at byte {entry.chunk_pos}") as told:
        bag.read("/file_version", entry)
    assert f"`nlos-cam repair {path} --out damaged-repaired.bag`" in str(told.value)


def test_everything_is_every_message_as_it_follows_in_the_file(noise_bag: Path) -> None:
    bag = BagContainer(noise_bag)
    found = list(bag.everything())
    assert sorted((entry, topic) for topic, entry, _ in found) == sorted(
        (entry, topic) for topic, entries in bag.entries.items() for entry in entries
    )
    places = [(entry.chunk_pos, entry.offset) for _, entry, _ in found]
    assert places == sorted(places)
    assert next(message for topic, _, message in found if topic == "/file_version").data == 4


def test_a_message_of_a_type_that_we_do_not_know_is_no_damage(noise_bag_uncompressed: Path, tmp_path: Path) -> None:
    path = tmp_path / "other.bag"
    path.write_bytes(
        noise_bag_uncompressed.read_bytes().replace(b"geometry_msgs/Transform", b"realsense_msgs/Transfor")
    )
    found = {topic: message for topic, _, message in BagContainer(path).everything()}
    assert [topic for topic, message in found.items() if message is None] == [t for t in found if "/tf/" in t]


def test_an_index_that_leads_elsewhere_is_told(noise_bag: Path) -> None:
    bag = BagContainer(noise_bag)
    one, other = (bag.entries[f"/device_0/sensor_0/{name}_0/image/data"][0] for name in ("Depth", "Infrared"))
    with pytest.raises(RecordingError, match="the index leads to another message"):
        bag.read("/file_version", one._replace(offset=other.offset))


def test_a_file_that_vanishes_after_opening_is_told(noise_bag: Path, tmp_path: Path) -> None:
    path = tmp_path / "gone.bag"
    path.write_bytes(noise_bag.read_bytes())
    bag = BagContainer(path)
    path.unlink()
    with pytest.raises(RecordingError, match="cannot be read: No such file"):
        bag.read("/file_version", bag.entries["/file_version"][0])


def test_an_index_of_nothing_is_told(noise_bag: Path, tmp_path: Path) -> None:
    path = tmp_path / "nothing.bag"
    path.write_bytes(re.sub(rb"(?s)(chunk_count=).{4}", rb"\1" + bytes(4), noise_bag.read_bytes(), count=1))
    with pytest.raises(RecordingError, match="its index lists nothing"):
        BagContainer(path)


def test_no_file_stays_open(noise_bag: Path, tmp_path: Path) -> None:
    path = tmp_path / "bag.bag"
    path.write_bytes(noise_bag.read_bytes())
    bag = BagContainer(path)
    bag.read("/file_version", bag.entries["/file_version"][0])
    open_files = Path("/proc/self/fd")
    if not open_files.is_dir():
        pytest.skip("only Linux lists the open files of a process")
    assert path not in {each.readlink() for each in open_files.iterdir() if each.is_symlink()}
