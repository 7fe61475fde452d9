import json

import pytest
import typer

from nlos_cam.camera.l515 import DeviceInfo
from nlos_cam.cli import devices

L515 = DeviceInfo("Intel RealSense L515", "f0246262", "01.05.08.01", "3.2")
D435 = DeviceInfo("Intel RealSense D435", "123", "", "")


def listed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    monkeypatch.setattr(devices, "list_devices", lambda: [L515, D435])
    app = typer.Typer()
    devices.register(app)
    app(list(arguments), standalone_mode=False)
    return capsys.readouterr().out


def test_every_device_is_listed_with_what_to_ask_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = json.loads(listed(monkeypatch, capsys, "--json").splitlines()[-1])["devices"]
    assert [device["uri"] for device in found] == ["l515:f0246262", "", "sim", "sim:bare-wall"]
    assert [device["simulated"] for device in found] == [False, False, True, True]
    assert {"name", "serial", "firmware", "usb_type"} < set(found[0])


def test_a_person_is_told_the_same(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    told = listed(monkeypatch, capsys)
    for word in ("l515:f0246262", "01.05.08.01", "usb_type 3.2", "D435", "sim:bare-wall"):
        assert word in told


def test_no_device_is_said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(devices, "list_devices", list)
    devices.devices()
    assert "sees no device" in capsys.readouterr().out
