"""Checks of what Linux puts between a camera and librealsense: containers, rules, permissions, drivers, other users."""

from nlos_cam.camera.host import Host
from nlos_cam.camera.sysfs import KernelCamera
from nlos_cam.camera.udev import RELOAD, WRITE_AND_INSTALL
from nlos_cam.camera.usb_ids import L515, LIDARS
from nlos_cam.doctor.check import Finding, failed, ok, skipped, warning
from nlos_cam.doctor.facts import Facts

CONTAINER_FIX = (
    'start the container with `-v /dev:/dev -v /sys:/sys --device-cgroup-rule "c 81:* rmw" --device-cgroup-rule '
    '"c 189:* rmw"`, and install the udev rules and kernel modules on the host'
)
NOT_LINUX = "only Linux needs this"
ABSENT = "the kernel sees no L515"
HID_MODULES = ("hid_sensor_hub", "hid_sensor_accel_3d", "hid_sensor_gyro_3d")
HID_OPTIONS = "CONFIG_HID_SENSOR_HUB, CONFIG_HID_SENSOR_ACCEL_3D and CONFIG_HID_SENSOR_GYRO_3D"
LEAST_SENSORS = 2
"""librealsense on Linux leaves out an L515 of which it does not see accelerometer and gyroscope."""
JOIN = "`sudo usermod -aG plugdev,video $USER`, and log in again"
PASSERS_BY = {"pipewire", "wireplumber"}
"""Desktop services that keep a camera's node open without streaming."""


def _not_here(facts: Facts) -> str:
    """Why a question about a camera on Linux does not arise; empty if it does."""
    if facts.host.platform.system != "linux":
        return NOT_LINUX
    return "" if facts.host.cameras else ABSENT


def container(facts: Facts) -> Finding:
    """Whether this is a container, and the camera is passed into it."""
    host = facts.host
    if host.platform.system != "linux":
        return skipped(NOT_LINUX)
    if not host.container:
        return ok("not in a container")
    if host.cameras and not facts.usb.of_kind("camera") + facts.usb.of_kind("recovery"):
        return failed(
            f"this is a container ({host.container}), and the host's L515 is not passed into it", CONTAINER_FIX
        )
    if facts.pairs and not any(node.error for node in host.nodes):
        return ok(f"in a container ({host.container}) that shows the camera")
    return warning(
        f"this is a container ({host.container}): a camera of the host shows only if it is passed", CONTAINER_FIX
    )


def udev_rules(facts: Facts) -> Finding:
    """Whether rules give this user access to an L515 once it is plugged in."""
    host = facts.host
    if host.platform.system != "linux":
        return skipped(NOT_LINUX)
    if host.rules:
        return ok(f"rules in {', '.join(host.rules)}")
    if host.container:
        return skipped("in a container the host's rules count")
    if host.platform.is_root:
        return warning("no udev rules for the L515: only root can open it", WRITE_AND_INSTALL)
    if host.nodes and not any(node.error for node in host.nodes):
        return warning("no udev rules for the L515, though this user can open it now", WRITE_AND_INSTALL)
    return failed("no udev rules for the L515: it opens for root only", WRITE_AND_INSTALL)


def permissions(facts: Facts) -> Finding:
    """Whether every node of the camera opens."""
    host = facts.host
    if host.platform.system != "linux":
        return skipped(NOT_LINUX)
    shut = [f"{node.path} ({node.error})" for node in host.nodes if node.error]
    if not host.cameras:  # no /sys here, so libusb is the only witness
        shut = [f"{device.label} ({device.error})" for device in facts.usb.devices if device.denied]
    if shut:
        return failed(f"cannot open {', '.join(shut)}", _permission_fix(host))
    return ok(f"{len(host.nodes)} nodes open") if host.nodes else skipped(ABSENT)


def _permission_fix(host: Host) -> str:
    if host.container:
        return CONTAINER_FIX
    if not host.rules:
        return WRITE_AND_INSTALL
    fix = f"{RELOAD}; then unplug the camera and plug it in again"
    return fix if host.platform.in_plugdev else f"{fix}; if that is not enough, {JOIN}"


def video_driver(facts: Facts) -> Finding:
    """Whether uvcvideo has made video nodes of the camera."""
    if reason := _not_here(facts):
        return skipped(reason)
    cameras = [camera for camera in facts.host.cameras if LIDARS[camera.product_id][0] == "camera"]
    if bare := [camera.port for camera in cameras if not camera.video_nodes]:
        state = facts.host.modules.get("uvcvideo", "unknown")
        fix = "install a kernel with CONFIG_USB_VIDEO_CLASS" if state == "missing" else "sudo modprobe uvcvideo"
        return failed(f"the L515 at {', '.join(bare)} has no /dev/video* (uvcvideo: {state})", fix)
    return ok(
        ", ".join(node for camera in cameras for node in camera.video_nodes) or "in recovery mode: none is needed"
    )


def hid_sensors(facts: Facts) -> Finding:
    """Whether the kernel shows the motion sensors, without which librealsense silently leaves the camera out."""
    if facts.host.platform.system != "linux":
        return skipped(NOT_LINUX)
    cameras = [camera for camera in facts.host.cameras if camera.product_id == L515]
    if not cameras:
        return skipped(ABSENT)
    for camera in cameras:
        if len(camera.hid_sensors) < LEAST_SENSORS:
            return _without_sensors(facts, camera)
    return ok("; ".join(f"{camera.port}: {', '.join(camera.hid_sensors)}" for camera in cameras))


def _without_sensors(facts: Facts, camera: KernelCamera) -> Finding:
    seen = ", ".join(camera.hid_sensors) or "none"
    drivers = ", ".join(camera.hid_devices) or "no HID device"
    detail = (
        f"the L515 at {camera.port} shows fewer than {LEAST_SENSORS} motion sensors ({seen}; {drivers}): librealsense "
        "then leaves it out without a word"
    )
    return failed(detail, _sensor_fix(facts, camera))


def _sensor_fix(facts: Facts, camera: KernelCamera) -> str:
    host = facts.host
    offers = next((device.interfaces for device in facts.usb.devices if device.port == camera.port), ())
    if offers and "hid" not in offers:
        return "it offers no HID interface: unplug it, wait 5 s, plug it in again; if it stays so, update its firmware"
    if host.container and not host.has_iio:
        return f"{CONTAINER_FIX}: this one hides /sys/bus/iio"
    if missing := [name for name in HID_MODULES if host.modules.get(name) == "missing"]:
        return (
            f"this kernel has no {', '.join(missing)} (JetPack 6 is built so): install one with {HID_OPTIONS}, or "
            "try librealsense 2.54.2 built with -DFORCE_RSUSB_BACKEND=ON, which reads USB without it"
        )
    return f"sudo modprobe -a {' '.join(HID_MODULES)}; then unplug the camera and plug it in again"


def in_use(facts: Facts) -> Finding:
    """Whether another process holds the camera: librealsense gives it to one at a time."""
    if reason := _not_here(facts):
        return skipped(reason)
    held = {f"{one.name} (pid {one.pid})": one for one in facts.host.holders}
    closed = facts.host.closed_processes
    blind = f"; {closed} processes of others do not show: sudo sees them" if closed else ""
    if not held:
        return ok(f"no other process has it open{blind}")
    pids = " ".join(str(pid) for pid in sorted({one.pid for one in held.values()}))
    if {one.name for one in held.values()} <= PASSERS_BY:
        return warning(
            f"{', '.join(held)} has it open; it may only watch{blind}",
            "if streaming fails: systemctl --user stop wireplumber pipewire",
        )
    return failed(f"{', '.join(held)} has it open{blind}", f"close that program, or `kill {pids}`")


def metadata(facts: Facts) -> Finding:
    """Where the frames' numbers and times come from; both ways work here."""
    on = facts.host.platform.system
    if on == "linux" and facts.host.patched_uvc:
        return ok("uvcvideo is librealsense's: frames carry the camera's clock and number")
    if on == "linux" and facts.host.modules.get("uvcvideo") in {"loaded", "built in"}:
        return ok("uvcvideo is the kernel's own: frames carry this host's clock and the SDK's count, which does here")
    if on == "windows":
        return ok(
            "frames carry the camera's clock only once librealsense's scripts/realsense_metadata_win10.ps1 has run as "
            "administrator; without it this host's clock does"
        )
    return skipped("uvcvideo is not loaded" if on == "linux" else "only Linux and Windows have it")
