"""`nlos-cam live --budget-ms`: the setting that keeps a delay on this machine, found by measuring, and told."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from nlos_calibration.wall_record import rig_named
from nlos_models.checkpoint import load_record, shipped_folder
from nlos_models.inference import Reconstructor

from nlos_cam.budget import HANDOVER_MS, SHIPPED, Machine, Option, choose, load_tradeoff
from nlos_cam.cache import cache_folder
from nlos_cam.camera.base import Camera
from nlos_cam.errors import BudgetError
from nlos_cam.live import warm_up
from nlos_cam.live_report import LiveReport
from nlos_cam.objects.depth_image import object_box
from nlos_cam.processing import Processing

BudgetMs = Annotated[
    float | None,
    typer.Option("--budget-ms", min=0.1, help="Choose the most accurate setting whose delay stays below so much."),
]
Tradeoff = Annotated[
    Path | None,
    typer.Option("--tradeoff", help="What `tradeoff reconstruct` measured, for --budget-ms; else beside the weights."),
]
CALLS = 30
LATE_PERCENT = 95

Make = Callable[[Reconstructor, int], Processing]
"""What is made of frames, by a network and the mean over so many frames."""
Clock = Callable[[], float]


@dataclass(frozen=True)
class Choice:
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

    def outcome(self, report: LiveReport) -> dict[str, Any]:
        """What became of it in a run, ready for JSON; the delay of averaging counts."""
        p95_ms = report.latency_ms["p95"] + self.option.averaging_ms
        option = self.option.model_dump(include={"name", "weights", "runtime", "threads", "frames"})
        figures = {"expected_ms": self.expected_ms, "rmse_mm": self.option.rmse_mm, "best_rmse_mm": self.best.rmse_mm}
        return {"ms": self.budget_ms, **option, **figures, "p95_ms": p95_ms, "kept": p95_ms <= self.budget_ms}

    def outcome_told(self, report: LiveReport) -> str:
        """The same in a line."""
        outcome = self.outcome(report)
        kept = "kept" if outcome["kept"] else "NOT kept"
        return f"budget   {self.budget_ms:g} ms {kept}: p95 {outcome['p95_ms']:.1f} ms"


@dataclass(frozen=True)
class Timed:
    """One setting's times here, late in their distribution."""

    network_ms: float
    rest_ms: float


def within_budget(
    budget_ms: float,
    options: Sequence[Option],
    make: Make,
    load: Callable[[Option], Reconstructor],
    measure: Callable[[Processing], Timed],
) -> tuple[Reconstructor, Choice]:
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
            return network, Choice(budget_ms, option, expected_ms, best)
        tried_ms.append(expected_ms)
        left.remove(option)
    raise BudgetError(
        f"no setting kept {budget_ms:g} ms when it was tried: the least was {min(tried_ms):.1f} ms; close what else "
        "runs, or give a larger --budget-ms"
    )


def options_here(tradeoff: Path | None, weights: Path | None) -> list[Option]:
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


def loader(weights: Path | None) -> Callable[[Option], Reconstructor]:
    """Makes the networks of options; `weights` are those that a table beside them calls shipped."""

    def load(option: Option) -> Reconstructor:
        from nlos_cam.tradeoff_reconstruct import runtimes

        folder = weights if option.weights == SHIPPED else Path(option.weights)
        rig = rig_named(load_record(folder or shipped_folder()).rig_name)
        if option.runtime.startswith("torch"):
            torch.set_num_threads(option.threads)
        return runtimes(folder, rig, object_box(rig), cache_folder() / "onnx")[option.runtime](option.threads)

    return load


def timer(camera: Camera, clock: Clock = time.perf_counter) -> Callable[[Processing], Timed]:
    """Measures what is made of frames on this machine, as it is now; a first call, which allocates, is not counted."""

    def measure(processing: Processing) -> Timed:
        warm_up(camera, processing)
        network_s, rest_s = np.empty(CALLS), np.empty(CALLS)
        for call in range(CALLS):
            begun_s = clock()
            network_s[call] = warm_up(camera, processing, clock)["network"]
            rest_s[call] = clock() - begun_s - network_s[call]
        return Timed(*(1e3 * float(np.percentile(each, LATE_PERCENT)) for each in (network_s, rest_s)))

    return measure
