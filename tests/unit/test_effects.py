"""Plans: the smallest bounds are left out while their sum keeps the tolerance, or exactly what is asked for."""

from collections.abc import Collection

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nlos_cam.errors import SceneError
from nlos_cam.render.effects import EFFECTS, decide, included

bounds = st.lists(st.floats(0, 1), min_size=len(EFFECTS), max_size=len(EFFECTS))


def _findings(values: list[float]) -> list[tuple[str, float, str]]:
    return [(name, bound, f"because of {name}") for name, bound in zip(EFFECTS, values, strict=True)]


@settings(deadline=None, derandomize=True)
@given(values=bounds, tolerance=st.floats(0, 1))
def test_what_is_left_out_sums_to_at_most_the_tolerance_and_one_more_would_not(
    values: list[float], tolerance: float
) -> None:
    plan = decide(_findings(values), tolerance)
    assert tuple(effect.name for effect in plan) == EFFECTS
    out, kept = ([e.bound for e in plan if e.included == wanted] for wanted in (False, True))
    assert sum(sorted(out)) <= tolerance
    assert not kept or sum(sorted(out)) + min(kept) > tolerance
    assert max(out, default=0) <= min(kept, default=1)


def test_without_tolerance_only_what_changes_nothing_is_left_out() -> None:
    plan = decide(_findings([0.0] * 5 + [1e-12] * 5), 0.0)
    assert [effect.included for effect in plan] == [False] * 5 + [True] * 5


@pytest.mark.parametrize("asked", [["tilt", "direct"], ("direct", "tilt"), {"tilt", "direct"}])
def test_effects_by_name_are_exactly_those_whatever_their_bounds(asked: Collection[str]) -> None:
    plan = decide(_findings([0.5] * len(EFFECTS)), 0.0, asked)
    assert {effect.name for effect in plan if effect.included} == {"direct", "tilt"}
    assert included(plan, "tilt")
    assert not included(plan, "occluder")
    assert all(e.reason.startswith("asked for" if e.included else "left out as asked") for e in plan)
    assert all(e.reason.endswith(f"because of {e.name}") for e in plan)


def test_one_name_alone_is_not_taken_for_its_letters() -> None:
    assert {e.name for e in decide(_findings([1.0] * len(EFFECTS)), 0.0, "pulse") if e.included} == {"pulse"}


def test_no_effects_at_all_are_none() -> None:
    assert not any(effect.included for effect in decide(_findings([1.0] * len(EFFECTS)), 0.0, []))


def test_an_effect_that_is_not_ours_is_refused_with_those_that_are() -> None:
    with pytest.raises(SceneError, match=r"no effect 'fog': choose of direct, .*, or auto"):
        decide(_findings([0.0] * len(EFFECTS)), 0.0, ["direct", "fog"])
