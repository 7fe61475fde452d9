import re
from contextlib import ExitStack
from dataclasses import replace
from itertools import count as count_up
from pathlib import Path
from tempfile import TemporaryFile
from threading import Event

import numpy as np
import pytest
from fake_uncertainty import FakeUncertainty
from fake_wall import WallCamera, measured_wall, wall_frame
from made_up_moments import RIG, Recorded, full_moment
from nlos_calibration.arrays import Float32
from page_reader import read_page
from replays import BENCH, NAMES, TEXT, left_half, noise_frame, replay_noise, replay_wall, text_of
from small_frames import FrameCamera

from nlos_cam.errors import OutputExistsError, RecordingError
from nlos_cam.frames import LidarMaps
from nlos_cam.reconstruct import PeriodicPhysicsCheck, PhysicsCheckResult, Pipeline, Quality, ignore
from nlos_cam.reconstruct.consistency import COMPLETE, MapConsistency
from nlos_cam.reconstruct.network import Uncertainty
from nlos_cam.reconstruct.physics_check import NullPhysicsCheck
from nlos_cam.reconstruct.streaming import BATCH_FRAMES, MAX_BATCHES_AHEAD
from nlos_cam.replay import REPORT, replay_recording
from nlos_cam.replay.replay import DIFFERENCE, RESULT, SHEET
from nlos_cam.replay.report import replay_document
from nlos_cam.replay.results import ReplayResults
from nlos_cam.report import figure_of, png


@pytest.fixture(scope="module")
def noise(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a replay of twelve frames of noise, without an uncertainty model."""
    out = tmp_path_factory.mktemp("replay") / "out"
    replay_noise(out, 12)
    return out


def test_replay_reports_frames_folder_and_progress(tmp_path: Path) -> None:
    progress = []
    out = tmp_path / "out"
    report = replay_noise(out, 12, on_frame=lambda: progress.append(1))

    assert report.frames == 12
    assert report.out == str(out)
    assert len(progress) == 12
    assert list(tmp_path.iterdir()) == [out]


def test_replay_writes_every_frame_with_number_and_time(noise: Path) -> None:
    with np.load(noise / RESULT) as file:
        assert file["depth_m"].shape == (12, 64, 64)
        assert file["depth_m"].dtype == np.float32
        np.testing.assert_array_equal(file["frame_number"], np.arange(100, 112))
        np.testing.assert_allclose(file["timestamp_s"], 5.0 + np.arange(12) / 30)


def test_replay_writes_rig_and_place_of_the_pixels(noise: Path) -> None:
    with np.load(noise / RESULT) as file:
        assert (str(file["rig_name"]), str(file["rig_checksum"])) == (RIG.name, RIG.checksum)
        pitch_m = file["pitch_m"]
        last_m = file["origin_m"] + 63 * pitch_m
        np.testing.assert_allclose(file["origin_m"] - pitch_m / 2, [0.325, 0.125])
        np.testing.assert_allclose(last_m + pitch_m / 2, [0.575, -0.125])
        assert np.nanmin(file["depth_m"]) >= file["z_near_m"] - 1e-6
        assert np.nanmax(file["depth_m"]) <= file["z_far_m"] + 1e-6


def test_replay_without_uncertainty_and_checks_leaves_them_empty(noise: Path) -> None:
    with np.load(noise / RESULT) as file:
        assert file["verdict"].tolist() == [""] * 12
        assert np.isnan(file["uncertainty_m"]).all()
        assert file["check_score"].size == file["check_frame_number"].size == 0
    assert "physics" not in text_of(noise)


def test_replay_writes_report_sheet_and_text(noise: Path) -> None:
    assert {file.name for file in noise.iterdir()} == NAMES
    assert (noise / SHEET).read_bytes().startswith(b"\x89PNG")
    assert len(read_page((noise / REPORT).read_text()).pictures) == 1
    assert "12" in text_of(noise)
    assert "2 duplicate, 1 out of order" in text_of(noise)


def test_replay_writes_uncertainty_and_verdict_of_each_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # frames of noise are no maps of a bench, which is not the question here
    monkeypatch.setattr(MapConsistency, "examine", lambda *_: COMPLETE)
    probabilities = iter([(0.0, 0.0), (0.9, 0.0), (0.0, 0.9)])
    uncertainty_model = FakeUncertainty(lambda *_: next(probabilities), error_v=0.1)
    pipeline = Pipeline(BENCH, left_half, uncertainty_model=uncertainty_model)
    replay_noise(tmp_path / "out", 3, pipeline=pipeline)
    verdicts = ["object seen", "nothing there", "outside the trained range"]
    with np.load(tmp_path / "out" / RESULT) as file:
        assert file["verdict"].tolist() == verdicts
        assert np.isfinite(file["depth_m"]).any((1, 2)).tolist() == [True, False, True]
        assert file["uncertainty_m"].shape == (3, 64, 64)
        np.testing.assert_allclose(file["uncertainty_m"], 0.1 * 0.28 / 0.9, rtol=1e-5)


@pytest.fixture(scope="module")
def checked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Folders of two replays of the same frames, with physics checks."""
    folder = tmp_path_factory.mktemp("checked")
    for name in ("a", "b"):
        checks = PeriodicPhysicsCheck(RIG, every=9, accuracy="draft")
        replay_noise(folder / name, 12, pipeline=Pipeline(BENCH, left_half, checks=checks))
    return folder / "a", folder / "b"


@pytest.mark.slow
def test_replay_is_reproducible_to_the_bit(checked: tuple[Path, Path]) -> None:
    one, other = checked
    for file in (RESULT, SHEET):
        assert (one / file).read_bytes() == (other / file).read_bytes()
    page = (one / REPORT).read_text(encoding="utf-8")

    assert page.replace(str(one), str(other)) == (other / REPORT).read_text(encoding="utf-8")


@pytest.mark.slow
def test_replay_writes_the_scores_of_checked_frames(checked: tuple[Path, Path]) -> None:
    with np.load(checked[0] / RESULT) as result:
        assert result["check_frame_number"].tolist() == [100, 109]
        assert result["check_score"].shape == (2,)
        assert (result["check_score"] > 0.5).all()
    assert "of 2 checked frames" in text_of(checked[0])


class EmptyCheck(NullPhysicsCheck):
    """Check that compares the empty bench with every frame, at a score between both limits."""

    def offer(self, frame_number: int, maps: LidarMaps, depth_m: Float32) -> None:
        del depth_m
        residual = np.zeros_like(maps.depth_m)
        self.newest = PhysicsCheckResult(
            frame_number, residual, residual, score=0.6, seconds=0.0, has_surface=False
        )


def test_report_counts_checks_by_the_limit_that_applied(tmp_path: Path) -> None:
    model = FakeUncertainty(lambda *_: (0.9, 0.0))
    replay_noise(
        tmp_path / "out",
        3,
        pipeline=Pipeline(BENCH, left_half, uncertainty_model=model, checks=EmptyCheck()),
    )
    found = "3 of 3 checked frames at 0.84 or more (0.5 without a surface)"

    assert found in text_of(tmp_path / "out")


def test_checks_of_frames_with_one_number_are_all_counted() -> None:
    """A device that starts again repeats its numbers; one check holds for several frames."""
    with ExitStack() as files:
        results = ReplayResults(lambda: files.enter_context(TemporaryFile()), ignore)
        for _ in range(2):
            first = full_moment(0).result
            results.add(first)
            results.add(replace(full_moment(1).result, check=first.check))
        arrays = results.hidden_arrays(RIG)

    assert arrays["check_frame_number"].tolist() == [0, 0]
    assert arrays["check_score"].shape == (2,)


@pytest.mark.parametrize(("green", "state"), [(0, "doubtful"), (4, "doubtful"), (6, "good")])
def test_report_is_green_where_most_frames_are_on_the_page(
    tmp_path: Path, green: int, state: str
) -> None:
    (tmp_path / SHEET).write_bytes(png(figure_of(1.0, 1.0)))
    with ExitStack() as files:
        results = ReplayResults(lambda: files.enter_context(TemporaryFile()), ignore)
        for number in range(10):
            shown = full_moment(number).result
            cells = np.ones((64, 64), np.float32)
            quality = Quality((0.7, 0.8, 0.9), 0.9, 0.01, trusted=number < green)
            uncertainty = Uncertainty(0.0, 0.0, cells, cells, quality)
            found = replace(shown.reconstruction, uncertainty=uncertainty)
            results.add(replace(shown, reconstruction=found))
        document = replay_document(Recorded(0), BENCH, results, tmp_path, out=tmp_path)

    assert f"verdict {state}" in document.as_html()


def test_report_suggests_a_replay_of_the_same_bench(tmp_path: Path) -> None:
    replay_noise(tmp_path / "out", options=["--wall", "my wall.toml", "--average", "4"])
    command = "replay fake.bag --wall 'my wall.toml' --average 4 --stills 6 --video"

    assert command in text_of(tmp_path / "out")


@pytest.mark.parametrize(("serial", "said"), [("simulated", True), ("f0123456", False)])
def test_report_says_that_a_recording_was_simulated(
    tmp_path: Path, serial: str, said: bool
) -> None:
    camera = FrameCamera(2, make=noise_frame)
    camera.identity = {"serial": serial}
    pipeline = Pipeline(BENCH, left_half, weights="direct 89ce399040ef")
    report = replay_recording(camera, pipeline, tmp_path / "out", stop=Event())
    text = text_of(tmp_path / "out")

    assert ("nothing about a real L515" in text) == said
    assert "direct 89ce399040ef" in text
    assert report.weights == "direct 89ce399040ef"


def test_interrupted_replay_keeps_its_results(tmp_path: Path) -> None:
    stop = Event()
    done = count_up(1)
    out = tmp_path / "out"
    report = replay_noise(out, 1000, stop=stop, on_frame=lambda: next(done) == 7 and stop.set())

    assert report.frames == BATCH_FRAMES * (MAX_BATCHES_AHEAD + 2)

    with np.load(out / RESULT) as result:
        assert result["frame_number"].tolist() == list(range(100, 100 + report.frames))

    assert "Interrupted" in text_of(out)


def test_replay_stopped_before_a_frame_is_no_bad_recording(tmp_path: Path) -> None:
    stop = Event()
    stop.set()
    with pytest.raises(KeyboardInterrupt):
        replay_noise(tmp_path / "out", 9, stop=stop)

    assert list(tmp_path.iterdir()) == []


def test_replay_of_an_empty_recording_writes_nothing(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no frame"):
        replay_noise(tmp_path / "out", 0)
    assert list(tmp_path.iterdir()) == []


def test_replay_replaces_its_own_files_and_keeps_others(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep me")
    (tmp_path / TEXT).write_text("old")
    replay_noise(tmp_path)

    assert (tmp_path / "mine.txt").read_text() == "keep me"
    assert "Replay" in text_of(tmp_path)


def test_replay_into_a_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mine.txt"
    path.write_text("keep me")
    with pytest.raises(OutputExistsError, match=r"mine\.txt"):
        replay_noise(path)

    assert path.read_text() == "keep me"


DIFFERENCE_FIELDS = {
    "depth_m",
    "intensity",
    "frame_number",
    "timestamp_s",
    "rig_name",
    "rig_checksum",
    "reference_sha256",
}


def test_replay_writes_difference_maps_of_each_frame(tmp_path: Path) -> None:
    out = replay_wall(tmp_path, WallCamera(9))
    reference = measured_wall(tmp_path).reference
    with np.load(out / DIFFERENCE) as file:
        assert set(file) == DIFFERENCE_FIELDS
        assert file["depth_m"].shape == file["intensity"].shape == (9, 64, 80)
        assert file["depth_m"].dtype == file["intensity"].dtype == np.float32
        expected_m = wall_frame(5).depth_m - reference.map_depth_m
        np.testing.assert_array_equal(file["depth_m"][5], expected_m)


def test_difference_maps_name_frames_rig_and_reference(tmp_path: Path) -> None:
    out = replay_wall(tmp_path, WallCamera(9))
    record = measured_wall(tmp_path).record
    with np.load(out / DIFFERENCE) as file:
        np.testing.assert_array_equal(file["frame_number"], np.arange(9))
        np.testing.assert_allclose(file["timestamp_s"], np.arange(9) / 30)
        assert str(file["reference_sha256"]) == record.reference_sha256
        assert (str(file["rig_name"]), str(file["rig_checksum"])) == (RIG.name, RIG.checksum)

    assert DIFFERENCE in text_of(out)
    assert "20 frames" in text_of(out)


def test_replay_without_a_wall_removes_earlier_difference_maps(tmp_path: Path) -> None:
    out = replay_wall(tmp_path, WallCamera(2))
    replay_recording(WallCamera(2), Pipeline(BENCH, left_half), out, stop=Event())

    assert not (out / DIFFERENCE).exists()
    assert "difference maps" not in text_of(out)


@pytest.mark.slow
def test_replay_reports_warnings_with_their_frames(tmp_path: Path) -> None:
    texts = []
    for name in ("a", "b"):
        camera = WallCamera(100, moved=range(30, 60), celsius=80.0)
        out = replay_wall(tmp_path, camera, name)
        texts.append(text_of(out).replace(f"/{name}/", "/"))

    assert texts[0] == texts[1]

    lines = [line for line in texts[0].splitlines() if "warning" in line]
    warnings = [tuple(map(int, re.findall(r"\d+", line)[:3])) for line in lines]

    assert (100, 0, 99) in warnings
    assert any(first in range(30, 60) for _, first, _ in warnings)
