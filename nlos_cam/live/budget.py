"""Which of the measured ways to reconstruct keeps a budget of delay on this machine, and what that costs.

    expected delay = hand-over + all but the network, here + network's 90 % in the table x how much slower this machine
                     is + (n - 1) / 2 frame periods

The last is what a mean over n frames adds: its middle is so much older than its newest frame. Accuracy is what was
measured on objects that stand still; what moves also smears.
"""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nlos_calibration import ObjectBox, Rig, rig_named
from nlos_models import Reconstructor, load_record, shipped_folder
from pydantic import BaseModel, Field, ValidationError

from nlos_cam.camera import FRAMES_PER_S, Camera
from nlos_cam.errors import BudgetError, RecordingError
from nlos_cam.files import cache_folder
from nlos_cam.live.loop import warm_up
from nlos_cam.live.statistics import RunReport
from nlos_cam.objects import object_box
from nlos_cam.reconstruct import Pipeline

TRADEOFF = "tradeoff.json"
"""What `tradeoff reconstruct` writes; one lies beside the shipped weights."""
SHIPPED = "shipped"
PERIOD_MS = 1000 / FRAMES_PER_S
HANDOVER_MS = 2.4
"""From a frame's timestamp until it is its turn: 95 % of both stages in docs/live.json."""
BUSY_SHARE = 0.5
"""Of each frame's period: the rest is for the camera, the view and whatever else runs."""


class Figure(BaseModel):
    """A metric's estimate."""

    value: float | None


class Option(BaseModel):
    """One measured setting of a trade-off."""

    name: str
    weights: str
    """"shipped", or a folder."""
    runtime: str
    threads: int = Field(ge=1)
    frames: int = Field(ge=1)
    """Averaged."""
    milliseconds: float = Field(gt=0)
    milliseconds_p90: float = Field(gt=0)
    foreground_rmse_mm: Figure

    @property
    def rmse_mm(self) -> float:
        """Infinite where no surface was found at all."""
        value = self.foreground_rmse_mm.value
        return float("inf") if value is None else value

    @property
    def averaging_ms(self) -> float:
        """The delay that the mean over its frames adds."""
        return (self.frames - 1) / 2 * PERIOD_MS


class _Table(BaseModel):
    settings: list[Option] = Field(min_length=1)


@dataclass(frozen=True)
class Machine:
    """What was measured of this machine."""

    slower: float
    """How many times longer a network takes at its 90 % than in the table."""
    rest_ms: float
    """All that is done to a frame but the network."""

    def busy_ms(self, option: Option) -> float:
        """What a frame costs."""
        return self.rest_ms + self.slower * option.milliseconds_p90

    def expected_ms(self, option: Option) -> float:
        """The delay of what is shown."""
        return HANDOVER_MS + self.busy_ms(option) + option.averaging_ms


def load_tradeoff(path: Path) -> list[Option]:
    """The settings of a table that `tradeoff reconstruct` wrote. Raises RecordingError."""
    file = path / TRADEOFF if path.is_dir() else path
    try:
        return _Table.model_validate_json(file.read_text(encoding="utf-8")).settings
    except (OSError, UnicodeDecodeError, ValidationError) as error:
        what = error.strerror if isinstance(error, OSError) else "no table of settings"
        raise RecordingError(
            f"{file} cannot be read ({what}): measure these weights with `nlos-cam tradeoff reconstruct --out DIR`, "
            "and give --tradeoff DIR"
        ) from error


def keeping_pace(options: Sequence[Option], machine: Machine) -> list[Option]:
    """Those that leave time between frames; the quickest alone where none does."""
    kept = [option for option in options if machine.busy_ms(option) <= BUSY_SHARE * PERIOD_MS]
    return kept or [min(options, key=lambda option: (machine.busy_ms(option), option.frames))]


def choose(options: Sequence[Option], machine: Machine, budget_ms: float) -> Option:
    """The most accurate that keeps budget and pace; of those alike, that of the fewest threads, then the quickest.

    Raises BudgetError where none does.
    """
    paced = keeping_pace(options, machine)
    kept = [option for option in paced if machine.expected_ms(option) <= budget_ms]
    if not kept:
        least = min(paced, key=machine.expected_ms)
        raise BudgetError(
            f"no setting keeps a delay of {budget_ms:g} ms on this machine: the least is "
            f"{machine.expected_ms(least):.1f} ms ({least.name}); give a larger --budget-ms"
        )
    return min(kept, key=lambda option: (round(option.rmse_mm, 2), option.threads, machine.expected_ms(option)))


CALLS = 30


LATE_PERCENT = 95


Make = Callable[[Reconstructor, int], Pipeline]
"""What is made of frames, by a network and the mean over so many frames."""


Clock = Callable[[], float]


@dataclass(frozen=True)
class BudgetChoice:
    """What was chosen, and why."""

    budget_ms: float
    option: Option
    expected_ms: float
    best: Option
    """The most accurate of all that were measured, however late."""

    def told(self) -> str:
        """In one line."""
        option, loss_mm = self.option, self.option.rmse_mm - self.best.rmse_mm
        averaged = f", the mean of {option.frames} frames ({option.averaging_ms:.0f} ms)" if option.frames > 1 else ""
        cost = f"{loss_mm:.1f} mm more than the best, {self.best.name}" if loss_mm > 0 else "the best there is"
        return (
            f"budget {self.budget_ms:g} ms: {option.runtime} on {option.threads} "
            f"thread{'s' if option.threads > 1 else ''}{averaged}; {self.expected_ms:.1f} ms expected at p95; "
            f"RMSE {option.rmse_mm:.1f} mm, {cost}"
        )

    def outcome(self, report: RunReport) -> dict[str, Any]:
        """What became of it in a run, ready for JSON; the delay of averaging counts."""
        p95_ms = report.latency_ms["p95"] + self.option.averaging_ms
        option = self.option.model_dump(include={"name", "weights", "runtime", "threads", "frames"})
        figures = {"expected_ms": self.expected_ms, "rmse_mm": self.option.rmse_mm, "best_rmse_mm": self.best.rmse_mm}
        return {"ms": self.budget_ms, **option, **figures, "p95_ms": p95_ms, "kept": p95_ms <= self.budget_ms}

    def outcome_told(self, report: RunReport) -> str:
        """The same in a line."""
        outcome = self.outcome(report)
        kept = "kept" if outcome["kept"] else "NOT kept"
        return f"budget   {self.budget_ms:g} ms {kept}: p95 {outcome['p95_ms']:.1f} ms"


@dataclass(frozen=True)
class Timed:
    """One setting's times here, late in their distribution."""

    network_ms: float
    rest_ms: float


def choose_within_budget(
    budget_ms: float,
    options: Sequence[Option],
    make: Make,
    load: Callable[[Option], Reconstructor],
    measure: Callable[[Pipeline], Timed],
) -> tuple[Reconstructor, BudgetChoice]:
    """The networks of the setting that keeps the budget: chosen by the table, and then tried.

    The table is scaled by its quickest setting of one thread and frame. One that turns out slower than expected is
    given up for the next best. Raises BudgetError where none is left.
    """
    singles = (option for option in options if option.frames == 1)
    anchor = min(singles, key=lambda option: (option.threads, option.milliseconds))
    timed = measure(make(load(anchor), 1))
    machine = Machine(timed.network_ms / anchor.milliseconds_p90, timed.rest_ms)
    best, left = min(options, key=lambda option: option.rmse_mm), list(options)
    tried_ms: list[float] = []
    while left:
        try:
            option = choose(left, machine, budget_ms)
        except BudgetError:
            if not tried_ms:
                raise
            break
        network = load(option)
        timed = measure(make(network, option.frames))
        expected_ms = HANDOVER_MS + timed.network_ms + timed.rest_ms + option.averaging_ms
        if expected_ms <= budget_ms:
            return network, BudgetChoice(budget_ms, option, expected_ms, best)
        tried_ms.append(expected_ms)
        left.remove(option)
    raise BudgetError(
        f"no setting kept {budget_ms:g} ms when it was tried: the least was {min(tried_ms):.1f} ms; close what else "
        "runs, or give a larger --budget-ms"
    )


def available_options(tradeoff: Path | None, weights: Path | None) -> list[Option]:
    """The measured settings that can run on this machine. Raises RecordingError, and BudgetError where none can."""
    options = load_tradeoff(tradeoff or weights or shipped_folder())
    processors = os.cpu_count() or 1
    here = [
        option
        for option in options
        if option.threads <= processors
        and ("cuda" not in option.runtime or torch.cuda.is_available())
        and (option.weights == SHIPPED or Path(option.weights).is_dir())
    ]
    if not any(option.frames == 1 for option in here):
        raise BudgetError("no setting of this trade-off runs on this machine: measure with `tradeoff reconstruct`")
    return here


Runtimes = Callable[[Path | None, Rig, ObjectBox, Path], Mapping[str, Callable[[int], Reconstructor]]]
"""Weights, rig, object box and cache folder to networks by runtime and number of threads."""


def loader(weights: Path | None, runtimes: Runtimes) -> Callable[[Option], Reconstructor]:
    """Return a function that loads the networks of an option; `weights` are those that its table calls shipped."""

    def load(option: Option) -> Reconstructor:
        folder = weights if option.weights == SHIPPED else Path(option.weights)
        rig = rig_named(load_record(folder or shipped_folder()).rig_name)
        if option.runtime.startswith("torch"):
            torch.set_num_threads(option.threads)
        return runtimes(folder, rig, object_box(rig), cache_folder() / "onnx")[option.runtime](option.threads)

    return load


def timer(camera: Camera, clock: Clock = time.perf_counter) -> Callable[[Pipeline], Timed]:
    """Measures what is made of frames on this machine, as it is now; a first call, which allocates, is not counted."""

    def measure(processing: Pipeline) -> Timed:
        warm_up(camera, processing)
        network_s, rest_s = np.empty(CALLS), np.empty(CALLS)
        for call in range(CALLS):
            start_s = clock()
            network_s[call] = warm_up(camera, processing, clock)["network"]
            rest_s[call] = clock() - start_s - network_s[call]
        return Timed(*(1e3 * float(np.percentile(each, LATE_PERCENT)) for each in (network_s, rest_s)))

    return measure
