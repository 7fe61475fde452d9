"""RealSense cameras on USB, read through libusb without claiming an interface."""

import errno
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nlos_cam.camera import sdk_serial
from nlos_cam.doctor.host import INTEL, LIDARS, OTHERS, Kind, read_text

SPEEDS = {
    1: "1.5 Mbit/s (USB 1)",
    2: "12 Mbit/s (USB 1)",
    3: "480 Mbit/s (USB 2)",
    4: "5 Gbit/s (USB 3)",
    5: "10 Gbit/s (USB 3)",
    6: "20 Gbit/s (USB 3)",
}
"""Link speed by libusb's code."""
SUPER_SPEED = 4
CLASSES = {0x03: "hid", 0x0E: "video", 0xFE: "dfu", 0xFF: "vendor"}


@dataclass(frozen=True)
class UsbDevice:
    """RealSense camera on USB; unknown texts are empty."""

    product_id: int
    kind: Kind
    meaning: str
    bus: int | None
    address: int | None
    port: str
    """Bus and ports as Linux writes them: 2-1.4."""
    bcd_usb: int
    speed: int | None
    """libusb's code."""
    firmware: str
    serial: str
    """As `sdk_serial` writes it."""
    product: str
    interfaces: tuple[str, ...]
    """Classes: video, vendor, hid, dfu, or a number."""
    error: str = ""
    """Why the device's strings could not be read."""
    denied: bool = False
    """True if that was for lack of permission."""

    @property
    def id(self) -> str:
        """Vendor and product id, as `lsusb` writes them."""
        return f"{INTEL:04x}:{self.product_id:04x}"

    @property
    def usb_type(self) -> str:
        """Version of USB on this link, as the SDK writes it: 3.2, 2.1."""
        return f"{self.bcd_usb >> 8:x}.{self.bcd_usb >> 4 & 0xF:x}"

    @property
    def link(self) -> str:
        """Speed of the link."""
        return SPEEDS.get(self.speed or 0, f"USB {self.usb_type}, speed unknown")

    @property
    def is_slow(self) -> bool:
        """True for a link of USB 2 or less."""
        return (self.speed or 0) < SUPER_SPEED if self.speed in SPEEDS else self.bcd_usb < 0x0300

    @property
    def label(self) -> str:
        """Name for messages: L515 f0246262 at 2-1."""
        place = f"at {self.port}" if self.port else ""
        return " ".join(part for part in (self.meaning, self.serial, place) if part)


@dataclass(frozen=True)
class UsbScan:
    """RealSense cameras on USB, the number of all devices, and the error of listing them."""

    devices: tuple[UsbDevice, ...] = ()
    total: int = 0
    error: str = ""

    def of_kind(self, kind: Kind) -> list[UsbDevice]:
        """Return the devices of one kind."""
        return [device for device in self.devices if device.kind == kind]


def scan_usb(backend: Any = None, root: Path = Path("/")) -> UsbScan:
    """Return the RealSense cameras on USB; never raises. `root` holds `sys`, read where a device
    denies access.
    """
    try:
        import libusb_package
        import usb.core

        backend = backend or libusb_package.get_libusb1_backend()
        devices: Any = usb.core.find(find_all=True, backend=backend)
        found = list(devices)
    except (ImportError, OSError, ValueError, NotImplementedError) as error:
        # no pyusb, no libusb, or no USB
        return UsbScan(error=str(error) or type(error).__name__)
    known = [
        device
        for device in found
        if device.idVendor == INTEL and device.idProduct in {*LIDARS, *OTHERS}
    ]
    return UsbScan(tuple(_describe(device, root) for device in known), len(found))


def _describe(device: Any, root: Path) -> UsbDevice:
    other: tuple[Kind, str] = ("other", f"RealSense {OTHERS.get(device.idProduct)}")
    kind, meaning = LIDARS.get(device.idProduct, other)
    serial, product, error = _strings(device)
    port = ""
    if device.port_numbers:
        port = f"{device.bus}-{'.'.join(map(str, device.port_numbers))}"  # as 2-1.4
        # The kernel has read the strings when the camera was plugged in, whatever this user may.
        kernel = root / "sys/bus/usb/devices" / port
        serial = serial or read_text(kernel / "serial")
        product = product or read_text(kernel / "product")
    return UsbDevice(
        product_id=device.idProduct,
        kind=kind,
        meaning=meaning,
        bus=device.bus,
        address=device.address,
        port=port,
        bcd_usb=device.bcdUSB,
        speed=device.speed,
        firmware=firmware_of(device.bcdDevice) if device.idProduct in LIDARS else "",
        serial=sdk_serial(serial),
        product=product,
        interfaces=_interfaces(device),
        error=str(error) if error else "",
        denied=isinstance(error, OSError) and error.errno in {errno.EACCES, errno.EPERM},
    )


def _strings(device: Any) -> tuple[str, str, Exception | None]:
    """Return serial number, product, and the error of reading them: permission, driver on Windows,
    unplugged.
    """
    import usb.util

    try:
        # not device.langids, which hides a missing permission
        languages = usb.util.get_langids(device)
        if not languages:
            return "", "", None
        indices = (device.iSerialNumber, device.iProduct)
        serial, product = (
            usb.util.get_string(device, index, languages[0]) or "" for index in indices
        )
    except (OSError, NotImplementedError, ValueError) as error:
        return "", "", error
    finally:
        usb.util.dispose_resources(device)
    return serial.strip("\0 "), product.strip("\0 "), None


def _interfaces(device: Any) -> tuple[str, ...]:
    """Return the classes of all interfaces; none where the system does not provide the
    description.
    """
    try:
        codes = {
            interface.bInterfaceClass for configuration in device for interface in configuration
        }
    except (OSError, NotImplementedError):
        return ()
    return tuple(CLASSES.get(code, f"0x{code:02x}") for code in sorted(codes))


def firmware_of(bcd_device: int) -> str:
    """Return the firmware version encoded in an L515's USB release number; empty for another form.

    Major, a zero, minor and patch, a hexadecimal digit each: 0x1058 is 1.5.8. Inferred from three
    units (0x1058, 0x1052, 0x1041), where the second digit was always 0; the fourth part of a
    version is not encoded.
    """
    major, second, minor, patch = (bcd_device >> shift & 0xF for shift in (12, 8, 4, 0))
    if second or major == 0 or max(major, minor, patch) > 9:
        return ""
    return f"{major}.{minor}.{patch}"
