"""Diagnosis: every check in order, and the cause if USB shows a camera that librealsense does
not.
"""

from collections.abc import Callable

from nlos_cam.doctor import checks
from nlos_cam.doctor.facts import Check, Facts, Finding, failed, ok, skipped, warning

REPLUG = (
    "unplug the camera, wait 5 s, plug it straight into a USB 3 port and run this again; if that"
    " does not help, run with LRS_LOG_LEVEL=DEBUG in the environment and look for `partial enum`"
)
REPLUG_WINDOWS = (
    "in the Device Manager uninstall every RealSense device together with its driver, unplug the"
    " camera and plug it in again: Windows' own camera driver has to take it, not one of Zadig or"
    " of a vendor"
)
CAUSES = (
    "sdk-version",
    "sdk-alone",
    "system",
    "container",
    "permissions",
    "video-driver",
    "hid-sensors",
    "in-use",
    "firmware",
)
"""Checks whose failure can hide a camera from librealsense that USB shows, the likeliest cause
first.
"""


def sdk_camera(facts: Facts) -> Finding:
    """Check that librealsense sees the cameras that USB shows; if not, name the causes."""
    if facts.sdk.error:
        return skipped("librealsense cannot be queried: see sdk")
    hidden = [pair.label for pair in facts.pairs if not pair.sdk]
    if hidden:
        return _hidden(facts, ", ".join(hidden))
    if not facts.pairs:
        return skipped(checks.NO_CAMERA)
    visible = ", ".join(f"l515:{pair.sdk.serial}" for pair in facts.pairs if pair.sdk)
    if facts.usb.error or all(pair.usb for pair in facts.pairs):
        return ok(f"librealsense sees {visible}")
    return warning(f"librealsense sees {visible}, USB not all of them", checks.CONTAINER_FIX)


def _hidden(facts: Facts, cameras: str) -> Finding:
    """Return a failure with every cause found, and the fix of the likeliest."""
    found = {name: CHECKS[name](facts) for name in CAUSES}
    causes = {name: finding for name, finding in found.items() if finding.status == "failed"}
    if not causes:
        fix = REPLUG_WINDOWS if facts.host.platform.system == "windows" else REPLUG
        if facts.host.is_jetson:
            fix = checks.JETSON_FIX
        return failed(f"USB shows {cameras}, librealsense does not; no check found the cause", fix)
    reasons = "; ".join(f"{name}: {finding.detail}" for name, finding in causes.items())
    return failed(
        f"USB shows {cameras}, librealsense does not: {reasons}", next(iter(causes.values())).fix
    )


IN_ORDER: tuple[Callable[[Facts], Finding], ...] = (
    checks.python,
    checks.system,
    checks.sdk,
    checks.sdk_version,
    checks.sdk_alone,
    checks.libusb,
    checks.usb_camera,
    checks.recovery,
    checks.link,
    checks.container,
    checks.udev_rules,
    checks.permissions,
    checks.video_driver,
    checks.hid_sensors,
    checks.in_use,
    sdk_camera,
    checks.firmware,
    checks.metadata,
    checks.stream,
    checks.reported,
)
CHECKS = {check.__name__.replace("_", "-"): check for check in IN_ORDER}
"""Every check by its name, in the order of the output."""


def diagnose(facts: Facts) -> list[Check]:
    """Return the outcome of every check, in order."""
    return [Check(name, **vars(check(facts))) for name, check in CHECKS.items()]
