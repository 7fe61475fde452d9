"""`nlos-cam demo`: the live view of the simulated camera, with an explanation."""

from __future__ import annotations

import typer

from nlos_cam.cli.common import Json, say
from nlos_cam.cli.live import Seconds, live
from nlos_cam.cli.view import NoView, Open, ViewPort

EXPLANATION = (
    "A simulated lidar looks at a wall, and an airplane flies around the corner, out of its sight. Of the light that "
    "bounces wall, airplane, wall, two networks reconstruct it 30 times per second."
)


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("demo")(demo)


def demo(
    seconds: Seconds = None,
    no_view: NoView = False,
    view_port: ViewPort = None,
    open_view: Open = False,
    json: Json = False,
) -> None:
    """Show the live view of a simulated bench; no camera is needed. The same as `live sim`."""
    say(EXPLANATION)
    live("sim", seconds=seconds, no_view=no_view, view_port=view_port, open_view=open_view, json=json)
