"""Verdicts: what a scene calls for is in its plan, what it does not is left out, within the tolerance."""

from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration.rig import Rig, load_rig

from nlos_cam.errors import SceneError
from nlos_cam.objects.hidden import object_depth
from nlos_cam.render import renderer
from nlos_cam.render.accuracy import STOPS, Accuracy
from nlos_cam.render.beams import SPEED_OF_LIGHT_M_PER_S, cast
from nlos_cam.render.effects import Plan, included, plan
from nlos_cam.render.renderer import transient
from nlos_cam.render.scene import Patches, Scene

RIG, BARE = load_rig("paper-rig"), load_rig("bare-wall")
NAMES = ("direct", "three-bounce", "self-occlusion", "tilt", "occluder")


def _plan(scene: Scene, tolerance: float = 1e-3) -> Plan:
    return plan(scene, cast(scene.rig, scene.cell_intrinsics), tolerance)


def _plate(slope: float = 0.0, z_m: float = 0.25) -> np.ndarray:
    depth = np.full((64, 64), np.nan, np.float32)
    depth[20:40, 15:45] = z_m + slope * 0.25 / 64 * np.arange(30)
    return depth


def _object() -> np.ndarray:
    assert RIG.object_box is not None
    return object_depth(3, RIG.object_box)[1]


def _gated(rig: Rig, path_m: float) -> Rig:
    device = rig.device.model_copy(update={"gate_s": path_m / SPEED_OF_LIGHT_M_PER_S})
    return rig.model_copy(update={"device": device})


def _called_for(scene: Scene, tolerance: float = 1e-3) -> set[str]:
    return {effect.name for effect in _plan(scene, tolerance) if effect.included}


def test_an_object_in_the_papers_rig_calls_for_everything() -> None:
    assert _called_for(Scene(RIG, _object())) == set(NAMES)


def test_a_bare_wall_calls_for_the_direct_return_alone() -> None:
    assert _called_for(Scene(BARE)) == {"direct"}


def test_an_empty_box_calls_for_no_third_bounce() -> None:
    empty = np.full((64, 64), np.nan, np.float32)
    for scene in (Scene(RIG), Scene(RIG, empty)):
        assert _called_for(scene) == {"direct", "occluder"}


def test_a_level_plate_neither_shades_itself_nor_tilts() -> None:
    assert _called_for(Scene(RIG, _plate())) == {"direct", "three-bounce", "occluder"}


def test_a_gate_shorter_than_every_path_calls_for_nothing_but_the_occluder() -> None:
    assert _called_for(Scene(_gated(RIG, 0.1), _plate())) <= {"occluder"}


def test_a_gate_short_of_the_object_leaves_the_third_bounce_out() -> None:
    assert "three-bounce" not in _called_for(Scene(_gated(RIG, 0.45), _plate()))
    assert "three-bounce" in _called_for(Scene(_gated(RIG, 3.0), _plate()))


@pytest.mark.parametrize("stop", STOPS.values(), ids=lambda stop: stop.name)
@pytest.mark.parametrize("slope", [0.0, 1e-5, 5e-4, 0.01, 1.0])
def test_what_is_left_out_may_change_no_more_than_the_tolerance(stop: Accuracy, slope: float) -> None:
    verdicts = _plan(Scene(RIG, _plate(slope)), stop.tolerance)
    assert tuple(effect.name for effect in verdicts) == NAMES
    assert sum(effect.bound for effect in verdicts if not effect.included) <= stop.tolerance
    assert all(effect.reason for effect in verdicts)


def _change(scene: Scene, name: str, monkeypatch: pytest.MonkeyPatch) -> float:
    """Relative L1 change of the transient where one verdict is turned round."""
    before, original = transient(scene), renderer.plan
    with monkeypatch.context() as patch:
        turned = tuple(replace(e, included=not e.included) if e.name == name else e for e in _plan(scene))
        patch.setattr(renderer, "plan", lambda *_: turned)
        after = transient(scene)
    assert renderer.plan is original
    return float(np.abs(after - before).sum() / before.sum())


@pytest.mark.parametrize("name", ["self-occlusion", "tilt", "occluder"])
def test_leaving_out_what_is_called_for_changes_more_than_the_tolerance(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Scene(RIG, _object())
    assert included(_plan(scene), name)
    assert _change(scene, name, monkeypatch) > 1e-3


@pytest.mark.parametrize(("name", "slope"), [("self-occlusion", 0.0), ("tilt", 0.0), ("tilt", 9e-4)])
def test_forcing_in_what_is_not_called_for_changes_less_than_the_tolerance(
    name: str, slope: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Scene(RIG, _plate(slope))
    assert not included(_plan(scene), name)
    assert _change(scene, name, monkeypatch) < 1e-3


def _seen_at(column: float, row: float, rig: Rig = BARE, range_m: float = 0.15) -> Scene:
    """A scene with one patch on the ray of a point of the lidar's image."""
    pinhole = rig.pinhole
    ray = np.array([(column - pinhole.ppx) / pinhole.fx, (row - pinhole.ppy) / pinhole.fy, 1.0])
    point = rig.wall_from_lidar[:3, 3] + range_m * rig.wall_from_lidar[:3, :3] @ ray
    scene, index = Scene(rig), np.zeros(1, np.int64)
    one = Patches(point[None], np.array([[0.0, 0, -1]]), np.ones(1), index, index, 1e-5)
    object.__setattr__(scene, "patches", one)  # a cached property: set before it is asked for
    return scene


@pytest.mark.parametrize(("column", "row"), [(320, 240), (-0.4, 240), (639.4, 240), (320, -0.4), (320, 479.4)])
def test_a_patch_within_the_field_of_view_is_refused(column: float, row: float) -> None:
    with pytest.raises(SceneError, match="own sight"):
        _plan(_seen_at(column, row))


@pytest.mark.parametrize(("column", "row"), [(-0.6, 240), (639.6, 240), (320, -0.6), (320, 479.6)])
def test_a_patch_outside_it_is_not(column: float, row: float) -> None:
    _plan(_seen_at(column, row))


def test_a_patch_behind_the_occluder_is_not_in_sight() -> None:
    _plan(Scene(RIG, _plate()))
    with pytest.raises(SceneError, match="own sight"):
        _plan(Scene(RIG.model_copy(update={"occluder": None}), _plate(z_m=0.13)))
