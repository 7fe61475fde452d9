__all__ = [
    "Check",
    "Facts",
    "Pair",
    "UsbDevice",
    "diagnose",
    "gather",
    "install",
    "rules",
]

from .diagnosis import diagnose
from .facts import Check, Facts, Pair, gather
from .udev import install, rules
from .usb import UsbDevice
