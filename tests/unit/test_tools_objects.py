"""The contact sheet of objects: every category and every fixed object is on it."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
from nlos_calibration.rig import load_rig

from nlos_cam.objects.benchmark import test_set
from nlos_cam.objects.depth_map import image_from_depth, object_box
from nlos_cam.objects.generators import CATEGORIES

BOX = object_box(load_rig("paper-rig"))
MOST_BYTES = 300_000


def test_every_category_has_its_variations(tool: Callable[[str], ModuleType]) -> None:
    sheet = tool("contact_sheet_objects")
    for category in CATEGORIES:
        images = sheet.variations(category, BOX)
        assert len({image.tobytes() for image in images}) == sheet.VARIATIONS
        np.testing.assert_array_equal(images, sheet.variations(category, BOX))


def test_every_fixed_object_is_there(tool: Callable[[str], ModuleType]) -> None:
    shown = [image for row in tool("contact_sheet_objects").fixed(BOX).values() for image in row]
    np.testing.assert_array_equal(shown, [image_from_depth(thing.depth_m, BOX) for thing in test_set(BOX)])


def test_a_sheet_names_every_line(tmp_path: Path, tool: Callable[[str], ModuleType]) -> None:
    sheet = tool("contact_sheet_objects")
    images = {name: [np.full((64, 64), k / 4, np.float32) for k in range(3)] for name in "abcde"}
    figure = sheet.draw(tmp_path / "sheet.png", images)
    assert [axis.get_title(loc="left") for axis in figure.axes if axis.get_title(loc="left")] == [
        "a",
        "d",
        "b",
        "e",
        "c",
    ]
    assert [len(axis.images) for axis in figure.axes] == [1] * 15 + [0] * 3
    assert 0 < (tmp_path / "sheet.png").stat().st_size < MOST_BYTES
