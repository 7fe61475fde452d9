"""Effects of light transport: verdicts with bounds, gathered into a plan that the renderer
follows.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from math import nan
from typing import Literal

from nlos_cam.errors import SceneError, UnknownNameError, did_you_mean

EFFECTS = (
    "direct",
    "three-bounce",
    "line-of-sight",
    "occluder",
    "self-occlusion",
    "tilt",
    "brdf",
    "colour",
    "inter-reflection",
    "pulse",
)
"""In the order in which light meets them."""

Effects = Literal["auto"] | Collection[str]
""""auto" for those that a scene calls for, or exactly these by name."""


@dataclass(frozen=True)
class Effect:
    """Verdict on one effect."""

    name: str
    included: bool
    reason: str
    bound: float
    """Largest change of the transient (relative L1) without the effect; 1 is all of it or more."""


Plan = tuple[Effect, ...]


def included(verdicts: Plan, name: str) -> bool:
    """Return whether a plan includes an effect."""
    return next(effect.included for effect in verdicts if effect.name == name)


def decide(
    findings: Collection[tuple[str, float, str]], tolerance: float, effects: Effects = "auto"
) -> Plan:
    """Return a plan from findings (name, bound, reason): omitted bounds sum to at most the
    tolerance, smallest first.

    `effects` names exactly those to include instead. Raises SceneError for an unknown name.
    """
    if effects != "auto":
        return _asked(findings, effects)
    # Changes add up at most (triangle inequality of L1); taking the smallest bounds first leaves
    # out the most effects.
    spent = 0.0
    left_out = set[str]()
    for name, bound, _ in sorted(findings, key=lambda finding: finding[1]):
        spent += bound
        if spent > tolerance:
            break
        left_out.add(name)
    return tuple(
        Effect(name, name not in left_out, reason, bound) for name, bound, reason in findings
    )


def _asked(findings: Collection[tuple[str, float, str]], effects: Collection[str]) -> Plan:
    """Return the plan with exactly some effects, each with its bound all the same."""
    return tuple(
        replace(verdict, reason=f"{verdict.reason}; {reason}", bound=bound)
        for verdict, (_, bound, reason) in zip(requested(effects), findings, strict=True)
    )


def brings_light(effects: Collection[str]) -> bool:
    """Return whether any light arrives with only these effects."""
    return not {"direct", "three-bounce"}.isdisjoint(effects)


def requested(effects: Collection[str]) -> Plan:
    """Return the plan with exactly some effects, without a look at the scene: bounds are NaN.

    Raises SceneError for an unknown name, or if no light arrives.
    """
    names = {effects} if isinstance(effects, str) else set(effects)
    if unknown := names - set(EFFECTS):
        near = did_you_mean(min(unknown), EFFECTS)
        raise UnknownNameError(
            f"no effect {min(unknown)!r}.{near} Choose from {', '.join(EFFECTS)}, or auto"
        )
    if not brings_light(names):
        raise SceneError(
            f"effects {', '.join(sorted(names)) or 'none'}: no light arrives: add direct or"
            " three-bounce"
        )
    return tuple(
        Effect(name, name in names, "requested" if name in names else "left out on request", nan)
        for name in EFFECTS
    )
