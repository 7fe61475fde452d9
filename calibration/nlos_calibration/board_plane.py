"""The wall's plane from a board's corners: pose, plane, and how surely; or a refusal that says why.

The plane normal . p + distance_m = 0 is told as slopes = -normal / distance_m, like the depth's. A print is not what
was drawn: one that is 0.2 % too wide for its height turns the plane by 0.2 degrees, one that stands off the wall by
0.5 mm in its middle shifts it by 1 mm. So stretch and bows are fitted with the pose, held by what is to be expected of
them. The covariance is that of the corners, by their own residuals, through all of these; and that of the print's
scale, which no image shows.
"""

from dataclasses import dataclass, replace
from math import degrees, sqrt

import cv2
import numpy as np
from numpy.typing import NDArray

from nlos_calibration.board import Board
from nlos_calibration.board_corners import MIN_CORNERS, Corners
from nlos_calibration.errors import BoardRefusedError
from nlos_calibration.projection import Intrinsics

Array = NDArray[np.float64]

MAX_STRETCH, MAX_BOW_M = 0.015, 0.0015
"""More is no printer's error, and no sheet that was glued on."""
OUTLIER_SIGMAS, SIGMA_FLOOR_PX = 5.0, 0.02
MAGSAC_PX = 1.0
MEDIAN_PER_SIGMA = 0.67449
"""The median of |x| of a normal distribution."""
MIN_GOOD_SHARE = 0.7
"""Of the corners that were found; more strays are no accident."""
MAX_RESIDUAL_PX = 0.6
"""RMS of a coordinate. One dim frame stays below a half of that; paper that stands off by a millimetre does not."""
MISFIT_CHI2 = 25.0
"""How much better any homography may be than the pose, in variances."""
AMBIGUOUS_CHI2 = 25.0
"""A second pose is out only if it is worse by five standard deviations."""
SAME_NORMAL_DEG = 0.5
MAX_ANGLE_STD_DEG = 1.0
"""A board seen edge on, or a few corners close together, say less."""
MAX_STEPS, SETTLED = 50, 1e-10


@dataclass(frozen=True)
class PrintErrors:
    """Standard uncertainties of a print on the wall."""

    scale_std: float = 0.0025
    """Relative: a ruler reads 100 mm to a quarter of a millimetre."""
    stretch_std: float = 0.0035
    """Of width over height: two axes that are each that far off."""
    bow_std_m: float = 0.0003
    """How far the middle of the sheet stands off, seen along either axis."""


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
    stretch: float
    """Width over height as seen, less 1."""
    bow_m: float
    """How far the middle of the sheet stands off the wall."""


@dataclass(frozen=True)
class _View:
    """Corners on the print, where they are seen, and how well."""

    points_m: Array
    """(n, 3)."""
    pixels: Array
    """(n, 2)."""
    camera: Array
    """(3, 3)."""
    size_m: Array
    """(2,); the pattern's width and height."""
    variance_px2: float
    """Of a coordinate."""
    print_std: Array
    """(3,); of the print's stretch and bows."""


@dataclass(frozen=True)
class _Pose:
    """lidar_from_board, and what the print is like."""

    parameters: Array
    """(9,): rotation vector, translation, logarithm of the stretch, bows along x and y."""
    errors_px: Array
    """(n, 2)."""
    chi2: float
    """Of the corners and of what is expected of the print."""
    covariance: Array
    """(9, 9)."""

    @property
    def normal(self) -> Array:
        """(3,), away from the lidar."""
        return cv2.Rodrigues(self.parameters[:3])[0][:, 2].astype(np.float64)


def fit_board(corners: Corners, board: Board, intrinsics: Intrinsics, printed: PrintErrors | None = None) -> BoardFit:
    """The plane of `board` from its corners in an image of the lidar's pinhole.

    Raises BoardRefusedError where the corners do not lie as on a flat print of the right proportions, and where they
    leave the plane open.
    """
    printed = printed or PrintErrors()
    points_m = board.corners_m[corners.ids]
    good = _good(points_m, corners.pixels)
    points_m, pixels = points_m[good], corners.pixels[good]
    variance_px2 = _plane_variance_px2(points_m, pixels)
    camera = np.array([[intrinsics.fx, 0.0, intrinsics.ppx], [0.0, intrinsics.fy, intrinsics.ppy], [0.0, 0.0, 1.0]])
    size_m, print_std = np.array(board.size_mm) * 1e-3, np.array([printed.stretch_std, *2 * [printed.bow_std_m]])
    view = _View(points_m, pixels, camera, size_m, variance_px2, print_std)
    pose = _pose(view)
    _check_fit(pose)
    variance_px2 = _variance_px2(pose.errors_px, spent=9)
    pose = _refined(replace(view, variance_px2=variance_px2), pose.parameters)
    _check_print(pose)
    slopes, by_pose = _slopes(pose)
    by_corners = by_pose @ pose.covariance[:6, :6] @ by_pose.T
    _check_certain(slopes, by_corners)
    return BoardFit(
        slopes=slopes,
        covariance=by_corners + printed.scale_std**2 * np.outer(slopes, slopes),
        corners=len(pixels),
        residual_px=sqrt(variance_px2),
        stretch=float(np.expm1(pose.parameters[6])),
        bow_m=float(pose.parameters[7:].sum()),
    )


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


def _plane_variance_px2(points_m: Array, pixels: Array) -> float:
    """Of the residuals of any plane seen by any pinhole. Raises BoardRefusedError where it is no noise."""
    found, _ = cv2.findHomography(points_m[:, :2], pixels, 0)
    variance_px2 = _variance_px2(pixels - _projected(points_m, found), spent=8)
    if variance_px2 > MAX_RESIDUAL_PX**2:
        raise BoardRefusedError(
            f"the board is not flat: its corners are {sqrt(variance_px2):.2f} pixels RMS off a plane, "
            f"{MAX_RESIDUAL_PX:g} allowed; glue it to the wall or to a stiff plate, and keep lidar and board still",
        )
    return variance_px2


def _variance_px2(errors_px: Array, spent: int) -> float:
    """Of a coordinate, from what a model with `spent` parameters leaves.

    Divided by two less than that leaves: normal intervals are then as wide as Student's, which they should be where
    noise is estimated from few corners.
    """
    return max(float((errors_px**2).sum()) / (errors_px.size - spent - 2), SIGMA_FLOOR_PX**2)


def _check_fit(pose: _Pose) -> None:
    free = pose.errors_px.size - 8
    if pose.chi2 > free + MISFIT_CHI2:
        raise BoardRefusedError(
            f"the squares do not fit: {sqrt(pose.chi2 / free):.1f} times as far off any pose as off a plane; is the "
            "print stretched or skewed, or are these another camera's intrinsics?",
        )


def _check_print(pose: _Pose) -> None:
    stretch, bows_m = float(pose.parameters[6]), pose.parameters[7:]
    if abs(stretch) > MAX_STRETCH:
        raise BoardRefusedError(
            f"the squares do not fit: they are seen {100.0 * stretch:+.1f} % wider than high; print without stretching, "
            "and use the lidar's own intrinsics",
        )
    if float(np.abs(bows_m).max()) > MAX_BOW_M:
        raise BoardRefusedError(
            f"the board is not flat: its middle stands {1e3 * float(bows_m.sum()):+.1f} mm off the wall; glue it to the "
            "wall or to a stiff plate",
        )


def _pose(view: _View) -> _Pose:
    """The better of the two poses that a plane seen from afar allows."""
    _, turns, shifts, _ = cv2.solvePnPGeneric(view.points_m, view.pixels, view.camera, None, flags=cv2.SOLVEPNP_IPPE)
    starts = [np.concatenate([turn.ravel(), shift.ravel(), np.zeros(3)]) for turn, shift in zip(turns, shifts, strict=True)]
    best, *others = sorted((_refined(view, start) for start in starts), key=lambda pose: pose.chi2)
    for other in others:
        apart_deg = degrees(np.arccos(np.clip(float(best.normal @ other.normal), -1.0, 1.0)))
        if apart_deg > SAME_NORMAL_DEG and other.chi2 - best.chi2 < AMBIGUOUS_CHI2:
            raise BoardRefusedError(
                f"two poses, {apart_deg:.0f} degrees apart, explain the board equally well: bring it closer, or take a "
                "larger one",
            )
    return best


def _refined(view: _View, parameters: Array) -> _Pose:
    """Least squares by Gauss and Newton's steps, damped where they would not improve, with what is expected of the print."""
    rows, errors = _linear(view, parameters)
    damping = 0.0
    for _ in range(MAX_STEPS):
        normal = rows.T @ rows
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), rows.T @ errors)
        new_rows, new_errors = _linear(view, parameters + step)
        gain = float(errors @ errors - new_errors @ new_errors)
        if gain < 0.0:
            damping = max(10.0 * damping, 1e-3)
            continue
        parameters, rows, errors, damping = parameters + step, new_rows, new_errors, 0.1 * damping
        if gain <= SETTLED * float(errors @ errors):
            break
    errors_px = errors[:-3].reshape(-1, 2) * sqrt(view.variance_px2)
    return _Pose(parameters, errors_px, float(errors @ errors), np.linalg.inv(rows.T @ rows))


def _linear(view: _View, parameters: Array) -> tuple[Array, Array]:
    """The derivatives (2 n + 3, 9) of what is seen by the parameters, and what is left of it, in standard deviations."""
    points_m, by_print = _printed(view, parameters[6:])
    seen, by_pose = cv2.projectPoints(points_m, parameters[:3], parameters[3:6], view.camera, None)[:2]
    moved_m = cv2.Rodrigues(parameters[:3])[0] @ by_print
    by_print_px = (by_pose[:, 3:6].reshape(-1, 2, 3) @ moved_m).reshape(-1, 3)
    sigma_px = sqrt(view.variance_px2)
    expected = np.hstack([np.zeros((3, 6)), np.diag(1.0 / view.print_std)])
    rows = np.vstack([np.hstack([by_pose[:, :6], by_print_px]) / sigma_px, expected])
    errors = np.append((view.pixels - seen.reshape(-1, 2)).ravel() / sigma_px, -parameters[6:] / view.print_std)
    return rows, errors


def _printed(view: _View, how: Array) -> tuple[Array, Array]:
    """Where the corners (n, 3) of a stretched and bowed print are, and that by stretch and bows (n, 3, 3)."""
    x_m, y_m, _ = view.points_m.T
    across, down = (2.0 * view.points_m[:, :2] / view.size_m - 1.0).T
    heights = np.stack([1.0 - across**2, 1.0 - down**2])
    wide = np.exp(0.5 * how[0])
    points_m = np.column_stack([wide * x_m, y_m / wide, -how[1:] @ heights])
    by_print = np.zeros((len(points_m), 3, 3))
    by_print[:, :2, 0] = points_m[:, :2] * [0.5, -0.5]
    by_print[:, 2, 1:] = -heights.T
    return points_m, by_print


def _slopes(pose: _Pose) -> tuple[Array, Array]:
    """The slopes n / (n . t) of the plane with normal n through t, and their derivative (3, 6) by the pose."""
    matrix, by_turn = cv2.Rodrigues(pose.parameters[:3])
    normal, shift = matrix[:, 2].astype(np.float64), pose.parameters[3:6]
    normal_by_turn = by_turn.reshape(3, 3, 3)[:, :, 2].T  # OpenCV: d matrix[i, j] / d turn[k] at [k, 3 i + j]
    height = float(normal @ shift)
    by_normal = (np.eye(3) - np.outer(normal, shift) / height) / height
    by_shift = -np.outer(normal, normal) / height**2
    return normal / height, np.hstack([by_normal @ normal_by_turn, by_shift])


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
