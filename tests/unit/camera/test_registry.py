import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from made_benches import make_bench, wall_of
from packaging.requirements import Requirement

from nlos_cam.camera import (
    SIMULATED,
    camera_to_name,
    open_camera,
    pictures_command,
    source_to_name,
)
from nlos_cam.camera.protocol import SIMULATED_SERIAL
from nlos_cam.camera.sdk import MAC_WHEEL, WHEEL, load_sdk, wheel_for
from nlos_cam.errors import CameraError, CameraNotFoundError, UnknownCameraError
from nlos_cam.recording import ReplayCamera

LATE = """
import sys
from nlos_cam.camera import open_camera
print(*sys.modules.keys() & {"pyrealsense2", "nlos_cam.camera.l515", "nlos_cam.camera.simulated_world"})
"""


@pytest.mark.parametrize("uri", ["", "webcam", "bag", "bag:", "L515", "/dev/video0", "sims"])
def test_unknown_camera_is_an_error_with_the_known_ones(uri: str) -> None:
    with pytest.raises(
        CameraNotFoundError, match=r"l515, l515:SERIAL, sim, sim:bare-wall"
    ) as raised:
        open_camera(uri)
    assert repr(uri) in str(raised.value)


def test_path_of_a_recording_chooses_the_playback(noise_bag: Path, tmp_path: Path) -> None:
    path = tmp_path / "a:b.bag"
    path.write_bytes(noise_bag.read_bytes())
    camera = open_camera(f"bag:{path}")

    assert isinstance(camera, ReplayCamera)
    assert camera.uri == f"bag:{path}"


def test_recording_is_a_camera_by_its_path_and_by_its_name(
    noise_bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert open_camera(noise_bag).uri == f"bag:{noise_bag}"
    monkeypatch.chdir(tmp_path)
    Path("sample").mkdir()  # no recording
    assert open_camera("sample").uri == "bag:sample"


def test_bench_folder_is_no_camera_and_names_its_option(tmp_path: Path) -> None:
    bench = make_bench(tmp_path / "bench")

    with pytest.raises(UnknownCameraError, match=f"--bench {bench}"):
        open_camera(str(bench))


def test_worlds_can_be_opened_and_report_progress(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for uri in SIMULATED:
        assert open_camera(uri).uri == uri
    monkeypatch.setenv("NLOS_CAM_CACHE", str(tmp_path))
    monkeypatch.setattr("nlos_cam.camera.simulated_world.WORLDS", tmp_path)
    progress: list[tuple[int, int]] = []
    open_camera("sim:bare-wall", on_progress=lambda done, total: progress.append((done, total)))

    assert progress == [(1, 1)]


def test_backends_are_imported_late() -> None:
    ended = subprocess.run(
        [sys.executable, "-c", LATE], capture_output=True, text=True, check=True, timeout=120
    )
    assert ended.stdout.strip() == ""


@pytest.mark.parametrize(
    ("machine", "words"),
    [("x86_64", f"pip install {WHEEL}"), ("aarch64", r"linux aarch64.*Python 3\.11")],
)
def test_missing_wheel_has_advice(
    monkeypatch: pytest.MonkeyPatch, machine: str, words: str
) -> None:
    assert load_sdk() is load_sdk()

    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    monkeypatch.setattr("nlos_cam.camera.sdk._preload_libusb", lambda: None)
    monkeypatch.setattr("platform.machine", lambda: machine)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("sys.version_info", (3, 11, 7, "final", 0))
    load_sdk.cache_clear()
    try:
        with pytest.raises(CameraError, match=words):
            load_sdk()
    finally:
        load_sdk.cache_clear()


@pytest.mark.parametrize("minor", [11, 12, 13])
@pytest.mark.parametrize("system", ["linux", "win32", "darwin"])
@pytest.mark.parametrize("machine", ["x86_64", "aarch64", "AMD64", "ARM64", "arm64"])
def test_wheel_is_the_one_that_the_package_requires(system: str, machine: str, minor: int) -> None:
    project = tomllib.loads(
        (Path(__file__).parents[3] / "pyproject.toml").read_text(encoding="utf-8")
    )["project"]
    there = {"python_version": f"3.{minor}", "sys_platform": system, "platform_machine": machine}
    asked = [
        f"{found.name}{found.specifier}"
        for found in map(Requirement, project["dependencies"])
        if found.name.startswith("pyrealsense2") and found.marker and found.marker.evaluate(there)
    ]
    wheel = wheel_for((3, minor), system, machine)

    assert asked == ([wheel] if wheel else [])
    assert wheel in {WHEEL, MAC_WHEEL, None}


@pytest.mark.parametrize(
    ("serial", "measured_from", "source", "pictures"),
    [
        ("f123", "l515:f123", "--camera l515:f123", "live --camera l515:f123"),
        ("f123", "bag:wall.bag", "--camera l515", "live --camera l515"),
        (SIMULATED_SERIAL, "sim:a.toml", "--camera sim:SCENE.toml", "live --camera sim:SCENE.toml"),
        (SIMULATED_SERIAL, "bag:wall.bag", "--bag F.bag", "replay F.bag"),
    ],
)
def test_next_command_names_what_the_wall_was_measured_with(
    serial: str, measured_from: str, source: str, pictures: str
) -> None:
    wall = wall_of(serial=serial, camera=measured_from).record

    assert source_to_name(wall) == source
    assert pictures_command(wall, "--bench b") == f"nlos-cam {pictures} --bench b"
    assert camera_to_name(wall) == source.removeprefix("--camera ").replace(
        "--bag F.bag", "sim:SCENE.toml"
    )
