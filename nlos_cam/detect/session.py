"""Session: the folder of a detection, with its plan and one file for each turn."""

import json
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nlos_calibration import first_problem
from pydantic import ValidationError

from nlos_cam.detect.plan import BLOCK_TURNS, Plan
from nlos_cam.detect.turns import Turn
from nlos_cam.errors import OutputExistsError, RecordingError
from nlos_cam.files import TEXT_LIMIT, atomic_file, read_bounded

PLAN = "detection.json"
TURNS = "turn-*.npz"
REPORT = "detection.html"
NUMBERS = ("turns", "frames", "alpha")
"""Fields of the plan whose values say what differs."""
ASKED = (*NUMBERS, "control")
"""Fields of the plan that a command gives by itself, before a camera is open."""
TOGETHER = (*ASKED, "serial", "settings", "rig")
"""Fields of the plan that a command must repeat in order to go on with a session."""


@dataclass(frozen=True)
class Session:
    """Folder of a detection."""

    folder: Path
    plan: Plan

    @classmethod
    def start(cls, folder: Path, plan: Plan) -> "Session":
        """Create a session in an empty or new folder, or return the one in it that has this plan.

        Date, version and order are those of the session that exists. Raises RecordingError where
        its plan is another, OutputExistsError where the folder holds others' files.
        """
        if is_session(folder):
            session = cls.open(folder)
            # A real camera is known by its serial number; simulated ones share theirs.
            session.refuse_another(plan, (*TOGETHER, "camera") if plan.is_simulated else TOGETHER)
            return session
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise OutputExistsError(
                f"{folder} exists and is no detection: choose another name for --out"
            )
        return cls.begin(folder, plan)

    @classmethod
    def begin(cls, folder: Path, plan: Plan) -> "Session":
        """Create a session in a folder. An earlier one there goes, with its page; other files
        stay.
        """
        folder.mkdir(parents=True, exist_ok=True)
        for path in (folder / PLAN, folder / REPORT, *folder.glob(TURNS)):
            path.unlink(missing_ok=True)
        with atomic_file(folder / PLAN) as part:
            part.write_text(plan.model_dump_json(indent=1), encoding="utf-8")
        return cls(folder, plan)

    @classmethod
    def open(cls, folder: Path) -> "Session":
        """Return the session in a folder. Raises RecordingError where there is none."""
        path = folder / PLAN
        try:
            content = json.loads(read_bounded(path, TEXT_LIMIT))
        except OSError as error:
            raise RecordingError(
                f"{folder} is not a detection (no {PLAN} can be read): give a folder that"
                " `nlos-cam detect` wrote"
            ) from error
        except (ValueError, RecursionError) as error:
            raise RecordingError(f"{path} is not JSON: restore it, or begin again") from error
        try:
            return cls(folder, Plan.model_validate(content))
        except ValidationError as error:
            raise RecordingError(
                f"{path} is not a valid plan ({first_problem(error)}): restore it, or begin again"
            ) from error

    def refuse_another(self, plan: Plan, names: Sequence[str] = ASKED) -> None:
        """Raise RecordingError for a plan with another value in one of the named fields."""
        for name in names:
            before, asked = getattr(self.plan, name), getattr(plan, name)
            if before != asked:
                values = f" ({before}, not {asked})" if name in NUMBERS else ""
                raise RecordingError(
                    f"{self.folder} was begun with another {name}{values}: repeat that command, or"
                    " choose another folder (a plan that changes midway has no false-alarm rate)"
                )

    def path(self, turn: int) -> Path:
        """Return the file of a turn, counted from 0."""
        return self.folder / f"turn-{turn + 1:04d}.npz"

    def missing(self) -> list[int]:
        """Return the turns that are still to be measured, in order.

        Where one was deleted before a later one of its block, the whole block is: with turns of two
        days, the drift that each block's contrast leaves out would take the object along.
        """
        missing: list[int] = []
        for first in range(0, self.plan.turns, BLOCK_TURNS):
            block = range(first, first + BLOCK_TURNS)
            there = [self.path(turn).exists() for turn in block]
            has_hole = there != sorted(there, reverse=True)
            missing += [
                turn
                for turn, is_there in zip(block, there, strict=True)
                if has_hole or not is_there
            ]
        return missing

    def turns(self) -> list[Turn]:
        """Read the turns of all whole blocks from the start on. Raises RecordingError for a file
        that is none, or of the other label.
        """
        missing = self.missing()
        # A later turn is never used without those before it.
        count = missing[0] if missing else self.plan.turns
        order = self.plan.order()
        turns: list[Turn] = []
        for number in range(count):
            turn = Turn.load(self.path(number), len(self.plan.settings))
            if turn.frames != self.plan.frames:
                raise RecordingError(
                    f"{self.path(number)} is a turn of {turn.frames} frames, but {PLAN} has"
                    f" {self.plan.frames}: files of two sessions are mixed"
                )
            if turn.object_in != order[number]:
                raise RecordingError(
                    f"{self.path(number)} is a turn with the object"
                    f" {'in' if turn.object_in else 'out'}, which contradicts {PLAN}: files of two"
                    " sessions are mixed"
                )
            turns.append(turn)
        return turns


def how_to_go_on(folder: Path) -> str:
    """Return in words how the command goes on with a session; --overwrite would delete its turns."""
    return f"the same command, without --overwrite, goes on with --out {shlex.quote(str(folder))}"


def is_session(folder: Path) -> bool:
    """Return True if the folder has a plan."""
    return (folder / PLAN).is_file()
