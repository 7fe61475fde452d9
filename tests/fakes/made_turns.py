"""Turns made of Gaussian noise on a smooth wall, with drift and an effect of the object."""

from dataclasses import replace

import numpy as np
from nlos_calibration.arrays import Float64

from nlos_cam.detect import Plan, Turn

STD = np.array([2e-4, 0.2, 0.05])[:, None, None]
"""Noise of one frame in a cell: depth in m, infrared in counts, confidence in steps."""


def made_plan(seed: int = 0, **fields: object) -> Plan:
    """Return a plan of 32 turns of 30 frames; `fields` change it."""
    given = {"created": "2026-11-25", "camera": "sim", "turns": 32, "frames": 30, "seed": seed}
    return Plan.model_validate(given | fields)


def made_turns(
    plan: Plan,
    seed: int = 0,
    *,
    effect: Float64 | float = 0.0,
    drift_m: float = 0.0,
    gain_drift: float = 0.0,
    noise: float = 1.0,
) -> list[Turn]:
    """Return the plan's turns, 20 s apart; drift is per turn, `effect` is broadcast to (3, 64, 80)."""
    generator = np.random.default_rng(seed)
    wall = np.stack(
        [
            np.linspace(0.2, 0.3, 5120).reshape(64, 80),
            np.broadcast_to(np.linspace(40.0, 8.0, 80), (64, 80)),
            np.full((64, 80), 10.0),
        ]
    )
    std = np.broadcast_to(STD, wall.shape)
    turns: list[Turn] = []
    for number, object_in in enumerate(plan.order()):
        mean = wall + noise * std / np.sqrt(plan.frames) * generator.standard_normal(wall.shape)
        mean[0] = mean[0] * (1.0 + gain_drift * number) + drift_m * number
        mean = mean + effect * float(object_in)
        turns.append(
            Turn(
                bool(object_in),
                np.array([20.0 * number]),
                mean[None].astype(np.float32),
                std[None].astype(np.float32),
                plan.frames,
            )
        )
    return turns


def swapped(turns: list[Turn]) -> list[Turn]:
    """Return the same turns with the labels exchanged."""
    return [replace(turn, object_in=not turn.object_in) for turn in turns]


def patch_effect(size: float, side: int, channel: int = 0) -> Float64:
    """Return an effect (3, 64, 80) in a square of cells around the middle."""
    effect = np.zeros((3, 64, 80))
    half = side // 2
    effect[channel, 32 - half : 33 + half, 40 - half : 41 + half] = size
    return effect
