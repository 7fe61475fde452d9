"""Laws of accuracy: refining any grid converges, and the stops keep their promised errors against
brute force.
"""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from nlos_calibration import load_rig

from nlos_cam.objects import object_depth
from nlos_cam.render import (
    STOPS,
    Accuracy,
    Scene,
    histograms,
    prepare,
    render,
    three_bounce,
    transient,
)

RIG = load_rig("paper-rig")
SOME = np.arange(5120)[::23]
BLUR = 16
"""Number of bins summed, so that light moving between bins does not hide the convergence."""


def _hill(cells: int) -> np.ndarray:
    """A smooth surface, sampled at the middles of cells x cells."""
    at = (np.arange(cells) + 0.5) / cells
    x, y = np.meshgrid(at, at)
    return (0.3 - 0.12 * np.sin(np.pi * x) * np.sin(np.pi * y) + 0.03 * x).astype(np.float32)


def _blurred(histogram: np.ndarray) -> np.ndarray:
    bins = 400
    padded = np.pad(
        histogram,
        [(0, 0), (0, bins - histogram.shape[1])],
    )
    return padded.reshape(len(padded), -1, BLUR).sum(-1, dtype=np.float64)


def _found(depth: np.ndarray, accuracy: Accuracy) -> np.ndarray:
    return _blurred(
        three_bounce(
            Scene(RIG, depth, jump_m=0.5),
            accuracy,
            chosen=SOME,
        )
    )


def test_chosen_beams_come_in_the_order_asked_for() -> None:
    scene = Scene(RIG, _hill(16))
    count = len(prepare(scene, STOPS["draft"]).beams.on_wall)
    whole = three_bounce(scene, "reference", chosen=np.arange(count)[:40])
    chosen = np.array([7, 3, 3, 39])

    assert np.array_equal(three_bounce(scene, "reference", chosen=chosen), whole[chosen])
    everything = three_bounce(scene, "draft")
    backwards = three_bounce(scene, "draft", chosen=np.arange(count)[::-1])

    np.testing.assert_allclose(backwards[::-1], everything, rtol=1e-4, atol=1e-9)


def _relay(cells: int) -> np.ndarray:
    return _found(
        _hill(32),
        replace(STOPS["standard"], relay_columns=cells, relay_rows=cells),
    )


def _object(cells: int) -> np.ndarray:
    return _found(
        _hill(cells),
        replace(STOPS["standard"], relay_columns=40, relay_rows=32),
    )


def _beams(per_cell: int) -> np.ndarray:
    coarse = Accuracy("coarse", relay_columns=10, relay_rows=10, beams_per_cell=per_cell)
    found = transient(
        Scene(RIG, _hill(8)),
        coarse,
        effects=["three-bounce", "occluder", "tilt"],
    )
    mean = found.reshape(
        64,
        per_cell,
        80,
        per_cell,
        -1,
    ).mean((1, 3))
    return _blurred(mean.reshape(5120, -1))


@pytest.mark.slow
def test_finer_depth_maps_keep_the_size_of_patches_and_the_error() -> None:
    scene = Scene(RIG, _hill(192), jump_m=0.5)
    standard = replace(STOPS["standard"], relay_columns=40, relay_rows=32)
    joined = prepare(scene, standard).job
    apart = prepare(scene, replace(standard, finest_cells=0)).job

    assert joined is not None
    assert apart is not None
    assert len(apart.patches.beta) == 192**2
    assert len(joined.patches.beta) == 96**2

    some = np.arange(0, len(apart.length_m), 40)
    strongest, exact = (histograms(job.select(some)).max(1) for job in (joined, apart))
    off = np.abs(strongest[exact > 0] / exact[exact > 0] - 1)

    assert np.median(off) < 0.003
    assert np.percentile(off, 99) < 0.01


@pytest.mark.parametrize(
    ("grid", "sizes"),
    [
        (_relay, (10, 20, 40, 80)),
        (_object, (8, 16, 32, 64)),
        (_beams, (1, 2, 4)),
    ],
)
def test_refining_a_grid_changes_less_each_time(grid: Any, sizes: tuple[int, ...]) -> None:
    found = [grid(size) for size in sizes]
    steps = [
        float(np.abs(finer - coarser).sum() / finer.sum()) for coarser, finer in pairwise(found)
    ]

    assert all(later < earlier for earlier, later in pairwise(steps)), steps
    assert 0 < steps[-1] < 0.5 * steps[0]
    assert steps[-1] < 0.05


def test_refining_sub_bins_converges_to_brute_force() -> None:
    base = Accuracy("coarse", relay_columns=20, relay_rows=16)
    scene = Scene(RIG, _hill(16))
    exact = three_bounce(scene, replace(base, sub_bins=0), chosen=SOME)
    errors = [
        float(
            np.abs(
                three_bounce(
                    scene,
                    replace(base, sub_bins=n),
                    chosen=SOME,
                )
                - exact
            ).sum()
            / exact.sum()
        )
        for n in (1, 4, 16, 64)
    ]

    assert all(later < 0.7 * earlier for earlier, later in pairwise(errors)), errors


def test_share_of_winning_echoes_does_not_drift_with_the_grid() -> None:
    shares: list[float] = []
    direct = render(Scene(RIG)).intensity
    for cells in (20, 40, 80, 160):
        rendering = render(
            Scene(RIG, _hill(32)),
            replace(
                STOPS["draft"],
                relay_columns=cells,
                relay_rows=cells,
            ),
        )
        shares.append(float((rendering.intensity > direct).mean()))

    assert 0.1 < shares[-1] < 0.95
    assert np.ptp(shares[1:]) < 0.03


BEAMS = 70
Case = tuple[Scene, np.ndarray, np.ndarray]
"""A scene, beams that find something, and their brute-force histograms."""


@pytest.fixture(scope="module", params=[3, 20_000_009])
def case(request: pytest.FixtureRequest) -> Case:
    scene = Scene(RIG, object_depth(request.param, RIG.object_box)[1])
    chosen = np.arange(5120)
    chosen = chosen[three_bounce(scene, "draft").any(1)]
    chosen = chosen[:: len(chosen) // BEAMS]
    return scene, chosen, three_bounce(scene, "reference", chosen=chosen)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stop", "median", "p99"),
    [
        ("standard", 3e-3, 1e-2),
        ("fine", 1e-3, 1e-3),
    ],
)
def test_stop_keeps_its_promised_error(case: Case, stop: str, median: float, p99: float) -> None:
    """Relative error of the peak and its offset in bins, beam by beam."""
    scene, chosen, slow = case
    fast = three_bounce(scene, stop, chosen=chosen)
    error = np.abs(fast.max(1) - slow.max(1)) / slow.max(1)
    off = np.abs(fast.argmax(1) - slow.argmax(1))

    assert np.median(error) < median
    assert np.quantile(error, 0.99) < p99
    assert (off <= 1).mean() >= 0.995
    assert np.median(off) == 0  # 0 mm of depth


def test_finer_stop_is_nearer_to_brute_force(case: Case) -> None:
    scene, chosen, slow = case
    errors: list[float] = []
    for stop in ("draft", "standard", "fine"):
        fast = three_bounce(scene, stop, chosen=chosen)
        bins = max(fast.shape[1], slow.shape[1])
        fast, exact = (
            np.pad(
                part,
                [(0, 0), (0, bins - part.shape[1])],
            )
            for part in (fast, slow)
        )
        errors.append(float(np.abs(fast - exact).sum() / exact.sum()))

    assert errors == sorted(errors, reverse=True)
    assert errors[1] < 1e-2
    assert errors[2] < 2e-3


def test_float32_light_is_within_1e_5_of_float64(case: Case) -> None:
    scene, chosen, slow = case
    fast = three_bounce(scene, replace(STOPS["fine"], tolerance=0.0), chosen=chosen)

    np.testing.assert_allclose(
        fast.sum(1, dtype=np.float64),
        slow.sum(1),
        rtol=1e-5,
    )


def test_sectors_do_not_change_a_bit_of_the_result(case: Case) -> None:
    scene, chosen, _ = case
    few, many = (
        three_bounce(
            scene,
            replace(STOPS["draft"], sectors=n),
            chosen=chosen,
        )
        for n in (1, 16)
    )

    np.testing.assert_array_equal(few, many)
