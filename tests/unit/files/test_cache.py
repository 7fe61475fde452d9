"""Cache entries: damaged, foreign and unusable ones."""

from pathlib import Path
from unittest.mock import Mock

import pytest

from nlos_cam.files import load_cached


def upper(content: bytes) -> str:
    return content.decode("ascii").upper()


@pytest.mark.parametrize("damage", [b"", b"cont", b"cOntent", b"\xff\xfe", None])
def test_damaged_or_foreign_cache_entry_counts_as_absent(
    tmp_path: Path, damage: bytes | None
) -> None:
    entry = tmp_path / "cache" / "world.npz"
    make = Mock(return_value=b"content")

    assert [load_cached(entry, upper, make) for _ in range(3)] == ["CONTENT"] * 3
    make.assert_called_once()

    (file,) = entry.parent.iterdir()
    if damage is None:
        load_cached(entry.with_name("other.npz"), upper, lambda: b"other")
        (other,) = entry.parent.glob("other.*")
        other.replace(file)
    else:
        file.write_bytes(damage)

    assert [load_cached(entry, upper, make) for _ in range(2)] == ["CONTENT"] * 2
    assert make.call_count == 2
    assert len(list(entry.parent.glob("world.*"))) == 1


@pytest.mark.parametrize("place", ["file/below", "/proc/none"])
def test_unusable_cache_or_entry_is_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, place: str
) -> None:
    (tmp_path / "file").write_bytes(b"")

    assert load_cached(tmp_path / place / "a.npz", upper, lambda: b"made") == "MADE"
    assert "NLOS_CAM_CACHE" in caplog.text

    load_cached(tmp_path / "a.npz", bytes, lambda: b"\xff")

    assert load_cached(tmp_path / "a.npz", upper, lambda: b"new") == "NEW"
    assert "making it again" in caplog.text
