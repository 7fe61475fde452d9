"""Latency budget (`--budget-ms`): the most accurate measured setting that meets it on this machine.

    expected latency = hand-over + all but the networks, here + networks' 90th percentile in the
    table x how much slower
                       this machine is + (n - 1) / 2 frame periods

The last term is the age of a mean over n frames: its frames are 0 to n - 1 periods older than the
newest, on average (n - 1) / 2. The table's accuracy was measured with objects at rest; moving ones
blur as well.
"""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from nlos_calibration import ObjectBox, Rig, rig_named
from nlos_models import Reconstructor, load_reconstructor, load_record, weights_folder
from pydantic import BaseModel, Field, ValidationError

from nlos_cam.camera import FRAMES_PER_S, Camera
from nlos_cam.errors import BudgetError, RecordingError
from nlos_cam.files import cache_folder
from nlos_cam.live.control import RunControl
from nlos_cam.live.loop import warm_up
from nlos_cam.live.statistics import RunReport
from nlos_cam.objects import object_box
from nlos_cam.reconstruct import CalibratedRig, Clock, Pipeline

TRADEOFF = "tradeoff.json"
"""Table written by `tradeoff reconstruct`; one is beside the shipped weights."""
SHIPPED = "shipped"
ONNX_FLOAT32 = "ONNX Runtime float32"
PERIOD_MS = 1000 / FRAMES_PER_S
HANDOVER_MS = 2.4
"""From a frame's timestamp to its processing: 95th percentile of delivery and queue in
docs/figures/live.json.
"""
BUSY_SHARE = 0.5
"""Share of each frame period for processing: the rest is for camera, view and other programs."""
CALLS = 30
LATE_PERCENT = 95
"""Calls timed on this machine, and the percentile taken of them."""

BuildPipeline = Callable[[Reconstructor, int], Pipeline]
"""Networks and number of averaged frames to a pipeline."""
Runtimes = Callable[
    [Path | None, Rig, ObjectBox, Path], Mapping[str, Callable[[int], Reconstructor]]
]
"""Weights, rig, object box and cache folder to loaders by runtime, which take a number of
threads.
"""


class Metric(BaseModel):
    """Estimate of a metric."""

    value: float | None


class Setting(BaseModel):
    """Measured setting of a trade-off table: weights, runtime, threads, averaged frames."""

    name: str
    weights: str
    """"shipped", or a folder."""
    runtime: str
    threads: int = Field(ge=1)
    frames: int = Field(ge=1)
    """Number of averaged frames."""
    milliseconds: float = Field(gt=0)
    milliseconds_p90: float = Field(gt=0)
    foreground_rmse_mm: Metric

    @property
    def rmse_mm(self) -> float:
        """Infinite if no surface was found at all."""
        value = self.foreground_rmse_mm.value
        return float("inf") if value is None else value

    @property
    def averaging_ms(self) -> float:
        """Latency added by averaging."""
        return (self.frames - 1) / 2 * PERIOD_MS


class _Table(BaseModel):
    settings: list[Setting] = Field(min_length=1)


@dataclass(frozen=True)
class Timing:
    """Milliseconds per frame on this machine, late in their distribution."""

    network_ms: float
    rest_ms: float
    """All but the networks."""


@dataclass(frozen=True)
class Machine:
    """Speed of this machine."""

    slower: float
    """Networks' time here over their 90th percentile in the table."""
    rest_ms: float

    def busy_ms(self, setting: Setting) -> float:
        """Return the processing time of a frame."""
        return self.rest_ms + self.slower * setting.milliseconds_p90

    def expected_ms(self, setting: Setting) -> float:
        """Return the latency."""
        return HANDOVER_MS + self.busy_ms(setting) + setting.averaging_ms


@dataclass(frozen=True)
class BudgetChoice:
    """Setting chosen for a latency budget, with its latency measured here."""

    budget_ms: float
    setting: Setting
    expected_ms: float
    best: Setting
    """The most accurate of all measured settings, at any latency."""

    def describe(self) -> str:
        """Return the choice and its cost in accuracy in one line."""
        loss_mm = self.setting.rmse_mm - self.best.rmse_mm
        setting = self.setting
        threads = f"{setting.threads} thread{'s' if setting.threads > 1 else ''}"
        mean = (
            f", mean of {setting.frames} frames ({setting.averaging_ms:.0f} ms)"
            if setting.frames > 1
            else ""
        )
        cost = (
            f"{loss_mm:.1f} mm above the best, {self.best.name}"
            if loss_mm > 0
            else "the best of all settings"
        )
        return (
            f"Budget {self.budget_ms:g} ms: {setting.runtime} on {threads}{mean}; expected p95"
            f" {self.expected_ms:.1f} ms; RMSE {setting.rmse_mm:.1f} mm, {cost}"
        )

    def outcome(self, report: RunReport) -> dict[str, Any]:
        """Return the choice and its result in a run, ready for JSON; `p95_ms` includes
        averaging.
        """
        p95_ms = report.latency_ms["p95"] + self.setting.averaging_ms
        setting = self.setting.model_dump(
            include={"name", "weights", "runtime", "threads", "frames"}
        )
        figures = {
            "expected_ms": self.expected_ms,
            "rmse_mm": self.setting.rmse_mm,
            "best_rmse_mm": self.best.rmse_mm,
        }
        return {
            "ms": self.budget_ms,
            **setting,
            **figures,
            "p95_ms": p95_ms,
            "kept": p95_ms <= self.budget_ms,
        }

    def describe_outcome(self, report: RunReport) -> str:
        """Return whether a run met the budget in one line."""
        outcome = self.outcome(report)
        return (
            f"Budget {self.budget_ms:g} ms {'' if outcome['kept'] else 'NOT '}met: p95"
            f" {outcome['p95_ms']:.1f} ms"
        )


def load_tradeoff(path: Path) -> list[Setting]:
    """Load the settings of a table, given as a file or its folder. Raises RecordingError."""
    file = path / TRADEOFF if path.is_dir() else path
    try:
        return _Table.model_validate_json(file.read_text(encoding="utf-8")).settings
    except (OSError, UnicodeDecodeError, ValidationError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a table of settings"
        raise RecordingError(
            f"cannot read {file} ({reason}): measure these weights with `nlos-cam tradeoff"
            " reconstruct --out DIR`, and give --tradeoff DIR"
        ) from error


def offer_settings(
    control: RunControl,
    camera: Camera,
    bench: CalibratedRig,
    tradeoff: Path | None,
    weights: Path | None,
) -> None:
    """Let a run's control choose between the measured settings in ONNX_FLOAT32; without a table,
    none.

    The other runtimes are slower and no more accurate, and take seconds to import.
    """
    try:
        available = available_settings(tradeoff, weights)
    except (RecordingError, BudgetError):
        return
    settings = {each.name: each for each in available if each.runtime == ONNX_FLOAT32}
    control.settings = [
        (
            name,
            f"{name}: {each.milliseconds + each.averaging_ms:.0f} ms, error {each.rmse_mm:.1f} mm",
        )
        for name, each in settings.items()
    ]

    def load_setting(name: str) -> tuple[Reconstructor, int]:
        setting = settings[name]
        folder = weights if setting.weights == SHIPPED else Path(setting.weights)
        network = load_reconstructor(folder, cache_folder() / "onnx", setting.threads)
        warm_up(camera, Pipeline(bench, network))
        return network, setting.frames

    control.load_setting = load_setting


def available_settings(tradeoff: Path | None, weights: Path | None) -> list[Setting]:
    """Return the measured settings that this machine can run. Raises RecordingError, and
    BudgetError without any.
    """
    processors = os.cpu_count() or 1
    available = [
        setting
        for setting in load_tradeoff(tradeoff or weights_folder(weights))
        if setting.threads <= processors
        and (
            setting.runtime == ONNX_FLOAT32 or find_spec("torch") is not None
        )  # others are made with torch
        and ("cuda" not in setting.runtime or _has_cuda())
        and (setting.weights == SHIPPED or Path(setting.weights).is_dir())
    ]
    if not any(setting.frames == 1 for setting in available):
        raise BudgetError(
            "this machine can run no setting of the trade-off: measure with `tradeoff reconstruct`"
        )
    return available


def _has_cuda() -> bool:
    import torch

    return torch.cuda.is_available()


def keeping_pace(settings: Sequence[Setting], machine: Machine) -> list[Setting]:
    """Return the settings that leave time between frames; the quickest alone if none does."""
    quick = [setting for setting in settings if machine.busy_ms(setting) <= BUSY_SHARE * PERIOD_MS]
    return quick or [min(settings, key=lambda setting: (machine.busy_ms(setting), setting.frames))]


def choose(settings: Sequence[Setting], machine: Machine, budget_ms: float) -> Setting:
    """Return the most accurate setting that keeps pace and meets the budget. Raises BudgetError
    without any.

    Among equally accurate ones, that of the fewest threads, then the quickest.
    """
    paced = keeping_pace(settings, machine)
    within = [setting for setting in paced if machine.expected_ms(setting) <= budget_ms]
    if not within:
        quickest = min(paced, key=machine.expected_ms)
        raise BudgetError(
            f"no setting meets a latency budget of {budget_ms:g} ms on this machine: the least is "
            f"{machine.expected_ms(quickest):.1f} ms ({quickest.name}); give a larger --budget-ms"
        )
    return min(
        within,
        key=lambda setting: (
            round(setting.rmse_mm, 2),
            setting.threads,
            machine.expected_ms(setting),
        ),
    )


def choose_within_budget(
    budget_ms: float,
    settings: Sequence[Setting],
    build: BuildPipeline,
    load: Callable[[Setting], Reconstructor],
    measure: Callable[[Pipeline], Timing],
) -> tuple[Reconstructor, BudgetChoice]:
    """Return the networks of the setting that meets the budget: chosen from the table, then timed
    here.

    The table is scaled by its quickest setting with one frame and the fewest threads. A setting
    that is slower than expected is replaced by the next best. Raises BudgetError if none is left.
    """
    singles = (setting for setting in settings if setting.frames == 1)
    anchor = min(singles, key=lambda setting: (setting.threads, setting.milliseconds))
    timing = measure(build(load(anchor), 1))
    machine = Machine(timing.network_ms / anchor.milliseconds_p90, timing.rest_ms)
    best = min(settings, key=lambda setting: setting.rmse_mm)
    left = list(settings)
    tried_ms: list[float] = []
    while left:
        try:
            setting = choose(left, machine, budget_ms)
        except BudgetError:
            if not tried_ms:
                raise
            break
        network = load(setting)
        timing = measure(build(network, setting.frames))
        expected_ms = HANDOVER_MS + timing.network_ms + timing.rest_ms + setting.averaging_ms
        if expected_ms <= budget_ms:
            return network, BudgetChoice(budget_ms, setting, expected_ms, best)
        tried_ms.append(expected_ms)
        left.remove(setting)
    raise BudgetError(
        f"no setting met {budget_ms:g} ms when timed on this machine: the least was"
        f" {min(tried_ms):.1f} ms; close other programs, or give a larger --budget-ms"
    )


def setting_loader(weights: Path | None, runtimes: Runtimes) -> Callable[[Setting], Reconstructor]:
    """Return a function that loads a setting's networks; `weights` replace those that the table
    calls shipped.
    """

    def load(setting: Setting) -> Reconstructor:
        folder = weights if setting.weights == SHIPPED else Path(setting.weights)
        if setting.runtime == ONNX_FLOAT32:
            return load_reconstructor(folder, cache_folder() / "onnx", setting.threads)
        rig = rig_named(load_record(weights_folder(folder)).rig_name)
        if setting.runtime.startswith("torch"):
            import torch  # takes seconds, and is not needed for ONNX Runtime

            torch.set_num_threads(setting.threads)
        return runtimes(folder, rig, object_box(rig), cache_folder() / "onnx")[setting.runtime](
            setting.threads
        )

    return load


def pipeline_timer(
    camera: Camera, clock: Clock = time.perf_counter
) -> Callable[[Pipeline], Timing]:
    """Return a function that times a pipeline on this machine, without its first call, which
    allocates.
    """

    def measure(pipeline: Pipeline) -> Timing:
        warm_up(camera, pipeline)
        network_s = np.empty(CALLS)
        rest_s = np.empty(CALLS)
        for call in range(CALLS):
            start_s = clock()
            network_s[call] = warm_up(camera, pipeline, clock)["network"]
            rest_s[call] = clock() - start_s - network_s[call]
        return Timing(
            *(1e3 * float(np.percentile(each, LATE_PERCENT)) for each in (network_s, rest_s))
        )

    return measure
