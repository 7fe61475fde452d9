"""The MEMS raster: a lidar's rows are scanned one after another, and what moves has moved on meanwhile."""

from collections.abc import Callable
from dataclasses import replace
from math import ceil

import numpy as np

from nlos_cam.frames import MAP_ROWS
from nlos_cam.render.accuracy import Accuracy, accuracy_named
from nlos_cam.render.effects import Effect, Effects
from nlos_cam.render.energy_survey import CAUTION
from nlos_cam.render.renderer import Rendering, render, three_bounce
from nlos_cam.render.scene import Scene

SceneAt = Callable[[float], Scene]
"""The scene at a time of the scan, 0 (its top row) to 1 (its bottom row)."""

PROBES = 48
"""Beams that tell how much a movement changes."""
FINEST_SHARE = 2e-2
"""Of the transient: slices of a scan are not made so thin that less than this changes within one."""


def scan_effect(scene_at: SceneAt, accuracy: str | Accuracy = "standard") -> Effect:
    """Whether the raster matters: how much the transient changes from the top row's instant to the bottom row's."""
    setting, first, last = accuracy_named(accuracy), scene_at(0.0), scene_at(1.0)
    change = 0.0 if _alike(first, last) else min(CAUTION * _change(first, last), 1.0)
    reason = f"what moves changes {change:.3g} of the transient during a scan" if change else "nothing moves"
    return Effect("scan-time", change > setting.tolerance, reason, change)


def render_scan(scene_at: SceneAt, accuracy: str | Accuracy = "standard", effects: Effects = "auto") -> Rendering:
    """One frame of a raster: its rows in slices, each at the instant of its middle row; the plan is the first's."""
    setting = accuracy_named(accuracy)
    verdict = scan_effect(scene_at, setting)
    count = slices(verdict, setting)
    parts: list[Rendering] = []
    for rows in np.array_split(np.arange(MAP_ROWS), count):
        share = float(rows.mean() + 0.5) / MAP_ROWS if verdict.included else 0.0
        parts.append(render(scene_at(share), setting, effects, rows=(int(rows[0]), int(rows[-1]) + 1)))
    return joined(parts, verdict)


def slices(verdict: Effect, setting: Accuracy) -> int:
    """In how many instants a scan is rendered: at most FINEST_SHARE, or the tolerance, changes within one."""
    if not verdict.included:
        return 1
    return int(np.clip(ceil(verdict.bound / max(setting.tolerance, FINEST_SHARE)), 2, MAP_ROWS))


def joined(parts: list[Rendering], verdict: Effect) -> Rendering:
    """Renderings of some rows each as one of all rows."""
    multi = replace(
        parts[0].multi,
        peak=np.concatenate([part.multi.peak for part in parts]),
        runner_up=np.concatenate([part.multi.runner_up for part in parts]),
        path_m=np.concatenate([part.multi.path_m for part in parts]),
    )
    colours = [part.colour for part in parts if part.colour is not None]
    return replace(
        parts[0],
        depth_m=np.concatenate([part.depth_m for part in parts]),
        intensity=np.concatenate([part.intensity for part in parts]),
        margin=np.concatenate([part.margin for part in parts]),
        multi=multi,
        plan=(*parts[0].plan, verdict),
        near_legs=sum(part.near_legs for part in parts),
        colour=np.concatenate(colours) if colours else None,
    )


def _alike(one: Scene, other: Scene) -> bool:
    if one.object_depth_m is None or other.object_depth_m is None:
        return one.object_depth_m is other.object_depth_m
    return np.array_equal(one.object_depth_m, other.object_depth_m, equal_nan=True)


def _change(first: Scene, last: Scene) -> float:
    """Relative L1 between the transients of two instants, on some beams at draft."""
    count = first.cell_intrinsics.width * first.cell_intrinsics.height
    chosen = np.arange(count)[:: count // PROBES]
    one, other = (three_bounce(scene, "draft", chosen=chosen) for scene in (first, last))
    bins = max(one.shape[1], other.shape[1])
    one, other = (np.pad(part, [(0, 0), (0, bins - part.shape[1])]) for part in (one, other))
    whole = float(np.abs(other).sum())
    return float(np.abs(one - other).sum()) / whole if whole > 0 else float(one.any())
