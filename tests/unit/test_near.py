"""Near contact: what is added to d^2, and where it ends. Its law is in tests/laws/test_contact.py."""

import numpy as np
import pytest

from nlos_cam.render.geometry import MANY, contact_m2, softened


def test_at_contact_all_of_it_is_added_and_from_the_end_on_nothing() -> None:
    assert softened(np.array([0.0]), 0.5, 1.0)[0] == 0.5
    np.testing.assert_array_equal(softened(np.array([1.0, 4.0]), 0.5, 1.0), [1.0, 4.0])


def test_one_number_for_each_cell_or_one_for_all() -> None:
    each = softened(np.array([0.0, 0.0]), np.array([0.1, 0.2]), 1.0)
    np.testing.assert_array_equal(each, [0.1, 0.2])


def test_it_is_the_area_over_the_solid_angle_and_a_share_for_the_neighbours() -> None:
    assert contact_m2(2.0, np.pi) == pytest.approx(MANY * 2 / np.pi)
    np.testing.assert_allclose(contact_m2(np.array([1.0, 2.0]), 1.0), [MANY, 2 * MANY])
