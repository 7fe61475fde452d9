"""The wall's plane from a board's corners: pose, plane, and how surely; or a refusal that says why.

The plane normal . p + distance_m = 0 is told as slopes = -normal / distance_m, like the depth's. Its covariance is that
of the corners, taken from their own residuals, through the pose; and that of the print's scale, which no image shows.
"""

from dataclasses import dataclass
from math import degrees, sqrt

import cv2
import numpy as np
from numpy.typing import NDArray

from nlos_calibration.board import Board
from nlos_calibration.board_corners import MIN_CORNERS, Corners
from nlos_calibration.errors import BoardRefusedError
from nlos_calibration.projection import Intrinsics

Array = NDArray[np.float64]
Pose = tuple[Array, Array]
"""Rotation vector (3,) and translation (3,) of lidar_from_board."""

SCALE_STD = 0.0025
"""Standard uncertainty of the print's scale: a ruler reads 100 mm to a quarter of a millimetre."""
OUTLIER_SIGMAS, SIGMA_FLOOR_PX = 5.0, 0.05
MAGSAC_PX = 1.0
MEDIAN_PER_SIGMA = 0.67449
"""The median of |x| of a normal distribution."""
MIN_GOOD_SHARE = 0.7
"""Of the corners that were found; more strays are no accident."""
MAX_RESIDUAL_PX = 0.6
"""RMS of a coordinate. One dim frame stays below a half of that; paper that stands off by a millimetre does not."""
MISFIT_RATIO = 25.0
"""Of what the two freedoms that a homography has and a pose lacks take up, to what is left for each."""
AMBIGUOUS_CHI2 = 25.0
"""A second pose is out only if it is worse by five standard deviations."""
SAME_NORMAL_DEG = 0.5
MAX_ANGLE_STD_DEG = 1.0
"""A board seen edge on, or a few corners close together, say less."""


@dataclass(frozen=True)
class BoardFit:
    """The plane of a board in the lidar frame."""

    slopes: Array
    """(3,); -normal / distance_m, the normal towards the lidar."""
    covariance: Array
    """(3, 3) of the slopes."""
    corners: int
    """How many the plane rests on."""
    residual_px: float
    """RMS of a coordinate's residual."""


def fit_board(corners: Corners, board: Board, intrinsics: Intrinsics, scale_std: float = SCALE_STD) -> BoardFit:
    """The plane of `board` from its corners in an image of the lidar's pinhole.

    `scale_std` is the relative standard uncertainty of the printed size. Raises BoardRefusedError where the corners do
    not lie as on a flat print of the right proportions, and where they leave the plane open.
    """
    points_m = board.corners_m[corners.ids]
    good = _good(points_m, corners.pixels)
    points_m, pixels = points_m[good], corners.pixels[good]
    camera = np.array([[intrinsics.fx, 0.0, intrinsics.ppx], [0.0, intrinsics.fy, intrinsics.ppy], [0.0, 0.0, 1.0]])
    free_px = _homography_residuals(points_m, pixels)
    _check_flat(free_px)
    rotation, translation, errors_px = _pose(points_m, pixels, camera)
    _check_proportions(errors_px, free_px)
    slopes, by_pose = _slopes(rotation, translation)
    by_corners = by_pose @ _pose_covariance((rotation, translation), points_m, camera, errors_px) @ by_pose.T
    _check_certain(slopes, by_corners)
    covariance = by_corners + scale_std**2 * np.outer(slopes, slopes)
    return BoardFit(slopes, covariance, len(pixels), float(np.sqrt(np.mean(errors_px**2))))


def _good(points_m: Array, pixels: Array) -> NDArray[np.bool_]:
    """Which corners lie as on a plane with most others: the detector now and then takes an edge for a corner."""
    found, _ = cv2.findHomography(points_m[:, :2], pixels, cv2.USAC_MAGSAC, MAGSAC_PX)
    if found is None:
        raise BoardRefusedError(_LINE)
    errors_px = np.linalg.norm(pixels - _projected(points_m, found), axis=1)
    sigma_px = max(float(np.median(errors_px)) / sqrt(2.0) / MEDIAN_PER_SIGMA, SIGMA_FLOOR_PX)
    good = errors_px < OUTLIER_SIGMAS * sigma_px
    if good.sum() < max(MIN_CORNERS, MIN_GOOD_SHARE * len(good)):
        raise BoardRefusedError(
            f"only {good.sum()} of {len(good)} corners lie on one plane: is the board flat on the wall, and the "
            "lidar still?",
        )
    return good


def _projected(points_m: Array, homography: Array) -> Array:
    return cv2.perspectiveTransform(points_m[np.newaxis, :, :2], homography)[0].astype(np.float64)


def _homography_residuals(points_m: Array, pixels: Array) -> Array:
    """Residuals (n, 2) of any plane seen by any pinhole: what is left has no excuse."""
    return pixels - _projected(points_m, cv2.findHomography(points_m[:, :2], pixels, 0)[0])


def _check_flat(free_px: Array) -> None:
    sigma_px = sqrt(float((free_px**2).sum()) / (free_px.size - 8))
    if sigma_px > MAX_RESIDUAL_PX:
        raise BoardRefusedError(
            f"the board is not flat: its corners are {sigma_px:.2f} pixels RMS off a plane, {MAX_RESIDUAL_PX:g} allowed; "
            "glue it to the wall or to a stiff plate, and keep lidar and board still",
        )


def _check_proportions(errors_px: Array, free_px: Array) -> None:
    taken, left = float((errors_px**2).sum()) - float((free_px**2).sum()), float((free_px**2).sum())
    ratio = 0.5 * taken / (left / (free_px.size - 8))
    if ratio > MISFIT_RATIO:
        raise BoardRefusedError(
            f"the squares do not fit: {np.sqrt(np.mean(errors_px**2)):.2f} pixels RMS off any pose, but only "
            f"{np.sqrt(np.mean(free_px**2)):.2f} off a plane; print without stretching, and use the lidar's own intrinsics",
        )


def _pose(points_m: Array, pixels: Array, camera: Array) -> tuple[Array, Array, Array]:
    """Rotation and translation vectors of the better of the two poses that a plane allows, and its residuals (n, 2)."""
    _, turns, shifts, _ = cv2.solvePnPGeneric(points_m, pixels, camera, None, flags=cv2.SOLVEPNP_IPPE)
    poses = [cv2.solvePnPRefineLM(points_m, pixels, camera, None, *pose) for pose in zip(turns, shifts, strict=True)]
    found = [
        (turn.ravel(), shift.ravel(), pixels - cv2.projectPoints(points_m, turn, shift, camera, None)[0].reshape(-1, 2))
        for turn, shift in poses
    ]
    best, *others = sorted(found, key=lambda pose: float((pose[2] ** 2).sum()))
    for other in others:
        _check_unambiguous(best, other)
    return best


def _check_unambiguous(best: tuple[Array, Array, Array], other: tuple[Array, Array, Array]) -> None:
    normals = [cv2.Rodrigues(turn)[0][:, 2] for turn, _, _ in (best, other)]
    apart_deg = degrees(np.arccos(np.clip(float(normals[0] @ normals[1]), -1.0, 1.0)))
    squares = float((best[2] ** 2).sum())
    variance = max(squares / (best[2].size - 6), SIGMA_FLOOR_PX**2)
    if apart_deg > SAME_NORMAL_DEG and float((other[2] ** 2).sum()) - squares < AMBIGUOUS_CHI2 * variance:
        raise BoardRefusedError(
            f"two poses, {apart_deg:.0f} degrees apart, explain the board equally well: bring it closer, or take a "
            "larger one",
        )


def _slopes(rotation: Array, translation: Array) -> tuple[Array, Array]:
    """The slopes n / (n . t) of the plane with normal n through t, and their derivative (3, 6) by the pose."""
    matrix, by_turn = cv2.Rodrigues(rotation)
    normal = matrix[:, 2].astype(np.float64)
    normal_by_turn = by_turn.reshape(3, 3, 3)[:, :, 2].T  # OpenCV: d matrix[i, j] / d turn[k] at [k, 3 i + j]
    height = float(normal @ translation)
    by_normal = (np.eye(3) - np.outer(normal, translation) / height) / height
    by_shift = -np.outer(normal, normal) / height**2
    return normal / height, np.hstack([by_normal @ normal_by_turn, by_shift])


def _pose_covariance(pose: Pose, points_m: Array, camera: Array, errors_px: Array) -> Array:
    """(6, 6), by the corners' own residuals.

    Their variance is divided by two degrees of freedom less than are left: normal intervals are then as wide as
    Student's, which they should be where the noise itself is estimated from few corners.
    """
    jacobian = cv2.projectPoints(points_m, *pose, camera, None)[1][:, :6]
    variance = float((errors_px**2).sum()) / (errors_px.size - 8)
    return variance * np.linalg.inv(jacobian.T @ jacobian)


def _check_certain(slopes: Array, covariance: Array) -> None:
    distance_m = 1.0 / float(np.linalg.norm(slopes))
    worst = float(np.linalg.eigvalsh(covariance)[-1])
    angle_std_deg = degrees(distance_m * sqrt(worst))
    if angle_std_deg > MAX_ANGLE_STD_DEG:
        raise BoardRefusedError(
            f"the board fixes the wall's angle to {angle_std_deg:.1f} degrees only, {MAX_ANGLE_STD_DEG:g} needed: it is "
            "seen too far off, edge on, or too little of it; move it to the near side of the view",
        )


_LINE = "the board's corners are seen in a line, as of a board seen edge on: turn the lidar towards the wall"
