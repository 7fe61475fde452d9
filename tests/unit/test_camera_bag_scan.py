from pathlib import Path

import pytest

from nlos_cam.recording import salvage
from nlos_cam.recording.rosbag import Op, Read, pack_index, read_record
from nlos_cam.recording.salvage import Scan, scan_bag

FIRST_CHUNK_AT = 4117


@pytest.fixture(params=["packed", "plain"])
def bag(request: pytest.FixtureRequest, noise_bags: dict[str, Path]) -> Path:
    return noise_bags[request.param]


def chunk_places(content: bytes) -> list[tuple[int, int]]:
    """Where the chunks of a whole recording begin and end."""
    read: Read = lambda at, count: content[at : at + count]  # noqa: E731  as the code under test takes it
    places, at = list[tuple[int, int]](), FIRST_CHUNK_AT
    while at < len(content):
        record = read_record(read, at)
        if record.op is Op.CHUNK:
            places.append((at, record.end))
        at = record.end
    return places


def scanned(tmp_path: Path, content: bytes) -> Scan:
    path = tmp_path / "scanned.bag"
    path.write_bytes(content)
    return scan_bag(path)


def indexes(scan: Scan) -> list[dict[int, bytes]]:
    return [chunk.index for chunk in scan.chunks]


def test_a_whole_recording_has_no_damage_and_all_its_chunks(bag: Path) -> None:
    content = bag.read_bytes()
    scan = scan_bag(bag)
    assert not scan.damages
    assert [chunk.at for chunk in scan.chunks] == [at for at, _ in chunk_places(content)]
    assert len(scan.chunks) > 3
    assert scan.bytes == len(content)
    assert {connection.topic for connection in scan.connections.values()} >= {
        f"/device_0/sensor_0/{stream}_0/image/data" for stream in ("Depth", "Infrared", "Confidence")
    }


def test_the_index_found_is_the_index_written(bag: Path) -> None:
    content = bag.read_bytes()
    for (_, end), chunk in zip(chunk_places(content), scan_bag(bag).chunks, strict=True):
        written = b"".join(pack_index(number, entries) for number, entries in chunk.index.items())
        assert content[end:].startswith(written)


def test_the_trailer_is_not_needed(bag: Path, tmp_path: Path) -> None:
    content = bag.read_bytes()
    scan = scanned(tmp_path, content[: chunk_places(content)[-1][1]])
    assert (scan.chunks, scan.connections, scan.damages) == (
        scan_bag(bag).chunks,
        scan_bag(bag).connections,
        [],
    )


def test_damage_in_one_chunk_costs_that_chunk_and_no_other(noise_bags: dict[str, Path], tmp_path: Path) -> None:
    whole = noise_bags["packed"].read_bytes()
    before = indexes(scan_bag(noise_bags["packed"]))
    for number, (at, end) in enumerate(chunk_places(whole)[1:], start=1):
        content = bytearray(whole)
        content[(at + end) // 2] ^= 16
        scan = scanned(tmp_path, bytes(content))
        assert indexes(scan) == before[:number] + before[number + 1 :]
        assert [(damage.position, damage.bytes) for damage in scan.damages] == [(at, end - at)]


def test_a_lost_header_costs_nothing_where_the_data_is_whole(bag: Path, tmp_path: Path) -> None:
    whole = bag.read_bytes()
    at, _ = chunk_places(whole)[2]
    scan = scanned(tmp_path, whole[:at] + bytes(40) + whole[at + 40 :])
    assert indexes(scan) == indexes(scan_bag(bag))
    assert [damage.position for damage in scan.damages] == [at]


def test_damage_in_a_plain_chunk_costs_a_few_messages(noise_bags: dict[str, Path], tmp_path: Path) -> None:
    whole = noise_bags["plain"].read_bytes()
    at, end = chunk_places(whole)[1]
    middle = whole.index(b"\x04\0\0\0op=\x02", (at + end) // 2)
    scan = scanned(tmp_path, whole[:middle] + bytes(8) + whole[middle + 8 :])
    lost = count(scan_bag(noise_bags["plain"])) - count(scan)
    assert 1 <= lost <= 2
    assert len(scan.damages) == 1


def count(scan: Scan) -> int:
    return sum(len(entries) for index in indexes(scan) for entries in index.values()) // 12


def test_a_removed_range_is_bridged(bag: Path, tmp_path: Path) -> None:
    whole = bag.read_bytes()
    places = chunk_places(whole)
    scan = scanned(tmp_path, whole[: places[1][0] + 500_000] + whole[places[2][0] + 500_000 :])
    kept = indexes(scan_bag(bag))
    assert indexes(scan)[0] == kept[0]
    assert indexes(scan)[-len(kept) + 3 :] == kept[3:]


def test_connections_come_from_the_files_end_where_their_chunk_is_lost(
    noise_bags: dict[str, Path], tmp_path: Path
) -> None:
    whole = noise_bags["packed"].read_bytes()
    scan = scanned(tmp_path, whole[:FIRST_CHUNK_AT] + whole[chunk_places(whole)[1][0] :])
    assert scan.connections == scan_bag(noise_bags["packed"]).connections


def test_what_describes_the_streams_survives_in_a_broken_first_chunk(
    noise_bags: dict[str, Path], tmp_path: Path
) -> None:
    content = bytearray(noise_bags["packed-unindexed"].read_bytes())
    content[400_000] ^= 1
    scan = scanned(tmp_path, bytes(content))
    assert scan.connections == scan_bag(noise_bags["packed"]).connections
    assert "kept, unchecked" in scan.damages[0].why
    assert scan.chunks[0].content is not None
    assert count(scan) > 0.5 * count(scan_bag(noise_bags["packed-unindexed"]))


def test_a_chunk_that_is_there_twice_is_taken_once(bag: Path, tmp_path: Path) -> None:
    whole = bag.read_bytes()
    places = chunk_places(whole)
    scan = scanned(tmp_path, whole[: places[2][0]] + whole[places[1][0] :])
    assert indexes(scan) == indexes(scan_bag(bag))
    assert [damage.why for damage in scan.damages] == ["it is in the file twice"]


def test_a_chunk_of_another_recording_is_refused(noise_bags: dict[str, Path], tmp_path: Path) -> None:
    whole = noise_bags["plain"].read_bytes()
    at, end = chunk_places(whole)[0]
    other = whole[at:end].replace(b"topic=/device_0", b"topic=/device_1")
    scan = scanned(tmp_path, whole[:end] + other + whole[end:])
    assert indexes(scan) == indexes(scan_bag(noise_bags["plain"]))
    assert [damage.why for damage in scan.damages] == ["it calls other topics by the same numbers"]


def test_messages_that_show_in_packed_data_are_not_taken(noise_bags: dict[str, Path], tmp_path: Path) -> None:
    whole = noise_bags["packed"].read_bytes()
    at, end = chunk_places(whole)[1]
    assert whole.count(b"\x04\0\0\0op=\x02", at, end) > 1
    content = bytearray(whole)
    content[end - 100_000] ^= 1
    assert len(scanned(tmp_path, bytes(content)).chunks) == len(chunk_places(whole)) - 1


@pytest.mark.parametrize("content", [b"", b"#ROSBAG V2.0\n", b"no recording", bytes(3 << 20), b"\0\0\0op=" * 9999])
def test_where_there_is_nothing_nothing_is_found(tmp_path: Path, content: bytes) -> None:
    scan = scanned(tmp_path, content)
    assert (scan.chunks, scan.connections, scan.bytes) == ([], {}, len(content))


def test_a_record_that_windows_part_is_found(bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = bag.read_bytes()
    at, _ = chunk_places(whole)[1]
    for window in range(40, 90):
        monkeypatch.setattr(salvage, "WINDOW_BYTES", window)
        found = scanned(tmp_path, b"\1" * 200 + whole[at:])
        assert [chunk.index for chunk in found.chunks] == indexes(scan_bag(bag))[1:]


def test_progress_goes_up_to_the_files_size(bag: Path) -> None:
    told: list[tuple[int, int]] = []
    scan = scan_bag(bag, lambda done, total: told.append((done, total)))
    assert told == sorted(told)
    assert told[-1] == (scan.bytes, scan.bytes)
