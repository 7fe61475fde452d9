"""Where the cache lies."""

from pathlib import Path

import pytest

from nlos_cam.files import cache_folder


def test_the_variable_decides(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "other"))
    monkeypatch.setenv("NLOS_CAM_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path


@pytest.mark.parametrize("chosen", [None, ""])
def test_without_it_the_users_cache_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, chosen: str | None) -> None:
    if chosen is None:
        monkeypatch.delenv("NLOS_CAM_CACHE", raising=False)
    else:
        monkeypatch.setenv("NLOS_CAM_CACHE", chosen)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "nlos-cam"


def test_without_either_the_home_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("NLOS_CAM_CACHE", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    assert cache_folder() == tmp_path / ".cache" / "nlos-cam"


def test_asking_makes_no_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NLOS_CAM_CACHE", str(tmp_path / "none"))
    assert not cache_folder().exists()
