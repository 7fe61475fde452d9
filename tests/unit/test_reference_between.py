"""Inter-reflection: the tables of the fast renderer against every path by itself."""

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.errors import SceneError
from nlos_cam.render.accuracy import Accuracy
from nlos_cam.render.renderer import three_bounce
from nlos_cam.render.scene import Scene

RIG = load_rig("paper-rig")
SOME = np.arange(5120)[::151]
MORE = ["three-bounce", "occluder", "tilt", "self-occlusion", "inter-reflection"]


@pytest.fixture(scope="module")
def bowl() -> Scene:
    at = np.linspace(-1, 1, 4)
    depth = 0.2 - 0.08 * (at[:, None] ** 2 + at**2)
    return Scene(RIG, depth.astype(np.float32), radiometry="lambertian", jump_m=0.5)


def test_tables_carry_the_light_of_every_path(bowl: Scene) -> None:
    found = [three_bounce(bowl, Accuracy("own", 3, 3, sub_bins=n), effects=MORE, chosen=SOME) for n in (0, 64)]
    plain = three_bounce(bowl, Accuracy("own", 3, 3, sub_bins=0), effects=MORE[:-1], chosen=SOME)
    exact, fast = found
    np.testing.assert_allclose(fast.sum(1), exact.sum(1), rtol=1e-4)
    assert np.abs(fast - exact).sum() < 0.02 * exact.sum()
    gained = exact[:, : plain.shape[1]] - plain
    assert gained.min() > -1e-12 * exact.max()
    assert exact.sum() > 1.01 * plain.sum()
    assert exact.sum() < 2 * plain.sum()


def test_more_paths_than_it_can_sum_are_refused_with_what_to_do() -> None:
    scene = Scene(RIG, np.full((32, 32), 0.2, np.float32), radiometry="lambertian")
    with pytest.raises(SceneError, match=r"path by path would sum .* paths, at most .*: choose fine, or leave"):
        three_bounce(scene, Accuracy("own", 3, 3, sub_bins=0), effects=MORE, chosen=SOME)
