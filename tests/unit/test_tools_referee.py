import importlib
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

TOOLS = Path(__file__).parents[2] / "tools"
Array = np.ndarray
Noisy = tuple[Array, Array, Array, Array]


@pytest.fixture
def agreement(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("referee_agreement")


@pytest.fixture
def scenes(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(TOOLS)
    return importlib.import_module("referee_scene")


@pytest.fixture
def noisy() -> Noisy:
    """A truth, an estimate of it with known errors, the errors, and which bins count; in the others it is far off."""
    generator = np.random.default_rng(0)
    truth = generator.uniform(1, 2, (20, 100))
    error = generator.uniform(0.01, 0.05, truth.shape)
    which = generator.uniform(size=truth.shape) < 0.7
    estimate = truth + error * generator.standard_normal(truth.shape) + 100 * ~which
    return truth, estimate, error, which


def test_noise_alone_gives_a_reduced_chi_square_of_one(agreement: ModuleType, noisy: Noisy) -> None:
    spread = np.sqrt(2 / noisy[3].sum())
    assert abs(agreement.reduced_chi_square(*noisy) - 1) < 4 * spread


def test_a_bias_of_k_errors_adds_k_squared(agreement: ModuleType, noisy: Noisy) -> None:
    truth, estimate, error, which = noisy
    biased = agreement.reduced_chi_square(truth + 3 * error, estimate, error, which)
    assert biased == pytest.approx(1 + 9, rel=0.1)


def test_the_fitted_scale_is_the_one_that_is_there_within_its_error(agreement: ModuleType, noisy: Noisy) -> None:
    truth, estimate, error, which = noisy
    scale, scale_error = agreement.best_scale(truth / 3, estimate, error, which)
    assert abs(scale - 3) < 4 * scale_error
    assert scale_error < 0.01


def test_no_scale_fits_better(agreement: ModuleType, noisy: Noisy) -> None:
    truth, estimate, error, which = noisy
    scale, _ = agreement.best_scale(truth, estimate, error, which)
    best = agreement.reduced_chi_square(scale * truth, estimate, error, which)
    assert all(
        best < agreement.reduced_chi_square(factor * scale * truth, estimate, error, which) for factor in (0.999, 1.001)
    )


def test_the_depth_map_and_the_mesh_are_the_same_surface(scenes: ModuleType) -> None:
    depth = scenes.depth_map(scenes.STEP, 64)
    for face in scenes.STEP:
        corners = face.corners_m
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        assert normal[2] < 0  # it looks at the wall
        x, y = np.meshgrid(*scenes.cell_centres_m(scenes.BOX, 64))
        off = (np.stack([x, y, depth], axis=-1) - corners[0]) @ (normal / np.linalg.norm(normal))
        on_face = np.abs(off) < 1e-6
        assert on_face.any()
        assert face.covers(x, y)[on_face].all()
    assert not np.isnan(depth).any()


def test_the_block_stands_before_the_plate_and_its_sides_reach_from_rim_to_far_end(scenes: ModuleType) -> None:
    block = scenes.STEP[1]
    alone, both = scenes.depth_map(scenes.PLATE, 64), scenes.depth_map(scenes.STEP, 64)
    x, y = np.meshgrid(*scenes.cell_centres_m(scenes.BOX, 64))
    inside = block.covers(x, y)
    assert (both[inside] < alone[inside]).all()
    np.testing.assert_array_equal(both[~inside], alone[~inside])
    for side, corner in zip(block.sides_m, block.corners_m, strict=True):
        np.testing.assert_array_equal(side[0], corner)
        np.testing.assert_array_equal(side[3], [*corner[:2], scenes.BOX.z_far_m])
        assert np.linalg.matrix_rank(side[1:] - side[0], tol=1e-9) == 2  # flat


def test_a_tool_without_its_referee_says_where_to_look(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(TOOLS)
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(SystemExit, match=r"tools/referee\.py says what to install"):
        importlib.import_module("referee_mitransient").load()
