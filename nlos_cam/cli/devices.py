"""`nlos-cam devices` lists the cameras that librealsense and USB see; `nlos-cam doctor` explains
why one is missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from nlos_cam import camera as cameras
from nlos_cam import doctor as diagnosis
from nlos_cam.cli.common import Json, Overwrite, finish, output_path, say, show
from nlos_cam.errors import NlosCamError
from nlos_cam.files import atomic_file, describe

VISIBLE = {True: "yes", False: "[red]no[/]", None: ""}
"""Cell for a camera that is listed, not listed, and not searched for."""


def devices(json: Json = False) -> None:
    """List the cameras that librealsense and USB see, side by side, and the simulated cameras."""
    facts = diagnosis.gather_facts()
    if not json:
        show(_table(facts))
    finish(_result(facts), as_json=json, text=_device_notes(facts), marked=True)


def _result(facts: diagnosis.Facts) -> dict[str, Any]:
    seen = {id(pair.sdk): _usb_seen(facts, pair) for pair in facts.pairs if pair.sdk}
    real = [
        asdict(info) | {"uri": _uri(info), "simulated": False, "usb_seen": seen.get(id(info))}
        for info in facts.sdk.devices
    ]
    simulated = [
        {
            "name": name,
            "serial": "",
            "firmware": "",
            "usb_type": "",
            "uri": uri,
            "simulated": True,
            "usb_seen": None,
        }
        for uri, name in cameras.SIMULATED.items()
    ]
    return {
        "devices": real + simulated,
        "usb": [
            _usb(device) | {"sdk_seen": _sdk_seen(facts, device)} for device in facts.usb.devices
        ],
        "sdk_error": facts.sdk.error,
        "usb_error": facts.usb.error,
    }


def _usb(device: diagnosis.UsbDevice) -> dict[str, Any]:
    named = (
        "id",
        "kind",
        "meaning",
        "serial",
        "product",
        "firmware",
        "usb_type",
        "link",
        "port",
        "bus",
        "address",
    )
    return {name: getattr(device, name) for name in named} | {
        "interfaces": list(device.interfaces),
        "error": device.error,
    }


def _usb_seen(facts: diagnosis.Facts, pair: diagnosis.Pair) -> bool | None:
    return None if facts.usb.error else pair.usb is not None


def _sdk_seen(facts: diagnosis.Facts, device: diagnosis.UsbDevice) -> bool | None:
    """Return whether the SDK lists a USB device; None if unknown: only cameras of the L515's family
    are paired.
    """
    if facts.sdk.error:
        return None
    return next((pair.sdk is not None for pair in facts.pairs if pair.usb is device), None)


def _uri(info: cameras.DeviceInfo | None) -> str:
    """Return the value of `--camera` for a device; empty if it is not an L515."""
    return f"l515:{info.serial}" if info and "L515" in info.name else ""


def _table(facts: diagnosis.Facts) -> Table:
    table = Table(
        "--camera", "name", "serial", "firmware", "link", "SDK", "USB", box=None, pad_edge=False
    )
    for pair in facts.pairs:
        visible = (
            VISIBLE[None if facts.sdk.error else pair.sdk is not None],
            VISIBLE[_usb_seen(facts, pair)],
        )
        table.add_row(
            _uri(pair.sdk),
            *map(escape, (pair.name, pair.serial, pair.firmware, pair.link)),
            *visible,
        )
    for device in facts.usb.of_kind("recovery") + facts.usb.of_kind("other"):
        table.add_row(
            "",
            escape(device.meaning),
            escape(device.serial),
            device.firmware,
            device.link,
            "",
            VISIBLE[True],
        )
    for info in facts.sdk.devices:
        if info not in facts.sdk.lidars:
            table.add_row(
                "",
                *map(escape, (info.name, info.serial, info.firmware, info.usb_type)),
                VISIBLE[True],
                "",
            )
    for uri, name in cameras.SIMULATED.items():
        table.add_row(uri, escape(name))
    return table


def _device_notes(facts: diagnosis.Facts) -> str:
    """Return the errors and the missing cameras, with the command that explains them."""
    notes: list[str] = []
    if error := facts.sdk.error:
        notes.append(f"[yellow]Cannot query librealsense:[/] {escape(error)}")
    if facts.usb.error:
        notes.append(f"[yellow]Cannot list USB devices:[/] {escape(facts.usb.error)}")
    if not facts.pairs:
        notes.append(
            "No L515 found by librealsense or on USB; the simulated cameras work without one"
        )
    if notes or any(pair.usb is None or pair.sdk is None for pair in facts.pairs):
        notes.append("Run `nlos-cam doctor` for the cause and the fix")
    return "\n".join(notes) or "librealsense and USB list the same cameras"


COLORS = {"ok": "green", "warning": "yellow", "failed": "bold red", "skipped": "dim"}
WriteUdev = Annotated[
    Path | None,
    typer.Option("--write-udev", help="Write the udev rules for the L515 to this file."),
]
Message = Annotated[
    str,
    typer.Option("--message", help="Explain this message of librealsense or of its viewer."),
]
Watch = Annotated[
    str | None,
    typer.Option(
        "--camera",
        metavar="CAMERA",
        help="Watch this camera for 5 s, for frames that stand still: l515, sim, ...",
    ),
]


def doctor(
    write_udev: WriteUdev = None,
    message: Message = "",
    watched: Watch = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Check everything between a camera and this program, and print fixes; the exit code is 0 even
    if checks fail.
    """
    if write_udev is not None:
        _write(output_path(write_udev, "", ".rules", overwrite=overwrite))
    facts = diagnosis.gather_facts(message)
    if watched is not None:
        facts = replace(facts, watched=diagnosis.watch(cameras.full_uri(watched)))
    checks = diagnosis.diagnose(facts)
    if not json:
        show(_checks_table(checks))
    failures = sum(check.status == "failed" for check in checks)
    result = {"checks": [asdict(check) for check in checks], "ok": not failures}
    finish(result, as_json=json, text=_fixes(checks, failures), marked=True)


def _write(path: Path) -> None:
    try:
        with atomic_file(path) as part:
            part.write_text(diagnosis.rules_text(), encoding="utf-8")
    except OSError as error:
        raise NlosCamError(
            f"cannot write {path} ({describe(error)}): write it to this folder, then install it"
        ) from error
    command = diagnosis.install_command(str(path))
    say(f"Wrote {path}. To install it, run this, then plug the camera in again:\n  {command}")


def _checks_table(checks: Sequence[diagnosis.Check]) -> Table:
    table = Table("", "check", "finding", box=None, pad_edge=False)
    for check in checks:
        table.add_row(
            f"[{COLORS[check.status]}]{check.status}[/]", check.name, escape(check.detail)
        )
    return table


def _fixes(checks: Sequence[diagnosis.Check], failures: int) -> str:
    """Return the fixes, each on a line that can be copied, and the number of failures."""
    fixes = [f"[bold]{check.name}[/]: {escape(check.fix)}" for check in checks if check.fix]
    total = "No check failed" if fixes else "All checks passed"
    if failures:
        total = f"{failures} of {len(checks)} checks failed"
    return "\n".join(["", *(["Fixes, in this order:", *fixes, ""] if fixes else []), total])
