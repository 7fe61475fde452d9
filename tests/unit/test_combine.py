import numpy as np
import pytest
from nlos_calibration.board_wall import AGREE_SIGMAS, Plane, combine, disagreement
from nlos_calibration.geometry import normal_from_angles


def plane(distance_m: float, yaw_deg: float = 45.0, *, std_m: float = 1e-4, std_deg: float = 0.02) -> Plane:
    normal = normal_from_angles(np.radians(yaw_deg), 0.1)
    along = np.outer(normal, normal)
    covariance = (std_m / distance_m**2) ** 2 * along
    return Plane(-normal / distance_m, covariance + (np.radians(std_deg) / distance_m) ** 2 * (np.eye(3) - along))


def shaken(of: Plane, generator: np.random.Generator) -> Plane:
    return Plane(generator.multivariate_normal(of.slopes, of.covariance), of.covariance)


def test_equal_planes_agree_and_are_surer_together() -> None:
    both = combine(plane(0.2), plane(0.2), measured=False)
    assert (both.used, both.causes) == ("both", ())
    np.testing.assert_allclose(both.plane.slopes, plane(0.2).slopes)
    np.testing.assert_allclose(both.plane.covariance, 0.5 * plane(0.2).covariance)
    assert both.disagreement.sigmas == pytest.approx(0.0, abs=1e-9)


def test_each_counts_by_its_weight() -> None:
    """Depth knows the distance, the board the angle: the combination has each from the one that knows it."""
    depth, board = plane(0.2, 45.0, std_m=1e-5, std_deg=1.0), plane(0.2005, 45.5, std_m=1e-3, std_deg=0.01)
    both = combine(depth, board, measured=False)
    assert both.plane.distance_m == pytest.approx(0.2, abs=2e-5)
    assert both.plane.normal @ board.normal == pytest.approx(1.0, abs=1e-7)
    for one in (depth, board):
        assert (np.linalg.eigvalsh(one.covariance - both.plane.covariance) > -1e-9).all()


def test_a_plane_that_is_known_exactly_is_kept() -> None:
    exact = Plane(plane(0.2).slopes, np.zeros((3, 3)))
    both = combine(exact, plane(0.2001), measured=False)
    np.testing.assert_allclose(both.plane.slopes, exact.slopes)
    np.testing.assert_allclose(both.plane.covariance, 0.0, atol=1e-15)


def test_the_disagreement_is_in_millimetres_degrees_and_standard_deviations() -> None:
    apart = disagreement(plane(0.2, 45.0), plane(0.2003, 45.0))
    assert apart.distance_m == pytest.approx(0.0003)
    assert apart.angle_deg == pytest.approx(0.0, abs=1e-6)
    assert apart.distance_sigmas == pytest.approx(0.3 / np.hypot(0.1, 0.1), rel=0.01)
    assert apart.angle_sigmas < 1e-6
    turned = disagreement(plane(0.2, 45.0), plane(0.2, 45.1))
    expected_deg = 0.1 * np.cos(0.1)
    assert turned.angle_deg == pytest.approx(expected_deg, rel=1e-3)
    assert turned.angle_sigmas == pytest.approx(expected_deg / np.hypot(0.02, 0.02), rel=0.01)
    assert turned.distance_sigmas < 0.1


def test_chance_is_called_a_disagreement_as_rarely_as_it_should_be() -> None:
    generator, depth, board = np.random.default_rng(0), plane(0.2), plane(0.2, std_m=5e-4, std_deg=0.05)
    sigmas = [disagreement(shaken(depth, generator), shaken(board, generator)).sigmas for _ in range(3000)]
    assert np.mean(np.square(sigmas)) == pytest.approx(3.0, rel=0.1)
    assert np.mean(np.array(sigmas) > AGREE_SIGMAS) < 0.004


def test_the_combination_is_honest() -> None:
    generator, depth, board = np.random.default_rng(1), plane(0.2), plane(0.2, std_m=2e-4, std_deg=0.05)
    inside = []
    for _ in range(2000):
        both = combine(shaken(depth, generator), shaken(board, generator), measured=False).plane
        off = both.slopes - depth.slopes
        inside.append(off @ np.linalg.solve(both.covariance, off) < 7.815)  # 95 % of a chi-square of three
    assert np.mean(inside) == pytest.approx(0.95, abs=0.02)


@pytest.mark.parametrize(("measured", "used"), [(False, "depth"), (True, "board")])
def test_of_two_that_disagree_one_is_taken_and_said(measured: bool, used: str) -> None:
    depth, board = plane(0.2), plane(0.206)
    both = combine(depth, board, measured=measured)
    assert both.used == used
    assert both.plane is (board if measured else depth)
    assert both.disagreement.sigmas > AGREE_SIGMAS


def test_the_likely_causes_come_with_amounts_that_would_explain_it() -> None:
    """The squares seen as 30 mm that are 29.1 mm put the wall 3 % too far away."""
    causes = combine(plane(0.2), plane(0.2 / 0.97, std_m=5e-4), measured=False).causes
    assert any("print's scale: squares of 97.0 %" in cause for cause in causes)
    # along the axis the same wall is farther than along its normal
    offset_mm = 1e3 * 0.2 * (1 / 0.97 - 1) / (np.cos(np.radians(45.0)) * np.cos(0.1))
    assert any(f"range offset: {offset_mm:+.1f} mm" in cause for cause in causes)
    assert not any("angle" in cause for cause in causes)


def test_squares_that_were_measured_are_not_to_blame() -> None:
    causes = combine(plane(0.2), plane(0.204), measured=True).causes
    assert [cause for cause in causes if "offset" in cause]
    assert not [cause for cause in causes if "scale" in cause]


def test_another_angle_is_another_cause() -> None:
    (cause,) = combine(plane(0.2, 45.0), plane(0.2, 46.005), measured=False).causes
    assert "1.00 degrees apart" in cause
    assert "flat" in cause


def test_what_no_printer_and_no_lidar_does_is_not_offered() -> None:
    causes = combine(plane(0.2), plane(0.4), measured=False).causes
    assert causes
    assert not [cause for cause in causes if "scale" in cause or "offset" in cause]
