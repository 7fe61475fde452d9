"""View of a recording: its status and its one command, export."""

import re
from collections.abc import Iterator
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from fake_uncertainty import FakeUncertainty
from made_up_moments import full_moment
from replays import BENCH
from small_frames import FrameCamera, SheetNetwork

from nlos_cam.errors import NlosCamError
from nlos_cam.reconstruct.consistency import COMPLETE, MapConsistency
from nlos_cam.replay import Playback

HERE = "127.0.0.1"


def recording() -> FrameCamera:
    """Return a recording of frames 0 to 4 twice, as a device counts that restarts."""
    frames = [full_moment(number).result.frame for number in (*range(60, 65), *range(60, 65))]
    for number, frame in enumerate(frames):
        object.__setattr__(frame, "timestamp_s", 100.0 + number / 30)
    camera = FrameCamera(len(frames), make=frames.__getitem__, uri="bag:/home/someone/run.bag")
    camera.intrinsics = frames[0].intrinsics
    return camera


@pytest.fixture
def playback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Playback]:
    """A playback that has reconstructed its recording; exports go to a folder of the test."""
    monkeypatch.setattr("nlos_cam.replay.playback.open_camera", lambda _: recording())
    networks = SheetNetwork(), None
    with Playback(recording(), BENCH, networks, folder=tmp_path, host=HERE) as playback:
        playback.reconstruct(Event())
        yield playback


def exported_s(folder: Path) -> float:
    """Return the timestamp of the exported frame."""
    with np.load(next(folder.glob("*.npz"))) as arrays:
        return float(arrays["timestamp_s"])


def test_page_names_the_recording_without_its_folder(playback: Playback) -> None:
    assert playback.status()["camera"] == "bag:run.bag"


def test_export_takes_the_frame_shown_of_two_of_a_number(
    playback: Playback, tmp_path: Path
) -> None:
    playback.run("export", {"frame": 61, "time_s": 0.2})
    assert exported_s(tmp_path) == pytest.approx(100.2)


def test_export_of_the_other_frame_of_a_number_replaces_nothing(
    playback: Playback, tmp_path: Path
) -> None:
    for time_s in (1 / 30, 0.2):
        playback.run("export", {"frame": 61, "time_s": time_s})

    assert len([*tmp_path.glob("run-000061-*.npz")]) == 2


def test_export_by_number_alone_takes_the_first(playback: Playback, tmp_path: Path) -> None:
    playback.run("export", {"frame": 61})
    assert exported_s(tmp_path) == pytest.approx(100.0 + 1 / 30)


def test_export_has_the_verdict_of_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nlos_cam.replay.playback.open_camera", lambda _: recording())
    monkeypatch.setattr(MapConsistency, "examine", lambda *_: COMPLETE)
    outside = iter([0.9] * 10)  # of the page; the same frames again look like known objects
    uncertainty_model = FakeUncertainty(lambda *_: (0.0, next(outside, 0.0)))
    networks = SheetNetwork(), uncertainty_model
    with Playback(recording(), BENCH, networks, folder=tmp_path, host=HERE) as playback:
        playback.reconstruct(Event())
        playback.run("export", {"frame": 64, "time_s": 0.3})

    with np.load(next(tmp_path.glob("*.npz"))) as arrays:
        assert str(arrays["verdict"]) == "outside the trained range"


def test_export_reconstructs_the_frames_before_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nlos_cam.replay.playback.open_camera", lambda _: recording())
    monkeypatch.setattr("nlos_cam.replay.playback.FRAMES_BEFORE", 3)
    network = SheetNetwork()
    with Playback(recording(), BENCH, (network, None), folder=tmp_path, host=HERE) as playback:
        playback.run("export", {"frame": 62})
        early = len(network.given)
        playback.run("export", {"frame": 64})

    assert early == 3
    assert len(network.given) == 3 + 4


@pytest.mark.parametrize(
    "arguments", [{"frame": 99}, {"frame": 61, "time_s": 7}, {"frame": 61, "time_s": "now"}]
)
def test_export_of_no_frame_is_refused(
    playback: Playback, tmp_path: Path, arguments: dict[str, object]
) -> None:
    with pytest.raises(NlosCamError, match=r"frame"):
        playback.run("export", arguments)
    assert list(tmp_path.iterdir()) == []


def test_second_export_at_a_time_is_refused(playback: Playback) -> None:
    with playback._exporting, pytest.raises(NlosCamError, match="another frame is being exported"):
        playback.run("export", {"frame": 61})


def test_export_ends_with_the_view(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.replay.playback.open_camera", lambda _: recording())
    networks = SheetNetwork(), None
    with Playback(recording(), BENCH, networks, folder=tmp_path, host=HERE) as playback:
        pass
    with pytest.raises(NlosCamError, match="the view ends"):
        playback.run("export", {"frame": 61})


def test_export_into_a_lost_folder_says_why(playback: Playback, tmp_path: Path) -> None:
    tmp_path.rmdir()
    with pytest.raises(NlosCamError, match=re.escape(str(tmp_path))):
        playback.run("export", {"frame": 61})
