"""Seconds that each effect of a rendering costs."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from depth_maps import depth_map
from nlos_calibration import load_rig

from nlos_cam.render import Scene, costs, least_seconds, render

PRICES = {"direct": 0.5, "three-bounce": 8.0, "self-occlusion": 4.0, "tilt": 1.0, "occluder": 2.0}


def test_least_seconds_repeats_the_work() -> None:
    work = Mock()

    assert least_seconds(work, 3) >= 0
    assert work.call_count == 3


def test_costs_are_the_seconds_that_each_effect_adds(monkeypatch: pytest.MonkeyPatch) -> None:
    depth = depth_map(16, np.nan, (np.s_[5:9, 4:12], 0.2 + 0.002 * np.arange(8)))
    scene = Scene(load_rig("paper-rig"), depth)
    plan = render(scene).plan
    now = [0.0]

    def priced(_scene: Scene, _accuracy: str, effects: list[str], _backend: str) -> None:
        now[0] += sum(PRICES[name] for name in effects)

    monkeypatch.setattr("nlos_cam.render.effect_costs.render", priced)
    found = costs(scene, "standard", plan, clock=lambda: now[0])
    expected = [PRICES[effect.name] if effect.included else 0.0 for effect in plan]

    assert list(found) == [effect.name for effect in plan]
    assert list(found.values()) == pytest.approx(expected)
    assert sum(effect.included for effect in plan) >= 4


def test_plan_without_light_costs_nothing() -> None:
    scene = Scene(load_rig("paper-rig"))
    plan = [replace(effect, included=False) for effect in render(scene, "draft").plan]

    assert set(costs(scene, "draft", plan).values()) == {0.0}


def test_only_light_of_an_empty_scene_costs_nothing() -> None:
    scene = Scene(load_rig("paper-rig"))
    plan = render(scene, "draft").plan
    found = costs(scene, "draft", plan)

    assert not [one for one in plan if one.name == "three-bounce" and one.included]
    assert found["direct"] == 0.0
