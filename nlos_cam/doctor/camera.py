"""Checks of the camera itself: is it on USB, in its normal mode, on a fast link, with a firmware that is known."""

from nlos_cam.doctor.check import Finding, failed, ok, skipped, warning
from nlos_cam.doctor.facts import Facts
from nlos_cam.doctor.linux import CONTAINER_FIX
from nlos_cam.doctor.software import numbers

ABSENT = "no L515 is seen, neither on USB nor by librealsense"
LEAST_FIRMWARE = (1, 5, 1, 3)
BEST_FIRMWARE = (1, 5, 8, 1)
FLASH = (
    "with librealsense 2.54.2's realsense-viewer (More > Update Firmware), or `rs-fw-update -f "
    "Signed_Image_UVC_1_5_8_1.bin`, on a USB 3 port"
)


def usb_camera(facts: Facts) -> Finding:
    """Whether an L515 is on the bus, in whatever mode."""
    if facts.usb.error:
        return skipped("USB cannot be looked at: see libusb")
    here = facts.usb.of_kind("camera") + facts.usb.of_kind("recovery")
    if here:
        return ok(", ".join(f"{device.label} ({device.id}, {device.link})" for device in here))
    if kernel := facts.host.cameras:
        ports = ", ".join(camera.port for camera in kernel)
        fix = (
            CONTAINER_FIX
            if facts.host.container
            else "unplug the camera and plug it in again: udev then makes its node"
        )
        return failed(f"the kernel sees an L515 at {ports}, but /dev/bus/usb does not show it here", fix)
    if facts.sdk.lidars:
        return warning(
            "librealsense sees an L515 that USB does not show",
            CONTAINER_FIX if facts.host.container else "run as a user who may list USB devices",
        )
    return _absent(facts)


def _absent(facts: Facts) -> Finding:
    plug = (
        "plug it straight into a USB 3 port with its own cable; `lsusb -d 8086:` should list it; without a camera, use "
        "--camera sim"
    )
    if others := facts.usb.of_kind("other"):
        told = ", ".join(f"{device.label} ({device.id})" for device in others)
        return failed(f"no L515 on USB, but another RealSense: {told}", f"only an L515 will do: {plug}")
    if not facts.usb.total:
        return failed(
            "nothing is plugged in: USB shows no device at all", f"{plug}; in a virtual machine, pass USB to it"
        )
    return failed(f"nothing is plugged in: none of the {facts.usb.total} devices on USB is an L515", plug)


def recovery(facts: Facts) -> Finding:
    """Whether a camera waits for firmware instead of giving frames."""
    if stuck := facts.usb.of_kind("recovery"):
        return failed(
            ", ".join(f"{device.label} ({device.id})" for device in stuck)
            + ": it waits for firmware, and gives no frames",
            "unplug it, wait 5 s, plug it into a USB 3 port; if it comes back like this: `rs-fw-update -r -f "
            "Signed_Image_UVC_1_5_8_1.bin` of librealsense 2.54.2, or its realsense-viewer",
        )
    return ok(f"{len(facts.pairs)} in normal mode") if facts.pairs else skipped(ABSENT)


def link(facts: Facts) -> Finding:
    """Whether every camera is on USB 3."""
    if not facts.pairs:
        return skipped(ABSENT)
    if slow := [pair for pair in facts.pairs if pair.is_slow]:
        return warning(
            f"{', '.join(pair.label for pair in slow)} is on USB 2: depth, infrared and confidence come at 320 x 240 "
            "and 30 frames/s only, without max-usable-range and IR reflectivity",
            "turn the USB-C plug round and push it in whole; use a USB 3 cable and a USB 3 port, without a hub; a "
            "camera that stays on USB 2 with every cable and port is defective",
        )
    return ok(", ".join(f"{pair.label}: {pair.link}" for pair in facts.pairs))


def firmware(facts: Facts) -> Finding:
    """Whether every camera's firmware is accepted by librealsense 2.54.2, and the one it asks for."""
    told = {pair.label: pair.firmware for pair in facts.pairs}
    known = {label: version for label, version in told.items() if version}
    if not known:
        return skipped("no camera tells its firmware" if told else ABSENT)
    detail = ", ".join(f"{label}: {version}" for label, version in known.items())
    oldest = min(map(numbers, known.values()))
    if oldest < LEAST_FIRMWARE[: len(oldest)]:
        return failed(f"{detail}; librealsense takes 1.5.1.3 and later", f"update to 1.5.8.1 {FLASH}")
    if oldest < BEST_FIRMWARE[: len(oldest)]:
        return warning(f"{detail}; librealsense asks for 1.5.8.1", f"update to 1.5.8.1 {FLASH}")
    return ok(detail)
