"""The coarse look: what shades, what the occluder meets, and shares that bounds are made of."""

import numpy as np
import pytest
from nlos_calibration.rig import Occluder, Rig, load_rig

from nlos_cam.render.accuracy import Accuracy
from nlos_cam.render.energy_survey import CAUTION, EnergySurvey, occluder_meets, shaded
from nlos_cam.render.geometry import NO_OCCLUDER, occluder_edge
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_facts import SceneFacts

RIG = load_rig("paper-rig")
COARSE = Accuracy("coarse", relay_columns=8, relay_rows=6)


def _stage(depth: np.ndarray, rig: Rig = RIG) -> SceneFacts:
    return SceneFacts(Scene(rig, depth.astype(np.float32), jump_m=0.5), COARSE)


def _shaded(depth: np.ndarray) -> np.ndarray:
    stage = _stage(depth)
    assert stage.patches is not None
    return shaded(stage.patches, stage.field)


def test_a_plane_and_a_dome_shade_nothing_and_a_pit_all_but_its_rim() -> None:
    at = np.linspace(-1, 1, 8)
    round_m = 0.05 * (at[:, None] ** 2 + at**2)
    assert not _shaded(np.full((8, 8), 0.25)).any()
    assert not _shaded(0.2 + 0.02 * np.arange(8) * np.ones((8, 1))).any()
    pit = _shaded(0.3 - round_m)
    assert pit.mean() > 0.5
    assert _shaded(0.2 + round_m).mean() < pit.mean()


def test_a_share_is_cautious_and_never_more_than_all() -> None:
    two = np.ones(2)
    found = EnergySurvey(two, two, 0 * two, 0 * two, 0 * two, 0 * two, 1.0)
    assert found.share(np.array([0.1, 0.0])) == pytest.approx(CAUTION * 0.05)
    assert found.share(np.array([5.0, 0.0])) == 1
    assert found.tilt == found.occluder == 0
    dark = EnergySurvey(0 * two, two, two, two, two, two, 1.0)
    assert dark.share(two) == 1
    assert dark.share(0 * two) == 0
    uneven = EnergySurvey(two, two, 0 * two, 0 * two, 0 * two, 0 * two, 4.0)
    assert uneven.share(np.array([0.1, 0.0])) == pytest.approx(4 * found.share(np.array([0.1, 0.0])))


@pytest.mark.parametrize(("x_m", "z_min_m", "meets"), [(0.2, 0.1, True), (0.2, 5.0, False), (-3.0, 0.1, False)])
def test_the_occluder_meets_what_crosses_it(x_m: float, z_min_m: float, meets: bool) -> None:
    rig = RIG.model_copy(update={"occluder": Occluder(x_m=x_m, z_min_m=z_min_m)})
    stage = _stage(np.full((8, 8), 0.25), rig)
    assert stage.patches is not None
    assert occluder_meets(occluder_edge(rig), stage.patches, stage.beams(), stage.relay) == meets
    assert not occluder_meets(NO_OCCLUDER, stage.patches, stage.beams(), stage.relay)


@pytest.mark.parametrize("z_m", [0.0, 1e-9])
def test_contact_with_the_wall_weighs_no_more_than_contact_can(z_m: float) -> None:
    """A patch on the wall must not outweigh all others, whose verdicts would then be too small."""
    depth = np.full((8, 8), 0.2)
    depth[3, 3] = z_m
    light = _stage(depth).light
    assert light is not None
    assert np.isfinite(light.energy).all()
    assert light.energy.max() < 1e3 * np.median(light.energy)
