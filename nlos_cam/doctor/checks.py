"""Checks of everything between a camera and this program: Linux, librealsense and Python, USB,
firmware.

Each check answers one question about the facts with a finding: status, detail and, unless all is
well, a fix.
"""

import re

from nlos_cam.camera import MAC_WHEEL, WHEEL
from nlos_cam.doctor.facts import Facts, Finding, failed, ok, skipped, warning
from nlos_cam.doctor.host import L515, LIDARS, Host, KernelCamera
from nlos_cam.doctor.udev import RELOAD, WRITE_AND_INSTALL

CONTAINER_FIX = (
    'start the container with `-v /dev:/dev -v /sys:/sys --device-cgroup-rule "c 81:* rmw"'
    ' --device-cgroup-rule "c 189:* rmw"`, and install the udev rules and kernel modules on the'
    " host"
)
NOT_LINUX = "only Linux needs this"
NO_CAMERA_IN_KERNEL = "the kernel sees no L515"
HID_MODULES = ("hid_sensor_hub", "hid_sensor_accel_3d", "hid_sensor_gyro_3d")
HID_OPTIONS = "CONFIG_HID_SENSOR_HUB, CONFIG_HID_SENSOR_ACCEL_3D and CONFIG_HID_SENSOR_GYRO_3D"
MIN_SENSORS = 2
"""Accelerometer and gyroscope: without both, librealsense on Linux does not list an L515."""
JOIN = "`sudo usermod -aG plugdev,video $USER`, and log in again"
JETSON_FIX = (
    "git clone -b v2.54.2 --depth 1 https://github.com/IntelRealSense/librealsense && cmake -S"
    " librealsense -B build -DFORCE_RSUSB_BACKEND=ON -DBUILD_PYTHON_BINDINGS=ON"
    " -DCMAKE_BUILD_TYPE=Release && sudo cmake --build build --target install"
)
"""Build of librealsense that reads USB itself: a Jetson's kernel has no drivers that it could
use.
"""
DESKTOP_SERVICES = {"pipewire", "wireplumber"}
"""Desktop services that keep a camera's node open without streaming."""


def _not_here(facts: Facts) -> str:
    """Return why a check of a camera on Linux does not apply; empty if it does."""
    if facts.host.platform.system != "linux":
        return NOT_LINUX
    return "" if facts.host.cameras else NO_CAMERA_IN_KERNEL


def container(facts: Facts) -> Finding:
    """Check that the camera is passed into the container, if this is one."""
    host = facts.host
    if host.platform.system != "linux":
        return skipped(NOT_LINUX)
    if not host.container:
        return ok("not in a container")
    if host.cameras and not facts.usb.of_kind("camera") + facts.usb.of_kind("recovery"):
        return failed(
            f"running in a container ({host.container}); the host's L515 is not passed into it",
            CONTAINER_FIX,
        )
    if facts.pairs and not any(node.error for node in host.nodes):
        return ok(f"in a container ({host.container}) that shows the camera")
    return warning(
        f"running in a container ({host.container}): a camera of the host shows only if it is"
        " passed in",
        CONTAINER_FIX,
    )


def udev_rules(facts: Facts) -> Finding:
    """Check that udev rules give this user access to an L515."""
    host = facts.host
    if host.platform.system != "linux":
        return skipped(NOT_LINUX)
    if host.rules:
        return ok(f"rules in {', '.join(host.rules)}")
    if host.container:
        return skipped("in a container the host's rules apply")
    if host.platform.is_root:
        return warning("no udev rules for the L515: only root can open it", WRITE_AND_INSTALL)
    if host.nodes and not any(node.error for node in host.nodes):
        return warning(
            "no udev rules for the L515, though this user can open it now", WRITE_AND_INSTALL
        )
    return failed("no udev rules for the L515: it opens for root only", WRITE_AND_INSTALL)


def permissions(facts: Facts) -> Finding:
    """Check that every device node of the camera opens."""
    host = facts.host
    if host.platform.system != "linux":
        return skipped(NOT_LINUX)
    shut = [f"{node.path} ({node.error})" for node in host.nodes if node.error]
    if not host.cameras:  # no /sys here: libusb alone reports permissions
        shut = [f"{device.label} ({device.error})" for device in facts.usb.devices if device.denied]
    if shut:
        return failed(f"cannot open {', '.join(shut)}", _permission_fix(host))
    return ok(f"{len(host.nodes)} nodes open") if host.nodes else skipped(NO_CAMERA_IN_KERNEL)


def _permission_fix(host: Host) -> str:
    if host.container:
        return CONTAINER_FIX
    if not host.rules:
        return WRITE_AND_INSTALL
    fix = f"{RELOAD}; then unplug the camera and plug it in again"
    return fix if host.platform.in_plugdev else f"{fix}; if that is not enough, {JOIN}"


def video_driver(facts: Facts) -> Finding:
    """Check that uvcvideo has created the camera's video nodes."""
    if reason := _not_here(facts):
        return skipped(reason)
    cameras = [camera for camera in facts.host.cameras if LIDARS[camera.product_id][0] == "camera"]
    if bare := [camera.port for camera in cameras if not camera.video_nodes]:
        state = facts.host.modules.get("uvcvideo", "unknown")
        fix = "sudo modprobe uvcvideo"
        if state == "missing":
            fix = "install a kernel with CONFIG_USB_VIDEO_CLASS"
        return failed(f"the L515 at {', '.join(bare)} has no /dev/video* (uvcvideo: {state})", fix)
    nodes = [node for camera in cameras for node in camera.video_nodes]
    return ok(", ".join(nodes) or "none is needed in recovery mode")


def hid_sensors(facts: Facts) -> Finding:
    """Check that the kernel shows the motion sensors: without them librealsense does not list the
    camera.
    """
    if facts.host.platform.system != "linux":
        return skipped(NOT_LINUX)
    cameras = [camera for camera in facts.host.cameras if camera.product_id == L515]
    if not cameras:
        return skipped(NO_CAMERA_IN_KERNEL)
    for camera in cameras:
        if len(camera.hid_sensors) < MIN_SENSORS:
            return _without_sensors(facts, camera)
    return ok("; ".join(f"{camera.port}: {', '.join(camera.hid_sensors)}" for camera in cameras))


def _without_sensors(facts: Facts, camera: KernelCamera) -> Finding:
    seen = ", ".join(camera.hid_sensors) or "none"
    drivers = ", ".join(camera.hid_devices) or "no HID device"
    detail = (
        f"the L515 at {camera.port} shows fewer than {MIN_SENSORS} motion sensors ({seen};"
        f" {drivers}): librealsense then does not list it"
    )
    return failed(detail, _sensor_fix(facts, camera))


def _sensor_fix(facts: Facts, camera: KernelCamera) -> str:
    host = facts.host
    offers = next(
        (device.interfaces for device in facts.usb.devices if device.port == camera.port), ()
    )
    if offers and "hid" not in offers:
        return (
            "it has no HID interface: unplug it, wait 5 s, plug it in again; if that does not help,"
            " update its firmware"
        )
    if host.container and not host.has_iio:
        return f"{CONTAINER_FIX}: this one hides /sys/bus/iio"
    if host.is_jetson:
        return JETSON_FIX
    if missing := [name for name in HID_MODULES if host.modules.get(name) == "missing"]:
        return (
            f"this kernel has no {', '.join(missing)} (as on JetPack 6): install one with"
            f" {HID_OPTIONS}, or try librealsense 2.54.2 built with -DFORCE_RSUSB_BACKEND=ON, which"
            " reads USB without it"
        )
    return f"sudo modprobe -a {' '.join(HID_MODULES)}; then unplug the camera and plug it in again"


def in_use(facts: Facts) -> Finding:
    """Check that no other process has the camera open: librealsense serves one process at a
    time.
    """
    if reason := _not_here(facts):
        return skipped(reason)
    held = {f"{one.name} (pid {one.pid})": one for one in facts.host.holders}
    closed = facts.host.closed_processes
    blind = f"; {closed} processes of other users could not be checked: try sudo" if closed else ""
    if not held:
        return ok(f"no other process has it open{blind}")
    pids = " ".join(str(pid) for pid in sorted({one.pid for one in held.values()}))
    if {one.name for one in held.values()} <= DESKTOP_SERVICES:
        return warning(
            f"{', '.join(held)} has it open, perhaps without streaming{blind}",
            "if streaming fails: systemctl --user stop wireplumber pipewire",
        )
    return failed(f"{', '.join(held)} has it open{blind}", f"close that program, or `kill {pids}`")


def metadata(facts: Facts) -> Finding:
    """Report the source of the frames' numbers and times; both sources work."""
    on = facts.host.platform.system
    if on == "linux" and facts.host.patched_uvc:
        return ok("uvcvideo is librealsense's: frames carry the camera's clock and number")
    if on == "linux" and facts.host.modules.get("uvcvideo") in {"loaded", "built in"}:
        return ok(
            "uvcvideo is the kernel's own: frames carry this host's clock and the SDK's count,"
            " which does here"
        )
    if on == "windows":
        return ok(
            "frames carry the camera's clock only once librealsense's"
            " scripts/realsense_metadata_win10.ps1 has run as administrator; without it this host's"
            " clock does"
        )
    return skipped("uvcvideo is not loaded" if on == "linux" else "only Linux and Windows have it")


FROM_SOURCE = "build librealsense 2.54.2 from source with -DBUILD_PYTHON_BINDINGS=ON"
NEWEST_PYTHON = {"linux x86_64": (3, 11), "windows amd64": (3, 11), "darwin": (3, 12)}
"""Newest Python with a wheel that has the L515's driver; the one for macOS is by the community."""
TESTED = (2, 54, 2)
REMOVED = (2, 55)
"""First librealsense without the L515's driver; it reports no error."""
SYSTEM_LIBRARIES = {"libusb-1.0": "libusb-1.0-0", "libudev": "libudev1", "libstdc++": "libstdc++6"}
"""Shared libraries that the Linux wheel loads, and the Debian packages that provide them."""
VC_RUNTIME = (
    "install Microsoft's Visual C++ runtime: https://aka.ms/vs/17/release/vc_redist.x64.exe"
)


def _wheel(on: str) -> str:
    return MAC_WHEEL if on == "darwin" else WHEEL


def version_numbers(version: str) -> tuple[int, ...]:
    """Return a version as numbers: (1, 5, 8, 1) for 01.05.08.01."""
    return tuple(int(part) for part in re.findall(r"\d+", version))


def python(facts: Facts) -> Finding:
    """Check that librealsense has a wheel for this Python on this system."""
    on = facts.host.platform
    here = f"Python {on.python[0]}.{on.python[1]} on {on.system} {on.machine}"
    if not facts.sdk.load_error:
        return ok(f"{here}: librealsense runs here")
    if on.is_musl:
        return failed(
            f"{here} with musl: librealsense's wheels are for glibc",
            "use a system with glibc (Debian, Ubuntu, Fedora)",
        )
    newest = NEWEST_PYTHON.get(f"{on.system} {on.machine}") or NEWEST_PYTHON.get(on.system)
    if newest is None:
        return failed(f"{here}: there is no wheel of librealsense 2.54.2 for it", FROM_SOURCE)
    if on.python > newest:
        last = f"{newest[0]}.{newest[1]}"
        return failed(
            f"{here}: the last librealsense that supports the L515 has wheels up to Python {last}",
            f"use Python {last} (`python{last} -m venv .venv`), or {FROM_SOURCE}",
        )
    return ok(f"{here}: a wheel of librealsense exists")


def system(facts: Facts) -> Finding:
    """Check that a camera can be used on this operating system."""
    if facts.host.platform.system == "darwin":
        return _macos(facts)
    if facts.host.is_wsl:
        return _wsl(facts)
    return ok(f"a camera can be used on {facts.host.platform.system}")


def _macos(facts: Facts) -> Finding:
    finding = warning if facts.sdk.lidars else failed
    return finding(
        "macOS: simulation and recordings only; since macOS 12 librealsense needs root to reach a"
        " camera, and often fails even then",
        f"use the camera on Linux or Windows; to try it here anyway: `pip install {MAC_WHEEL}`, and"
        " run with sudo",
    )


def _wsl(facts: Facts) -> Finding:
    finding = warning if facts.pairs else failed
    return finding(
        "WSL: a virtual machine that sees only the USB devices handed to it, with a kernel that may"
        " lack uvcvideo and the HID sensors",
        "run nlos-cam on Windows itself; or, in PowerShell as administrator: `usbipd list`, "
        "`usbipd bind --busid B`, `usbipd attach --wsl --busid B` with the camera's B from the"
        " list",
    )


def sdk(facts: Facts) -> Finding:
    """Check that librealsense can be loaded and queried."""
    if error := facts.sdk.load_error:
        return failed(error, _load_fix(error, facts.host.platform.system))
    if error := facts.sdk.query_error:
        return failed(
            f"librealsense is loaded, but cannot list devices: {error}", _query_fix(error)
        )
    return ok(f"librealsense {facts.sdk.version or 'of unknown version'} is loaded")


def _load_fix(error: str, on: str) -> str:
    """Return what to install for an error of the loader."""
    if "DLL" in error:
        return VC_RUNTIME
    if "GLIBC" in error:
        return (
            "the system's C library is too old for the wheel: use a newer release of the system"
            " (glibc 2.17 or later)"
        )
    for library, package in SYSTEM_LIBRARIES.items():
        if library in error:
            fix = f"sudo apt install {package}"
            return f"{fix}, or `pip install libusb-package`" if "usb" in library else fix
    return f"pip install {_wheel(on)} libusb-package"


MIN_FRAMES_SHARE = 0.5
"""Share of the expected frames below which a camera is too slow."""
FROZEN_FIX = "unplug the camera, wait 5 s, plug it in, and run `nlos-cam live --camera l515`"
KNOWN_MESSAGES = (
    (
        r"fatal error.{0,20}\b16\b",
        "the laser's hardware alarm: the depth sensor is broken, and no software mends it",
        "return or replace the camera; until then: `nlos-cam demo`",
    ),
    (
        r"set power state",
        "the system does not let librealsense take the camera, as macOS 12 and later without root",
        "sudo nlos-cam doctor",
    ),
    (
        r"platform camera",
        "librealsense 2.55 and later have no driver for the L515: Windows' own camera is listed",
        f"pip install {WHEEL}",
    ),
    (
        r"same frame|frozen|frame number.{0,40}(again|repeat|not increas|stuck)|stalled",
        "the camera sends one frame again and again: its firmware stands still",
        FROZEN_FIX,
    ),
    (
        r"frames? did(n'?t| not) arrive",
        "no frame came in time: a slow or loose USB link, a still device, or a recording's end",
        "use its own cable in a USB 3 port, replug, then `nlos-cam doctor --camera l515`",
    ),
    (
        r"resolve requests",
        "no such streams: over USB 2 an L515 has 320 x 240 alone, which nlos-cam takes by itself",
        "turn the plug round, or use a USB 3 cable and port",
    ),
    (
        r"unindexed|wanted \d+ bytes, read",
        "the recording was killed or cut before its index was written",
        "nlos-cam repair F.bag --out repaired.bag",
    ),
)
"""Messages of librealsense and its viewer that owners report: pattern, meaning and fix."""


def _known(message: str) -> tuple[str, str] | None:
    """Return meaning and fix of a message of librealsense; None for an unknown one."""
    for pattern, meaning, fix in KNOWN_MESSAGES:
        if re.search(pattern, message, re.IGNORECASE):
            return meaning, fix
    return None


def stream(facts: Facts) -> Finding:
    """Check that the camera's frames come, and that each is another."""
    found = facts.watched
    if found is None:
        return skipped("no camera was watched: --camera l515 watches one for some seconds")
    if found.error:
        return failed(f"{found.camera}: {found.error}", "look at the other checks, then replug")
    if found.is_frozen:
        return failed(f"{found.camera} sends one frame again and again", FROZEN_FIX)
    if not found.frames:
        return failed(f"no frame of {found.camera} in {found.seconds:.0f} s", FROZEN_FIX)
    if found.frames < MIN_FRAMES_SHARE * found.frames_expected:
        return warning(
            f"{found.frames} frames of {found.camera}, of {found.frames_expected:.0f} expected",
            "use a USB 3 port of the computer itself, close other programs, then replug",
        )
    return ok(f"{found.frames} frames of {found.camera}, each another")


def reported(facts: Facts) -> Finding:
    """Explain a message that another program showed."""
    if not facts.reported:
        return skipped("no message was given: --message TEXT explains one")
    if known := _known(facts.reported):
        return failed(*known)
    return warning(
        f"{facts.reported[:80]!r} is not known here", "look at the other checks, then replug"
    )


def _query_fix(error: str) -> str:
    if known := _known(error):
        return known[1]
    if "attribute" in error:  # a folder or file called pyrealsense2 shadows the wheel
        return (
            "remove any folder or file of your own called pyrealsense2; `pip install"
            f" --force-reinstall {WHEEL}`"
        )
    return (
        "unplug the camera, wait 5 s, plug it in again; close realsense-viewer and whatever else"
        " uses it"
    )


def sdk_version(facts: Facts) -> Finding:
    """Check that this librealsense has the L515's driver, which was removed in 2.55."""
    if not facts.sdk.packages:
        if facts.sdk.has_platform_camera and any(not pair.sdk for pair in facts.pairs):
            return failed(
                "librealsense lists the L515 as 'Platform Camera': it has no driver for it",
                f"pip install {_wheel(facts.host.platform.system)}",
            )
        return skipped("no package of librealsense is installed, so its version is unknown")
    newest = max(facts.sdk.packages, key=lambda package: version_numbers(package[1]))[1]
    fix = f"pip install {_wheel(facts.host.platform.system)}"
    if version_numbers(newest)[:2] >= REMOVED:
        lists = "'Platform Camera'" if facts.sdk.has_platform_camera else "no device"
        return failed(
            f"librealsense {newest} has no driver for the L515 (the last with it is 2.54.2): it"
            f" reports {lists}",
            fix,
        )
    if version_numbers(newest)[:3] != TESTED:
        return warning(f"librealsense {newest} supports the L515, but only 2.54.2 is tested", fix)
    return ok(f"librealsense {newest} supports the L515")


def sdk_alone(facts: Facts) -> Finding:
    """Check that only one package of librealsense is installed: they share one folder."""
    packages = ", ".join(f"{name} {version}" for name, version in facts.sdk.packages)
    if len(facts.sdk.packages) > 1:
        names = " ".join(name for name, _ in facts.sdk.packages)
        return failed(
            f"{packages} are installed into one folder, and overwrite each other",
            f"pip uninstall -y {names} && pip install {_wheel(facts.host.platform.system)}",
        )
    if not packages:
        return skipped("no package of librealsense is installed")
    return ok(f"only {packages}")


def libusb(facts: Facts) -> Finding:
    """Check that USB devices can be listed without librealsense."""
    if facts.usb.error:
        fix = "pip install pyusb libusb-package"
        if facts.host.platform.system == "linux":
            fix += ", or `sudo apt install libusb-1.0-0`"
        return failed(f"cannot list USB devices: {facts.usb.error}", fix)
    return ok(f"{facts.usb.total} USB devices are listed")


NO_CAMERA = "no L515 is seen, neither on USB nor by librealsense"
MIN_FIRMWARE = (1, 5, 1, 3)
BEST_FIRMWARE = (1, 5, 8, 1)
FLASH = (
    "with librealsense 2.54.2's realsense-viewer (More > Update Firmware), or `rs-fw-update -f "
    "Signed_Image_UVC_1_5_8_1.bin`, on a USB 3 port"
)


def usb_camera(facts: Facts) -> Finding:
    """Check that an L515 is on USB, in any mode."""
    if facts.usb.error:
        return skipped("cannot list USB devices: see libusb")
    here = facts.usb.of_kind("camera") + facts.usb.of_kind("recovery")
    if here:
        return ok(", ".join(f"{device.label} ({device.id}, {device.link})" for device in here))
    if kernel := facts.host.cameras:
        ports = ", ".join(camera.port for camera in kernel)
        fix = "unplug the camera and plug it in again: udev then makes its node"
        return failed(
            f"the kernel sees an L515 at {ports}, but /dev/bus/usb does not show it here",
            CONTAINER_FIX if facts.host.container else fix,
        )
    if facts.sdk.lidars:
        return warning(
            "librealsense sees an L515 that USB does not show",
            CONTAINER_FIX if facts.host.container else "run as a user who may list USB devices",
        )
    return _absent(facts)


def _absent(facts: Facts) -> Finding:
    plug = (
        "plug it straight into a USB 3 port with its own cable; `lsusb -d 8086:` should list it;"
        " without a camera, use --camera sim"
    )
    if others := facts.usb.of_kind("other"):
        found = ", ".join(f"{device.label} ({device.id})" for device in others)
        return failed(
            f"no L515 on USB, but another RealSense: {found}", f"an L515 is required: {plug}"
        )
    if not facts.usb.total:
        return failed(
            "nothing is plugged in: USB shows no device at all",
            f"{plug}; in a virtual machine, pass USB to it",
        )
    return failed(
        f"nothing is plugged in: none of the {facts.usb.total} devices on USB is an L515", plug
    )


def recovery(facts: Facts) -> Finding:
    """Check that no camera is in recovery mode, waiting for firmware."""
    if stuck := facts.usb.of_kind("recovery"):
        return failed(
            ", ".join(f"{device.label} ({device.id})" for device in stuck)
            + ": it waits for firmware and delivers no frames",
            "unplug it, wait 5 s, plug it into a USB 3 port; if it comes back like this:"
            " `rs-fw-update -r -f Signed_Image_UVC_1_5_8_1.bin` of librealsense 2.54.2, or its"
            " realsense-viewer",
        )
    return ok(f"{len(facts.pairs)} in normal mode") if facts.pairs else skipped(NO_CAMERA)


def link(facts: Facts) -> Finding:
    """Check that every camera is on USB 3."""
    if not facts.pairs:
        return skipped(NO_CAMERA)
    if slow := [pair for pair in facts.pairs if pair.is_slow]:
        return warning(
            f"{', '.join(pair.label for pair in slow)} is on USB 2: depth, infrared and confidence"
            " come at 320 x 240 and 30 frames/s only, without max-usable-range and IR"
            " reflectivity",
            "turn the USB-C plug round and push it in fully; use a USB 3 cable and a USB 3 port,"
            " without a hub; a camera that stays on USB 2 with every cable and port is defective",
        )
    return ok(", ".join(f"{pair.label}: {pair.link}" for pair in facts.pairs))


def firmware(facts: Facts) -> Finding:
    """Check that librealsense 2.54.2 accepts the firmware of every camera and recommends no newer
    one.
    """
    known = {pair.label: pair.firmware for pair in facts.pairs if pair.firmware}
    if not known:
        return skipped("no camera reports its firmware" if facts.pairs else NO_CAMERA)
    detail = ", ".join(f"{label}: {version}" for label, version in known.items())
    oldest = min(map(version_numbers, known.values()))
    if oldest < MIN_FIRMWARE[: len(oldest)]:
        return failed(
            f"{detail}; librealsense accepts 1.5.1.3 and later", f"update to 1.5.8.1 {FLASH}"
        )
    if oldest < BEST_FIRMWARE[: len(oldest)]:
        return warning(f"{detail}; librealsense recommends 1.5.8.1", f"update to 1.5.8.1 {FLASH}")
    return ok(detail)
