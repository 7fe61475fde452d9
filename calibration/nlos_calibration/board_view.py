"""A camera's view of a board, and the wall's plane in the lidar frame from it, whichever camera that is.

Infrared is seen by the lidar itself. Another camera has a lens that distorts and a place of its own: its plane is
fitted in its own frame, and moved to the lidar's together with its covariance.
"""

from dataclasses import dataclass, field, replace
from math import radians

import cv2
import numpy as np

from nlos_calibration.arrays import Float64
from nlos_calibration.board import Board
from nlos_calibration.board_corners import Corners, Light, find_corners
from nlos_calibration.board_plane import BoardFit, PrintErrors, fit_board
from nlos_calibration.errors import BoardRefusedError
from nlos_calibration.projection import Intrinsics

UNDISTORTED = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9)


@dataclass(frozen=True)
class CameraErrors:
    """Standard uncertainties of a colour camera's calibration: assumed, since its maker publishes none.

    Owners of the L515 saw colour and depth 4 to 5 pixels apart at 4 m, which is a turn of 0.3 degrees.
    """

    turn_std_deg: float = 0.2
    """Of its axes against the lidar's, about each of them; what is wrong with its principal point is the same."""
    shift_std_m: float = 0.0005
    """Of its place, along each axis."""
    focal_std: float = 0.001
    """Relative; librealsense itself corrects it for the camera's temperature."""


EXACT = CameraErrors(0.0, 0.0, 0.0)
"""Of the lidar's infrared: depth is seen by the same pinhole, so that what is wrong with it is wrong with both."""


@dataclass(frozen=True)
class BoardView:
    """An image in which a board is looked for, and what took it; the lidar in infrared, unless told otherwise."""

    image: Float64
    """(height, width), the mean over frames; of any gain."""
    intrinsics: Intrinsics
    distortion: Float64 = field(default_factory=lambda: np.zeros(5))
    """(5,): k1, k2, p1, p2, k3 of Brown and Conrady, as OpenCV and librealsense have them."""
    lidar_from_camera: Float64 = field(default_factory=lambda: np.eye(4))
    """(4, 4)."""
    light: Light = "infrared"
    errors: CameraErrors = EXACT


def find_in_view(view: BoardView, board: Board, printed: PrintErrors | None = None) -> BoardFit:
    """The plane of `board` in the lidar frame, from where its corners are in a view.

    Raises BoardRefusedError as `find_corners` and `fit_in_lidar` do.
    """
    return fit_in_lidar(find_corners(view.image, board, view.light), board, view, printed)


def fit_in_lidar(corners: Corners, board: Board, view: BoardView, printed: PrintErrors | None = None) -> BoardFit:
    """The plane of `board` in the lidar frame, from corners as they were found in the image of a view.

    Raises BoardRefusedError as `fit_board` does, and where the lidar would be behind the plane.
    """
    fit = fit_board(undistorted(corners, view), board, view.intrinsics, printed, focal_std=view.errors.focal_std)
    slopes, covariance = plane_in_lidar(fit.slopes, fit.covariance, view.lidar_from_camera, view.errors)
    return replace(fit, slopes=slopes, covariance=covariance)


def undistorted(corners: Corners, view: BoardView) -> Corners:
    """Where a pinhole of the same intrinsics would see the corners."""
    if not view.distortion.any():
        return corners
    points = corners.pixels.reshape(-1, 1, 2)
    straight = cv2.undistortImagePoints(points, view.intrinsics.matrix, view.distortion, None, UNDISTORTED)
    return replace(corners, pixels=np.asarray(straight, np.float64).reshape(-1, 2))


def plane_in_lidar(
    slopes: Float64, covariance: Float64, lidar_from_camera: Float64, errors: CameraErrors
) -> tuple[Float64, Float64]:
    """A plane slopes . p = 1 of the camera's frame as one of the lidar's: slopes (3,) and covariance (3, 3).

    With u the slopes turned, and t the camera's place, u . (p - t) = 1: the lidar's slopes are u / (1 + u . t).
    Raises BoardRefusedError where the plane runs between camera and lidar.
    """
    turn, place_m = lidar_from_camera[:3, :3], lidar_from_camera[:3, 3]
    turned = turn @ slopes
    height = 1.0 + float(turned @ place_m)
    if height <= 0.0:
        raise BoardRefusedError(
            "the board's wall runs between colour camera and lidar: is the pose of one to the other right?"
        )
    found = turned / height
    by_turned = (np.eye(3) - np.outer(found, place_m)) / height
    by_slopes, by_angle, by_place = by_turned @ turn, by_turned @ _turned_by(turned), -np.outer(found, found)
    angle_std = radians(errors.turn_std_deg)
    return found, (
        by_slopes @ covariance @ by_slopes.T
        + angle_std**2 * by_angle @ by_angle.T
        + errors.shift_std_m**2 * by_place @ by_place.T
    )


def _turned_by(vector: Float64) -> Float64:
    """How a vector (3,) changes with a small turn, w x vector, by w: (3, 3)."""
    x, y, z = vector
    return np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
