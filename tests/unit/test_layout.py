from typing import Any

import pytest
import rerun.blueprint as rrb
from nlos_calibration.rig import load_rig

from nlos_cam.view.layout import Shown, WallNames, _plots, layout

RIG = load_rig("paper-rig")
NAMES = WallNames("Change", "Residual", "Noise", "Saturated")


def names(part: Any) -> list[str]:
    """Of the views below a container, in their order."""
    inside = [name for each in getattr(part, "contents", ()) if not isinstance(each, str) for name in names(each)]
    return inside if isinstance(part, rrb.Container) else [str(part.name)]


def views(**shown: Any) -> list[str]:
    return names(layout(RIG, Shown(**shown)).root_container)


@pytest.mark.parametrize("wall", [None, NAMES, WallNames()])
def test_verdict_reconstruction_uncertainty_and_bench_come_first(wall: WallNames | None) -> None:
    first = views(wall=wall)[:4]
    assert [name.split()[0] for name in first] == ["Verdict", "Reconstruction", "Uncertainty", "Bench"]


def test_nothing_is_shown_twice_under_one_name() -> None:
    every = views(with_truth=True, wall=NAMES)
    assert len(set(every)) == len(every)


def test_truth_is_shown_where_it_is_known_and_only_there() -> None:
    assert set(views(with_truth=True)) - set(views()) == {"Truth (simulated)"}


def test_a_measured_wall_adds_its_views_and_takes_none_away() -> None:
    added = [name for name in views(wall=NAMES) if name not in views()]
    assert added == ["Residual", "Noise", "Saturated", "Change", "Calibration"]
    assert set(views()) < set(views(wall=NAMES))


def test_what_has_no_name_has_no_view() -> None:
    assert [name for name in views(wall=WallNames()) if name not in views()] == ["Calibration"]


def test_what_has_an_end_waits_at_its_beginning_in_sight_of_its_time() -> None:
    live, saved = (layout(RIG, Shown(scrubbed=scrubbed)) for scrubbed in (False, True))
    assert (live.time_panel.play_state, live.time_panel.loop_mode) == ("following", None)
    assert (saved.time_panel.state, saved.time_panel.play_state, saved.time_panel.loop_mode) == (
        "collapsed",
        "paused",
        "all",
    )
    assert live.collapse_panels
    assert not saved.collapse_panels


def test_plots_show_the_last_seconds_of_what_goes_on_and_all_of_what_has_an_end() -> None:
    def windows(*, scrubbed: bool) -> list[bool]:
        return ["VisibleTimeRanges" in plot.properties for plot in _plots(scrubbed=scrubbed)]

    assert windows(scrubbed=False) == [True] * 4
    assert windows(scrubbed=True) == [False] * 4
