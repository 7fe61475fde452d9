"""Verdicts on scenes that call for much or for little; both sides of each effect: tests/laws/test_effects.py."""

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.objects.placement import object_depth
from nlos_cam.render.accuracy import STOPS
from nlos_cam.render.effects import EFFECTS
from nlos_cam.render.geometry import SPEED_OF_LIGHT_M_PER_S
from nlos_cam.render.material import Surface, phong
from nlos_cam.render.planning import plan
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_facts import SceneFacts

RIG, BARE = load_rig("paper-rig"), load_rig("bare-wall")


def _called_for(scene: Scene, stop: str = "standard") -> set[str]:
    return {effect.name for effect in plan(SceneFacts(scene, STOPS[stop])) if effect.included}


def _plate(slope: float = 0.0) -> np.ndarray:
    depth = np.full((16, 16), np.nan, np.float32)
    depth[4:12, 2:14] = 0.25 + slope * 0.25 / 16 * np.arange(12)
    return depth


def test_an_object_in_the_papers_rig_calls_for_what_the_paper_has() -> None:
    assert RIG.object_box is not None
    scene = Scene(RIG, object_depth(3, RIG.object_box)[1])
    assert _called_for(scene) == {"direct", "three-bounce", "occluder", "self-occlusion", "tilt"}


def test_a_bare_wall_calls_for_the_direct_return_alone() -> None:
    assert _called_for(Scene(BARE)) == {"direct"}


@pytest.mark.parametrize("depth", [None, np.full((8, 8), np.nan, np.float32)])
def test_an_empty_box_calls_for_no_third_bounce(depth: np.ndarray | None) -> None:
    assert _called_for(Scene(RIG, depth)) == {"direct", "occluder"}


def test_a_level_plate_neither_shades_itself_nor_tilts() -> None:
    assert _called_for(Scene(RIG, _plate())) == {"direct", "three-bounce", "occluder"}


def test_a_gate_shorter_than_every_path_calls_for_nothing_but_the_occluder() -> None:
    device = RIG.device.model_copy(update={"gate_s": 0.1 / SPEED_OF_LIGHT_M_PER_S})
    assert _called_for(Scene(RIG.model_copy(update={"device": device}), _plate())) <= {"occluder"}


def test_a_shiny_surface_calls_for_its_tilt_however_small() -> None:
    """A lobe turns by twice the tilt: what the cosines change says nothing of it."""
    gentle = _plate(1e-3)
    assert "tilt" not in _called_for(Scene(RIG, gentle), "draft")
    shiny = Surface(1.0, phong(0.1, 0.9, 2000))
    assert _called_for(Scene(RIG, gentle, shiny), "draft") >= {"tilt", "brdf"}


@pytest.mark.parametrize("specular", [0.01, 0.1, 0.5])
def test_a_brdfs_bound_is_what_its_mean_may_be_off(specular: float) -> None:
    verdicts = plan(SceneFacts(Scene(RIG, _plate(), Surface(1.0, phong(1 - specular, specular, 4))), STOPS["standard"]))
    low, high = 1 - specular, 1 - specular + 3 * specular
    bound = next(effect.bound for effect in verdicts if effect.name == "brdf")
    assert bound == pytest.approx(min((high - low) / 2 / low, 1))
    assert tuple(effect.name for effect in verdicts) == EFFECTS
