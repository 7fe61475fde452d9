"""The real pyusb on a fake bus; and the real bus with any devices on it."""

import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import usb.backend
import usb.core
import usb.util
from usb.backend.libusb1 import _LibUSB

from nlos_cam.doctor.usb import SPEEDS, UsbDevice, firmware_of, scan_usb, sdk_serial

Make = Callable[..., SimpleNamespace]
Scan = Callable[..., list[UsbDevice]]


@pytest.fixture
def seen(bench: Any, tmp_path: Path) -> Scan:
    """Scan these devices, on a host that has only the healthy camera's files."""

    def look(*devices: SimpleNamespace) -> list[UsbDevice]:
        bench.usb.devices = list(devices)
        found = scan_usb(bench.usb, tmp_path)
        assert found.total == len(devices)
        return list(found.devices)

    return look


def test_l515_has_every_field_that_usb_knows(seen: Scan, device: Make) -> None:
    [found, nowhere] = seen(device(), device(serial="", port_numbers=None))
    assert (found.id, found.kind, found.meaning) == ("8086:0b64", "camera", "L515")
    assert (found.bus, found.address, found.port) == (2, 3, "2-1")
    assert (found.usb_type, found.link, found.is_slow) == ("3.2", "5 Gbit/s (USB 3)", False)
    assert (found.firmware, found.serial, found.product) == ("1.5.8", "f0246262", "Intel(R) RealSense(TM) 515")
    assert found.interfaces == ("hid", "video", "vendor")
    assert (found.error, found.denied) == ("", False)
    assert (found.label, nowhere.label) == ("L515 f0246262 at 2-1", "L515")


@pytest.mark.parametrize(
    ("product", "kind", "word"),
    [
        *((0x0B64, "camera", "L515"), (0x0B3D, "camera", "pre-production"), (0x0B0D, "camera", "L500")),
        *((0x0B55, "recovery", "recovery"), (0x0ADC, "recovery", "USB 2"), (0x0B07, "other", "D435")),
    ],
)
def test_realsense_products_are_known(seen: Scan, device: Make, product: int, kind: str, word: str) -> None:
    [found] = seen(device(product), device(0x1234), device(idVendor=0x046D))  # strangers are counted only
    assert found.kind == kind
    assert word in found.meaning


@pytest.mark.parametrize(
    ("bcd_usb", "speed", "slow"),
    [
        *((0x0320, 4, False), (0x0320, 5, False), (0x0210, 3, True), (0x0210, 0, True)),
        *((0x0320, 0, False), (0x0210, None, True), (0x0300, None, False)),
    ],
)
def test_link_is_slow_by_speed_or_else_by_version(
    seen: Scan, device: Make, bcd_usb: int, speed: int | None, slow: bool
) -> None:
    [found] = seen(device(bcdUSB=bcd_usb, speed=speed))
    assert found.is_slow == slow
    assert ("USB 2" in found.link) == slow


def test_speeds_have_pyusbs_codes() -> None:
    assert SPEEDS[usb.util.SPEED_HIGH] == "480 Mbit/s (USB 2)"
    assert SPEEDS[usb.util.SPEED_SUPER] == "5 Gbit/s (USB 3)"


def test_firmware_and_serial_are_read_as_the_sdk_writes_them() -> None:
    known = {0x1058: "1.5.8", 0x1052: "1.5.2", 0x1041: "1.4.1", 0x1099: "1.9.9"}
    expected = known | dict.fromkeys((0x1158, 0x0058, 0x105A), "")
    assert {number: firmware_of(number) for number in expected} == expected
    for serial, written in {"00000000F0246262": "f0246262", "00000000f0140727": "f0140727", "": ""}.items():
        assert sdk_serial(serial) == written == sdk_serial(written)


def test_serial_comes_from_the_kernel_without_permission(seen: Scan, device: Make, access_denied: Exception) -> None:
    [found] = seen(device(shut=access_denied))
    assert found.denied
    assert "Access denied" in found.error
    assert (found.serial, found.product, found.firmware) == ("f0246262", "RealSense", "1.5.8")
    assert "hid" in found.interfaces


@pytest.mark.parametrize("refusal", [NotImplementedError("no driver"), usb.core.USBError("gone", -4, 19)])
def test_other_refusals_are_no_lack_of_permission(seen: Scan, device: Make, refusal: Exception) -> None:
    """As by a driver of Windows, or of a device that left."""
    [found] = seen(device(shut=refusal, hides=refusal, port_numbers=None))
    assert (found.error, found.denied) == (str(refusal), False)
    assert (found.serial, found.interfaces, found.port) == ("", (), "")


def test_broken_string_is_an_error_of_the_device(seen: Scan, device: Make) -> None:
    strings = {1: "", 2: "", 3: SimpleNamespace(encode=lambda _: b"\x00\xd8")}  # half a surrogate
    [found] = seen(device(strings=strings, port_numbers=()))
    assert "surrogate" in found.error or "decode" in found.error


def test_scan_closes_every_device_and_claims_none(bench: Any, tmp_path: Path, device: Make) -> None:
    bench.usb.devices = [device(), device(0x0B07, address=4)]
    assert len(scan_usb(bench.usb, tmp_path).devices) == 2
    assert (bench.usb.open_handles, bench.usb.meddled) == (0, [])
    bench.usb.fails = usb.core.USBError("Input/Output Error", -1, 5)
    assert "Input/Output Error" in scan_usb(bench.usb, tmp_path).error


def test_scan_reports_a_missing_libusb_or_package(monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("usb.core", "libusb_package"):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, package, None)
            assert package in scan_usb().error
    monkeypatch.setattr("libusb_package.get_libusb1_backend", lambda: None)
    for name in ("libusb1", "libusb0", "openusb"):
        monkeypatch.setattr(f"usb.backend.{name}.get_backend", lambda: None)
    assert scan_usb().error == "No backend available"


def test_scan_of_the_real_bus_has_no_error() -> None:
    found = scan_usb()
    assert found.error == ""
    assert len(found.devices) <= found.total


def test_fake_bus_has_the_methods_of_the_real_one(bench: Any) -> None:
    faked = [name for name in vars(type(bench.usb)) if not name.startswith("_")]
    assert len(faked) == 10
    for name in faked:
        real = list(inspect.signature(getattr(_LibUSB, name)).parameters)
        assert list(inspect.signature(getattr(type(bench.usb), name)).parameters) == real
        assert hasattr(usb.backend.IBackend, name)
