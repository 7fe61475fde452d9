"""Laws of every diagnosis; each cause is tested in test_checks.py."""

from typing import Any, get_args

from hypothesis import given
from hypothesis import strategies as st

from nlos_cam.camera.l515 import DeviceInfo
from nlos_cam.doctor import Facts, diagnose
from nlos_cam.doctor.diagnosis import CAUSES, CHECKS
from nlos_cam.doctor.facts import Sdk, Status
from nlos_cam.doctor.host import MODULES, Holder, Host, KernelCamera, Node, Platform
from nlos_cam.doctor.usb import UsbDevice, UsbScan

NAMES = (
    "python system sdk sdk-version sdk-alone libusb usb-camera recovery link container udev-rules permissions "
    "video-driver hid-sensors in-use sdk-camera firmware metadata"
)
words = st.sampled_from(
    ["", "x", "2.54.2", "f0246262", "01.05.08.01", "L515", "linux", "windows", "darwin", "hid", "2-1"]
)
listed = st.tuples(st.builds(DeviceInfo, words, words, words, words)) | st.just(())
sdks = st.builds(Sdk, st.lists(st.tuples(words, words), max_size=2).map(tuple), words, words, listed)
devices = st.builds(
    UsbDevice,
    product_id=st.sampled_from([0x0B64, 0x0B55, 0x0B07]), kind=st.sampled_from(["camera", "recovery", "other"]),
    meaning=words, bus=st.none(), address=st.none(), port=words, bcd_usb=st.integers(0, 0xFFFF),
    speed=st.none() | st.integers(-1, 9), firmware=words, serial=words, product=words,
    interfaces=st.tuples(words), error=words, denied=st.booleans(),
)  # fmt: skip
ids, texts = st.sampled_from([0x0B64, 0x0B55]), st.tuples(words)
cameras = st.builds(KernelCamera, words, ids, words, words, texts, st.just(()), texts)
hosts = st.builds(
    Host,
    st.builds(Platform, words, words, st.tuples(st.integers(2, 4), st.integers(0, 20)), st.booleans(), st.booleans()),
    words, st.booleans(), st.dictionaries(st.sampled_from(MODULES), words), st.booleans(), st.booleans(),
    st.just(()) | st.tuples(cameras), st.just(()) | st.tuples(words),
    st.just(()) | st.tuples(st.builds(Node, words, words)),
    st.just(()) | st.tuples(st.builds(Holder, st.integers(1, 9), words, words)), st.integers(0, 2),
)  # fmt: skip
scans = st.builds(UsbScan, st.lists(devices, max_size=2).map(tuple), st.integers(0, 5), words)


def test_healthy_bench_passes_every_check_in_a_fixed_order(bench: Any) -> None:
    checks = bench.checks()
    assert {check.status for check in checks.values()} == {"ok"}
    assert "f0246262" in checks["sdk-camera"].detail
    assert list(CHECKS) == NAMES.split() == list(checks)
    assert set(CAUSES) < set(CHECKS)


@given(st.builds(Facts, hosts, scans, sdks))
def test_diagnosis_of_any_facts_gives_each_fault_a_fix(facts: Facts) -> None:
    checks = diagnose(facts)
    assert [check.name for check in checks] == NAMES.split()
    for check in checks:
        assert check.status in get_args(Status)
        assert check.detail
        assert bool(check.fix) == (check.status in {"warning", "failed"}), check


def test_only_the_hidden_one_of_two_cameras_is_missed(bench: Any, device: Any, fake_l515: Any) -> None:
    bench.usb.devices.append(device(serial="00000000F0000001", port_numbers=(2,), address=4))
    bench.linux.plug("2-2", address=4)
    check = bench.failed()["sdk-camera"]
    assert "f0000001" in check.detail
    assert "f0246262" not in check.detail
    bench.sdk_devices.append(fake_l515("f0000001"))
    assert bench.failed() == {}
    assert "l515:f0246262, l515:f0000001" in bench.checks()["sdk-camera"].detail


def test_several_causes_are_named_and_the_likeliest_fixed_first(bench: Any) -> None:
    bench.hide()
    bench.installed["pyrealsense2"] = "2.56.5"
    bench.linux.process(41, "cheese", "/dev/video30")
    check = bench.failed()["sdk-camera"]
    assert "sdk-version: " in check.detail
    assert "in-use: " in check.detail
    assert check.fix == bench.failed()["sdk-version"].fix
