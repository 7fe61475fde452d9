import json
import re
import subprocess
import sys
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from fake_doubter import FakeDoubter
from fake_wall import RIG, SMALL, WallCamera, measured_wall, wall_frame
from page_reader import read_page
from small_frames import FrameCamera

from nlos_cam.errors import OutputExistsError, RecordingError
from nlos_cam.frames import Frame
from nlos_cam.live.loop import BATCH_FRAMES, MAX_BATCHES_AHEAD
from nlos_cam.live.replay import DIFFERENCE, REPORT, RESULT, SHEET, ReplayReport, replay_recording
from nlos_cam.reconstruct import CalibratedRig, PeriodicPhysicsCheck, Pipeline

TEXT = "report.md"


def network(depth_m: np.ndarray, *_: np.ndarray) -> np.ndarray:
    """Return the left half of the depth map as the image of the hidden object."""
    return np.nan_to_num(depth_m[:, :, :64])


def noise_frame(number: int) -> Frame:
    depth_m = np.random.default_rng(number).uniform(0.1, 1.0, (64, 80)).astype(np.float32)
    return Frame(depth_m, np.full((64, 80), 9, np.uint8), depth_m, 5.0 + number / 30, 100 + number, SMALL)


def replayed(out: Path, count: int = 2, **options: Any) -> ReplayReport:
    """Replay `count` frames of noise without a wall; the camera counts duplicates."""
    camera = FrameCamera(count, make=noise_frame)
    pipeline = options.pop("pipeline", Pipeline(CalibratedRig(RIG), network))
    camera.counts.update(duplicate=2, out_of_order=1)
    return replay_recording(camera, pipeline, out, **{"stop": Event(), **options})


def replayed_wall(tmp_path: Path, camera: WallCamera, out: str = "out") -> Path:
    pipeline = Pipeline(CalibratedRig(RIG, measured_wall(tmp_path)), network)
    replay_recording(camera, pipeline, tmp_path / out, stop=Event())
    return tmp_path / out


def test_replay_writes_every_frame_with_number_time_and_place(tmp_path: Path) -> None:
    counted, out = [], tmp_path / "out"
    report = replayed(out, 12, on_frame=lambda: counted.append(1))
    assert (report.frames, report.out, len(counted)) == (12, str(out), 12)
    with np.load(out / RESULT) as file:
        assert file["depth_m"].shape == (12, 64, 64)
        assert file["depth_m"].dtype == np.float32
        np.testing.assert_array_equal(file["frame_number"], np.arange(100, 112))
        np.testing.assert_allclose(file["timestamp_s"], 5.0 + np.arange(12) / 30)
        assert (str(file["rig_name"]), str(file["rig_checksum"])) == (RIG.name, RIG.checksum)
        corner_m = file["origin_m"] + file["pitch_m"] * 63
        np.testing.assert_allclose(file["origin_m"] - file["pitch_m"] / 2, [0.325, 0.125])
        np.testing.assert_allclose(corner_m + file["pitch_m"] / 2, [0.575, -0.125])
        assert np.nanmin(file["depth_m"]) >= file["z_near_m"] - 1e-6
        assert np.nanmax(file["depth_m"]) <= file["z_far_m"] + 1e-6
        assert file["verdict"].tolist() == [""] * 12
        assert np.isnan(file["uncertainty_m"]).all()
        assert file["check_score"].size == file["check_frame_number"].size == 0
    assert sorted(file.name for file in tmp_path.iterdir()) == ["out"]
    assert sorted(file.name for file in out.iterdir()) == sorted([RESULT, SHEET, REPORT, TEXT])
    assert (out / SHEET).read_bytes().startswith(b"\x89PNG")
    assert len(read_page((out / REPORT).read_text()).pictures) == 1
    text = (out / TEXT).read_text()
    assert "12" in text
    assert "2 duplicate, 1 out of order" in text
    assert "physics" not in text


def test_replay_writes_uncertainty_and_verdict_of_each_frame(tmp_path: Path) -> None:
    says = iter([(0.0, 0.0), (0.9, 0.0), (0.0, 0.9)])
    doubter = FakeDoubter(lambda *_: next(says), error_v=0.1)
    replayed(tmp_path / "out", 3, pipeline=Pipeline(CalibratedRig(RIG), network, uncertainty_model=doubter))
    with np.load(tmp_path / "out" / RESULT) as file:
        assert file["verdict"].tolist() == ["object seen", "nothing there", "outside the trained range"]
        assert np.isfinite(file["depth_m"]).any((1, 2)).tolist() == [True, False, True]
        assert file["uncertainty_m"].shape == (3, 64, 64)
        np.testing.assert_allclose(file["uncertainty_m"], 0.1 * 0.28 / 0.9, rtol=1e-5)


@pytest.mark.slow
def test_replay_with_checks_is_reproducible_to_the_bit(tmp_path: Path) -> None:
    for name in ("a", "b"):
        checks = PeriodicPhysicsCheck(RIG, every=9, accuracy="draft")
        replayed(tmp_path / name, 12, pipeline=Pipeline(CalibratedRig(RIG), network, checks=checks))
    for file in (RESULT, SHEET):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    one, other = ((tmp_path / name / REPORT).read_text(encoding="utf-8") for name in ("a", "b"))
    assert one.replace(str(tmp_path / "a"), str(tmp_path / "b")) == other
    with np.load(tmp_path / "a" / RESULT) as result:
        assert result["check_frame_number"].tolist() == [100, 109]
        assert result["check_score"].shape == (2,)
        assert (result["check_score"] > 0.5).all()
    assert "of 2 checked frames" in (tmp_path / "a" / TEXT).read_text()


def test_interrupted_replay_keeps_its_results(tmp_path: Path) -> None:
    stop, done = Event(), []

    def on_frame() -> None:
        done.append(1)
        if len(done) == 7:
            stop.set()

    report = replayed(tmp_path / "out", 1000, stop=stop, on_frame=on_frame)
    assert report.frames == BATCH_FRAMES * (MAX_BATCHES_AHEAD + 2)
    with np.load(tmp_path / "out" / RESULT) as result:
        assert result["frame_number"].tolist() == list(range(100, 100 + report.frames))
    assert "Interrupted" in (tmp_path / "out" / TEXT).read_text()


def test_replay_refuses_empty_recordings_and_keeps_other_files(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no frame"):
        replayed(tmp_path / "out", 0)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "mine.txt").write_text("keep me")
    (tmp_path / REPORT).write_text("old")
    replayed(tmp_path)
    assert (tmp_path / "mine.txt").read_text() == "keep me"
    assert "Replay" in (tmp_path / TEXT).read_text()
    with pytest.raises(OutputExistsError, match=r"mine\.txt"):
        replayed(tmp_path / "mine.txt")
    assert (tmp_path / "mine.txt").read_text() == "keep me"


def test_replay_writes_difference_maps_and_their_reference(tmp_path: Path) -> None:
    out = replayed_wall(tmp_path, WallCamera(9))
    wall = measured_wall(tmp_path)
    assert wall.reference is not None
    with np.load(out / DIFFERENCE) as file:
        assert set(file) == {
            *("depth_m", "intensity", "frame_number", "timestamp_s"),
            *("rig_name", "rig_checksum", "reference_sha256"),
        }
        assert file["depth_m"].shape == file["intensity"].shape == (9, 64, 80)
        assert file["depth_m"].dtype == file["intensity"].dtype == np.float32
        np.testing.assert_array_equal(file["frame_number"], np.arange(9))
        np.testing.assert_allclose(file["timestamp_s"], np.arange(9) / 30)
        assert str(file["reference_sha256"]) == wall.record.reference_sha256
        assert (str(file["rig_name"]), str(file["rig_checksum"])) == (RIG.name, RIG.checksum)
        np.testing.assert_array_equal(file["depth_m"][5], wall_frame(5).depth_m - wall.reference.map_depth_m)
    text = (out / TEXT).read_text()
    assert DIFFERENCE in text
    assert "20 frames" in text
    replay_recording(WallCamera(2), Pipeline(CalibratedRig(RIG), network), out, stop=Event())
    assert not (out / DIFFERENCE).exists(), "of an earlier replay"
    assert "difference maps" not in (out / TEXT).read_text()


@pytest.mark.slow
def test_replay_reports_warnings_with_their_frames(tmp_path: Path) -> None:
    texts = []
    for out in ("a", "b"):
        camera = WallCamera(100, moved=range(30, 60), celsius=80.0)
        texts.append((replayed_wall(tmp_path, camera, out) / TEXT).read_text().replace(f"/{out}/", "/"))
    assert texts[0] == texts[1]
    warnings = [tuple(map(int, re.findall(r"\d+", line)[:3])) for line in texts[0].splitlines() if "warning" in line]
    assert (100, 0, 99) in warnings
    assert any(first in range(30, 60) for _, first, _ in warnings)


WITHOUT_SDK = """
import sys
sys.modules["pyrealsense2"] = None
from nlos_cam.cli.main import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.slow
def test_replay_command_needs_no_sdk(noise_bag: Path, tmp_path: Path) -> None:
    run = [sys.executable, "-c", WITHOUT_SDK, "replay", str(noise_bag), "--out", str(tmp_path / "out"), "--json"]
    ended = subprocess.run(run, capture_output=True, text=True, timeout=250)  # noqa: PLW1510  the code is what is tested
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout.splitlines()[-1])["frames"] == 20
