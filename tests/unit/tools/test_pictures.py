"""The pictures of the docs on a few objects."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest


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
