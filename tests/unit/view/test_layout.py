from typing import Any

import pytest
import rerun.blueprint as rrb
from nlos_calibration.rig import load_rig

from nlos_cam.view.layout import Shown, WallNames, _plots, layout

RIG = load_rig("paper-rig")
NAMES = WallNames("Change", "Residual", "Noise", "Saturated")


def names(part: Any) -> list[str]:
    """Names of the views below a container, in their order."""
    inside = [name for each in getattr(part, "contents", ()) if not isinstance(each, str) for name in names(each)]
    return inside if isinstance(part, rrb.Container) else [str(part.name)]


def views(**shown: Any) -> list[str]:
    return names(layout(RIG, Shown(**shown)).root_container)


@pytest.mark.parametrize("wall", [None, NAMES, WallNames()])
def test_layout_begins_with_the_verdict(wall: WallNames | None) -> None:
    first = views(wall=wall)[:4]
    assert [name.split()[0] for name in first] == ["Verdict", "Reconstruction", "Uncertainty", "Bench"]


def test_layout_has_no_name_twice() -> None:
    every = views(with_truth=True, wall=NAMES)
    assert len(set(every)) == len(every)


def test_layout_shows_truth_only_where_it_is_known() -> None:
    assert set(views(with_truth=True)) - set(views()) == {"Truth (simulated)"}


@pytest.mark.parametrize(
    ("wall", "more"),
    [(NAMES, ["Residual", "Noise", "Saturated", "Change", "Calibration"]), (WallNames(), ["Calibration"])],
)
def test_layout_of_a_measured_wall_adds_its_named_views(wall: WallNames, more: list[str]) -> None:
    assert [name for name in views(wall=wall) if name not in views()] == more
    assert set(views()) < set(views(wall=wall))


def test_layout_of_a_recording_starts_paused_with_its_time() -> None:
    live, saved = (layout(RIG, Shown(scrubbed=scrubbed)) for scrubbed in (False, True))
    assert (live.time_panel.play_state, live.time_panel.loop_mode) == ("following", None)
    assert (saved.time_panel.state, saved.time_panel.play_state, saved.time_panel.loop_mode) == (
        "collapsed",
        "paused",
        "all",
    )
    assert live.collapse_panels
    assert not saved.collapse_panels


@pytest.mark.parametrize("scrubbed", [False, True])
def test_plots_show_the_last_seconds_live_and_all_of_a_recording(scrubbed: bool) -> None:
    windows = ["VisibleTimeRanges" in plot.properties for plot in _plots(scrubbed=scrubbed)]
    assert windows == [not scrubbed] * 4
