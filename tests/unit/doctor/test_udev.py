import re

import pytest

from nlos_cam.doctor.host import LIDARS, OTHERS
from nlos_cam.doctor.udev import FILE_NAME, RELOAD, WRITE_AND_INSTALL, install_command, rules_text

CLAUSE = re.compile(r'[A-Z]+(\{\w+\})?(==|:=|\+=)"[^"]*"')


def lines() -> list[str]:
    return [line for line in rules_text().splitlines() if line and not line.startswith("#")]


@pytest.mark.parametrize("product_id", LIDARS)
def test_rules_open_every_lidar_to_every_user(product_id: int) -> None:
    [rule] = [line for line in lines() if f'"{product_id:04x}"' in line and line.startswith('SUBSYSTEMS=="usb"')]
    assert 'ATTRS{idVendor}=="8086"' in rule
    assert 'MODE:="0666"' in rule


def test_rules_open_motion_sensors_and_are_well_formed() -> None:
    sensors = [line for line in lines() if not line.startswith("SUBSYSTEMS")]
    assert [line.split(",")[0] for line in sensors] == ['KERNEL=="iio*"', 'DRIVER=="hid_sensor*"']
    assert all('ATTRS{idProduct}=="0b64"' in line and "chmod -R 0777 /sys/%p" in line for line in sensors)
    for line in lines():
        assert all(CLAUSE.fullmatch(clause) for clause in line.split(", ")), line
    assert not LIDARS.keys() & OTHERS.keys()


def test_commands_name_the_file_and_reload() -> None:
    assert f"--write-udev {FILE_NAME}" in WRITE_AND_INSTALL
    assert WRITE_AND_INSTALL.endswith(RELOAD)
    assert "'my rules'" in install_command("my rules")
    assert install_command("a").index("install") < install_command("a").index("udevadm")
