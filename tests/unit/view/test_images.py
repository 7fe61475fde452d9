from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_up_moments import NOTHING, RIG, full_moment, moment, with_result
from measured_walls import HEIGHT, WIDTH, exact_wall
from nlos_calibration import MeasuredWall, normal_from_angles, wall_from_plane
from PIL import Image

from nlos_cam.errors import NlosCamError
from nlos_cam.objects.depth_map import object_box
from nlos_cam.reconstruct import Verdict
from nlos_cam.view import Still, VideoFile, images
from nlos_cam.view import video as layout
from nlos_cam.view.calibration import calibration_facts, outline_m, wall_pictures, wall_points_m

BOX = object_box(RIG)


def flat(z_m: float) -> np.ndarray:
    return np.full((64, 64), z_m, np.float32)


def test_pictures_brighten_with_nearness_noise_and_counts() -> None:
    nearer = np.concatenate(
        [images.hidden_rgb(flat(z_m), BOX)[:1, :1] for z_m in (np.nan, 0.4, 0.25, 0.13)], axis=1
    )
    for rgb in (nearer, images.noise_rgb(np.array([[np.nan, 0.0, 1.0, 2.0]]), 2.0)):
        assert (np.diff(rgb[0].sum(axis=-1).astype(int)) > 0).all()
    grey = images.infrared_grey(np.arange(256, dtype=np.uint8)[None])[0].astype(int)

    assert grey[0] == 0
    assert grey[255] == 255
    assert (np.diff(grey) >= 0).all()


def test_depth_pictures_show_missing_depth_as_background() -> None:
    assert (images.hidden_rgb(NOTHING, BOX) == images.BACKGROUND_RGB).all()
    assert (images.lidar_rgb(NOTHING, 0.1, 1.0) == images.BACKGROUND_RGB).all()

    depth_m = flat(0.3)
    depth_m[5, 6] = np.nan

    assert np.argwhere(
        (images.lidar_rgb(depth_m, 0.1, 1.0) == images.BACKGROUND_RGB).all(axis=-1)
    ).tolist() == [[5, 6]]


def test_lidar_depth_darkens_all_the_way() -> None:
    rgb = images.lidar_rgb(np.linspace(0.1, 1.0, 40, dtype=np.float32)[None], 0.1, 1.0)[0]
    luminance = rgb @ np.array([0.2126, 0.7152, 0.0722])

    assert (np.diff(luminance) <= 0).all()


def test_near_is_red_far_is_blue_and_equal_is_grey() -> None:
    near, same, far, nothing = images.difference_rgb(
        np.array([-0.01, 0.0, 0.01, np.nan]), 0.01
    ).astype(int)

    assert near[0] > 2 * near[2]
    assert far[2] > 2 * far[0]
    assert np.ptp(same) < 30
    assert tuple(nothing) == images.BACKGROUND_RGB

    redness = np.diff(
        images.difference_rgb(np.linspace(-1, 1, 21), 1.0)[:, [2, 0]].astype(int), axis=1
    )[:, 0]

    assert (np.diff(redness) < 0).all()


def test_saturated_rgb_colors_saturated_pixels_only() -> None:
    rgb = images.saturated_rgb(
        np.array([[0.0, 40.0, 255.0, np.nan]]), np.array([[0.0, 0.0, 0.01, 0.0]])
    )[0]

    assert tuple(rgb[2]) == images.SATURATED_RGB
    assert (np.ptp(rgb[[0, 1, 3]], axis=-1) == 0).all()


@given(st.floats(1e-6, 1e6))
def test_round_span_is_round_and_little_larger_than_the_values(value: float) -> None:
    span = images.round_span(np.array([value, -value, np.nan]))

    assert value <= span * (1 + 1e-5)
    assert span <= value * 2 * (1 + 1e-5)
    assert f"{span:e}"[0] in "1235"
    assert float(f"{span:.0e}") == span


def test_spans_ignore_what_is_missing_or_has_not_changed() -> None:
    depth_m = np.linspace(0.2, 1.2, 64 * 64, dtype=np.float32).reshape(64, 64)
    near_m, far_m = images.depth_span_m(depth_m)

    assert 0.2 <= near_m < 0.25
    assert 1.15 < far_m <= 1.2
    assert images.depth_span_m(NOTHING) == (0.0, 1.0)

    off_m = np.full((64, 80), 0.0003, np.float32)
    off_m[3] = np.nan

    assert images.change_span_m(off_m) == images.QUIET_SPAN_M

    off_m[:, 40:60] = 0.28
    off_m[:, 78:] = -1.5

    assert images.change_span_m(off_m) == pytest.approx(0.3)
    assert images.round_span(np.array([np.nan, np.nan])) == 1.0
    assert images.round_span(np.zeros(3), otherwise=0.5) == 0.5


def test_uncertainty_rgb_is_brighter_the_larger_on_the_surface() -> None:
    depth_m = flat(0.2)
    depth_m[0] = np.nan
    spread_m = np.linspace(0.0, 2 * images.MAX_UNCERTAINTY_M, 64, dtype=np.float32) * np.ones(
        (64, 1), np.float32
    )
    rgb = images.uncertainty_rgb(spread_m, depth_m)

    assert (rgb[0] == images.BACKGROUND_RGB).all()

    brightness = rgb[1].sum(axis=-1).astype(int)

    assert (np.diff(brightness) >= -3).all()
    assert brightness[0] > sum(images.BACKGROUND_RGB)
    assert (rgb[1, 40:] == rgb[1, 63]).all()
    assert (
        images.uncertainty_rgb(NOTHING, depth_m) == images.uncertainty_rgb(flat(1.0), depth_m)
    ).all()  # the largest


def test_pictures_clip_values_beyond_their_span() -> None:
    np.testing.assert_array_equal(
        images.noise_rgb(flat(3.0), 2.0), images.noise_rgb(flat(2.0), 2.0)
    )
    np.testing.assert_array_equal(
        images.lidar_rgb(flat(9.0), 0.1, 1.0), images.lidar_rgb(flat(1.0), 0.1, 1.0)
    )
    np.testing.assert_array_equal(
        images.difference_rgb(flat(9.0), 0.01), images.difference_rgb(flat(0.01), 0.01)
    )


def test_faded_keeps_brightness_and_loses_color() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (9, 9, 3)).astype(np.uint8)
    pale = images.faded(rgb).astype(float)

    np.testing.assert_allclose(pale.mean(axis=-1), rgb.mean(axis=-1), atol=1.0)
    np.testing.assert_allclose(
        np.ptp(pale, axis=-1), images.FADED * np.ptp(rgb.astype(float), axis=-1), atol=1.5
    )


def test_relief_rgb_is_lit_from_the_top_left() -> None:
    y, x = np.mgrid[:64, :64]
    hill_m = (0.3 - 0.1 * np.exp(-((x - 32) ** 2 + (y - 32) ** 2) / 200)).astype(np.float32)
    brightness = images.relief_rgb(hill_m, BOX).sum(axis=-1).astype(int)

    assert brightness[24, 24] > brightness[40, 40]
    assert (images.relief_rgb(NOTHING, BOX) == images.BACKGROUND_RGB).all()


UNSEEN = np.full((HEIGHT, WIDTH), np.nan, np.float32)


def with_record(wall: MeasuredWall, **fields: Any) -> MeasuredWall:
    return replace(wall, record=wall.record.model_copy(update=fields))


def test_wall_outline_is_closed_finite_and_on_the_wall() -> None:
    wall = exact_wall()
    outline = outline_m(wall)
    extent = wall.record.rig.wall
    points_m = wall_points_m(wall.record, wall.reference)[..., :2].reshape(-1, 2)

    assert (points_m.min(axis=0) > outline.min(axis=0) - 0.01).all()
    assert (points_m.max(axis=0) < outline.max(axis=0) + 0.01).all()
    np.testing.assert_array_equal(outline[0], outline[-1])
    assert (outline >= [extent.x_min_m - 1e-6, extent.y_min_m - 1e-6]).all()
    assert (outline <= [extent.x_max_m + 1e-6, extent.y_max_m + 1e-6]).all()

    pose = wall_from_plane(normal_from_angles(np.radians(75.0), 0.0), 0.2)
    oblique = outline_m(
        with_record(wall, wall_from_lidar=pose.tolist(), yaw_deg=75.0, facing_deg=75.0)
    )

    assert len(oblique) > 3
    assert np.isfinite(oblique).all()
    assert oblique[:, 0].max() == pytest.approx(extent.x_max_m, abs=0.5)

    far = extent.model_copy(update={"x_min_m": -1.0, "x_max_m": -0.9})

    assert (
        len(outline_m(with_record(wall, rig=wall.record.rig.model_copy(update={"wall": far})))) == 0
    )


def test_wall_pictures_need_a_reference_and_returns() -> None:
    assert wall_pictures(exact_wall(reference=None)) == {}

    pictures = wall_pictures(
        exact_wall(depth_m=UNSEEN, depth_std_m=UNSEEN, ir=UNSEEN, inliers=UNSEEN > 0)
    )

    assert all(
        (pictures[name][1] == images.BACKGROUND_RGB).all()
        for name in ("wall_residual", "wall_noise")
    )

    titles = {name: title for name, (title, _) in wall_pictures(exact_wall()).items()}

    assert "±2 mm" in titles["wall_residual"]
    assert "0.5 mm" in titles["wall_noise"]


def test_saturated_pixel_survives_thinning() -> None:
    blank = np.full((480, 641), 0.3, np.float32)
    saturated = np.zeros_like(blank)
    saturated[301, 17] = 1.0
    fields = {
        "depth_m": blank,
        "depth_std_m": blank,
        "ir": blank,
        "saturated": saturated,
        "inliers": blank > 0,
    }
    picture = wall_pictures(exact_wall(**fields, intrinsics=RIG.pinhole.scaled(641, 480)))[
        "wall_saturated"
    ][1]

    assert picture.shape == (240, 321, 3)
    assert np.argwhere((picture == images.SATURATED_RGB).all(axis=-1)).tolist() == [[150, 8]]


def test_calibration_facts_have_verdict_and_missing_reference() -> None:
    record = exact_wall().record
    facts = calibration_facts(record)

    assert facts[0][:2] == ["verdict", record.verdict]
    assert any(row[0] == "distance" for row in facts)
    assert "drift is not watched" in facts[-1][1]

    whole = record.model_copy(update={"reference": "wall.npz", "reference_sha256": "0" * 64})

    assert "drift" not in calibration_facts(whole)[-1][1]


@pytest.fixture
def film(tmp_path: Path) -> VideoFile:
    """A finished film of twenty moments, film.webm."""
    with VideoFile(tmp_path / "film.webm") as film:
        for number in range(20):
            film.show(full_moment(number))
    return film


def test_film_holds_every_second_frame(film: VideoFile, tmp_path: Path) -> None:
    video = cv2.VideoCapture(str(tmp_path / "film.webm"))
    frames = list[np.ndarray]()
    while (got := video.read())[0]:
        frames.append(got[1][..., ::-1])

    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(layout.FRAMES_PER_S)
    assert len(frames) == film.filmed == 10
    assert {frame.shape for frame in frames} == {(layout.HEIGHT, layout.WIDTH, 3)}
    expected = Still(full_moment(0)).rgb(full_moment(0)).astype(int)
    assert np.abs(frames[0] - expected).mean() < 6.0
    assert (np.abs(frames[0].astype(int) - frames[-1]).max(axis=-1) > 60).mean() > 0.005, "it moves"


@pytest.mark.usefixtures("film")
def test_film_is_a_webm_that_browsers_play(tmp_path: Path) -> None:
    content = (tmp_path / "film.webm").read_bytes()

    assert content.startswith(b"\x1a\x45\xdf\xa3")
    assert b"webm" in content[:64]
    assert b"V_VP8" in content


def test_film_keeps_the_codec_quiet(capfd: pytest.CaptureFixture[str], film: VideoFile) -> None:
    assert film.filmed
    assert capfd.readouterr().err == "", "the codec writes to the terminal"


def test_film_refuses_a_missing_codec(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlos_cam.view.video.CODEC", "none")
    with pytest.raises(NlosCamError, match="none codec"), VideoFile(tmp_path / "film.webm"):
        pass


PANELS = {
    "banner": ((20, 20), (880, 96)),
    "reconstruction": (layout.LARGE_AT, (layout.LARGE, layout.LARGE)),
    "uncertainty": (layout.MIDDLE_AT, (layout.SMALL, layout.SMALL)),
    "truth": (
        (layout.MIDDLE_AT[0], layout.MIDDLE_AT[1] + layout.LOWER),
        (layout.SMALL, layout.SMALL),
    ),
    "depth": (layout.RIGHT_AT, (layout.LIDAR_WIDTH, layout.SMALL)),
    "infrared": (
        (layout.RIGHT_AT[0], layout.RIGHT_AT[1] + layout.LOWER),
        (layout.LIDAR_WIDTH, layout.SMALL),
    ),
    "footer": ((20, 690), (600, 25)),
}


def panel(picture: np.ndarray, name: str) -> np.ndarray:
    (x, y), (width, height) = PANELS[name]
    return picture[y : y + height, x : x + width]


def changed(before: np.ndarray, after: np.ndarray) -> set[str]:
    return {name for name in PANELS if (panel(before, name) != panel(after, name)).any()}


def other_still(**fields: Any) -> set[str]:
    """Return the panels that change with other fields of the result."""
    one = full_moment(0)
    still = Still(one)
    return changed(still.rgb(one), still.rgb(with_result(one, **fields)))


def test_still_shows_each_part_of_a_frame_in_its_panel() -> None:
    frame = full_moment(0).result.frame
    halved_m = frame.depth_m * np.float32(0.5)

    assert Still(full_moment(0)).rgb(full_moment(0)).shape == (layout.HEIGHT, layout.WIDTH, 3)
    assert other_still(frame=replace(frame, truth_depth_m=NOTHING)) == {"truth"}
    assert other_still(frame=replace(frame, ir=frame.ir + 90)) == {"infrared"}
    assert other_still(frame=replace(frame, depth_m=halved_m)) == {"depth"}


def test_still_shows_uncertainty_and_times_in_their_panels() -> None:
    one = full_moment(0)
    certain = replace(one.result.reconstruction, uncertainty_m=flat(0.0))

    assert other_still(reconstruction=certain) == {"uncertainty"}

    still = Still(one)
    later = replace(one, latency_s=0.5, time_s=0.5)

    assert changed(still.rgb(one), still.rgb(later)) == {"footer"}


@pytest.mark.parametrize("verdict", [verdict for verdict in Verdict if verdict != Verdict.SEEN])
def test_still_marks_an_uncertain_reconstruction(verdict: Verdict) -> None:
    assert other_still(verdict=verdict) == {"banner", "reconstruction"}


def test_still_of_nothing_shows_the_background() -> None:
    rgb = Still(moment(0)).rgb(moment(0, NOTHING))
    assert (panel(rgb, "reconstruction") == images.BACKGROUND_RGB).all()


def test_still_keeps_lidar_pictures_until_new_ones() -> None:
    still = Still(full_moment(0))
    first, kept, new = (
        still.rgb(full_moment(number), with_lidar=number != 3) for number in (0, 3, 6)
    )

    assert not {"depth", "infrared"} & changed(first, kept)
    assert "reconstruction" in changed(first, kept)
    assert "depth" in changed(kept, new)


def test_still_is_saved_as_png(tmp_path: Path) -> None:
    one = full_moment(0, size=(480, 640))
    Still(one).save(tmp_path / "still.png", one)
    with Image.open(tmp_path / "still.png") as image:
        assert (image.format, image.size) == ("PNG", (layout.WIDTH, layout.HEIGHT))


@pytest.mark.parametrize(("rows", "columns"), [(64, 64), (64, 80), (480, 640), (3, 1000), (1, 1)])
def test_fitted_picture_is_whole_and_keeps_its_shape(rows: int, columns: int) -> None:
    height, width, _ = layout._fitted(np.zeros((rows, columns, 3), np.uint8), 294, 232).shape

    assert width == 294 or height == 232
    assert width <= 294
    assert height <= 232
    assert abs(width * rows - height * columns) <= max(rows, columns)
