"""Laws of every diagnosis; each cause is tested in test_checks.py."""

from typing import Any, get_args
from unittest.mock import Mock

from fake_bench import fake_device
from fake_lidar import FakeLidar
from hypothesis import given
from hypothesis import strategies as st

from nlos_cam.camera.l515 import DeviceInfo
from nlos_cam.doctor import Facts, diagnose
from nlos_cam.doctor.diagnosis import CAUSES, CHECKS
from nlos_cam.doctor.facts import Pair, Sdk, Status, gather_facts, match_devices, query_sdk
from nlos_cam.doctor.host import MODULES, Holder, Host, KernelCamera, Node, Platform
from nlos_cam.doctor.usb import UsbDevice, UsbScan
from nlos_cam.errors import CameraError

NAMES = (
    "python system sdk sdk-version sdk-alone libusb usb-camera recovery link container udev-rules"
    " permissions video-driver hid-sensors in-use sdk-camera firmware metadata stream reported"
)
words = st.sampled_from(
    [
        "",
        "x",
        "2.54.2",
        "f0246262",
        "01.05.08.01",
        "L515",
        "linux",
        "windows",
        "darwin",
        "hid",
        "2-1",
    ]
)
listed = st.tuples(st.builds(DeviceInfo, words, words, words, words)) | st.just(())
sdks = st.builds(
    Sdk, st.lists(st.tuples(words, words), max_size=2).map(tuple), words, words, listed
)
devices = st.builds(
    UsbDevice,
    product_id=st.sampled_from([0x0B64, 0x0B55, 0x0B07]),
    kind=st.sampled_from(["camera", "recovery", "other"]),
    meaning=words,
    bus=st.none(),
    address=st.none(),
    port=words,
    bcd_usb=st.integers(0, 0xFFFF),
    speed=st.none() | st.integers(-1, 9),
    firmware=words,
    serial=words,
    product=words,
    interfaces=st.tuples(words),
    error=words,
    denied=st.booleans(),
)
ids = st.sampled_from([0x0B64, 0x0B55])
texts = st.tuples(words)
cameras = st.builds(KernelCamera, words, ids, words, words, texts, st.just(()), texts)
hosts = st.builds(
    Host,
    st.builds(
        Platform,
        words,
        words,
        st.tuples(st.integers(2, 4), st.integers(0, 20)),
        st.booleans(),
        st.booleans(),
    ),
    words,
    st.booleans(),
    st.dictionaries(st.sampled_from(MODULES), words),
    st.booleans(),
    st.booleans(),
    st.just(()) | st.tuples(cameras),
    st.just(()) | st.tuples(words),
    st.just(()) | st.tuples(st.builds(Node, words, words)),
    st.just(()) | st.tuples(st.builds(Holder, st.integers(1, 9), words, words)),
    st.integers(0, 2),
)
scans = st.builds(UsbScan, st.lists(devices, max_size=2).map(tuple), st.integers(0, 5), words)


def test_healthy_bench_passes_every_check_in_a_fixed_order(bench: Any) -> None:
    checks = bench.checks()

    unasked = {"stream", "reported"}  # by --camera and --message
    assert {name for name, check in checks.items() if check.status == "skipped"} == unasked
    assert {checks[name].status for name in checks.keys() - unasked} == {"ok"}
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


def test_only_the_hidden_one_of_two_cameras_is_missed(bench: Any) -> None:
    bench.usb.devices.append(fake_device(serial="00000000F0000001", port_numbers=(2,), address=4))
    bench.linux.plug("2-2", address=4)
    check = bench.failed()["sdk-camera"]

    assert "f0000001" in check.detail
    assert "f0246262" not in check.detail

    bench.sdk_devices.append(FakeLidar("f0000001"))

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


def info(serial: str, usb: str = "3.2") -> DeviceInfo:
    return DeviceInfo("Intel RealSense L515", serial, "01.05.08.01", usb)


def matched(bench: Any, *seen: str) -> list[tuple[str | None, str | None]]:
    """Serials on USB and in the SDK, of cameras on the bench's USB and of these in the SDK."""
    pairs = match_devices(bench.facts().usb.of_kind("camera"), [info(serial) for serial in seen])
    return [(one.usb and one.usb.serial, one.sdk and one.sdk.serial) for one in pairs]


def test_gather_asks_this_machine() -> None:
    facts = gather_facts()

    assert facts.sdk.load_error == ""
    assert ("pyrealsense2", facts.sdk.version) in facts.sdk.packages


def test_sdk_facts_hold_version_and_devices(bench: Any) -> None:
    bench.sdk_devices.append(FakeLidar("9", name="Intel RealSense D435"))
    sdk = bench.facts().sdk

    assert sdk.version == "2.54.2.5684"
    assert [one.serial for one in sdk.devices] == ["f0246262", "9"]
    assert [one.serial for one in sdk.lidars] == ["f0246262"]
    assert sdk.error == ""

    bench.installed["PyRealSense2-beta"] = "2.56.0"

    assert bench.facts().sdk.version == ""  # of two packages, none is known
    assert len(bench.facts().sdk.packages) == 2


def test_sdk_that_cannot_load_keeps_the_error(bench: Any) -> None:
    assert (
        query_sdk(Mock(side_effect=CameraError("no such luck")), list).load_error == "no such luck"
    )

    bench.sdk_error = ImportError("No module named 'pyrealsense2'")
    sdk = bench.facts().sdk

    assert sdk.load_error == str(bench.sdk_error)
    assert sdk.error == str(bench.sdk_error)
    assert sdk.devices == ()


def test_pair_matches_serials_whatever_their_zeros(bench: Any) -> None:
    assert matched(bench) == [("f0246262", None)]
    assert matched(bench, "f9") == [("f0246262", None), (None, "f9")]

    bench.usb.devices = [
        fake_device(serial="00000000F1"),
        fake_device(serial="00000000F2", address=4),
    ]

    assert matched(bench, "f2", "00000000f1") == [("f1", "00000000f1"), ("f2", "f2")]

    bench.put_on_usb(0x0B55)

    assert [one.usb for one in bench.facts().pairs] == [None]  # one in recovery mode is no camera

    bench.usb.devices.clear()

    assert matched(bench, "f9") == [(None, "f9")]


def test_pair_gives_the_last_device_to_a_camera_without_serial(bench: Any) -> None:
    bench.usb.devices = [fake_device(serial="", port_numbers=None)]

    assert matched(bench, "f1") == [("", "f1")]
    assert matched(bench) == [("", None)]
    assert matched(bench, "f1", "f2") == [("", None), (None, "f1"), (None, "f2")]


def test_pair_prefers_what_the_sdk_reports(bench: Any) -> None:
    [both] = bench.facts().pairs

    assert both.name == "Intel RealSense L515"
    assert both.serial == "f0246262"
    assert both.firmware == "01.05.08.01"
    assert (both.link, both.is_slow, both.label) == (
        "5 Gbit/s (USB 3)",
        False,
        "L515 f0246262 at 2-1",
    )

    alone = Pair(both.usb, None)

    assert alone.name == "L515"
    assert alone.serial == "f0246262"
    assert alone.firmware == "1.5.8"

    seen = Pair(None, info("f1", usb="2.1"))

    assert (seen.link, seen.is_slow, seen.label) == ("USB 2.1", True, "Intel RealSense L515 f1")
