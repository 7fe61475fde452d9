import json
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from threading import Event
from typing import Self

import numpy as np
import pytest
from fake_doubter import FakeDoubter
from fake_wall import WallCamera, measured_wall, wall_frame
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.rig import load_rig

from nlos_cam.errors import OutputExistsError, RecordingError
from nlos_cam.frames import Frame
from nlos_cam.live.loop import FRAMES_TOGETHER, MAX_BATCHES_AHEAD
from nlos_cam.live.replay import DIFFERENCE, REPORT, RESULT, SHEET, replay_recording
from nlos_cam.reconstruct.bench import CalibratedRig
from nlos_cam.reconstruct.pipeline import Pipeline

RIG = load_rig("paper-rig")
SMALL = Intrinsics(80, 64, 57.0, 61.0, 39.5, 31.5)


def network(depth_m: np.ndarray, *_: np.ndarray) -> np.ndarray:
    """Shows the depth map's left half as if it were the hidden object."""
    return np.nan_to_num(depth_m[:, :, :64])


class Recorded:
    """A recording of so many frames."""

    uri, intrinsics, incomplete, dropped = "bag:fake.bag", SMALL, 0, 0

    def __init__(self, count: int) -> None:
        self.counts = Counter(duplicate=2, out_of_order=1)
        self._count = count

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def telemetry(self, ending: str = "") -> Mapping[str, float]:
        del ending
        return {}

    def __iter__(self) -> Iterator[Frame]:
        for number in range(self._count):
            depth_m = np.random.default_rng(number).uniform(0.1, 1.0, (64, 80)).astype(np.float32)
            yield Frame(depth_m, np.full((64, 80), 9, np.uint8), depth_m, 5.0 + number / 30, 100 + number, SMALL)


def test_every_frame_is_written_with_its_number_time_and_place(tmp_path: Path) -> None:
    counted = []
    out = tmp_path / "out"
    report = replay_recording(
        Recorded(40), Pipeline(CalibratedRig(RIG), network), out, stop=Event(), on_frame=lambda: counted.append(1)
    )
    assert (report.frames, report.out, len(counted)) == (40, str(out), 40)
    with np.load(out / RESULT) as file:
        assert file["depth_m"].shape == (40, 64, 64)
        assert file["depth_m"].dtype == np.float32
        np.testing.assert_array_equal(file["frame_number"], np.arange(100, 140))
        np.testing.assert_allclose(file["timestamp_s"], 5.0 + np.arange(40) / 30)
        assert (str(file["rig_name"]), str(file["rig_checksum"])) == (RIG.name, RIG.checksum)
        corner_m = file["origin_m"] + file["pitch_m"] * 63
        np.testing.assert_allclose(file["origin_m"] - file["pitch_m"] / 2, [0.325, 0.125])
        np.testing.assert_allclose(corner_m + file["pitch_m"] / 2, [0.575, -0.125])
        assert np.nanmin(file["depth_m"]) >= file["z_near_m"] - 1e-6
        assert np.nanmax(file["depth_m"]) <= file["z_far_m"] + 1e-6
    assert sorted(file.name for file in tmp_path.iterdir()) == ["out"]
    assert sorted(file.name for file in out.iterdir()) == sorted([RESULT, SHEET, REPORT])
    assert (out / SHEET).read_bytes().startswith(b"\x89PNG")
    assert "frames: 40" in (out / REPORT).read_text()
    assert "seen: 2 duplicate, 1 out of order" in (out / REPORT).read_text()


def test_each_frames_uncertainty_and_verdict_are_written_beside_its_depth(tmp_path: Path) -> None:
    says = iter([(0.0, 0.0), (0.9, 0.0), (0.0, 0.9)])
    doubter = FakeDoubter(lambda *_: next(says), error_v=0.1)
    replay_recording(
        Recorded(3), Pipeline(CalibratedRig(RIG), network, doubter=doubter), tmp_path / "out", stop=Event()
    )
    with np.load(tmp_path / "out" / RESULT) as file:
        assert file["verdict"].tolist() == ["object seen", "nothing there", "outside the trained range"]
        assert np.isfinite(file["depth_m"]).any((1, 2)).tolist() == [True, False, True]
        assert file["uncertainty_m"].shape == (3, 64, 64)
        np.testing.assert_allclose(file["uncertainty_m"], 0.1 * 0.28 / 0.9, rtol=1e-5)


def test_without_a_doubt_network_verdicts_are_empty_and_uncertainties_are_not_a_number(tmp_path: Path) -> None:
    replay_recording(Recorded(2), Pipeline(CalibratedRig(RIG), network), tmp_path / "out", stop=Event())
    with np.load(tmp_path / "out" / RESULT) as file:
        assert file["verdict"].tolist() == ["", ""]
        assert np.isnan(file["uncertainty_m"]).all()


def test_two_replays_are_equal_to_the_bit(tmp_path: Path) -> None:
    for name in ("a", "b"):
        replay_recording(Recorded(12), Pipeline(CalibratedRig(RIG), network), tmp_path / name, stop=Event())
    for file in (RESULT, SHEET, REPORT):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_an_interrupted_replay_keeps_what_is_done_and_says_so(tmp_path: Path) -> None:
    stop, done = Event(), []

    def on_frame() -> None:
        done.append(1)
        if len(done) == 7:
            stop.set()

    report = replay_recording(
        Recorded(1000), Pipeline(CalibratedRig(RIG), network), tmp_path / "out", stop=stop, on_frame=on_frame
    )
    assert report.frames == FRAMES_TOGETHER * (MAX_BATCHES_AHEAD + 2)
    with np.load(tmp_path / "out" / RESULT) as result:
        assert result["frame_number"].tolist() == list(range(100, 100 + report.frames))
    assert "Interrupted" in (tmp_path / "out" / REPORT).read_text()


def test_a_recording_without_frames_leaves_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no frame"):
        replay_recording(Recorded(0), Pipeline(CalibratedRig(RIG), network), tmp_path / "out", stop=Event())
    assert list(tmp_path.iterdir()) == []


def test_only_files_of_the_same_name_are_replaced(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep me")
    (tmp_path / REPORT).write_text("old")
    replay_recording(Recorded(2), Pipeline(CalibratedRig(RIG), network), tmp_path, stop=Event())
    assert (tmp_path / "mine.txt").read_text() == "keep me"
    assert "Replay" in (tmp_path / REPORT).read_text()


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    with pytest.raises(OutputExistsError, match="is a file"):
        replay_recording(Recorded(2), Pipeline(CalibratedRig(RIG), network), tmp_path / "out", stop=Event())
    assert (tmp_path / "out").read_text() == "mine"


def replay_wall(tmp_path: Path, camera: WallCamera, out: str = "out") -> Path:
    method = Pipeline(CalibratedRig(RIG, measured_wall(tmp_path)), network)
    replay_recording(camera, method, tmp_path / out, stop=Event())
    return tmp_path / out


def test_difference_maps_are_written_with_what_they_were_formed_from(tmp_path: Path) -> None:
    out = replay_wall(tmp_path, WallCamera(9))
    reference = measured_wall(tmp_path)
    assert reference.reference is not None
    with np.load(out / DIFFERENCE) as file:
        assert set(file) == {
            *("depth_m", "intensity", "frame_number", "timestamp_s"),
            *("rig_name", "rig_checksum", "reference_sha256"),
        }
        assert file["depth_m"].shape == file["intensity"].shape == (9, 64, 80)
        assert file["depth_m"].dtype == file["intensity"].dtype == np.float32
        np.testing.assert_array_equal(file["frame_number"], np.arange(9))
        np.testing.assert_allclose(file["timestamp_s"], np.arange(9) / 30)
        assert str(file["reference_sha256"]) == reference.record.reference_sha256
        assert (str(file["rig_name"]), str(file["rig_checksum"])) == (RIG.name, RIG.checksum)
        expected_m = wall_frame(5).depth_m - reference.reference.map_depth_m
        np.testing.assert_array_equal(file["depth_m"][5], expected_m)
    assert f"mean of 20 frames: in `{DIFFERENCE}`" in (out / REPORT).read_text()


def test_a_replay_without_a_reference_leaves_no_difference_maps_of_another(tmp_path: Path) -> None:
    out = replay_wall(tmp_path, WallCamera(2))
    replay_recording(WallCamera(2), Pipeline(CalibratedRig(RIG), network), out, stop=Event())
    assert not (out / DIFFERENCE).exists()
    assert "difference" not in (out / REPORT).read_text()


def test_a_report_tells_warnings_with_their_frames_the_same_each_time(tmp_path: Path) -> None:
    texts = []
    for out in ("a", "b"):
        camera = WallCamera(150, moved=range(30, 80), celsius=80.0)
        texts.append((replay_wall(tmp_path, camera, out) / REPORT).read_text())
    assert texts[0] == texts[1]
    warnings = re.findall(r"- warning, (\d+) frames from (\d+) to (\d+): ", texts[0])
    assert ("150", "0", "149") in warnings
    assert any(int(first) in range(30, 80) for _, first, _ in warnings)


WITHOUT_SDK = """
import sys
sys.modules["pyrealsense2"] = None
from nlos_cam.cli.main import main
sys.exit(main(sys.argv[1:]))
"""


def test_replay_needs_no_sdk(noise_bag: Path, tmp_path: Path) -> None:
    run = [sys.executable, "-c", WITHOUT_SDK, "replay", str(noise_bag), "--out", str(tmp_path / "out"), "--json"]
    ended = subprocess.run(run, capture_output=True, text=True, timeout=250)  # noqa: PLW1510  the code is what is tested
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout.splitlines()[-1])["frames"] == 20
