"""Which effects a scene calls for: pure verdicts, gathered into a plan that the renderer reads."""

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Literal

from nlos_cam.errors import SceneError

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
"""What a scene calls for, or exactly these by name."""


@dataclass(frozen=True)
class Effect:
    """A verdict on one effect."""

    name: str
    included: bool
    reason: str
    bound: float
    """At most this much of the transient (relative L1) changes without the effect; 1 is all of it or more."""


Plan = tuple[Effect, ...]


def included(verdicts: Plan, name: str) -> bool:
    """Whether a plan includes an effect."""
    return next(effect.included for effect in verdicts if effect.name == name)


def decide(findings: Collection[tuple[str, float, str]], tolerance: float, effects: Effects = "auto") -> Plan:
    """A plan from findings (name, bound, reason): the omitted bounds sum to at most the tolerance, the smallest first.

    `effects` names exactly what to include instead. Raises SceneError where it names none of ours.
    """
    if effects != "auto":
        return _asked(findings, effects)
    spent, left_out = 0.0, set[str]()
    for name, bound, _ in sorted(findings, key=lambda finding: finding[1]):
        spent += bound
        if spent > tolerance:
            break
        left_out.add(name)
    return tuple(Effect(name, name not in left_out, reason, bound) for name, bound, reason in findings)


def _asked(findings: Collection[tuple[str, float, str]], effects: Collection[str]) -> Plan:
    names = {effects} if isinstance(effects, str) else set(effects)
    if unknown := names - set(EFFECTS):
        raise SceneError(f"no effect {min(unknown)!r}: choose of {', '.join(EFFECTS)}, or auto")
    verdicts = (Effect(name, name in names, reason, bound) for name, bound, reason in findings)
    return tuple(
        replace(e, reason=f"{'asked for' if e.included else 'left out as asked'}; {e.reason}") for e in verdicts
    )
