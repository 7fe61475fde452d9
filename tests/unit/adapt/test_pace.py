"""Pace of a machine: how many objects its processes render a second."""

from heapq import heapify, heappop, heappush
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nlos_calibration import load_rig

from nlos_cam.adapt import Adaptation, calibration_spread
from nlos_cam.adapt import pace as machine_pace
from nlos_cam.dataset.build import PIECE

PIECE_S = 0.5
"""Time in which a process renders a piece."""


STEP_S = 0.4


class Machine:
    """Machine with a number of processes, and a clock that only their work moves."""

    def __init__(self, processes: int) -> None:
        self.processes = processes
        self.now_s = 0.0
        self.objects = 0

    def perf_counter(self) -> float:
        """Return the time."""
        return self.now_s

    def step(self) -> None:
        """Train a step."""
        self.now_s += STEP_S

    def build(self, _plan: Any, count: int, *_: object, on_progress: Any, **__: object) -> None:
        """Render, each process a piece at a time, each in about the same time."""
        on_progress(self.objects, count)
        generator = np.random.default_rng(0)
        free_s = [self.now_s] * self.processes
        heapify(free_s)
        ends_s: list[float] = []
        for _ in range((count - self.objects) // PIECE):
            ends_s.append(heappop(free_s) + PIECE_S * generator.uniform(0.9, 1.1))
            heappush(free_s, ends_s[-1])
        for end_s in sorted(ends_s):
            self.now_s = end_s
            self.objects += PIECE
            on_progress(self.objects, count)


@pytest.mark.parametrize("processes", [1, 3, 8, 20, 64])
def test_the_pace_is_that_of_any_number_of_processes(
    processes: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first pieces of 20 processes arrive together: 200 objects would seem to take no time."""
    machine = Machine(processes)
    monkeypatch.setattr(machine_pace, "time", machine)
    monkeypatch.setattr(machine_pace.data, "build_dataset", machine.build)
    monkeypatch.setattr(machine_pace, "_probe_step", lambda *_: machine.step)
    job = Adaptation(load_rig("paper-rig"), calibration_spread(None), tmp_path, workers=processes)

    pace = machine_pace.measure_pace(job, lambda _done, _total: None)

    assert pace.objects_per_s == pytest.approx(processes * PIECE / PIECE_S, rel=0.15)
    assert pace.samples_per_s == pytest.approx(machine_pace.BATCH / STEP_S)
    assert machine.objects % machine_pace.data.SHARD == 0


def test_the_pace_of_a_cluster_is_known_once_it_has_rendered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a killed measurement the first objects are there, and nothing was connected to."""
    machine = Machine(30)
    machine.objects = machine_pace.data.SHARD
    farm: Any = SimpleNamespace(workers=1)

    def build(*arguments: Any, **others: Any) -> None:
        machine.build(*arguments, **others)
        farm.workers = machine.processes if machine.objects > machine_pace.data.SHARD else 1

    monkeypatch.setattr(machine_pace, "time", machine)
    monkeypatch.setattr(machine_pace.data, "build_dataset", build)
    monkeypatch.setattr(machine_pace, "_probe_step", lambda *_: machine.step)
    job = Adaptation(load_rig("paper-rig"), calibration_spread(None), tmp_path, farm=farm)

    pace = machine_pace.measure_pace(job, lambda _done, _total: None)

    assert pace.objects_per_s == pytest.approx(30 * PIECE / PIECE_S, rel=0.15)


def test_a_farm_may_say_how_many_processes_it_has(tmp_path: Path) -> None:
    alone = Adaptation(load_rig("paper-rig"), calibration_spread(None), tmp_path, workers=2)
    farm: Any = SimpleNamespace(workers=12)

    assert alone.renderers == 2
    assert Adaptation(alone.rig, alone.spread, tmp_path, farm=farm).renderers == 12
    assert Adaptation(alone.rig, alone.spread, tmp_path, farm=lambda *_: iter(())).renderers == 1
