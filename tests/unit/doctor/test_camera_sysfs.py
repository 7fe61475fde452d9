import subprocess
import sys
from pathlib import Path
from typing import Any

from nlos_cam.doctor.host import Holder, entries, holders, is_there, kernel_cameras, text

HOLDS = "import sys; file = open(sys.argv[1]); print('open', flush=True); sys.stdin.read()"


def test_a_camera_is_told_with_all_that_hangs_on_it(bench: Any, tmp_path: Path) -> None:
    assert bench.linux.root == tmp_path
    [found] = kernel_cameras(tmp_path)
    assert (found.port, found.product_id, found.serial) == ("2-1", 0x0B64, "00000000F0246262")
    assert found.nodes == ("/dev/bus/usb/002/003", "/dev/video30", "/dev/video31")
    assert found.hid_sensors == ("accel_3d", "gyro_3d")
    assert found.hid_devices == ("0003:8086:0B64.3 (hid-sensor-hub)",)


def test_two_cameras_keep_their_parts_apart(bench: Any, tmp_path: Path) -> None:
    bench.linux.plug("2-1.4", address=7, hid=0, video=1)  # behind a hub whose name begins like the other's
    one, other = kernel_cameras(tmp_path)
    assert (one.port, len(one.hid_sensors), len(one.video_nodes)) == ("2-1", 2, 2)
    assert (other.port, other.hid_sensors, other.video_nodes) == ("2-1.4", (), ("/dev/video70",))


def test_what_is_no_l515_is_left_out(bench: Any, tmp_path: Path) -> None:
    bench.linux.plug("2-2", product="0b07", address=5)
    bench.linux.write("sys/bus/usb/devices/2-3/idVendor", "not a number")
    assert [camera.port for camera in kernel_cameras(tmp_path)] == ["2-1"]


def test_a_host_without_such_files_has_no_camera(tmp_path: Path) -> None:
    assert kernel_cameras(tmp_path) == ()
    assert holders(["/dev/video0"], tmp_path) == ([], 0)


def test_odd_files_are_empty_and_odd_folders_hold_nothing(tmp_path: Path) -> None:
    (tmp_path / "binary").write_bytes(b"\xff\xfe 1 ")
    assert text(tmp_path / "binary").endswith("1")
    assert text(tmp_path) == text(tmp_path / "absent") == text(Path("nul\0byte")) == ""
    assert entries(tmp_path / "binary") == entries(tmp_path / "absent") == []
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    assert not is_there(tmp_path / "loop")


def test_a_process_that_holds_a_node_is_named(bench: Any, tmp_path: Path) -> None:
    bench.linux.process(41, "realsense-viewer", "/dev/null", "/dev/video30", "/dev/video31")
    bench.linux.process(42, "bash", "/dev/tty")
    found, closed = holders(["/dev/video30", "/dev/bus/usb/002/003"], tmp_path)
    assert (found, closed) == ([Holder(41, "realsense-viewer", "/dev/video30")], 0)


def test_processes_that_do_not_show_their_files_are_counted(bench: Any, tmp_path: Path) -> None:
    bench.linux.write("proc/43/fd", "stands for a folder that may not be listed")
    assert holders(["/dev/video30"], tmp_path) == ([], 1)


def test_a_real_process_that_has_a_file_open_is_found(tmp_path: Path) -> None:
    held = tmp_path / "video0"
    held.touch()
    with subprocess.Popen([sys.executable, "-c", HOLDS, held], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout
        other.stdout.readline()
        with held.open():  # ours is not told
            found, _ = holders([str(held)])
        other.communicate(b"")
    assert [(one.pid, one.node) for one in found] == [(other.pid, str(held))]
    assert found[0].name.startswith("python")
    assert holders([str(held)])[0] == []
