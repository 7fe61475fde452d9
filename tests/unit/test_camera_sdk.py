import sys

import pytest

from nlos_cam.camera.sdk import WHEEL, load_sdk
from nlos_cam.errors import CameraError


def test_it_is_loaded_once() -> None:
    assert load_sdk() is load_sdk()


def test_a_missing_wheel_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    load_sdk.cache_clear()
    try:
        with pytest.raises(CameraError, match=f"pip install {WHEEL}"):
            load_sdk()
    finally:
        load_sdk.cache_clear()
