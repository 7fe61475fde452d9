"""Layout of the page: views, places and names."""

from dataclasses import dataclass

import numpy as np
import rerun.blueprint as rrb
from nlos_calibration import Rig

from nlos_cam.objects import object_box
from nlos_cam.view.images import BACKGROUND_RGB, BANNER_HEIGHT, BANNER_WIDTH, MAX_UNCERTAINTY_M, RESIDUAL_SPAN_M

TIMELINE, FRAME_TIMELINE = "time", "frame"
PLOT_WINDOW_S = 20.0
ROW_SHARES, HIDDEN_SHARE, BENCH_SHARE = (3.0, 2.0), 1.4, 1.0
BANNER_SHARE, PICTURES_SHARE = 1.0, 4.0
TRUTH_SHARE, LIDAR_SHARE, PLOT_SHARE = 0.8, 1.1, 1.2
"""Heights of the views above each other, widths of those side by side."""
MEASURED_AWAY = 1.2
"""How much farther the eye is from a measured wall: the footprint reaches beyond the bench."""


@dataclass(frozen=True)
class WallNames:
    """Names of a measured wall's views, with their scales; empty where there is nothing to show."""

    difference: str = ""
    residual: str = ""
    noise: str = ""
    saturated: str = ""

    def pictures(self) -> list[rrb.Spatial2DView]:
        """Return the views of the bare-wall reference."""
        named = {"residual": self.residual, "noise": self.noise, "saturated": self.saturated}
        return [_picture(f"wall/{path}", name) for path, name in named.items() if name]


@dataclass(frozen=True)
class Shown:
    """Available data of a run."""

    with_truth: bool = False
    """True if the hidden object is known, as in simulation."""
    wall: WallNames | None = None
    """Names of the views of a measured wall."""
    scrubbed: bool = False
    """True for a recording with an end, in which one can scrub."""


def layout(rig: Rig, shown: Shown) -> rrb.Blueprint:
    """Return the layout: verdict, reconstruction, uncertainty and bench; below them the inputs."""
    hidden = rrb.Horizontal(
        _picture("reconstruction", "Reconstruction (bright: near the wall)"),
        _picture("uncertainty", f"Uncertainty (bright: {1e3 * MAX_UNCERTAINTY_M:g} mm)"),
    )
    found = rrb.Vertical(_banner(), hidden, row_shares=[BANNER_SHARE, PICTURES_SHARE])
    top = rrb.Horizontal(found, _bench_tabs(rig, shown.wall), column_shares=[HIDDEN_SHARE, BENCH_SHARE])
    return rrb.Blueprint(
        rrb.Vertical(top, _bottom(shown), row_shares=ROW_SHARES),
        _time_panel(scrubbed=shown.scrubbed),
        collapse_panels=not shown.scrubbed,
        auto_views=False,
    )


def _time_panel(*, scrubbed: bool) -> rrb.TimePanel:
    if not scrubbed:
        return rrb.TimePanel(timeline=TIMELINE, play_state="following")
    return rrb.TimePanel(timeline=TIMELINE, state="collapsed", play_state="paused", loop_mode="all")


def _banner() -> rrb.Spatial2DView:
    bounds = rrb.VisualBounds2D(x_range=[0, BANNER_WIDTH], y_range=[0, BANNER_HEIGHT])
    return rrb.Spatial2DView(
        origin="verdict", name="Verdict", titlebar=False, background=BACKGROUND_RGB, visual_bounds=bounds
    )


def _bench_tabs(rig: Rig, wall: WallNames | None) -> rrb.Tabs | rrb.Spatial3DView:
    if wall is None:
        return _bench(rig)
    return rrb.Tabs(_bench(rig, MEASURED_AWAY), *wall.pictures(), active_tab=0)


def _bottom(shown: Shown) -> rrb.Horizontal:
    """Return the bottom row: truth, lidar images and plots; a measured wall comes first."""
    wall = shown.wall
    truth = [_picture("truth", "Truth (simulated)")] if shown.with_truth else []
    change = [_picture("lidar/difference", wall.difference)] if wall and wall.difference else []
    text = [rrb.TextDocumentView(origin="calibration", name="Calibration")] if wall else []
    residual = _picture("physics/residual", f"Physics ±{1e3 * RESIDUAL_SPAN_M:g} mm")
    depth = rrb.Tabs(_picture("lidar/depth", "Depth"), _picture("lidar/confidence", "Confidence"), active_tab=0)
    light = rrb.Tabs(*change, _picture("lidar/infrared", "Infrared"), residual, active_tab=0)
    plots = rrb.Tabs(*text, *_plots(scrubbed=shown.scrubbed), active_tab=0)
    shares = [*([TRUTH_SHARE] if truth else []), LIDAR_SHARE, LIDAR_SHARE, PLOT_SHARE]
    return rrb.Horizontal(*truth, depth, light, plots, column_shares=shares)


def _plots(*, scrubbed: bool) -> list[rrb.TimeSeriesView]:
    named = {"latency": "Latency", "drops": "Drops", "temperature": "°C", "physics/score": "Physics"}
    return [_plot(origin, name, scrubbed=scrubbed) for origin, name in named.items()]


def _plot(origin: str, name: str, *, scrubbed: bool) -> rrb.TimeSeriesView:
    """Return a plot of the last seconds, or of a whole recording."""
    window = rrb.VisibleTimeRange(
        TIMELINE,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-PLOT_WINDOW_S),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    legend = rrb.PlotLegend(corner=rrb.Corner2D.LeftTop)
    return rrb.TimeSeriesView(origin=origin, name=name, time_ranges=None if scrubbed else [window], plot_legend=legend)


def _picture(origin: str, name: str) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(origin=origin, name=name, background=BACKGROUND_RGB)


def _bench(rig: Rig, away: float = 1.0) -> rrb.Spatial3DView:
    return rrb.Spatial3DView(
        origin="bench",
        name="Bench",
        line_grid=False,
        eye_controls=_eye(rig, away),
        background=BACKGROUND_RGB,
    )


def _eye(rig: Rig, away: float) -> rrb.EyeControls3D:
    """Return the eye above and behind the lidar, looking at the wall between lidar and box."""
    box = object_box(rig)
    middle = np.array([box.x_max_m / 2 + 0.03, 0.0, rig.lidar.distance_m / 2])
    position = middle + away * np.array([-0.36, 0.42, 0.72])
    return rrb.EyeControls3D(position=position, look_target=middle, eye_up=(0.0, 1.0, 0.0))
