"""`nlos-cam devices`: which cameras there are."""

from dataclasses import asdict

import typer
from rich.markup import escape

from nlos_cam.camera import SIMULATED
from nlos_cam.camera.l515 import DeviceInfo, list_devices
from nlos_cam.cli.common import Json, finish


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(devices)


def devices(json: Json = False) -> None:
    """List the cameras that librealsense sees, and the simulated ones that can be asked for."""
    real = [asdict(info) | {"uri": _uri(info), "simulated": False} for info in list_devices()]
    simulated = [
        {"name": name, "serial": "", "firmware": "", "usb_type": "", "uri": uri, "simulated": True}
        for uri, name in SIMULATED.items()
    ]
    found = real + simulated
    told = [] if real else ["librealsense sees no device; these need none:"]
    finish({"devices": found}, as_json=json, text="\n".join(told + [_line(device) for device in found]))


def _uri(info: DeviceInfo) -> str:
    """What `--camera` takes for it; empty for a device that is no L515."""
    return f"l515:{info.serial}" if "L515" in info.name else ""


def _line(device: dict[str, str | bool]) -> str:
    told = [f"{key} {device[key]}" for key in ("serial", "firmware", "usb_type") if device[key]]
    return escape(f"{device['uri'] or '(not an L515)':<20} {device['name']}  {', '.join(told)}".rstrip())
