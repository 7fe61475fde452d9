"""The udev rules that let every user of a Linux machine open an L515, which librealsense's wheel does not install."""

from shlex import quote

from nlos_cam.doctor.host import INTEL, L515, LIDARS

HEAD = """\
# Access to the Intel RealSense L515 for every user, as librealsense 2.54 needs it.
# Keep as /etc/udev/rules.d/{name}, then run, and plug the camera in again:
#   {reload}
"""
MOTION = """\
# The motion sensors: without them the SDK leaves the whole camera out.
KERNEL=="iio*", {match}, MODE:="0777", GROUP:="plugdev", RUN+="/bin/sh -c 'chmod -R 0777 /sys/%p'"
DRIVER=="hid_sensor*", {match}, RUN+="/bin/sh -c 'chmod -R 0777 /sys/%p && chmod 0777 /dev/%k'"
"""
FILE_NAME = "99-l515.rules"
RELOAD = "sudo udevadm control --reload-rules && sudo udevadm trigger"


def install(written: str) -> str:
    """What to run once the rules are in that file."""
    return f"sudo install -m 644 {quote(written)} /etc/udev/rules.d/{FILE_NAME} && {RELOAD}"


WRITE_AND_INSTALL = f"nlos-cam doctor --write-udev {FILE_NAME} && {install(FILE_NAME)}"
"""What to run to have the rules in force for a camera that is plugged in after it."""


def rules() -> str:
    """The file: access to the camera's USB and video nodes, and to its motion sensors."""
    access = [f"# {name}\n{_usb_rule(product_id)}\n" for product_id, (_, name) in LIDARS.items()]
    return "\n".join([HEAD.format(name=FILE_NAME, reload=RELOAD), *access, MOTION.format(match=_match(L515))])


def _usb_rule(product_id: int) -> str:
    return f'SUBSYSTEMS=="usb", {_match(product_id)}, MODE:="0666", GROUP:="plugdev"'


def _match(product_id: int) -> str:
    return f'ATTRS{{idVendor}}=="{INTEL:04x}", ATTRS{{idProduct}}=="{product_id:04x}"'
