__all__ = [
    "Check",
    "Facts",
    "Pair",
    "UsbDevice",
    "diagnose",
    "gather_facts",
    "install_command",
    "rules_text",
    "watch",
]

from .diagnosis import diagnose
from .facts import Check, Facts, Pair, gather_facts
from .stream import watch
from .udev import install_command, rules_text
from .usb import UsbDevice
