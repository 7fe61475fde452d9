from typing import Any

import pytest
import rerun.blueprint as rrb
from nlos_calibration.rig import load_rig

from nlos_cam.view.layout import WallNames, layout

RIG = load_rig("paper-rig")
NAMES = WallNames("Change", "Residual", "Noise", "Saturated")


def names(part: Any) -> list[str]:
    """Of the views below a container, in their order."""
    inside = [name for each in getattr(part, "contents", ()) if not isinstance(each, str) for name in names(each)]
    return inside if isinstance(part, rrb.Container) else [str(part.name)]


def views(*, with_truth: bool = True, wall: WallNames | None = None) -> list[str]:
    return names(layout(RIG, with_truth=with_truth, wall=wall).root_container)


@pytest.mark.parametrize("wall", [None, NAMES, WallNames()])
def test_the_reconstruction_comes_first(wall: WallNames | None) -> None:
    assert views(wall=wall)[0].startswith("Reconstruction")


def test_truth_is_shown_where_it_is_known_and_only_there() -> None:
    assert set(views()) - set(views(with_truth=False)) == {"Truth (known in simulation)"}


def test_a_measured_wall_adds_its_views_and_takes_none_away() -> None:
    added = [name for name in views(wall=NAMES) if name not in views()]
    assert added == ["Residual", "Noise", "Saturated", "Change", "Calibration"]
    assert set(views()) < set(views(wall=NAMES))


def test_what_has_no_name_has_no_view() -> None:
    assert [name for name in views(wall=WallNames()) if name not in views()] == ["Calibration"]
