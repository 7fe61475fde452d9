"""Laws of a pulse that has some width: it spreads light in time, makes none and loses none."""

from typing import Any

import numpy as np
import pytest
from nlos_calibration.rig import load_rig

from nlos_cam.render.echoes import pulse_bins, spread
from nlos_cam.render.scene import Scene

RIG = load_rig("paper-rig")
BIN_M = RIG.device.bin_m
DEPTH = np.full((4, 4), 0.3, np.float32)
WIDTHS_NS = (1e-4, 0.01, 0.1, 0.3, 1.0)


def test_energy_is_kept_and_the_peak_falls_as_the_width_grows(implementation: Any) -> None:
    thin = implementation.transient(Scene(RIG, DEPTH)).astype(np.float64)
    peak = thin.max()
    for pulse_ns in WIDTHS_NS[1:4]:
        wide = implementation.transient(Scene(RIG, DEPTH, pulse_ns=pulse_ns)).astype(np.float64)
        np.testing.assert_allclose(wide.sum(-1), thin.sum(-1), rtol=1e-5)
        assert wide.max() < peak
        peak = wide.max()


def test_zero_width_is_no_pulse(implementation: Any) -> None:
    scene = Scene(RIG, DEPTH, pulse_ns=0.0)
    effects = ["direct", "three-bounce", "occluder"]
    np.testing.assert_array_equal(
        implementation.transient(scene, [*effects, "pulse"]), implementation.transient(scene, effects)
    )


@pytest.mark.parametrize("pulse_ns", WIDTHS_NS)
def test_one_echo_becomes_a_gaussian_of_the_pulses_width_about_its_place(pulse_ns: float) -> None:
    one = np.zeros((1, 400), np.float32)
    one[0, 200] = 2.0
    wide = spread(one, pulse_ns, BIN_M)[0].astype(np.float64)
    at, sigma = np.arange(len(wide)) - 200, pulse_bins(pulse_ns, BIN_M)
    assert wide.sum() == pytest.approx(2)
    assert (wide * at).sum() == pytest.approx(0, abs=1e-3)
    if sigma > 1:  # a bin is a twelfth of its square wide itself
        assert (wide * at**2).sum() / 2 == pytest.approx(sigma**2 + 1 / 12, rel=1e-2)
    assert wide.argmax() == 200


def test_a_nanosecond_is_thirty_centimetres_of_path_at_half_height() -> None:
    one = np.zeros((1, 400), np.float32)
    one[0, 200] = 1.0
    wide = spread(one, 1.0, BIN_M)[0]
    assert (wide >= wide.max() / 2).sum() * BIN_M == pytest.approx(0.30, abs=0.011)
    assert wide.shape[0] > 400 + 3 * pulse_bins(1.0, BIN_M)  # room for the tail


def test_the_direct_return_mixes_with_what_comes_at_the_same_time(implementation: Any) -> None:
    """With a wide pulse the waveform's highest bin is told from both, in the grid of bins."""
    rendering = implementation.render(Scene(RIG, DEPTH, pulse_ns=1.0))
    assert rendering.multi.direct_included
    seen = np.isfinite(rendering.multi.path_m)
    np.testing.assert_allclose(rendering.multi.path_m[seen] / BIN_M % 1, 0.5, atol=1e-3)
    np.testing.assert_array_equal(rendering.intensity, rendering.multi.peak)
