"""Rolling acquisition of the MEMS raster: rows are scanned one after another while objects move."""

from collections.abc import Callable
from dataclasses import replace
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlos_cam.frames import MAP_ROWS
from nlos_cam.render.accuracy import Accuracy, accuracy_named
from nlos_cam.render.effects import Effect, Effects
from nlos_cam.render.energy_survey import CAUTION
from nlos_cam.render.renderer import Rendering, render, three_bounce
from nlos_cam.render.scene import Scene

SceneAt = Callable[[float], Scene]
"""Function from the time of the scan, 0 (top row) to 1 (bottom row), to the scene."""

PROBES = 48
"""Beams from which the change by motion is estimated."""
FINEST_SHARE = 2e-2
"""Smallest change of the transient within a slice of a scan: thinner slices are not made."""


def scan_effect(scene_at: SceneAt, accuracy: str | Accuracy = "standard") -> Effect:
    """Return the verdict on the raster: the change of the transient from the top row's instant to the bottom row's."""
    # Only the ends of the scan are compared: an object that comes back within it would go unseen, but a scan lasts
    # 1/30 s.
    setting, first, last = accuracy_named(accuracy), scene_at(0.0), scene_at(1.0)
    change = 0.0 if _alike(first, last) else min(CAUTION * _change(first, last), 1.0)
    reason = f"motion changes {change:.3g} of the transient during a scan" if change else "nothing moves"
    return Effect("scan-time", change > setting.tolerance, reason, change)


def render_scan(scene_at: SceneAt, accuracy: str | Accuracy = "standard", effects: Effects = "auto") -> Rendering:
    """Return one frame of a raster: slices of rows, each at the instant of its middle row; the first gives the plan."""
    setting = accuracy_named(accuracy)
    verdict = scan_effect(scene_at, setting)
    count = slices(verdict, setting)
    parts: list[Rendering] = []
    for rows in np.array_split(np.arange(MAP_ROWS), count):
        # The middle of a slice makes the error of its timing odd in the row, so that it cancels to first order.
        share = float(rows.mean() + 0.5) / MAP_ROWS if verdict.included else 0.0
        parts.append(render(scene_at(share), setting, effects, rows=(int(rows[0]), int(rows[-1]) + 1)))
    return joined(parts, verdict)


def slices(verdict: Effect, setting: Accuracy) -> int:
    """Return the number of instants of a scan: within one, at most FINEST_SHARE or the tolerance changes."""
    if not verdict.included:
        return 1
    # Change is taken as linear over the scan: a slice of 1 / n of the rows then changes 1 / n of the bound. Two slices
    # are the fewest that show motion at all, and more than one a row there cannot be.
    return int(np.clip(ceil(verdict.bound / max(setting.tolerance, FINEST_SHARE)), 2, MAP_ROWS))


def joined(parts: list[Rendering], verdict: Effect) -> Rendering:
    """Return renderings of some rows each as one of all rows."""

    def stacked(name: str, of: Callable[[Rendering], object] = lambda part: part) -> NDArray[Any]:
        return np.concatenate([getattr(of(part), name) for part in parts])

    multi = {name: stacked(name, lambda part: part.multi) for name in ("peak", "runner_up", "path_m")}
    return replace(
        parts[0],
        **{name: stacked(name) for name in ("depth_m", "intensity", "margin")},
        multi=replace(parts[0].multi, **multi),
        plan=(*parts[0].plan, verdict),
        near_legs=sum(part.near_legs for part in parts),
        color=None if any(part.color is None for part in parts) else stacked("color"),
    )


def _alike(one: Scene, other: Scene) -> bool:
    if one.object_depth_m is None or other.object_depth_m is None:
        return one.object_depth_m is other.object_depth_m
    return np.array_equal(one.object_depth_m, other.object_depth_m, equal_nan=True)


def _change(first: Scene, last: Scene) -> float:
    """Return the relative L1 between the transients of two instants, on some beams at draft."""
    count = first.cell_intrinsics.width * first.cell_intrinsics.height
    chosen = np.arange(count)[:: count // PROBES]
    one, other = (three_bounce(scene, "draft", chosen=chosen) for scene in (first, last))
    # L1 over all bins, relative to the light: an echo that leaves one bin for the next counts as lost and as new.
    bins = max(one.shape[1], other.shape[1])
    one, other = (np.pad(part, [(0, 0), (0, bins - part.shape[1])]) for part in (one, other))
    whole = float(np.abs(other).sum())
    return float(np.abs(one - other).sum()) / whole if whole > 0 else float(one.any())
