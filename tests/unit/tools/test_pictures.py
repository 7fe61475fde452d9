"""The pictures of the docs on a few objects."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.render.sensor.sensor import SensedImages


@pytest.fixture
def gallery(tool: Callable[[str], ModuleType]) -> ModuleType:
    return tool("pictures")


def test_things_unlike_training_lie_in_the_box_and_the_last_is_nothing(gallery: ModuleType) -> None:
    *things, nothing = gallery.unlike_training()
    assert np.isnan(nothing.depth_m).all()
    for thing in things:
        assert thing.depth_m.shape == (64, 64)
        assert 0.12 <= np.nanmin(thing.depth_m) <= np.nanmax(thing.depth_m) <= 0.4


def test_the_picture_has_a_column_for_each(gallery: ModuleType, tmp_path: Path) -> None:
    subjects = gallery.unlike_training()[-2:]
    image = truth = np.stack([np.eye(64, dtype=np.float32), np.zeros((64, 64), np.float32)])
    gallery.draw_pairs(tmp_path / "a.png", [("a row", subjects, image, truth, np.array([1.0, np.nan]))])
    assert (tmp_path / "a.png").stat().st_size > 1000


def test_a_sheet_names_every_line(gallery: ModuleType, tmp_path: Path) -> None:
    images = {name: [np.full((64, 64), k / 4, np.float32) for k in range(3)] for name in "abcde"}
    figure = gallery.draw_sheet(tmp_path / "sheet.png", images)
    assert [axis.get_title(loc="left") for axis in figure.axes if axis.get_title(loc="left")] == [
        "a",
        "d",
        "b",
        "e",
        "c",
    ]
    assert [len(axis.images) for axis in figure.axes] == [1] * 15 + [0] * 3
    assert 0 < (tmp_path / "sheet.png").stat().st_size < 300_000


class FakeWorld:
    """A world of one value a frame."""

    rig, scene = load_rig("paper-rig"), SimpleNamespace(name="fake")

    def images(self, number: int) -> SensedImages:
        shape = 6, 8
        return SensedImages(
            np.full(shape, 400 + number, np.uint16), np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
        )

    def truth_depth_m(self, number: int) -> np.ndarray:
        return np.full((64, 64), number, np.float32)

    def celsius(self, number: int) -> dict[str, float]:
        return {"ldd_temperature": 40.0 + number, "fan": 1.0}


def test_an_unhurried_camera_gives_each_frame_of_its_world_with_its_truth(gallery: ModuleType) -> None:
    camera = gallery.Unhurried(FakeWorld(), 4)
    with camera as source:
        for number, frame in enumerate(source):
            assert frame.frame_number == number
            assert frame.timestamp_s == pytest.approx(number / 30)
            assert frame.depth_m == pytest.approx((400 + number) * 0.00025)
            assert (frame.truth_depth_m == number).all()
            assert camera.telemetry("_temperature") == {"ldd_temperature": 40.0 + number}
    assert number == 3
