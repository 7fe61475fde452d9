"""An occluder in view is found where it stands, within its stated uncertainty; elsewhere none is
found.
"""

import numpy as np
import pytest
from nlos_calibration.rig import load_rig
from occluder_trials import (
    BARELY,
    IN_VIEW,
    OccluderConditions,
    draw,
    find_occluder,
    simulated_trial,
    trial,
)
from synthetic_scenes import bench_depth
from synthetic_walls import depth_statistics

SENSOR = load_rig("paper-rig").pinhole.scaled(160, 120)
LOOKS = {
    "one frame": {"frames": 1, "noise": 1.0},
    "noisy": {"frames": 6, "noise": 4.0},
    "mixed pixels": {"frames": 6, "beams": 4},
    "outliers": {"frames": 6, "outliers": 0.05},
}


@pytest.mark.slow
@pytest.mark.parametrize("look", LOOKS)
def test_occluder_interval_holds_the_truth_as_often_as_stated(look: str) -> None:
    """80 benches each: a share of 95 % is found below 86 % once in 500. A gap's is of a pixel,
    uniform: 100 %.
    """
    uniform = np.random.default_rng(11).uniform
    drawn_of = [
        uniform(low, high, 80)
        for low, high in ((0.15, 0.3), (35.0, 70.0), (0.12, 0.22), (0.05, 0.12))
    ]
    benches = [OccluderConditions(*values, **LOOKS[look]) for values in zip(*drawn_of, strict=True)]
    outcomes = [
        trial(conditions, np.random.default_rng([3, n])) for n, conditions in enumerate(benches)
    ]
    found = [one for one in outcomes if not one.refused]
    inside = np.array([one.inside for one in found]).mean(axis=0)

    assert len(found) > 70
    assert (inside >= 0.86).all()
    assert inside[1] >= 0.97


@pytest.mark.parametrize("facing_deg", [15.0, 30.0, 75.0])
def test_occluder_is_found_only_where_one_is_in_view(facing_deg: float) -> None:
    shown = set()
    for n, (x_m, gap_m) in enumerate([(0.12, 0.05), (0.2, 0.1), (0.3, 0.15), (0.3, 0.05)]):
        one = trial(
            OccluderConditions(0.2, facing_deg, x_m, gap_m, frames=4), np.random.default_rng(n)
        )
        shown.add(one.shown)
        if one.shown == IN_VIEW:
            assert not one.refused
            assert abs(one.x_error_m) < 1e-3
        elif one.shown != BARELY:
            assert one.refused

    assert shown - {BARELY}


def test_occluder_of_more_frames_has_a_surer_sheet_but_same_edge() -> None:
    def stds(frames: int) -> tuple[float, float]:
        generator = np.random.default_rng(4)
        seen, sheet = draw(OccluderConditions(lean_deg=0.0), generator)
        mean = depth_statistics(bench_depth(seen, sheet), generator, frames=frames, noise=1.0)
        fit = find_occluder(mean.mean_m(), mean.noise(), seen.pinhole, seen.pose, generator)
        return fit.x_std_m, fit.gap_std_m

    (x_few, gap_few) = stds(4)
    (x_many, gap_many) = stds(64)

    assert x_many < 0.5 * x_few
    assert gap_many == pytest.approx(gap_few, rel=0.2)


@pytest.mark.parametrize(
    ("facing_deg", "x_m", "gap_m"), [(45.0, 0.2, 0.1), (60.0, 0.15, 0.06), (40.0, 0.12, 0.13)]
)
def test_occluder_of_the_simulated_camera_is_found(
    facing_deg: float, x_m: float, gap_m: float
) -> None:
    one = simulated_trial(
        OccluderConditions(0.2, facing_deg, x_m, gap_m, frames=4), np.random.default_rng(2), SENSOR
    )

    assert not one.refused
    assert abs(one.x_error_m) < 1e-3
    assert abs(one.gap_error_m) < 2e-3
    assert one.inside[1]
