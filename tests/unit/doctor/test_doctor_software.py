from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import pytest
import usb.core

from nlos_cam.camera.sdk import WHEEL
from nlos_cam.doctor.checks import numbers
from nlos_cam.doctor.host import Platform


@pytest.mark.parametrize(
    ("text", "version"), [("01.05.08.01", (1, 5, 8, 1)), ("2.54.2.5684", (2, 54, 2, 5684)), ("", ())]
)
def test_versions_are_numbers(text: str, version: tuple[int, ...]) -> None:
    assert numbers(text) == version


@pytest.mark.parametrize(
    ("on", "word"),
    [
        (Platform("linux", "x86_64", (3, 12)), "python3.11 -m venv"),
        (Platform("windows", "amd64", (3, 13)), "python3.11 -m venv"),
        (Platform("linux", "aarch64", (3, 11)), "BUILD_PYTHON_BINDINGS"),
        (Platform("linux", "riscv64", (3, 11)), "BUILD_PYTHON_BINDINGS"),
        (Platform("darwin", "arm64", (3, 13)), "python3.12 -m venv"),
        (Platform("linux", "x86_64", (3, 11), is_musl=True), "glibc"),
    ],
)
def test_a_python_without_a_wheel_fails(bench: Any, on: Platform, word: str) -> None:
    bench.platform, bench.sdk_error = on, ImportError("No module named 'pyrealsense2'")
    check = bench.failed()["python"]
    assert word in check.fix
    assert on.machine in check.detail


@pytest.mark.parametrize("python", [(3, 11), (3, 12)])
def test_a_python_on_which_librealsense_runs_is_ok_however_it_came_there(bench: Any, python: tuple[int, int]) -> None:
    bench.platform = replace(bench.platform, python=python)
    assert bench.checks()["python"].status == "ok"


def test_a_wheel_that_exists_but_is_not_installed_is_no_fault_of_python(bench: Any) -> None:
    bench.sdk_error = ImportError("No module named 'pyrealsense2'")
    assert bench.checks()["python"].status == "ok"


@pytest.mark.parametrize(
    ("error", "fix"),
    [
        ("No module named 'pyrealsense2'", f"pip install {WHEEL}"),
        ("No module named 'libusb_package'", "libusb-package"),
        (
            "libusb-1.0.so.0: cannot open shared object file",
            "sudo apt install libusb-1.0-0, or `pip install libusb-package`",
        ),
        ("libudev.so.1: cannot open shared object file", "sudo apt install libudev1"),
        ("libstdc++.so.6: cannot open shared object file", "sudo apt install libstdc++6"),
        ("/lib/libc.so.6: version `GLIBC_2.17' not found", "newer release"),
        ("DLL load failed while importing pyrealsense2", "vc_redist"),
    ],
)
def test_an_sdk_that_cannot_be_loaded_fails_with_what_it_lacks(bench: Any, error: str, fix: str) -> None:
    bench.sdk_error = ImportError(error)
    check = bench.failed()["sdk"]
    assert check.detail == error
    assert fix in check.fix


def test_an_sdk_that_is_only_a_folder_fails(bench: Any) -> None:
    bench.load_sdk = object
    check = bench.failed()["sdk"]
    assert "attribute" in check.detail
    assert "--force-reinstall" in check.fix


def test_an_sdk_that_cannot_list_fails(bench: Any) -> None:
    def fail() -> None:
        raise RuntimeError("failed to set power state")

    bench.load_sdk = lambda: Mock(context=fail)
    check = bench.failed()["sdk"]
    assert "failed to set power state" in check.detail
    assert "unplug the camera" in check.fix


@pytest.mark.parametrize("version", ["2.55.1.6486", "2.59.1.11053", "3.0"])
def test_an_sdk_without_the_l515_fails_and_is_why_it_is_not_seen(bench: Any, version: str) -> None:
    bench.installed["pyrealsense2"] = version
    bench.sdk_devices.clear()
    failed = bench.failed()
    assert set(failed) == {"sdk-version", "sdk-camera"}
    assert failed["sdk-version"].fix == failed["sdk-camera"].fix == f"pip install {WHEEL}"
    assert version in failed["sdk-camera"].detail


def test_an_older_sdk_that_knows_the_l515_is_a_warning(bench: Any) -> None:
    bench.installed["pyrealsense2"] = "2.53.1.4623"
    assert bench.checks()["sdk-version"].status == "warning"


def test_an_sdk_that_pip_does_not_know_is_not_judged(bench: Any) -> None:
    del bench.installed["pyrealsense2"]
    checks = bench.checks()
    assert "unknown version" in checks["sdk"].detail
    assert checks["sdk-version"].status == checks["sdk-alone"].status == "skipped"


def test_two_sdks_in_one_environment_fail(bench: Any) -> None:
    bench.installed["pyrealsense2-beta"] = "2.54.2.5684"
    check = bench.failed()["sdk-alone"]
    assert check.fix == f"pip uninstall -y pyrealsense2 pyrealsense2-beta && pip install {WHEEL}"


def test_a_missing_libusb_fails_and_what_hangs_on_it_is_left_out(bench: Any) -> None:
    bench.usb.fails = usb.core.NoBackendError("No backend available")
    checks = bench.checks()
    assert {name for name, check in checks.items() if check.status == "failed"} == {"libusb"}
    assert "No backend available" in checks["libusb"].detail
    assert "pip install pyusb libusb-package" in checks["libusb"].fix
    assert "sudo apt" in checks["libusb"].fix
    assert checks["usb-camera"].status == "skipped"
    assert checks["sdk-camera"].status == "ok"  # the SDK sees it all the same
    bench.platform = Platform("windows", "amd64", (3, 11))
    assert "apt" not in bench.checks()["libusb"].fix


def test_macos_without_a_camera_fails(bench: Any) -> None:
    bench.platform = Platform("darwin", "arm64", (3, 11))
    bench.sdk_devices.clear()
    check = bench.failed()["system"]
    assert "simulation and recordings only" in check.detail
    assert "pyrealsense2-macosx==2.54.2" in check.fix
    assert "sudo" in check.fix


def test_macos_where_the_camera_is_seen_is_a_warning(bench: Any) -> None:
    bench.platform = Platform("darwin", "arm64", (3, 11))
    assert bench.checks()["system"].status == "warning"
    assert bench.failed() == {}


def test_macos_gets_its_own_wheel(bench: Any) -> None:
    bench.platform = Platform("darwin", "arm64", (3, 11))
    bench.sdk_error = ImportError("No module named 'pyrealsense2'")
    assert "pip install pyrealsense2-macosx==2.54.2" in bench.failed()["sdk"].fix


def test_wsl_without_a_camera_fails(bench: Any) -> None:
    bench.unplug()
    bench.linux.write("proc/version", "Linux version 6.6.87-microsoft-standard-WSL2")
    check = bench.failed()["system"]
    assert "usbipd attach --wsl --busid" in check.fix


def test_wsl_with_the_camera_attached_is_a_warning(bench: Any) -> None:
    bench.linux.write("proc/version", "Linux version 6.6.87-microsoft-standard-WSL2")
    assert bench.checks()["system"].status == "warning"
