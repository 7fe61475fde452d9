"""A bench with an L515 on it: a fake USB under the real pyusb, a fake Linux as a tree of files, and
a fake SDK.
"""

import errno
from array import array
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from fake_librealsense import FakeSdk
from fake_lidar import FakeLidar
from usb.backend import IBackend

from nlos_cam.doctor import Check, Facts, diagnose
from nlos_cam.doctor.facts import query_sdk
from nlos_cam.doctor.host import Platform, read_host
from nlos_cam.doctor.usb import scan_usb
from nlos_cam.errors import CameraError

L515_CLASSES = (0x0E, 0x0E, 0xFF, 0x03)
LINUX = Platform("linux", "x86_64", (3, 11), in_plugdev=True)


class FakeUsb(IBackend):
    """A bus of `fake_device`s behind pyusb's interface to libusb; `meddled` notes calls that would
    change a device.
    """

    def __init__(self, *devices: SimpleNamespace) -> None:
        self.devices = list(devices)
        self.fails: Exception | None = None
        self.open_handles = 0
        self.meddled: list[str] = []

    def enumerate_devices(self) -> Iterator[SimpleNamespace]:
        if self.fails:
            raise self.fails
        return iter(self.devices)

    def get_device_descriptor(self, dev: SimpleNamespace) -> SimpleNamespace:
        return dev

    def get_configuration_descriptor(self, dev: SimpleNamespace, config: int) -> SimpleNamespace:
        if dev.hides:
            raise dev.hides
        fields = (
            "bLength",
            "bDescriptorType",
            "wTotalLength",
            "iConfiguration",
            "bmAttributes",
            "bMaxPower",
        )
        values = dict.fromkeys(fields, 0) | {
            "bConfigurationValue": config + 1,
            "extra_descriptors": [],
        }
        return SimpleNamespace(**values, bNumInterfaces=len(dev.classes))

    def get_interface_descriptor(
        self, dev: SimpleNamespace, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        if alt or config or intf >= len(dev.classes):
            raise IndexError
        fields = (
            "bLength bDescriptorType bNumEndpoints bInterfaceSubClass bInterfaceProtocol iInterface"
        )
        values = dict.fromkeys(fields.split(), 0) | {
            "bInterfaceNumber": intf,
            "bAlternateSetting": 0,
        }
        values |= {"extra_descriptors": []}
        return SimpleNamespace(**values, bInterfaceClass=dev.classes[intf])

    def open_device(self, dev: SimpleNamespace) -> SimpleNamespace:
        if dev.shut:
            raise dev.shut
        self.open_handles += 1
        return dev

    def close_device(self, dev_handle: SimpleNamespace) -> None:
        del dev_handle
        self.open_handles -= 1

    def ctrl_transfer(
        self,
        dev_handle: Any,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: Any,
        timeout: int,
    ) -> int:
        del timeout
        assert (bmRequestType, bRequest, wValue >> 8) == (
            0x80,
            0x06,
            3,
        )  # reads a string, and does nothing else
        index = wValue & 0xFF
        assert wIndex == (0x0409 if index else 0)
        body = dev_handle.strings[index].encode("utf-16-le") if index else b"\x09\x04"
        answer = bytes([len(body) + 2, 3]) + body
        data[: len(answer)] = array("B", answer)
        return len(answer)

    def claim_interface(self, dev_handle: SimpleNamespace, intf: int) -> None:
        self.meddled.append(f"claim {intf} of {dev_handle}")

    def set_configuration(self, dev_handle: SimpleNamespace, config_value: int) -> None:
        self.meddled.append(f"configure {dev_handle} as {config_value}")

    def detach_kernel_driver(self, dev_handle: SimpleNamespace, intf: int) -> None:
        self.meddled.append(f"detach {intf} of {dev_handle}")


def fake_device(
    product: int = 0x0B64, serial: str = "00000000F0246262", **changes: Any
) -> SimpleNamespace:
    """Make an L515 with firmware 1.5.8 on USB 3, except for the changes; `shut` is raised on
    opening.
    """
    strings = ("Intel(R) RealSense(TM) Camera", "Intel(R) RealSense(TM) 515", serial)
    values: dict[str, Any] = {
        # the descriptor, by its names in the USB standard
        "bLength": 18,
        "bDescriptorType": 1,
        "bMaxPacketSize0": 9,
        "bNumConfigurations": 1,
        "bDeviceClass": 0xEF,
        "bDeviceSubClass": 2,
        "bDeviceProtocol": 1,
        "idVendor": 0x8086,
        "idProduct": product,
        "bcdUSB": 0x0320,
        "bcdDevice": 0x1058,
        "iManufacturer": 1,
        "iProduct": 2,
        "iSerialNumber": 3,
        # its place and link, as pyusb adds them
        "speed": 4,
        "bus": 2,
        "address": 3,
        "port_number": 1,
        "port_numbers": (1,),
        # this fake's own
        "classes": L515_CLASSES,
        "strings": dict(enumerate(strings, start=1)),
        "shut": None,
        "hides": None,
    }
    return SimpleNamespace(**values | changes)


class FakeLinux:
    """File systems of a Linux host: plain files and links below `root`."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.write("proc/version", "Linux version 6.8.0 (gcc)")
        self.write("proc/sys/kernel/osrelease", "6.8.0")
        self.write("lib/modules/6.8.0/modules.dep", "kernel/drivers/media/usb/uvc/uvcvideo.ko.zst:")

    def write(self, path: str, content: str) -> Path:
        file = self.root / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(content, encoding="utf-8")
        return file

    def link(self, path: str, target: Path | str) -> None:
        link = self.root / path
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(target)

    def plug(
        self,
        port: str = "2-1",
        product: str = "0b64",
        address: int = 3,
        hid: int = 2,
        video: int = 2,
    ) -> None:
        """Plug in a camera with `hid` motion sensors and `video` nodes."""
        device = self.root / f"sys/devices/pci0000:00/usb2/{port}"
        values = {"idVendor": "8086", "idProduct": product, "busnum": "2", "devnum": str(address)}
        for name, content in (
            values | {"serial": "00000000F0246262", "product": "RealSense"}
        ).items():
            self.write(f"{device.relative_to(self.root)}/{name}", f"{content}\n")
        self.link(f"sys/bus/usb/devices/{port}", device)
        for number in range(video):
            node = self._part(device, f"{port}:1.0/video4linux/video{address}{number}")
            self.link(f"sys/class/video4linux/{node.name}", node)
        for number, name in zip(range(hid), ("accel_3d", "gyro_3d"), strict=False):
            sensor = self._part(
                device, f"{port}:1.6/0003:8086:0B64.{address}/iio:device{address}{number}"
            )
            self.write(f"{sensor.relative_to(self.root)}/name", f"{name}\n")
            self.link(f"sys/bus/iio/devices/{sensor.name}", sensor)
        hub = self._part(device, f"{port}:1.6/0003:8086:0B64.{address}")
        driver = self.root / "sys/bus/hid/drivers" / ("hid-sensor-hub" if hid else "hid-generic")
        driver.mkdir(parents=True, exist_ok=True)
        self.link(f"{hub.relative_to(self.root)}/driver", driver)
        self.link(f"sys/bus/hid/devices/{hub.name}", hub)

    def _part(self, device: Path, name: str) -> Path:
        part = device / name
        part.mkdir(parents=True, exist_ok=True)
        return part

    def rules(self, path: str = "etc/udev/rules.d/99-l515.rules") -> None:
        self.write(path, 'ATTRS{idProduct}=="0B64", MODE:="0666"')

    def load(self, *modules: str) -> None:
        self.write("proc/modules", "".join(f"{name} 16384 0 - Live 0x0\n" for name in modules))

    def process(self, pid: int, name: str, *opened: str) -> None:
        self.write(f"proc/{pid}/comm", f"{name}\n")
        (self.root / f"proc/{pid}/fd").mkdir()
        for number, node in enumerate(opened):
            self.link(f"proc/{pid}/fd/{number}", node)


class Bench:
    """A healthy L515 on a healthy Linux, for faults to be added; `facts` and `checks` come from the
    real code.
    """

    def __init__(self, root: Path) -> None:
        self.usb = FakeUsb(fake_device())
        self.linux = FakeLinux(root)
        self.linux.plug()
        self.linux.rules()
        self.linux.load("uvcvideo", "hid_sensor_hub", "hid_sensor_accel_3d", "hid_sensor_gyro_3d")
        self.platform = LINUX
        self.refused: dict[str, OSError] = {}
        self.sdk_devices = [FakeLidar()]
        self.sdk_error: BaseException | None = None
        self.installed = {"pyrealsense2": "2.54.2.5684", "numpy": "2.0"}
        self.reported = ""

    def unplug(self) -> None:
        self.usb.devices.clear()
        self.hide()
        (self.linux.root / "sys/bus/usb/devices/2-1").unlink()

    def hide(self) -> None:
        """Hide the camera from librealsense."""
        self.sdk_devices.clear()

    def show(self, **values: str) -> None:
        """Let librealsense report the camera, with these fields."""
        self.sdk_devices[:] = [FakeLidar()]
        self.sdk_devices[0].info |= values

    def put_on_usb(self, product: int = 0x0B64, **changes: Any) -> None:
        """Put one device on USB, in place of all others."""
        self.usb.devices = [fake_device(product, **changes)]

    def plug_second(self, **parts: Any) -> None:
        self.linux.plug("2-2", address=5, **parts)

    def remove_rules(self) -> None:
        (self.linux.root / "etc/udev/rules.d/99-l515.rules").unlink()

    def refuse(self, node: str = "/dev/video30") -> None:
        self.refused[node] = PermissionError(errno.EACCES, "Permission denied")

    def run_on(self, system: str, machine: str = "amd64", minor: int = 11, **flags: bool) -> None:
        self.platform = Platform(system, machine, (3, minor), **flags)

    def open_node(self, path: str) -> None:
        if path in self.refused:
            raise self.refused[path]

    def load_sdk(self) -> Any:
        if self.sdk_error:
            raise CameraError(
                f"librealsense cannot be loaded ({self.sdk_error})"
            ) from self.sdk_error
        sdk = FakeSdk()
        sdk.lidars = self.sdk_devices
        return sdk

    def facts(self, reported: str = "") -> Facts:
        host = read_host(self.linux.root, self.platform, self.open_node)
        packages = [
            SimpleNamespace(name=name, version=version) for name, version in self.installed.items()
        ]
        return Facts(
            host,
            scan_usb(self.usb, self.linux.root),
            query_sdk(self.load_sdk, lambda: packages),
            reported or self.reported,
        )

    def checks(self) -> dict[str, Check]:
        return {check.name: check for check in diagnose(self.facts())}

    def failed(self) -> dict[str, Check]:
        return {name: check for name, check in self.checks().items() if check.status == "failed"}
