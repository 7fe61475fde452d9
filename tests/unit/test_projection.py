import numpy as np
import pytest
from nlos_calibration.geometry import Intrinsics

PINHOLE = Intrinsics(640, 480, 457.0, 461.0, 318.0, 241.0)


def test_a_ray_projects_back_to_its_pixel() -> None:
    rays = PINHOLE.rays()
    np.testing.assert_allclose(rays[..., 0] * PINHOLE.fx + PINHOLE.ppx, np.tile(np.arange(640), (480, 1)), atol=1e-9)
    np.testing.assert_allclose(rays[:, 0, 1] * PINHOLE.fy + PINHOLE.ppy, np.arange(480), atol=1e-9)
    assert (rays[..., 2] == 1.0).all()


def test_x_is_right_and_y_is_down() -> None:
    rays = PINHOLE.rays()
    assert rays[0, -1, 0] > rays[0, 0, 0]
    assert rays[-1, 0, 1] > rays[0, 0, 1]


@pytest.mark.parametrize("size", [(80, 64), (1024, 768), (640, 480)])
def test_scaling_keeps_the_edges_of_the_field(size: tuple[int, int]) -> None:
    scaled = PINHOLE.scaled(*size)
    for whole, part in ((PINHOLE, scaled), (scaled, PINHOLE)):
        assert (-0.5 - part.ppx) / part.fx == pytest.approx((-0.5 - whole.ppx) / whole.fx)
        assert (part.height - 0.5 - part.ppy) / part.fy == pytest.approx((whole.height - 0.5 - whole.ppy) / whole.fy)
    assert scaled.scaled(640, 480).ppx == pytest.approx(PINHOLE.ppx)


def test_a_cells_ray_is_the_mean_of_its_pixels_rays() -> None:
    cells = PINHOLE.scaled(80, 60).rays()
    np.testing.assert_allclose(PINHOLE.rays().reshape(60, 8, 80, 8, 3).mean(axis=(1, 3)), cells, atol=1e-12)


def test_opencvs_matrix_projects_alike() -> None:
    points = PINHOLE.rays()[::97, ::89].reshape(-1, 3) * 0.7
    seen = points @ PINHOLE.matrix.T
    columns, rows = np.meshgrid(np.arange(640)[::89], np.arange(480)[::97])
    np.testing.assert_allclose(seen[:, :2] / seen[:, 2:], np.column_stack([columns.ravel(), rows.ravel()]), atol=1e-9)
