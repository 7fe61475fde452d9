"""What USB itself shows of the L515 and its relatives, asked through libusb; no interface is claimed."""

import errno
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nlos_cam.doctor.host import INTEL, LIDARS, OTHERS, Kind, text

SPEEDS = {
    1: "1.5 Mbit/s (USB 1)",
    2: "12 Mbit/s (USB 1)",
    3: "480 Mbit/s (USB 2)",
    4: "5 Gbit/s (USB 3)",
    5: "10 Gbit/s (USB 3)",
    6: "20 Gbit/s (USB 3)",
}
"""libusb's codes of the speed that a link came up with."""
SUPER_SPEED = 4
CLASSES = {0x03: "hid", 0x0E: "video", 0xFE: "dfu", 0xFF: "vendor"}


@dataclass(frozen=True)
class UsbDevice:
    """A RealSense camera on the bus; a text is empty where the device or the system does not tell it."""

    product_id: int
    kind: Kind
    meaning: str
    bus: int | None
    address: int | None
    port: str
    """Bus and ports from the root down, as Linux writes them: 2-1.4."""
    bcd_usb: int
    speed: int | None
    """libusb's code."""
    firmware: str
    serial: str
    """As the SDK writes it: lower case, without leading zeros."""
    product: str
    interfaces: tuple[str, ...]
    """The classes of its interfaces: video, vendor, hid, dfu, or a number."""
    error: str = ""
    """Why the device could not be asked for its strings."""
    denied: bool = False
    """Whether that was for lack of permission."""

    @property
    def id(self) -> str:
        """Vendor and product, as `lsusb` writes them."""
        return f"{INTEL:04x}:{self.product_id:04x}"

    @property
    def usb_type(self) -> str:
        """The version of USB that it speaks on this link, as the SDK writes it: 3.2, 2.1."""
        return f"{self.bcd_usb >> 8:x}.{self.bcd_usb >> 4 & 0xF:x}"

    @property
    def link(self) -> str:
        """The speed of the link in words."""
        return SPEEDS.get(self.speed or 0, f"USB {self.usb_type}, speed unknown")

    @property
    def is_slow(self) -> bool:
        """Whether the link is USB 2 or less."""
        return (self.speed or 0) < SUPER_SPEED if self.speed in SPEEDS else self.bcd_usb < 0x0300

    @property
    def label(self) -> str:
        """What to call it in a sentence: L515 f0246262 at 2-1."""
        place = f"at {self.port}" if self.port else ""
        return " ".join(part for part in (self.meaning, self.serial, place) if part)


@dataclass(frozen=True)
class UsbScan:
    """The RealSense cameras on the bus, how many devices there are in all, and why there is no knowing."""

    devices: tuple[UsbDevice, ...] = ()
    total: int = 0
    error: str = ""

    def of_kind(self, kind: Kind) -> list[UsbDevice]:
        """Those that are cameras, in recovery mode, or something else."""
        return [device for device in self.devices if device.kind == kind]


def scan(backend: Any = None, root: Path = Path("/")) -> UsbScan:
    """Look at every device on the bus; never raises. `root` holds the `sys` that tells what a device will not."""
    try:
        import libusb_package
        import usb.core

        devices: Any = usb.core.find(find_all=True, backend=backend or libusb_package.get_libusb1_backend())
        found = list(devices)
    except (ImportError, OSError, ValueError, NotImplementedError) as error:  # no pyusb, no libusb, no USB
        return UsbScan(error=str(error) or type(error).__name__)
    known = [device for device in found if device.idVendor == INTEL and device.idProduct in {*LIDARS, *OTHERS}]
    return UsbScan(tuple(_described(device, root) for device in known), len(found))


def _described(device: Any, root: Path) -> UsbDevice:
    kind, meaning = LIDARS.get(device.idProduct) or ("other", f"RealSense {OTHERS[device.idProduct]}")
    port = _port(device)
    serial, product, error = _strings(device)
    told = root / "sys/bus/usb/devices" / port
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
        serial=sdk_serial(serial or text(told / "serial")) if port else sdk_serial(serial),
        product=product or (text(told / "product") if port else ""),
        interfaces=_interfaces(device),
        error=str(error) if error else "",
        denied=isinstance(error, OSError) and error.errno in {errno.EACCES, errno.EPERM},
    )


def _port(device: Any) -> str:
    """Where it is plugged in; empty for a device that hangs on no port."""
    return f"{device.bus}-{'.'.join(map(str, device.port_numbers))}" if device.port_numbers else ""


def _strings(device: Any) -> tuple[str, str, Exception | None]:
    """Serial number, product, and what stood in the way: permission, a driver of Windows, a device that left."""
    import usb.util

    try:
        languages = usb.util.get_langids(device)  # not device.langids, which hides a missing permission
        if not languages:
            return "", "", None
        indices = (device.iSerialNumber, device.iProduct)
        serial, product = (usb.util.get_string(device, index, languages[0]) or "" for index in indices)
    except (OSError, NotImplementedError, ValueError) as error:
        return "", "", error
    finally:
        usb.util.dispose_resources(device)
    return serial.strip("\0 "), product.strip("\0 "), None


def _interfaces(device: Any) -> tuple[str, ...]:
    """The classes of every interface; none where the system keeps the description to itself."""
    try:
        codes = {interface.bInterfaceClass for configuration in device for interface in configuration}
    except (OSError, NotImplementedError):
        return ()
    return tuple(CLASSES.get(code, f"0x{code:02x}") for code in sorted(codes))


def firmware_of(bcd_device: int) -> str:
    """The firmware that an L515's release number stands for; empty for a number of another form.

    Major, a zero, minor and patch, a hexadecimal digit each: 0x1058 is 1.5.8. Inferred from three units (0x1058,
    0x1052, 0x1041), none of which showed what the second digit is for; the fourth part of a version is not in it.
    """
    major, second, minor, patch = (bcd_device >> shift & 0xF for shift in (12, 8, 4, 0))
    return "" if second or major == 0 or max(major, minor, patch) > 9 else f"{major}.{minor}.{patch}"


def sdk_serial(serial: str) -> str:
    """A serial number as the SDK writes it, so that both can be compared."""
    return serial.strip().lower().lstrip("0")
