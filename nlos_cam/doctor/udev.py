"""udev rules that let every user of a Linux machine open an L515; librealsense's wheel does not
install them.
"""

from shlex import quote

from nlos_cam.doctor.host import INTEL, L515, LIDARS

HEAD = """\
# Access to the Intel RealSense L515 for every user, as librealsense 2.54 needs it.
# Keep as /etc/udev/rules.d/{name}, then run, and plug the camera in again:
#   {reload}
"""
MOTION = """\
# The motion sensors: without them the SDK does not list the camera.
KERNEL=="iio*", {match}, MODE:="0777", GROUP:="plugdev", RUN+="/bin/sh -c 'chmod -R 0777 /sys/%p'"
DRIVER=="hid_sensor*", {match}, RUN+="/bin/sh -c 'chmod -R 0777 /sys/%p && chmod 0777 /dev/%k'"
"""
FILE_NAME = "99-l515.rules"
RELOAD = "sudo udevadm control --reload-rules && sudo udevadm trigger"


def install_command(path: str) -> str:
    """Return the shell command that installs the rules from a file."""
    return f"sudo install -m 644 {quote(path)} /etc/udev/rules.d/{FILE_NAME} && {RELOAD}"


WRITE_AND_INSTALL = (
    f"nlos-cam doctor --write-udev {FILE_NAME} --overwrite && {install_command(FILE_NAME)}"
)
"""Shell command that writes and installs the rules, also a second time; they apply to a camera
plugged in afterwards.
"""


def rules_text() -> str:
    """Return the rules file: access to the camera's USB and video nodes and its motion sensors."""
    rule = '# {}\nSUBSYSTEMS=="usb", {}, MODE:="0666", GROUP:="plugdev"\n'
    access = [rule.format(name, _match(product_id)) for product_id, (_, name) in LIDARS.items()]
    return "\n".join(
        [HEAD.format(name=FILE_NAME, reload=RELOAD), *access, MOTION.format(match=_match(L515))]
    )


def _match(product_id: int) -> str:
    return f'ATTRS{{idVendor}}=="{INTEL:04x}", ATTRS{{idProduct}}=="{product_id:04x}"'
