"""`nlos-cam detect`: does a hidden object change what the lidar reports? Object in, object out, in
turns.
"""

from __future__ import annotations

import secrets
import shutil
import sys
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import nlos_calibration as walls
import typer

from nlos_cam import camera as cameras
from nlos_cam import detect as detection
from nlos_cam.cli import benches
from nlos_cam.cli.common import (
    Camera,
    Json,
    Overwrite,
    finish,
    interrupted_by_signals,
    output_path,
    progress,
    say,
    stderr,
    tracked,
)
from nlos_cam.errors import NlosCamError

TURNS = 32
FRAMES = 30
ALPHA = 0.01
CONTROL_WORDS = ": the same motions with an EMPTY hand"


class TerminalHands:
    """Person at the terminal who moves the object and presses Enter."""

    def __init__(
        self, plan: detection.Plan, read_line: Callable[[], str] = sys.stdin.readline
    ) -> None:
        self._plan = plan
        self._read_line = read_line

    def place(self, turn: int, *, object_in: bool) -> None:
        """Ask for the object's place and wait for Enter. Raises NlosCamError where stdin ends."""
        # In every turn the object leaves its place once: otherwise the hands alone would tell
        # turns apart.
        words = "take the object out, put it back IN" if object_in else "put it in, take it OUT"
        if self._plan.control:
            words += CONTROL_WORDS
        say(f"Turn {turn + 1} of {self._plan.turns}: {words}. Step back and press Enter.")
        if not self._read_line():
            raise NlosCamError(
                f"stdin ended before turn {turn + 1}: run the same command in a terminal to go on"
            )


def detect(
    camera: Camera = "sim",
    wall: Annotated[
        Path | None,
        typer.Option("--wall", help="Record of the bench (wall.toml): which cells see the object."),
    ] = None,
    bench_folder: benches.BenchFolder = None,
    turns: Annotated[
        int | None,
        typer.Option("--turns", min=8, max=4096, help="Turns, a multiple of 4 (default: 32)."),
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(
            "--frames",
            min=2,
            max=100_000,
            help="Frames of each turn and setting (default: 30, one second).",
        ),
    ] = None,
    alpha: Annotated[
        float | None,
        typer.Option(
            "--alpha",
            min=1e-6,
            max=0.2,
            help="Rate of false alarms, for the whole family of tests (default: 0.01).",
        ),
    ] = None,
    settings: Annotated[
        Literal["as-started", "sweep"],
        typer.Option(
            "--settings",
            help="sweep: in every turn also one option at a time at other values (laser power,"
            " gains, least distance, filters).",
        ),
    ] = "as-started",
    control: Annotated[
        bool, typer.Option("--control", help="Control: the same motions with an empty hand.")
    ] = False,
    seed: Annotated[
        int | None,
        typer.Option("--seed", min=0, help="Seed of the turns' order (default: a random one)."),
    ] = None,
    show_serial: Annotated[
        bool, typer.Option("--show-serial", help="Print the camera's serial number on the page.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder of turns and page; the same command goes on in it."),
    ] = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Test whether a hidden object changes depth, infrared or confidence, and write a page.

    The program asks for the object in and out, in an order drawn by coins; a simulated camera moves
    its own. Stopped at any moment, the same command goes on. With the folder in place of CAMERA the
    stored turns are analyzed again.
    """
    folder = Path(camera)
    if folder.is_dir():
        session = detection.Session.open(folder)
    else:
        if camera.startswith("bag:"):
            raise typer.BadParameter(f"{camera} is a recording without turns: give a live camera")
        folder = output_path(out, "detect", "", overwrite=True)  # a session that exists goes on
        if overwrite and detection.is_session(folder):
            shutil.rmtree(folder)
        chosen = benches.choose(bench_folder, wall)
        asked = Asked(turns, frames, alpha, seed, control, settings == "sweep")
        session = _measure(camera, chosen, asked, folder)
    _report(session, show_serial=show_serial, as_json=json)


class Asked(NamedTuple):
    """Options of the command line; None for those that follow a session that exists."""

    turns: int | None
    frames: int | None
    alpha: float | None
    seed: int | None
    control: bool
    sweep: bool

    def plan(
        self, source: cameras.Camera, rig: walls.Rig | None, before: detection.Plan | None
    ) -> detection.Plan:
        """Return the plan for an entered camera. Raises typer.BadParameter for a wrong number."""
        from pydantic import ValidationError  # not for the help page

        swept = detection.swept_settings(source) if self.sweep else (detection.BASELINE,)
        try:
            return detection.Plan(
                created=datetime.now().astimezone().isoformat(timespec="seconds"),
                camera=source.uri,
                serial=source.identity.get("serial", ""),
                firmware=source.identity.get("firmware", ""),
                rig=rig,
                turns=self.turns or (before.turns if before else TURNS),
                frames=self.frames or (before.frames if before else FRAMES),
                alpha=self.alpha or (before.alpha if before else ALPHA),
                seed=secrets.randbits(32) if self.seed is None else self.seed,
                control=self.control,
                settings=swept,
            )
        except ValidationError as error:
            raise typer.BadParameter(walls.first_problem(error)) from error


def _measure(uri: str, chosen: benches.Choice, asked: Asked, folder: Path) -> detection.Session:
    before = detection.Session.open(folder).plan if detection.is_session(folder) else None
    with tracked("Opening the camera") as on_progress:
        source = cameras.open_camera(uri, on_progress=on_progress)
    movable = isinstance(source, cameras.SimulatedCamera)
    if not movable and not sys.stdin.isatty():
        raise NlosCamError(
            f"{uri} needs hands at a terminal, and stdin is none: run the command in a terminal"
        )
    kept = f"whole turns are in {folder}; the same command goes on"
    with interrupted_by_signals(kept), source:
        rig = chosen.open(source).rig if chosen.record else source.rig
        session = detection.Session.start(folder, asked.plan(source, rig, before))
        hands: detection.Hands = (
            detection.SimulatedHands(source, control=asked.control)
            if movable
            else TerminalHands(session.plan)
        )
        _run(session, source, hands, with_bar=movable or not stderr.is_terminal)
    return session


def _run(
    session: detection.Session, source: cameras.Camera, hands: detection.Hands, *, with_bar: bool
) -> None:
    """Measure the missing turns; a bar would cover the lines that ask for the object."""
    if not with_bar:
        detection.measure_turns(session, source, hands)
        return
    plan = session.plan
    with progress() as bar:
        per_turn = len(plan.settings) * (plan.frames + detection.SETTLING_FRAMES)
        task = bar.add_task("Measuring turns", total=per_turn * len(session.missing()))

        def advance() -> None:
            bar.advance(task)

        detection.measure_turns(session, source, hands, advance)


def _report(session: detection.Session, *, show_serial: bool, as_json: bool) -> None:
    with tracked("Flipping signs") as on_step:
        analysis = detection.analyze(session.plan, session.turns(), on_step)
    page = session.folder / detection.REPORT
    detection.write_report(analysis, page, show_serial=show_serial)
    banner = detection.verdict(analysis)
    lines = [f"Verdict: {banner.headline}. {banner.advice}"]
    if analysis.detected or not analysis.complete:
        lines.append(detection.power_text(analysis))
    lines.append(f"Wrote {page}")
    finish(_fields(analysis, page), as_json=as_json, text="\n".join(lines))


def _fields(analysis: detection.Analysis, page: Path) -> dict[str, Any]:
    plan = analysis.plan
    return {
        "detected": analysis.detected and analysis.complete,
        "complete": analysis.complete,
        "p_value": analysis.p_value,
        "alpha": plan.alpha,
        "turns": 4 * analysis.blocks,
        "frames": plan.frames,
        "control": plan.control,
        "settings": [each.name for each in plan.settings],
        "findings": [
            {
                "setting": each.setting,
                "channel": each.channel,
                "patch": each.patch,
                "p_value": each.p_value,
                "peak": each.peak,
                "cell": list(each.cell),
                "effect": each.effect,
                "smallest": each.smallest,
            }
            for each in analysis.findings
        ],
        "out": str(page),
    }
