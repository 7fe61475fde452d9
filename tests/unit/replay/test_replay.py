import re
from dataclasses import replace
from itertools import count as count_up
from pathlib import Path
from threading import Event
from typing import Any

import cv2
import numpy as np
import pytest
from fake_doubter import FakeDoubter
from fake_wall import SMALL, WallCamera, measured_wall, wall_frame
from made_up_moments import RIG, Recorded, full_moment
from matplotlib.figure import Figure
from page_reader import read_page
from small_frames import NOTHING, FrameCamera, SheetNetwork
from view_streams import saved_moments

from nlos_cam.errors import OutputExistsError, RecordingError
from nlos_cam.frames import Frame, LidarMaps, maps_from_frame
from nlos_cam.objects import mesh_from_depth, object_box
from nlos_cam.reconstruct import CalibratedRig, FrameResult, PeriodicPhysicsCheck, Pipeline, Verdict
from nlos_cam.reconstruct.streaming import BATCH_FRAMES, MAX_BATCHES_AHEAD
from nlos_cam.replay import OBJECT_FORMATS, VIDEO, ReplayMedia, export_objects
from nlos_cam.replay.media import VIEW, FrameSampler, draw_contact_sheet
from nlos_cam.replay.replay import DIFFERENCE, REPORT, RESULT, SHEET, ReplayReport, replay_recording
from nlos_cam.view import Moment

TEXT = "report.md"
NAMES = {REPORT, RESULT, SHEET, TEXT}
BENCH = CalibratedRig(RIG)
BOX = object_box(RIG)
FULL = full_moment(0)
STEP = FULL.result


def left_half(depth_m: np.ndarray, *_: np.ndarray) -> np.ndarray:
    """Return the left half of the depth map as the image of the hidden object."""
    return np.nan_to_num(depth_m[:, :, :64])


def noise_frame(number: int) -> Frame:
    depth_m = np.random.default_rng(number).uniform(0.1, 1.0, (64, 80)).astype(np.float32)
    return Frame(
        depth_m, np.full((64, 80), 9, np.uint8), depth_m, 5.0 + number / 30, 100 + number, SMALL
    )


def replayed_noise(out: Path, count: int = 2, **options: Any) -> ReplayReport:
    """Replay `count` frames of noise without a wall; the camera counts duplicates."""
    camera = FrameCamera(count, make=noise_frame)
    camera.counts.update(duplicate=2, out_of_order=1)
    return replay_recording(
        camera, out=out, **{"pipeline": Pipeline(BENCH, left_half), "stop": Event(), **options}
    )


def replayed_wall(tmp_path: Path, camera: WallCamera, out: str = "out") -> Path:
    pipeline = Pipeline(CalibratedRig(RIG, measured_wall(tmp_path)), left_half)
    replay_recording(camera, pipeline, tmp_path / out, stop=Event())
    return tmp_path / out


def test_replay_writes_every_frame_with_number_time_and_place(tmp_path: Path) -> None:
    counted = []
    out = tmp_path / "out"
    report = replayed_noise(out, 12, on_frame=lambda: counted.append(1))
    assert (report.frames, report.out, len(counted)) == (12, str(out), 12)
    with np.load(out / RESULT) as file:
        assert (file["depth_m"].shape, file["depth_m"].dtype) == ((12, 64, 64), np.float32)
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
    assert list(tmp_path.iterdir()) == [out]
    assert {file.name for file in out.iterdir()} == NAMES
    assert (out / SHEET).read_bytes().startswith(b"\x89PNG")
    assert len(read_page((out / REPORT).read_text()).pictures) == 1
    text = (out / TEXT).read_text()
    assert "12" in text
    assert "2 duplicate, 1 out of order" in text
    assert "physics" not in text


def test_replay_writes_uncertainty_and_verdict_of_each_frame(tmp_path: Path) -> None:
    says = iter([(0.0, 0.0), (0.9, 0.0), (0.0, 0.9)])
    doubter = FakeDoubter(lambda *_: next(says), error_v=0.1)
    replayed_noise(
        tmp_path / "out", 3, pipeline=Pipeline(BENCH, left_half, uncertainty_model=doubter)
    )
    with np.load(tmp_path / "out" / RESULT) as file:
        assert file["verdict"].tolist() == [
            "object seen",
            "nothing there",
            "outside the trained range",
        ]
        assert np.isfinite(file["depth_m"]).any((1, 2)).tolist() == [True, False, True]
        assert file["uncertainty_m"].shape == (3, 64, 64)
        np.testing.assert_allclose(file["uncertainty_m"], 0.1 * 0.28 / 0.9, rtol=1e-5)


@pytest.mark.slow
def test_replay_with_checks_is_reproducible_to_the_bit(tmp_path: Path) -> None:
    for name in ("a", "b"):
        checks = PeriodicPhysicsCheck(RIG, every=9, accuracy="draft")
        replayed_noise(tmp_path / name, 12, pipeline=Pipeline(BENCH, left_half, checks=checks))
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
    stop = Event()
    done = count_up(1)
    report = replayed_noise(
        tmp_path / "out", 1000, stop=stop, on_frame=lambda: next(done) == 7 and stop.set()
    )
    assert report.frames == BATCH_FRAMES * (MAX_BATCHES_AHEAD + 2)
    with np.load(tmp_path / "out" / RESULT) as result:
        assert result["frame_number"].tolist() == list(range(100, 100 + report.frames))
    assert "Interrupted" in (tmp_path / "out" / TEXT).read_text()


def test_replay_refuses_empty_recordings_and_keeps_other_files(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no frame"):
        replayed_noise(tmp_path / "out", 0)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "mine.txt").write_text("keep me")
    (tmp_path / REPORT).write_text("old")
    replayed_noise(tmp_path)
    assert (tmp_path / "mine.txt").read_text() == "keep me"
    assert "Replay" in (tmp_path / TEXT).read_text()
    with pytest.raises(OutputExistsError, match=r"mine\.txt"):
        replayed_noise(tmp_path / "mine.txt")
    assert (tmp_path / "mine.txt").read_text() == "keep me"


def test_replay_writes_difference_maps_and_their_reference(tmp_path: Path) -> None:
    out = replayed_wall(tmp_path, WallCamera(9))
    wall = measured_wall(tmp_path)
    assert wall.reference is not None
    with np.load(out / DIFFERENCE) as file:
        names = "depth_m intensity frame_number timestamp_s rig_name rig_checksum reference_sha256"
        assert set(file) == set(names.split())
        assert file["depth_m"].shape == file["intensity"].shape == (9, 64, 80)
        assert file["depth_m"].dtype == file["intensity"].dtype == np.float32
        np.testing.assert_array_equal(file["frame_number"], np.arange(9))
        np.testing.assert_allclose(file["timestamp_s"], np.arange(9) / 30)
        assert str(file["reference_sha256"]) == wall.record.reference_sha256
        assert (str(file["rig_name"]), str(file["rig_checksum"])) == (RIG.name, RIG.checksum)
        np.testing.assert_array_equal(
            file["depth_m"][5], wall_frame(5).depth_m - wall.reference.map_depth_m
        )
    text = (out / TEXT).read_text()
    assert DIFFERENCE in text
    assert "20 frames" in text
    replay_recording(WallCamera(2), Pipeline(BENCH, left_half), out, stop=Event())
    assert not (out / DIFFERENCE).exists(), "of an earlier replay"
    assert "difference maps" not in (out / TEXT).read_text()


@pytest.mark.slow
def test_replay_reports_warnings_with_their_frames(tmp_path: Path) -> None:
    texts = []
    for out in ("a", "b"):
        camera = WallCamera(100, moved=range(30, 60), celsius=80.0)
        texts.append(
            (replayed_wall(tmp_path, camera, out) / TEXT).read_text().replace(f"/{out}/", "/")
        )
    assert texts[0] == texts[1]
    warnings = [
        tuple(map(int, re.findall(r"\d+", line)[:3]))
        for line in texts[0].splitlines()
        if "warning" in line
    ]
    assert (100, 0, 99) in warnings
    assert any(first in range(30, 60) for _, first, _ in warnings)


def replayed(out: Path, count: int, **asked: Any) -> set[str]:
    media = ReplayMedia(BENCH, **asked)
    pipeline = Pipeline(BENCH, SheetNetwork())
    replay_recording(Recorded(count), pipeline, out, stop=Event(), media=media)
    return {file.name for file in out.iterdir()}


def test_replay_makes_view_video_and_stills_as_asked(tmp_path: Path) -> None:
    assert replayed(tmp_path / "plain", 30) == NAMES
    made = replayed(tmp_path / "out", 30, view=True, stills=3, video=True) - NAMES
    assert {VIEW, VIDEO} <= made
    numbers = sorted(int(name[6:12]) for name in made - {VIEW, VIDEO})
    assert len(numbers) == 3
    assert numbers[0] == 0
    assert numbers[-1] >= 20
    video = cv2.VideoCapture(str(tmp_path / "out" / VIDEO))
    frames = 0
    while video.read()[0]:
        frames += 1
    assert frames == 15
    assert [each["frame"] for each in saved_moments(tmp_path / "out" / VIEW)] == list(
        range(0, 30, 3)
    )
    assert (tmp_path / "plain" / RESULT).read_bytes() == (tmp_path / "out" / RESULT).read_bytes()
    assert VIDEO in (tmp_path / "out" / REPORT).read_text(encoding="utf-8")


@pytest.mark.slow
def test_replay_removes_media_of_an_earlier_one_and_nothing_else(tmp_path: Path) -> None:
    out = tmp_path / "out"
    replayed(out, 12, view=True, stills=4, objects=["csv"])
    assert (out / "object" / "000003.csv").is_file()
    (out / "mine.png").write_text("keep me")
    assert replayed(out, 3, stills=1) == NAMES | {"mine.png", "still-000000.png"}


def test_media_of_a_failed_replay_have_no_stills(tmp_path: Path) -> None:
    media = ReplayMedia(BENCH, view=True, stills=2)
    with pytest.raises(ZeroDivisionError), media.into(tmp_path):
        media.add(STEP, 1 / 0)  # type: ignore[arg-type]
    assert {file.name for file in tmp_path.iterdir()} == {VIEW}


def test_moment_of_step_is_complete_and_at_its_own_time() -> None:
    stages_s = {"wait": 9.0, "maps": 0.001, "network": 0.01}
    result = replace(STEP, published_s=77.0, stages_s=stages_s)
    shown = Moment.recorded(result, FULL.celsius)
    assert shown.result is result
    assert shown.time_s == STEP.timestamp_s
    assert shown.latency_s == pytest.approx(0.011)
    assert shown.celsius == FULL.celsius


@pytest.mark.parametrize("count", [1, 5, 6, 7, 100, 1001])
def test_samples_are_few_ordered_and_spread(count: int) -> None:
    samples = FrameSampler(6)
    for number in range(count):
        samples.add(number)  # type: ignore[arg-type]
    chosen = samples.results()
    assert len(chosen) == min(count, 6)
    assert chosen[0] == 0
    assert chosen == sorted(set(chosen))
    assert chosen[-1] >= 0.7 * (count - 1)


def wall_step(number: int, difference: LidarMaps | None = None) -> FrameResult:
    frame = wall_frame(number)
    return FrameResult(frame, maps_from_frame(frame), NOTHING, 0.0, {}, difference)


def test_sheet_has_a_row_per_map_and_a_column_per_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved: list[Any] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: saved.append(figure))

    def titles(steps: list[FrameResult]) -> list[str]:
        draw_contact_sheet(tmp_path / "sheet.png", steps)
        return [
            title for axis in saved[-1].axes if (title := axis.get_ylabel() or axis.get_title())
        ]

    plain = ["lidar depth (m)", "infrared (counts)", "hidden depth (m)"]
    assert titles([wall_step(3), wall_step(9)]) == ["frame 3", "frame 9", *plain]
    differing = [wall_step(number, maps_from_frame(wall_frame(number))) for number in (3, 9)]
    assert titles(differing)[2:] == [*plain[:2], "difference (mm)", plain[2]]
    made = replace(NOTHING, uncertainty_m=np.full((64, 64), 0.01, np.float32))
    doubted = titles([replace(wall_step(3), verdict=Verdict.OUTSIDE, reconstruction=made)])
    assert doubted[0] == "frame 3\noutside the trained range"
    assert doubted[-1] == "uncertainty (mm)"


@pytest.fixture(scope="module")
def replay(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a replay of seven frames, with every third object in all formats."""
    replayed(out := tmp_path_factory.mktemp("replay"), 7, objects=OBJECT_FORMATS, every=3)
    return out


def test_export_of_result_equals_files_of_replay(replay: Path, tmp_path: Path) -> None:
    made = replay / "object"
    exported = tmp_path / "exported"
    assert export_objects(replay / RESULT, exported, OBJECT_FORMATS, 3, stop=Event()) == 3
    names = [sorted(file.name for file in folder.iterdir()) for folder in (made, exported)]
    assert names[0] == names[1]
    assert len(names[0]) == 3 * len(OBJECT_FORMATS)
    vertices = [np.load(folder / "000003.npz")["vertices_m"] for folder in (made, exported)]
    np.testing.assert_allclose(*vertices, atol=1e-9)
    depth_m = np.load(replay / RESULT)["depth_m"][3]
    np.testing.assert_array_equal(vertices[0], mesh_from_depth(depth_m, BOX).vertices_m)


def test_export_stops_when_asked_and_skips_frames_without_surface(
    replay: Path, tmp_path: Path
) -> None:
    (stop := Event()).set()
    assert export_objects(replay / RESULT, tmp_path / "a", ["ply"], stop=stop) == 0
    with np.load(replay / RESULT) as file:
        np.savez(
            tmp_path / "empty.npz", **{**file, "depth_m": np.full_like(file["depth_m"], np.nan)}
        )
    assert export_objects(tmp_path / "empty.npz", tmp_path / "b", ["ply"], stop=Event()) == 0


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut", b"text"])
def test_export_refuses_other_files(tmp_path: Path, content: bytes) -> None:
    (path := tmp_path / "reconstruction.npz").write_bytes(content)
    with pytest.raises(RecordingError, match="replay"):
        export_objects(path, tmp_path / "out", ["ply"], stop=Event())
    np.savez(path, depth_m=np.zeros(3))
    with pytest.raises(RecordingError, match="replay"):
        export_objects(path, tmp_path / "out", ["ply"], stop=Event())
    assert [file.name for file in tmp_path.iterdir()] == ["reconstruction.npz"]


BAD = {"pitch_m": [0.1], "z_far_m": 0.0, "frame_number": [1, 2], "z_near_m": [[]]}


@pytest.mark.parametrize(("name", "value"), [("depth_m", "text"), ("depth_m", 1.0), *BAD.items()])
def test_export_refuses_arrays_that_contradict(
    replay: Path, tmp_path: Path, name: str, value: object
) -> None:
    with np.load(replay / RESULT) as file:
        np.savez(tmp_path / "bad.npz", **{**file, name: np.array(value)})
    with pytest.raises(RecordingError, match="not the reconstruction"):
        export_objects(tmp_path / "bad.npz", tmp_path / "out", ["ply"], stop=Event())
