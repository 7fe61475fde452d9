"""The real pyusb on a fake bus; and the real bus, whatever is on it."""

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

from nlos_cam.doctor.usb import SPEEDS, SUPER_SPEED, UsbDevice, firmware_of, scan, sdk_serial

Make = Callable[..., SimpleNamespace]


@pytest.fixture
def seen(bench: Any, tmp_path: Path) -> Callable[..., list[UsbDevice]]:
    """What a scan makes of these devices, on a host that has only the healthy camera's files."""

    def look(*devices: SimpleNamespace) -> list[UsbDevice]:
        bench.usb.devices = list(devices)
        found = scan(bench.usb, tmp_path)
        assert found.total == len(devices)
        return list(found.devices)

    return look


def test_an_l515_tells_all_that_usb_knows_of_it(seen: Callable[..., list[UsbDevice]], device: Make) -> None:
    [found] = seen(device())
    assert (found.id, found.kind, found.meaning) == ("8086:0b64", "camera", "L515")
    assert (found.bus, found.address, found.port) == (2, 3, "2-1")
    assert (found.usb_type, found.link, found.is_slow) == ("3.2", "5 Gbit/s (USB 3)", False)
    assert (found.firmware, found.serial, found.product) == ("1.5.8", "f0246262", "Intel(R) RealSense(TM) 515")
    assert found.interfaces == ("hid", "video", "vendor")
    assert (found.error, found.denied) == ("", False)


@pytest.mark.parametrize(
    ("product", "kind", "word"),
    [
        (0x0B64, "camera", "L515"),
        (0x0B3D, "camera", "pre-production"),
        (0x0B0D, "camera", "L500"),
        (0x0B55, "recovery", "recovery"),
        (0x0ADC, "recovery", "USB 2"),
        (0x0B07, "other", "D435"),
    ],
)
def test_every_relative_is_known(
    seen: Callable[..., list[UsbDevice]], device: Make, product: int, kind: str, word: str
) -> None:
    [found] = seen(device(product))
    assert found.kind == kind
    assert word in found.meaning


def test_strangers_are_counted_and_not_told(seen: Callable[..., list[UsbDevice]], device: Make) -> None:
    assert seen(device(0x1234), device(idVendor=0x046D)) == []


@pytest.mark.parametrize(
    ("bcd_usb", "speed", "slow"),
    [
        (0x0320, 4, False),
        (0x0320, 5, False),
        (0x0210, 3, True),
        (0x0210, 0, True),
        (0x0320, 0, False),
        (0x0210, None, True),
        (0x0300, None, False),
    ],
)
def test_the_link_is_slow_by_its_speed_or_else_by_its_version(
    seen: Callable[..., list[UsbDevice]], device: Make, bcd_usb: int, speed: int | None, slow: bool
) -> None:
    [found] = seen(device(bcdUSB=bcd_usb, speed=speed))
    assert found.is_slow == slow
    assert ("USB 2" in found.link) == slow


def test_every_speed_that_pyusb_names_has_its_words() -> None:
    named = {getattr(usb.util, name) for name in dir(usb.util) if name.startswith("SPEED_")}
    assert named - {usb.util.SPEED_UNKNOWN} <= SPEEDS.keys()
    assert SUPER_SPEED == usb.util.SPEED_SUPER
    assert SPEEDS[usb.util.SPEED_HIGH] == "480 Mbit/s (USB 2)"
    assert SPEEDS[usb.util.SPEED_SUPER] == "5 Gbit/s (USB 3)"


def test_the_label_tells_what_is_known(seen: Callable[..., list[UsbDevice]], device: Make) -> None:
    [here, nowhere] = seen(device(), device(serial="", port_numbers=None))
    assert (here.label, nowhere.label) == ("L515 f0246262 at 2-1", "L515")


@pytest.mark.parametrize(
    ("bcd_device", "firmware"),
    [
        (0x1058, "1.5.8"),
        (0x1052, "1.5.2"),
        (0x1041, "1.4.1"),
        (0x1158, ""),
        (0x0058, ""),
        (0x105A, ""),
        (0x1099, "1.9.9"),
    ],
)
def test_firmware_is_read_from_the_release_number_or_not_at_all(bcd_device: int, firmware: str) -> None:
    assert firmware_of(bcd_device) == firmware


@pytest.mark.parametrize(
    ("serial", "written"), [("00000000F0246262", "f0246262"), ("00000000f0140727", "f0140727"), ("", "")]
)
def test_serials_of_usb_and_sdk_are_the_same(serial: str, written: str) -> None:
    assert sdk_serial(serial) == written == sdk_serial(written)


def test_without_permission_the_kernel_tells_the_serial(
    seen: Callable[..., list[UsbDevice]], device: Make, access_denied: Exception
) -> None:
    [found] = seen(device(shut=access_denied))
    assert found.denied
    assert "Access denied" in found.error
    assert (found.serial, found.product, found.firmware) == ("f0246262", "RealSense", "1.5.8")
    assert "hid" in found.interfaces


@pytest.mark.parametrize("refusal", [NotImplementedError("no driver"), usb.core.USBError("gone", -4, 19)])
def test_a_driver_of_windows_or_a_device_that_left_is_an_error_and_no_lack_of_permission(
    seen: Callable[..., list[UsbDevice]], device: Make, refusal: Exception
) -> None:
    [found] = seen(device(shut=refusal, hides=refusal, port_numbers=None))
    assert (found.error, found.denied) == (str(refusal), False)
    assert (found.serial, found.interfaces, found.port) == ("", (), "")


def test_a_broken_string_is_an_error_and_not_a_crash(seen: Callable[..., list[UsbDevice]], device: Make) -> None:
    strings = {1: "", 2: "", 3: SimpleNamespace(encode=lambda _: b"\x00\xd8")}  # half a surrogate
    [found] = seen(device(strings=strings, port_numbers=()))
    assert "surrogate" in found.error or "decode" in found.error


def test_every_device_is_closed_again_and_none_is_claimed(bench: Any, tmp_path: Path, device: Make) -> None:
    bench.usb.devices = [device(), device(0x0B07, address=4)]
    assert len(scan(bench.usb, tmp_path).devices) == 2
    assert (bench.usb.open_handles, bench.usb.meddled) == (0, [])


def test_a_bus_that_cannot_be_listed_is_told(bench: Any, tmp_path: Path) -> None:
    bench.usb.fails = usb.core.USBError("Input/Output Error", -1, 5)
    assert "Input/Output Error" in scan(bench.usb, tmp_path).error


def test_a_missing_libusb_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("libusb_package.get_libusb1_backend", lambda: None)
    for name in ("libusb1", "libusb0", "openusb"):
        monkeypatch.setattr(f"usb.backend.{name}.get_backend", lambda: None)
    assert scan().error == "No backend available"


@pytest.mark.parametrize("package", ["usb.core", "libusb_package"])
def test_a_missing_package_is_told(monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    assert package in scan().error


def test_the_real_bus_can_be_looked_at() -> None:
    found = scan()
    assert found.error == ""
    assert len(found.devices) <= found.total


def test_the_fake_bus_has_the_methods_of_the_real_one(bench: Any) -> None:
    faked = [name for name in vars(type(bench.usb)) if not name.startswith("_")]
    assert len(faked) == 10
    for name in faked:
        real = list(inspect.signature(getattr(_LibUSB, name)).parameters)
        assert list(inspect.signature(getattr(type(bench.usb), name)).parameters) == real
        assert hasattr(usb.backend.IBackend, name)
