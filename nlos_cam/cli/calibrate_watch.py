"""`calibrate --watch`: distance and angle on the terminal, ten times a second, while somebody positions the rig."""

import sys
from collections.abc import Callable
from threading import Event, Thread

from nlos_calibration.verdict import DISTANCE_RANGE_M, FACING_RANGE_DEG
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from nlos_cam.calibrate.measure import Glance, glance
from nlos_cam.camera.protocol import Camera
from nlos_cam.cli.common import say, stderr
from nlos_cam.frames import MOST_SATURATED

EVERY = 3
"""Of 30 frames a second."""
GAUGE_WIDTH = 31


def watch(camera: Camera, stop: Callable[[], bool]) -> Glance | None:
    """Show what each third frame of an entered camera says, until it ends or `stop` says so; returns the last."""
    last: Glance | None = None
    with Live(console=stderr, auto_refresh=False, transient=True) as live:
        for number, frame in enumerate(camera):
            if number % EVERY == 0:
                last = glance(frame)
                live.update(panel(last), refresh=True)
            if stop():
                break
    return last


def until_enter() -> Callable[[], bool]:
    """Whether somebody has pressed Enter since; the end of the input counts as that."""
    pressed = Event()

    def wait() -> None:
        sys.stdin.readline()
        pressed.set()

    Thread(target=wait, name="waits for Enter", daemon=True).start()
    return pressed.is_set


def watch_until_enter(camera: Camera) -> None:
    """Show the wall until Enter is pressed."""
    say("position the lidar; [bold]Enter[/] measures, Ctrl-C leaves", marked=True)
    with camera as source:
        last = watch(source, until_enter())
    if last is not None:
        stderr.print(panel(last))


def panel(seen: Glance) -> Table:
    """A glance as a few lines with gauges over the paper's ranges."""
    table = Table.grid(padding=(0, 2))
    if seen.fit is None:
        table.add_row("wall", f"[yellow]not measured:[/] {escape(seen.refused)}")
    else:
        fit = seen.fit
        table.add_row("distance", f"{fit.distance_m:.4f} m", gauge(fit.distance_m, *DISTANCE_RANGE_M))
        table.add_row("facing", f"{fit.facing_deg:.2f} deg", gauge(fit.facing_deg, *FACING_RANGE_DEG))
        table.add_row("yaw, pitch", f"{fit.yaw_deg:+z.2f}, {fit.pitch_deg:+z.2f} deg")
        colour = "green" if fit.verdict == "good" else "yellow"
        table.add_row("verdict", f"[{colour}]{fit.verdict}[/]", fit.advice)
    if seen.saturated > MOST_SATURATED:
        table.add_row("infrared", f"{seen.saturated:.1%} saturated", "lower the laser's power, or move back")
    return table


def gauge(value: float, low: float, high: float) -> str:
    """Where a value lies on the way from `low` to `high`; at an end, with an arrow, where it is beyond."""
    share = (value - low) / (high - low)
    place = round(min(max(share, 0.0), 1.0) * (GAUGE_WIDTH - 1))
    mark = "◀" if share < 0 else "▶" if share > 1 else "●"
    return f"{low:g} {'─' * place}{mark}{'─' * (GAUGE_WIDTH - 1 - place)} {high:g}"
