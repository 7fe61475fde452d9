"""What the stops of the dial promise, held against the brute force on beams of whole objects."""

from dataclasses import replace

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.objects.placement import object_depth
from nlos_cam.render.accuracy import STOPS
from nlos_cam.render.renderer import three_bounce
from nlos_cam.render.scene import Scene

RIG = load_rig("paper-rig")
BEAMS = 70
Case = tuple[Scene, np.ndarray, np.ndarray]
"""A scene, beams that find something, and their brute-force histograms."""


@pytest.fixture(scope="module", params=[3, 20_000_009])
def case(request: pytest.FixtureRequest) -> Case:
    assert RIG.object_box is not None
    scene = Scene(RIG, object_depth(request.param, RIG.object_box)[1])
    chosen = np.arange(5120)
    chosen = chosen[three_bounce(scene, "draft").any(1)]
    chosen = chosen[:: len(chosen) // BEAMS]
    return scene, chosen, three_bounce(scene, "reference", chosen=chosen)


def _errors(case: Case, stop: str) -> tuple[np.ndarray, np.ndarray]:
    """Relative error of the peak, and by how many bins its place is off, beam by beam."""
    scene, chosen, slow = case
    fast = three_bounce(scene, stop, chosen=chosen)
    return np.abs(fast.max(1) - slow.max(1)) / slow.max(1), np.abs(fast.argmax(1) - slow.argmax(1))


def test_standard_keeps_its_promise(case: Case) -> None:
    error, off = _errors(case, "standard")
    assert np.median(error) < 3e-3
    assert np.quantile(error, 0.99) < 1e-2
    assert (off <= 1).mean() >= 0.995
    assert np.median(off) == 0  # 0 mm of depth


def test_fine_keeps_its_promise(case: Case) -> None:
    error, off = _errors(case, "fine")
    assert np.quantile(error, 0.99) < 1e-3
    assert (off <= 1).mean() >= 0.995


def test_a_finer_stop_is_nearer_to_the_reference(case: Case) -> None:
    scene, chosen, slow = case
    errors: list[float] = []
    for stop in ("draft", "standard", "fine"):
        fast = three_bounce(scene, stop, chosen=chosen)
        bins = max(fast.shape[1], slow.shape[1])
        fast, exact = (np.pad(part, [(0, 0), (0, bins - part.shape[1])]) for part in (fast, slow))
        errors.append(float(np.abs(fast - exact).sum() / exact.sum()))
    assert errors == sorted(errors, reverse=True)
    assert errors[1] < 1e-2
    assert errors[2] < 2e-3


def test_float32_stays_within_a_hundred_thousandth_of_float64(case: Case) -> None:
    """Whatever the bins: the light of each beam, and of each half of its histogram moved by less than a sub-bin."""
    scene, chosen, slow = case
    fast = three_bounce(scene, replace(STOPS["fine"], tolerance=0.0), chosen=chosen)
    np.testing.assert_allclose(fast.sum(1, dtype=np.float64), slow.sum(1), rtol=1e-5)


def test_sectors_decide_time_and_not_a_bit_of_the_result(case: Case) -> None:
    scene, chosen, _ = case
    few, many = (three_bounce(scene, replace(STOPS["draft"], sectors=n), chosen=chosen) for n in (1, 16))
    np.testing.assert_array_equal(few, many)
