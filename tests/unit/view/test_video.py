from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from made_up_moments import NOTHING, RIG, full_moment, moment
from PIL import Image

from nlos_cam.errors import NlosCamError
from nlos_cam.reconstruct import Verdict
from nlos_cam.view import Still, VideoFile
from nlos_cam.view import video as layout
from nlos_cam.view.images import BACKGROUND_RGB


def read(path: Path) -> list[np.ndarray]:
    video, frames = cv2.VideoCapture(str(path)), []
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(layout.FRAMES_PER_S)
    while (got := video.read())[0]:
        frames.append(got[1][..., ::-1])
    return frames


def test_film_holds_every_second_frame(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "film.webm"
    with VideoFile(path, RIG) as film:
        for number in range(20):
            film.show(full_moment(number))
    frames = read(path)
    assert len(frames) == film.filmed == 10
    assert {frame.shape for frame in frames} == {(layout.HEIGHT, layout.WIDTH, 3)}
    expected = Still(RIG, full_moment(0)).rgb(full_moment(0)).astype(int)
    assert np.abs(frames[0] - expected).mean() < 6.0
    assert (np.abs(frames[0].astype(int) - frames[-1]).max(axis=-1) > 60).mean() > 0.005, "it moves"
    content = path.read_bytes()
    assert content.startswith(b"\x1a\x45\xdf\xa3")
    assert b"webm" in content[:64]
    assert b"V_VP8" in content
    assert capfd.readouterr().err == "", "the codec writes to the terminal"


def test_film_refuses_a_missing_codec(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.view.video.CODEC", "none")
    with pytest.raises(NlosCamError, match="none codec"), VideoFile(tmp_path / "film.webm", RIG):
        pass


Picture = np.ndarray
PANELS = {
    "banner": ((20, 20), (880, 96)),
    "reconstruction": (layout.LARGE_AT, (layout.LARGE, layout.LARGE)),
    "uncertainty": (layout.MIDDLE_AT, (layout.SMALL, layout.SMALL)),
    "truth": ((layout.MIDDLE_AT[0], layout.MIDDLE_AT[1] + layout.LOWER), (layout.SMALL, layout.SMALL)),
    "depth": (layout.RIGHT_AT, (layout.LIDAR_WIDTH, layout.SMALL)),
    "infrared": ((layout.RIGHT_AT[0], layout.RIGHT_AT[1] + layout.LOWER), (layout.LIDAR_WIDTH, layout.SMALL)),
    "footer": ((20, 690), (600, 25)),
}


def panel(picture: Picture, name: str) -> Picture:
    (x, y), (width, height) = PANELS[name]
    return picture[y : y + height, x : x + width]


def changed(before: Picture, after: Picture) -> set[str]:
    return {name for name in PANELS if (panel(before, name) != panel(after, name)).any()}


def test_still_shows_each_part_of_a_moment_in_its_panel() -> None:
    one = full_moment(0)
    still = Still(RIG, one)
    before = still.rgb(one)
    assert before.shape == (layout.HEIGHT, layout.WIDTH, 3)
    frame = one.frame
    for name, other in {
        "truth": replace(one, frame=replace(frame, truth_depth_m=NOTHING)),
        "infrared": replace(one, frame=replace(frame, ir=frame.ir + 90)),
        "depth": replace(one, frame=replace(frame, depth_m=frame.depth_m * np.float32(0.5))),
        "footer": replace(one, latency_s=0.5, published_s=0.5),
        "uncertainty": replace(
            one, reconstruction=replace(one.reconstruction, uncertainty_m=np.zeros((64, 64), np.float32))
        ),
    }.items():
        assert changed(before, still.rgb(other)) == {name}


@pytest.mark.parametrize("verdict", [verdict for verdict in Verdict if verdict is not Verdict.SEEN])
def test_still_marks_a_doubted_reconstruction(verdict: Verdict) -> None:
    one = full_moment(0)
    still = Still(RIG, one)
    other = still.rgb(replace(one, verdict=verdict))
    assert changed(still.rgb(one), other) == {"banner", "reconstruction"}


def test_still_of_a_bare_moment_has_no_surface() -> None:
    picture = Still(RIG, moment(0)).rgb(moment(0, NOTHING))
    assert (panel(picture, "reconstruction") == BACKGROUND_RGB).all()


def test_still_keeps_lidar_pictures_until_new_ones() -> None:
    still = Still(RIG, full_moment(0))
    first, kept, new = (still.rgb(full_moment(number), with_lidar=number != 3) for number in (0, 3, 6))
    assert not {"depth", "infrared"} & changed(first, kept)
    assert "reconstruction" in changed(first, kept)
    assert "depth" in changed(kept, new)


def test_still_is_saved_as_png(tmp_path: Path) -> None:
    one = full_moment(0, size=(480, 640))
    Still(RIG, one).save(tmp_path / "still.png", one)
    with Image.open(tmp_path / "still.png") as image:
        assert (image.format, image.size) == ("PNG", (layout.WIDTH, layout.HEIGHT))


@pytest.mark.parametrize(("rows", "columns"), [(64, 64), (64, 80), (480, 640), (3, 1000), (1, 1)])
def test_fitted_picture_is_whole_and_keeps_its_shape(rows: int, columns: int) -> None:
    height, width, _ = layout._fitted(np.zeros((rows, columns, 3), np.uint8), 294, 232).shape
    assert width == 294 or height == 232
    assert width <= 294
    assert height <= 232
    assert abs(width * rows - height * columns) <= max(rows, columns)
