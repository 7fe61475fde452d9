"""The study of measured light: offsets and exponents that were put in come out again."""

from collections.abc import Callable
from types import ModuleType

import numpy as np

Tool = Callable[[str], ModuleType]
BIN_S = 16e-12


def scan_places() -> np.ndarray:
    generator = np.random.default_rng(4)
    return generator.uniform([-0.5, -0.33, 0.64], [0.5, -0.33, 0.79], (80, 3))


def test_offsets_put_into_arrivals_are_found(tool: Tool) -> None:
    reality = tool("reality")
    offset_m = np.array([0.04, 0.18, 0.06])
    center_m = scan_places()

    def point(at_m: np.ndarray) -> np.ndarray:
        return reality.point_arrival(at_m, BIN_S)

    scan = reality.Scan(center_m, point(center_m + offset_m), np.ones(80), BIN_S)
    found_m, left_bins = reality.fit_offsets(scan, point)

    np.testing.assert_allclose(found_m, offset_m, atol=1e-4)
    assert np.abs(left_bins).max() < 0.01


def test_exponents_of_made_light_are_found(tool: Tool) -> None:
    center_m = scan_places()
    distance_m = np.linalg.norm(center_m, axis=1)
    light = distance_m**-4.0 * (center_m[:, 2] / distance_m) ** 2
    found = tool("reality").exponents(center_m, light)

    np.testing.assert_allclose([found["distance"], found["cosine"]], [4, 2], atol=1e-6)


def test_rendered_speck_arrives_as_a_point(tool: Tool) -> None:
    reality = tool("reality")
    look = ("lambertian", reality.MATERIALS["matt"])
    problem = reality.confocal_problem("Y", 0.02, look, BIN_S)
    place_m = np.array([0.2, -0.25, 0.7])
    arrival, _ = reality.confocal(problem, place_m)

    assert abs(arrival - reality.point_arrival(place_m, BIN_S)) < 1
