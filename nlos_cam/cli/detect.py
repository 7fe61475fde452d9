"""`nlos-cam detect`: does a hidden object change what the lidar reports? Object in, object out, in
turns.
"""

from __future__ import annotations

import secrets
import shlex
import sys
from collections.abc import Callable
from contextlib import suppress
from datetime import datetime
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import nlos_calibration as walls
import typer

from nlos_cam import bench as bench_folders
from nlos_cam import camera as cameras
from nlos_cam import detect as detection
from nlos_cam.cli import benches
from nlos_cam.cli.common import (
    Camera,
    Json,
    Overwrite,
    ask,
    finish,
    interrupted_by_signals,
    output_path,
    progress,
    refuse_ignored,
    stderr,
    tracked,
)
from nlos_cam.errors import NlosCamError

TURNS = 32
FRAMES = 30
ALPHA = 0.01
CONTROL_WORDS = ": the same motions with an EMPTY hand"


def read_fresh_line() -> str:
    """Return the next line that is typed, "" where stdin ends.

    What was typed before it is dropped: an Enter during the last turn answers no later question.
    """
    if sys.stdin.isatty():
        with suppress(ImportError):  # Windows has none
            import termios

            termios.tcflush(sys.stdin, termios.TCIFLUSH)
    return sys.stdin.readline()


class TerminalHands:
    """Person at the terminal who moves the object and presses Enter."""

    def __init__(
        self,
        plan: detection.Plan,
        folder: Path,
        read_line: Callable[[], str] = read_fresh_line,
    ) -> None:
        self._plan = plan
        self._folder = folder
        self._read_line = read_line

    def place(self, turn: int, *, object_in: bool) -> None:
        """Ask for the object's place and wait for Enter. Raises NlosCamError where stdin ends."""
        # In every turn the object leaves its place once: otherwise the hands alone would tell
        # turns apart.
        words = "take the object out, put it back IN" if object_in else "put it in, take it OUT"
        if self._plan.control:
            words += CONTROL_WORDS
        ask(f"Turn {turn + 1} of {self._plan.turns}: {words}. Step back and press Enter.")
        if not self._read_line():
            raise NlosCamError(
                f"stdin ended before turn {turn + 1}: in a terminal,"
                f" {detection.how_to_go_on(self._folder)}"
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
        typer.Option(
            "--turns",
            min=16,
            max=4096,
            help="Turns, a multiple of 4; --alpha 0.01 needs at least 32 (default: 32).",
        ),
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
            min=1e-3,
            max=0.2,
            help="Rate of false alarms, for the whole family of tests (default: 0.01).",
        ),
    ] = None,
    settings: Annotated[
        Literal["as-started", "sweep"] | None,
        typer.Option(
            "--settings",
            show_default="as-started",
            help="sweep: in every turn also one option at a time at other values (laser power,"
            " gains, least distance, filters).",
        ),
    ] = None,
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
    rig_option = _rig_option(bench_folder, wall)
    asked = Asked(turns, frames, alpha, seed, control, settings == "sweep", rig_option)
    folder = Path(camera)
    # A folder that happens to be named like a camera is given as ./sim.
    if folder.is_dir() and camera not in cameras.PLAIN_NAMES:
        _refuse_bench(folder)
        asked.refuse_beside(folder, {"--settings": settings is not None, "--out": out is not None})
        with interrupted_by_signals(f"the turns in {folder} are as they were"):
            _report(detection.Session.open(folder), show_serial=show_serial, as_json=json)
        return
    if camera.startswith("bag:"):
        raise typer.BadParameter(f"{camera} is a recording without turns: give a live camera")
    folder = output_path(out, "detect", "", overwrite=True)  # a session that exists goes on
    folder = folder.resolve() if folder.is_symlink() else folder  # --overwrite keeps a link
    chosen = benches.choose(bench_folder, wall, reconstructs=False)
    goes_on = detection.is_session(folder) and not overwrite
    existing = detection.Session.open(folder) if goes_on else None
    asked.check(camera, existing)
    source = _open(camera)
    with interrupted_by_signals(f"whole turns are in {folder}; {detection.how_to_go_on(folder)}"):
        before = existing.plan if existing else None
        session = _measure(source, chosen, asked, before, folder)
        _report(session, show_serial=show_serial, as_json=json)


def _rig_option(bench_folder: Path | None, wall: Path | None) -> str:
    """Return the option that names the rig, without the folders above it."""
    for option, path in (("--bench", bench_folder), ("--wall", wall)):
        if path is not None:
            return f"{option} {shlex.quote(path.resolve().name)}"
    return ""


def _refuse_bench(folder: Path) -> None:
    """Raise typer.BadParameter for a bench folder in place of CAMERA."""
    if not bench_folders.is_bench(folder):
        return
    camera = cameras.camera_to_name(bench_folders.load_bench(folder).measured.record)
    raise typer.BadParameter(
        f"{folder} is a bench folder, and no camera was named: give it as --bench, for example"
        f" `nlos-cam detect {camera} --bench {shlex.quote(str(folder))}`"
    )


class Asked(NamedTuple):
    """Options of the command line; None for those that follow a session that exists."""

    turns: int | None
    frames: int | None
    alpha: float | None
    seed: int | None
    control: bool
    sweep: bool
    rig_option: str

    def refuse_beside(self, folder: Path, others: dict[str, bool]) -> None:
        """Raise SceneError for an option that a session, to be analyzed again, would ignore."""
        given = {
            (self.rig_option or "--wall").split(maxsplit=1)[0]: bool(self.rig_option),
            "--turns": self.turns is not None,
            "--frames": self.frames is not None,
            "--alpha": self.alpha is not None,
            "--seed": self.seed is not None,
            "--control": self.control,
        }
        why = f"the turns in {folder} are analyzed by the plan they were measured by"
        refuse_ignored(why, given | others, "give a camera in place of the folder")

    def check(self, uri: str, existing: detection.Session | None) -> None:
        """Check before the camera is opened. Raises typer.BadParameter for a wrong number,
        RecordingError for another plan than that of the session that goes on.
        """
        plan = self._plan(existing.plan if existing else None, camera=uri)
        if existing is None:
            return
        existing.refuse_another(plan)
        if self.seed not in {None, existing.plan.seed}:
            raise typer.BadParameter(
                f"--seed {self.seed} draws another order of turns than the session that goes on"
                f" (seed {existing.plan.seed}): omit it, or choose another folder"
            )

    def plan(
        self, source: cameras.Camera, rig: walls.Rig | None, before: detection.Plan | None
    ) -> detection.Plan:
        """Return the plan for an entered camera. Raises typer.BadParameter for a wrong number."""
        return self._plan(
            before,
            camera=source.uri,
            serial=source.identity.get("serial", ""),
            firmware=source.identity.get("firmware", ""),
            rig=rig,
            settings=self._settings(source, before),
        )

    def _settings(
        self, source: cameras.Camera, before: detection.Plan | None
    ) -> tuple[detection.Setting, ...]:
        """Return the settings of every turn; a session that goes on keeps those it began with."""
        if before and (len(before.settings) > 1) == self.sweep:
            return before.settings
        if self.sweep:
            return detection.swept_settings(source)
        return (detection.setting_as_started(source),)

    def _plan(self, before: detection.Plan | None, **circumstances: Any) -> detection.Plan:
        from pydantic import ValidationError  # not for the help page

        try:
            return detection.Plan(
                created=datetime.now().astimezone().isoformat(timespec="seconds"),
                turns=self.turns or (before.turns if before else TURNS),
                frames=self.frames or (before.frames if before else FRAMES),
                alpha=self.alpha or (before.alpha if before else ALPHA),
                seed=secrets.randbits(32) if self.seed is None else self.seed,
                control=self.control,
                rig_option=self.rig_option,
                **circumstances,
            )
        except ValidationError as error:
            problem = walls.first_problem(error).removeprefix("record: ")
            raise typer.BadParameter(problem) from error


def _open(uri: str) -> cameras.Camera:
    """Return a camera whose object can be moved. Raises NlosCamError without hands to do it."""
    with tracked("Opening the camera") as on_progress:
        source = cameras.open_camera(uri, on_progress=on_progress)
    if not isinstance(source, cameras.SimulatedCamera) and not sys.stdin.isatty():
        raise NlosCamError(
            f"{uri} needs hands at a terminal, and stdin is none: run the command in a terminal"
        )
    return source


def _measure(
    source: cameras.Camera,
    chosen: benches.Choice,
    asked: Asked,
    before: detection.Plan | None,
    folder: Path,
) -> detection.Session:
    with source:
        rig = source.rig
        if chosen.record:
            bench = chosen.open(source)
            rig = bench.rig
            benches.note_warnings(bench)
        plan = asked.plan(source, rig, before)
        begins_again = before is None and detection.is_session(folder)  # by --overwrite
        start = detection.Session.begin if begins_again else detection.Session.start
        session = start(folder, plan)
        hands: detection.Hands = (
            detection.SimulatedHands(source, control=asked.control)
            if isinstance(source, cameras.SimulatedCamera)
            else TerminalHands(session.plan, session.folder)
        )
        with_bar = isinstance(hands, detection.SimulatedHands) or not stderr.is_terminal
        _run(session, source, hands, with_bar=with_bar)
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
                # Not known where no size of an effect was found: JSON has no infinity.
                "smallest": each.smallest if isfinite(each.smallest) else None,
            }
            for each in analysis.findings
        ],
        "out": str(page),
    }
