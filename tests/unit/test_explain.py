"""What effects cost: told by a clock that counts what is rendered, so that no test depends on time."""

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.render import accuracy_search as module
from nlos_cam.render.accuracy_search import costs
from nlos_cam.render.renderer import render
from nlos_cam.render.scene import Scene

PRICES = {"direct": 0.5, "three-bounce": 8.0, "self-occlusion": 4.0, "tilt": 1.0, "occluder": 2.0}


def test_each_effect_costs_what_a_rendering_takes_longer_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    depth = np.full((16, 16), np.nan, np.float32)
    depth[4:12, 4:12] = 0.3
    depth[6:10, 6:10] = 0.2
    scene = Scene(load_rig("paper-rig"), depth)
    plan, now = render(scene).plan, [0.0]

    def priced(_scene: Scene, _accuracy: str, effects: list[str], _backend: str) -> None:
        now[0] += sum(PRICES[name] for name in effects)

    monkeypatch.setattr(module, "render", priced)
    found = costs(scene, "standard", plan, clock=lambda: now[0])
    assert list(found) == [effect.name for effect in plan]
    for effect in plan:
        assert found[effect.name] == pytest.approx(PRICES[effect.name] if effect.included else 0.0)
    assert sum(effect.included for effect in plan) >= 4
