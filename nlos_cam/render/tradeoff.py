"""What accuracy costs in time on one scene: the stops of the dial and their ingredients against brute force."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from nlos_cam.errors import SceneError
from nlos_cam.render.accuracy import STOPS, Accuracy
from nlos_cam.render.accuracy_search import Agreement, Echoes, Stopwatch, agreement, least_seconds
from nlos_cam.render.effects import Effects
from nlos_cam.render.planning import Prepared, plan
from nlos_cam.render.renderer import Rendering, render, three_bounce
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_facts import Stage

Part = Literal["stop", "sub_bins", "relay grid", "object_stride", "beams_per_cell", "effect left out"]

REPEATS = 7
"""Of each setting but brute force; the least counts."""
FINEST_BEAMS = 4
"""Beams per cell, along each axis, that fewer are held against: brute force has one, and that is their error."""


@dataclass(frozen=True)
class Setting:
    """One thing to measure: a stop, or `standard` with one ingredient changed."""

    name: str
    part: Part
    accuracy: Accuracy
    effects: Effects = "auto"


@dataclass(frozen=True)
class Row:
    """What was measured of a setting."""

    name: str
    part: Part
    seconds: float
    speedup: float
    """Over brute force, compiled as well."""
    errors: Agreement
    """Against brute force; of `beams_per_cell`, against FINEST_BEAMS at `standard`."""


@dataclass(frozen=True)
class Facts:
    """How large the scene is."""

    patches: int
    beams_on_wall: int


def settings(scene: Scene, stops: Mapping[str, Accuracy] = STOPS) -> list[Setting]:
    """All that is measured of a scene, brute force first."""
    standard = stops["standard"]
    ordered = sorted(stops.values(), key=lambda stop: stop.sub_bins > 0)
    columns, rows = standard.relay_columns, standard.relay_rows
    grids = [(max(int(columns * share), 1), max(int(rows * share), 1)) for share in (0.25, 0.5, 1, 2)]
    called_for = [effect.name for effect in plan(Stage(scene, standard)) if effect.included]
    return [
        *(Setting(stop.name, "stop", stop) for stop in ordered),
        *(Setting(f"sub_bins {n}", "sub_bins", replace(standard, sub_bins=n)) for n in (1, 2, 4, 8, 16, 32, 64)),
        *(
            Setting(f"relay grid {x} x {y}", "relay grid", replace(standard, relay_columns=x, relay_rows=y))
            for x, y in grids
        ),
        *(Setting(f"object_stride {n}", "object_stride", replace(standard, object_stride=n)) for n in (1, 2, 4)),
        *(Setting(f"beams_per_cell {n}", "beams_per_cell", replace(standard, beams_per_cell=n)) for n in (1, 2)),
        *(
            Setting(f"without {name}", "effect left out", standard, tuple(e for e in called_for if e != name))
            for name in called_for
        ),
    ]


def facts(scene: Scene, stops: Mapping[str, Accuracy] = STOPS) -> Facts:
    """The scene's size. Raises SceneError where no three-bounce path is possible: there is nothing to trade."""
    ready = Prepared.of(scene, stops["reference"], "auto")
    job = ready.job()
    if job is None:
        raise SceneError("nothing is hidden, or no light reaches it and returns: give an object within the gate")
    return Facts(len(job.patches.beta), len(job.foot_m))


def measure(scene: Scene, stops: Mapping[str, Accuracy] = STOPS, stopwatch: Stopwatch = least_seconds) -> Iterator[Row]:
    """One row for each of `settings`, as they are measured."""
    brute, *others = settings(scene, stops)
    lit = Prepared.of(scene, brute.accuracy, "auto").beams.on_wall
    bin_m = scene.rig.device.bin_m
    three_bounce(scene, brute.accuracy, chosen=np.flatnonzero(lit)[:1])  # compiles
    slow_s, slow = _timed(scene, brute, stopwatch, 1)
    truth = Echoes.of_beams(slow).some(lit)
    yield Row(brute.name, brute.part, slow_s, 1.0, agreement(truth, truth, bin_m))
    finest = render(scene, replace(stops["standard"], beams_per_cell=FINEST_BEAMS))
    true_cells = Echoes.of_cells(finest, scene).some(lit)
    for setting in others:
        render(scene, setting.accuracy, setting.effects)  # compiles
        seconds, found = _timed(scene, setting, stopwatch, REPEATS)
        if setting.part == "beams_per_cell":
            errors = agreement(Echoes.of_cells(found, scene).some(lit), true_cells, bin_m)
        else:
            errors = agreement(Echoes.of_beams(found).some(lit), truth, bin_m)
        yield Row(setting.name, setting.part, seconds, slow_s / seconds, errors)


def _timed(scene: Scene, setting: Setting, stopwatch: Stopwatch, repeats: int) -> tuple[float, Rendering]:
    kept: list[Rendering] = []
    seconds = stopwatch(lambda: kept.append(render(scene, setting.accuracy, setting.effects)), repeats)
    return seconds, kept[-1]


def pareto_front(rows: list[Row]) -> list[Row]:
    """The rows held against brute force of which no other is both quicker and nearer, from quick to slow."""
    front: list[Row] = []
    for row in sorted(_alike(rows), key=lambda row: (row.seconds, row.errors.intensity_error_p99)):
        if not front or row.errors.intensity_error_p99 < front[-1].errors.intensity_error_p99:
            front.append(row)
    return front


def _alike(rows: list[Row]) -> list[Row]:
    """Those whose intensity error tells what they miss: an effect left out may change the map alone."""
    return [row for row in rows if row.part not in {"beams_per_cell", "effect left out"}]
