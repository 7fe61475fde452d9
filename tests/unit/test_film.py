from pathlib import Path

import cv2
import numpy as np
import pytest
from made_up_moments import RIG, full_moment

from nlos_cam.errors import NlosCamError
from nlos_cam.view.video import FRAMES_PER_S, HEIGHT, WIDTH, Still, VideoFile


def read(path: Path) -> list[np.ndarray]:
    video, frames = cv2.VideoCapture(str(path)), []
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(FRAMES_PER_S)
    while (got := video.read())[0]:
        frames.append(got[1][..., ::-1])
    return frames


def test_every_second_frame_is_filmed_and_can_be_read_back(tmp_path: Path) -> None:
    path = tmp_path / "film.webm"
    with VideoFile(path, RIG) as film:
        for number in range(20):
            film.show(full_moment(number))
    frames = read(path)
    assert len(frames) == film.filmed == 10
    assert {frame.shape for frame in frames} == {(HEIGHT, WIDTH, 3)}
    expected = Still(RIG, full_moment(0)).rgb(full_moment(0)).astype(int)
    assert np.abs(frames[0] - expected).mean() < 6.0
    assert (np.abs(frames[0].astype(int) - frames[-1]).max(axis=-1) > 60).mean() > 0.005, "it moves"


def test_a_film_is_what_browsers_play(tmp_path: Path) -> None:
    with VideoFile(tmp_path / "film.webm", RIG) as film:
        film.show(full_moment(0))
    content = (tmp_path / "film.webm").read_bytes()
    assert content.startswith(b"\x1a\x45\xdf\xa3")
    assert b"webm" in content[:64]
    assert b"V_VP8" in content


def test_a_missing_codec_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.view.video.CODEC", "none")
    with pytest.raises(NlosCamError, match="no none codec"), VideoFile(tmp_path / "film.webm", RIG):
        pass


def test_nothing_of_the_codecs_talk_reaches_the_terminal(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with VideoFile(tmp_path / "film.webm", RIG) as film:
        film.show(full_moment(0))
    assert capfd.readouterr().err == ""
