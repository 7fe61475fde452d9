"""`nlos-cam devices`: which cameras there are, as librealsense and as USB see them.

`nlos-cam doctor`: why a camera is not found, and exactly what to do.
"""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from nlos_cam.camera import SIMULATED, DeviceInfo
from nlos_cam.cli.common import Json, Overwrite, finish, output_path, say, show
from nlos_cam.doctor import Check, Facts, Pair, UsbDevice, diagnose, gather, install, rules
from nlos_cam.errors import NlosCamError

SEEN = {True: "yes", False: "[red]no[/]", None: ""}
"""A camera seen, not seen, and not looked for."""


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command()(devices)
    app.command()(doctor)


def devices(json: Json = False) -> None:
    """List the cameras that librealsense and USB see, side by side, and the simulated ones that can be asked for."""
    facts = gather()
    if not json:
        show(_table(facts))
    finish(_result(facts), as_json=json, text=_format_device(facts), marked=True)


def _result(facts: Facts) -> dict[str, Any]:
    seen = {id(pair.sdk): _usb_seen(facts, pair) for pair in facts.pairs if pair.sdk}
    real = [
        asdict(info) | {"uri": _uri(info), "simulated": False, "usb_seen": seen.get(id(info))}
        for info in facts.sdk.devices
    ]
    simulated = [
        {"name": name, "serial": "", "firmware": "", "usb_type": "", "uri": uri, "simulated": True, "usb_seen": None}
        for uri, name in SIMULATED.items()
    ]
    return {
        "devices": real + simulated,
        "usb": [_usb(device) | {"sdk_seen": _sdk_seen(facts, device)} for device in facts.usb.devices],
        "sdk_error": facts.sdk.error,
        "usb_error": facts.usb.error,
    }


def _usb(device: UsbDevice) -> dict[str, Any]:
    named = ("id", "kind", "meaning", "serial", "product", "firmware", "usb_type", "link", "port", "bus", "address")
    return {name: getattr(device, name) for name in named} | {
        "interfaces": list(device.interfaces),
        "error": device.error,
    }


def _usb_seen(facts: Facts, pair: Pair) -> bool | None:
    return None if facts.usb.error else pair.usb is not None


def _sdk_seen(facts: Facts, device: UsbDevice) -> bool | None:
    """Only of the L515's family is it known which device of the SDK is which on USB."""
    if facts.sdk.error:
        return None
    return next((pair.sdk is not None for pair in facts.pairs if pair.usb is device), None)


def _uri(info: DeviceInfo | None) -> str:
    """What `--camera` takes for it; empty for a device that is no L515."""
    return f"l515:{info.serial}" if info and "L515" in info.name else ""


def _table(facts: Facts) -> Table:
    table = Table("--camera", "name", "serial", "firmware", "link", "SDK", "USB", box=None, pad_edge=False)
    for pair in facts.pairs:
        table.add_row(*_row(facts, pair))
    for device in facts.usb.of_kind("recovery") + facts.usb.of_kind("other"):
        table.add_row("", escape(device.meaning), escape(device.serial), device.firmware, device.link, "", SEEN[True])
    for info in facts.sdk.devices:
        if info not in facts.sdk.lidars:
            table.add_row("", *map(escape, (info.name, info.serial, info.firmware, info.usb_type)), SEEN[True], "")
    for uri, name in SIMULATED.items():
        table.add_row(uri, escape(name))
    return table


def _row(facts: Facts, pair: Pair) -> list[str]:
    seen = SEEN[None if facts.sdk.error else pair.sdk is not None], SEEN[_usb_seen(facts, pair)]
    return [_uri(pair.sdk), *map(escape, (pair.name, pair.serial, pair.firmware, pair.link)), *seen]


def _format_device(facts: Facts) -> str:
    """What is missing, and where to ask why."""
    told: list[str] = []
    if error := facts.sdk.error:
        told.append(f"[yellow]librealsense cannot be asked:[/] {escape(error)}")
    if facts.usb.error:
        told.append(f"[yellow]USB cannot be looked at:[/] {escape(facts.usb.error)}")
    if not facts.pairs:
        told.append("no L515 is seen, neither by librealsense nor on USB; the simulated cameras need none")
    if told or any(pair.usb is None or pair.sdk is None for pair in facts.pairs):
        told.append("`nlos-cam doctor` says why, and what to do")
    return "\n".join(told) or "librealsense and USB see the same"


COLOURS = {"ok": "green", "warning": "yellow", "failed": "bold red", "skipped": "dim"}
WriteUdev = Annotated[Path | None, typer.Option("--write-udev", help="Write the udev rules for the L515 to this file.")]


def doctor(write_udev: WriteUdev = None, overwrite: Overwrite = False, json: Json = False) -> None:
    """Check everything between a camera and this program, and say what to do; exit code 0 whatever is found."""
    if write_udev is not None:
        _write(output_path(write_udev, "", ".rules", overwrite=overwrite))
    checks = diagnose(gather())
    if not json:
        show(_checks_table(checks))
    failures = sum(check.status == "failed" for check in checks)
    result = {"checks": [asdict(check) for check in checks], "ok": not failures}
    finish(result, as_json=json, text=_format_check(checks, failures), marked=True)


def _write(path: Path) -> None:
    try:
        path.write_text(rules(), encoding="utf-8")
    except OSError as error:
        raise NlosCamError(f"{path} cannot be written ({error.strerror}): write it here, then install it") from error
    say(f"wrote {path!s}; to put it in force, run, and plug the camera in again:\n  {install(str(path))}")


def _checks_table(checks: Sequence[Check]) -> Table:
    table = Table("", "check", "what was seen", box=None, pad_edge=False)
    for check in checks:
        table.add_row(f"[{COLOURS[check.status]}]{check.status}[/]", check.name, escape(check.detail))
    return table


def _format_check(checks: Sequence[Check], failures: int) -> str:
    """The fixes, each on a line that can be copied, and the sum."""
    fixes = [f"[bold]{check.name}[/]: {escape(check.fix)}" for check in checks if check.fix]
    told = f"{failures} of {len(checks)} checks failed" if failures else "nothing failed"
    return "\n".join(["", *(["what to do, from the top:", *fixes, ""] if fixes else []), told])
