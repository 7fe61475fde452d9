from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import cv2
import numpy as np
import pytest
from fake_wall import wall_frame
from made_up_moments import full_moment, with_result
from matplotlib.figure import Figure
from replays import BENCH, NAMES, replay_moments, text_of
from small_frames import NOTHING, FrameCamera, SheetNetwork, result_of
from view_streams import saved_moments

from nlos_cam.errors import OutputExistsError
from nlos_cam.frames import LidarMaps, maps_from_frame
from nlos_cam.reconstruct import FrameResult, Pipeline, Verdict
from nlos_cam.replay import REPORT, VIDEO, ReplayMedia, replay_recording
from nlos_cam.replay.media import VIEW, FrameSampler, draw_contact_sheet
from nlos_cam.replay.replay import RESULT
from nlos_cam.view import Moment, Still

FULL = full_moment(0)


def test_replay_makes_no_media_unasked(tmp_path: Path) -> None:
    assert replay_moments(tmp_path / "out", 3) == NAMES


@pytest.fixture(scope="module")
def media(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a replay of 30 frames with a view, three stills and a video."""
    out = tmp_path_factory.mktemp("media") / "out"
    replay_moments(out, 30, view=True, stills=3, video=True)
    return out


def test_stills_are_spread_over_the_replay(media: Path) -> None:
    numbers = sorted(int(path.stem.removeprefix("still-")) for path in media.glob("still-*.png"))

    assert len(numbers) == 3
    assert numbers[0] == 0
    assert numbers[-1] >= 20


def test_report_lists_the_media(media: Path) -> None:
    text = text_of(media)

    assert "3 frames as pictures" in text
    assert "view.html" in text


def test_duration_skips_steps_of_the_clock_backwards(fallen: Path) -> None:
    assert "10 frames, 0.3 s" in text_of(fallen)


def test_video_has_every_second_frame(media: Path) -> None:
    video = cv2.VideoCapture(str(media / VIDEO))
    frames = 0
    while video.read()[0]:
        frames += 1

    assert frames == 15
    assert VIDEO in (media / REPORT).read_text(encoding="utf-8")


def test_view_has_every_third_frame(media: Path) -> None:
    assert [each["frame"] for each in saved_moments(media / VIEW)] == list(range(0, 30, 3))


@pytest.fixture(scope="module")
def fallen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a replay of frames 0 to 4 twice, as a device counts that restarts."""
    out = tmp_path_factory.mktemp("fallen")
    camera = FrameCamera(10, make=lambda number: full_moment(number % 5).result.frame)
    camera.intrinsics = FULL.result.frame.intrinsics
    media = ReplayMedia(BENCH, view=True, stills=10, video=True, objects=["csv", "points"])
    replay_recording(camera, Pipeline(BENCH, SheetNetwork()), out, stop=Event(), media=media)
    return out


def test_number_that_comes_again_overwrites_no_file(fallen: Path) -> None:
    names = {path.name for path in (fallen / "object").iterdir()}

    assert len(names) == 20
    assert names > {"000003.csv", "000003-2.csv", "000003-points.ply", "000003-2-points.ply"}
    assert len(list(fallen.glob("still-*.png"))) == 10


def test_view_and_video_go_on_where_the_time_falls_back(fallen: Path) -> None:
    video = cv2.VideoCapture(str(fallen / VIDEO))
    frames = [each["frame"] for each in saved_moments(fallen / VIEW)]

    assert frames == [0, 3, 0, 3]
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 6


def test_still_of_a_blind_start_has_the_later_frames_colors() -> None:
    blind_m = np.full_like(FULL.result.frame.depth_m, np.nan)
    blind = with_result(FULL, frame=replace(FULL.result.frame, depth_m=blind_m))
    still = Still(blind)
    still.rgb(blind)

    np.testing.assert_array_equal(still.rgb(FULL), Still(FULL).rgb(FULL))


def test_media_change_no_result(media: Path, tmp_path: Path) -> None:
    replay_moments(tmp_path / "plain", 30)
    assert (tmp_path / "plain" / RESULT).read_bytes() == (media / RESULT).read_bytes()


@pytest.mark.slow
def test_replay_removes_media_of_an_earlier_one(tmp_path: Path) -> None:
    out = tmp_path / "out"
    replay_moments(out, 12, view=True, stills=4, objects=["csv"])

    assert (out / "object" / "000003.csv").is_file()

    (out / "mine.png").write_text("keep me")

    assert replay_moments(out, 3, stills=1) == NAMES | {"mine.png", "still-000000.png"}


def test_replay_removes_only_files_of_an_earlier_one(tmp_path: Path) -> None:
    out = tmp_path / "out"
    replay_moments(out, 2, objects=["csv"])
    (out / "object" / "notes.csv").write_text("mine")
    (out / "still-life.png").write_text("mine")
    replay_moments(out, 2)

    assert [path.name for path in (out / "object").iterdir()] == ["notes.csv"]
    assert (out / "still-life.png").is_file()


def test_replay_removes_nothing_where_none_was_before(tmp_path: Path) -> None:
    mine = {"view.html", "replay.webm", "difference.npz", "object"}
    for name in mine - {"object"}:
        (tmp_path / name).write_text("mine")
    (tmp_path / "object").mkdir()
    (tmp_path / "object" / "000001.csv").write_text("mine")

    assert replay_moments(tmp_path, 2) == NAMES | mine
    assert (tmp_path / "object" / "000001.csv").is_file()


def test_replay_refuses_to_replace_objects_of_others(tmp_path: Path) -> None:
    out = tmp_path / "out"
    replay_moments(out, 2, objects=["csv"])
    replay_moments(out, 1, objects=["csv"])

    assert len([*(out / "object").iterdir()]) == 1

    (out / "object" / "notes.txt").write_text("mine")
    with pytest.raises(OutputExistsError, match=r"notes\.txt"):
        replay_moments(out, 2, objects=["csv"])

    assert (out / "object" / "notes.txt").is_file()


def test_media_of_a_failed_replay_have_no_stills(tmp_path: Path) -> None:
    media = ReplayMedia(BENCH, view=True, stills=2)
    with pytest.raises(ZeroDivisionError), media.into(tmp_path):
        media.add(FULL.result, 1 / 0)  # type: ignore[arg-type]

    assert {file.name for file in tmp_path.iterdir()} == {VIEW}


def test_replay_says_that_its_saved_view_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("nlos_cam.view.session_file.MAX_BYTES", 1)
    replay_moments(tmp_path / "out", 60, view=True)

    assert "view.html is full" in caplog.text


def test_recorded_moment_is_at_its_own_time() -> None:
    stages_s = {"wait": 9.0, "maps": 0.001, "network": 0.01}
    result = replace(FULL.result, published_s=77.0, stages_s=stages_s)
    shown = Moment.recorded(result, FULL.celsius)

    assert shown.result is result
    assert shown.time_s == result.timestamp_s
    assert shown.latency_s == pytest.approx(0.011)
    assert shown.celsius == FULL.celsius


@pytest.mark.parametrize("count", [1, 5, 6, 7, 100, 1001])
def test_samples_are_few_ordered_and_spread(count: int) -> None:
    samples = FrameSampler(6)
    for number in range(count):
        samples.add(number)  # type: ignore[arg-type]
    chosen: list[Any] = samples.results()

    assert len(chosen) == min(count, 6)
    assert chosen == sorted(set(chosen))
    assert chosen[0] == 0
    assert chosen[-1] >= 0.7 * (count - 1)


def wall_result(number: int, difference: LidarMaps | None = None) -> FrameResult:
    return result_of(wall_frame(number), difference=difference)


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Figures that were saved."""
    saved: list[Any] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: saved.append(figure))
    return saved


def titles(figure: Figure) -> list[str]:
    both = [axis.get_ylabel() or axis.get_title() for axis in figure.axes]
    return [title for title in both if title]


def test_sheet_has_a_row_per_map_and_a_column_per_frame(figures: list[Any]) -> None:
    draw_contact_sheet(Path("sheet.png"), [wall_result(3), wall_result(9)])
    rows = ["lidar depth (cm)", "infrared (counts)", "hidden depth (cm)"]

    assert titles(figures[0]) == ["frame 3", "frame 9", *rows]


def test_sheet_shows_differences_from_the_bare_wall(figures: list[Any]) -> None:
    results = [wall_result(number, maps_from_frame(wall_frame(number))) for number in (3, 9)]
    draw_contact_sheet(Path("sheet.png"), results)

    assert titles(figures[0])[4] == "difference (mm)"


def test_sheet_shows_verdict_and_uncertainty(figures: list[Any]) -> None:
    uncertain = replace(NOTHING, uncertainty_m=np.full((64, 64), 0.01, np.float32))
    result = replace(wall_result(3), verdict=Verdict.OUTSIDE, reconstruction=uncertain)
    draw_contact_sheet(Path("sheet.png"), [result])

    assert titles(figures[0])[0] == "frame 3\noutside the trained range"
    assert titles(figures[0])[-1] == "uncertainty (mm)"
