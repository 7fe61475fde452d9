"""The viewer's layout: which views a newcomer sees, where, and under which names."""

from dataclasses import dataclass

import numpy as np
import rerun.blueprint as rrb
from nlos_calibration.rig import Rig

from nlos_cam.objects.depth_image import object_box
from nlos_cam.view.pictures import BACKGROUND_RGB

TIMELINE = "time"
PLOT_WINDOW_S = 20.0
HIDDEN_SHARES, BENCH_SHARE, BOTTOM_PLOT_SHARE = (1.25, 1.0), 1.25, 1.2
"""Widths of the views, side by side."""
MEASURED_SHARES, MEASURED_BENCH_SHARE = (1.2, 1.0), 2.0
LIDAR_SHARES, TEXT_SHARE = (1.0, 1.0, 1.15), 1.25
"""The same where a wall was measured: the bench has more to show."""
MEASURED_AWAY = 1.2
"""How much farther the eye is then: the footprint reaches beyond the bench."""


@dataclass(frozen=True)
class WallNames:
    """The names of the views of a measured wall, which state their scales; empty for what there is nothing to show."""

    difference: str = ""
    residual: str = ""
    noise: str = ""
    saturated: str = ""

    def pictures(self) -> list[rrb.Spatial2DView]:
        """The views of the reference."""
        named = {"residual": self.residual, "noise": self.noise, "saturated": self.saturated}
        return [_picture(f"wall/{path}", name) for path, name in named.items() if name]


def layout(rig: Rig, *, with_truth: bool, wall: WallNames | None = None) -> rrb.Blueprint:
    """What a newcomer sees: the reconstruction first, then what it was made from; `wall` where one was measured."""
    hidden = [_picture("reconstruction", "Reconstruction (bright: near the wall)")]
    if with_truth:
        hidden.append(_picture("truth", "Truth (known in simulation)"))
    lidar = [_picture("lidar/depth", "Lidar depth (red: near)"), _picture("lidar/infrared", "Lidar infrared")]
    top, bottom = (
        _rows(hidden, _bench(rig), lidar, _plot()) if wall is None else _measured_rows(hidden, rig, lidar, wall)
    )
    return rrb.Blueprint(
        rrb.Vertical(top, bottom, row_shares=[3, 2]),
        rrb.TimePanel(timeline=TIMELINE, play_state="following"),
        collapse_panels=True,
        auto_views=False,
    )


Pictures = list[rrb.Spatial2DView]
Rows = tuple[rrb.Horizontal, rrb.Horizontal]


def _rows(hidden: Pictures, bench: rrb.Spatial3DView, lidar: Pictures, plot: rrb.TimeSeriesView) -> Rows:
    return (
        rrb.Horizontal(*hidden, bench, column_shares=[*HIDDEN_SHARES[: len(hidden)], BENCH_SHARE]),
        rrb.Horizontal(*lidar, plot, column_shares=[1, 1, BOTTOM_PLOT_SHARE]),
    )


def _measured_rows(hidden: Pictures, rig: Rig, lidar: Pictures, wall: WallNames) -> Rows:
    """The same, with the wall's pictures in tabs behind the bench, and the calibration's text before the plot."""
    bench = rrb.Tabs(_bench(rig, MEASURED_AWAY), *wall.pictures(), active_tab=0)
    text = rrb.TextDocumentView(origin="calibration", name="Calibration")
    seen = [*lidar, _picture("lidar/difference", wall.difference)] if wall.difference else lidar
    return (
        rrb.Horizontal(*hidden, bench, column_shares=[*MEASURED_SHARES[: len(hidden)], MEASURED_BENCH_SHARE]),
        rrb.Horizontal(
            *seen, rrb.Tabs(text, _plot(), active_tab=0), column_shares=[*LIDAR_SHARES[: len(seen)], TEXT_SHARE]
        ),
    )


def _picture(origin: str, name: str) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(origin=origin, name=name)


def _bench(rig: Rig, away: float = 1.0) -> rrb.Spatial3DView:
    return rrb.Spatial3DView(
        origin="bench",
        name="Bench (drag to turn)",
        line_grid=False,
        eye_controls=_eye(rig, away),
        background=BACKGROUND_RGB,
    )


def _plot() -> rrb.TimeSeriesView:
    window = rrb.VisibleTimeRange(
        TIMELINE,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-PLOT_WINDOW_S),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    quiet = rrb.PlotLegend(visible=False)
    return rrb.TimeSeriesView(origin="latency", name="Latency (milliseconds)", time_ranges=[window], plot_legend=quiet)


def _eye(rig: Rig, away: float) -> rrb.EyeControls3D:
    """From above and behind the lidar, looking at the wall between lidar and box."""
    box = object_box(rig)
    middle = np.array([box.x_max_m / 2 + 0.03, 0.0, rig.lidar.distance_m / 2])
    position = middle + away * np.array([-0.36, 0.42, 0.72])
    return rrb.EyeControls3D(position=position, look_target=middle, eye_up=(0.0, 1.0, 0.0))
