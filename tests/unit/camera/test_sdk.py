import sys
import tomllib
from itertools import product
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from nlos_cam.camera.sdk import MAC_WHEEL, WHEEL, load_sdk, wheel_for
from nlos_cam.errors import CameraError

PLACES = ["linux x86_64", "linux aarch64", "win32 AMD64", "win32 ARM64", "darwin arm64", "darwin x86_64"]


@pytest.mark.parametrize(
    ("machine", "words"), [("x86_64", f"pip install {WHEEL}"), ("aarch64", r"linux aarch64.*Python 3\.11")]
)
def test_missing_wheel_says_what_to_do(monkeypatch: pytest.MonkeyPatch, machine: str, words: str) -> None:
    assert load_sdk() is load_sdk()
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    monkeypatch.setattr("nlos_cam.camera.sdk._preload_libusb", lambda: None)
    monkeypatch.setattr("platform.machine", lambda: machine)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("sys.version_info", (3, 11, 7, "final", 0))
    load_sdk.cache_clear()
    try:
        with pytest.raises(CameraError, match=words):
            load_sdk()
    finally:
        load_sdk.cache_clear()


@pytest.mark.parametrize(("place", "minor"), list(product(PLACES, (11, 12, 13))))
def test_wheel_is_the_one_that_the_package_requires(place: str, minor: int) -> None:
    project = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    system, machine = place.split()
    there = {"python_version": f"3.{minor}", "sys_platform": system, "platform_machine": machine}
    asked = [
        f"{found.name}{found.specifier}"
        for found in map(Requirement, project["dependencies"])
        if found.name.startswith("pyrealsense2") and found.marker and found.marker.evaluate(there)
    ]
    wheel = wheel_for((3, minor), system, machine)
    assert asked == ([wheel] if wheel else [])
    assert wheel in {WHEEL, MAC_WHEEL, None}
