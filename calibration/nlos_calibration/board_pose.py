"""Plane of a printed board from its corners in an image, with covariance; or a refusal with its
reason.

The pose is found by least squares over the corners, together with the errors of printer and glue: a
print that is 0.2 % too wide for its height turns the plane by 0.2 degrees, one whose middle stands
0.5 mm off the wall shifts it by 1 mm. So stretch and bows are unknowns too, each with a prior of
its expected size. The plane is expressed as slopes = -normal / distance_m, like the depth's; its
covariance adds that of the print's scale, which no image shows.
"""

from dataclasses import dataclass, replace
from math import degrees, sqrt
from typing import Any

import cv2
import numpy as np

from nlos_calibration.arrays import Float64, Mask
from nlos_calibration.board import MIN_CORNERS, Board, Corners
from nlos_calibration.errors import BoardRefusedError
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.noise import MEDIAN_PER_SIGMA

UNKNOWNS = 9
AMBIGUOUS_CHI2 = 25.0
"""A second pose is excluded only if it is worse by five standard deviations."""
SAME_NORMAL_DEG = 0.5
MAX_STEPS = 50
SETTLED = 1e-10


@dataclass(frozen=True)
class CornerObservations:
    """Corners of the drawing, their pixels, and the noise and print errors to expect."""

    points_m: Float64
    """(n, 3)."""
    pixels: Float64
    """(n, 2)."""
    camera: Float64
    """(3, 3)."""
    size_m: Float64
    """(2,); width and height of the drawing."""
    print_std: Float64
    """(3,); standard deviations of the print's stretch (width over height) and of its bows along x
    and y (m).
    """
    variance_px2: float
    """Variance of a coordinate."""


@dataclass(frozen=True)
class BoardPose:
    """Fitted pose lidar_from_board, and the print's stretch and bows."""

    parameters: Float64
    """(9,): rotation vector, translation, logarithm of the stretch, bows along x and y."""
    errors_px: Float64
    """(n, 2)."""
    chi2: float
    """Sum of squared residuals of the corners and of the priors of the print."""
    covariance: Float64
    """(9, 9)."""

    @property
    def normal(self) -> Float64:
        """Unit normal (3,), away from the lidar."""
        return cv2.Rodrigues(self.parameters[:3])[0][:, 2].astype(np.float64)

    def slopes(self) -> tuple[Float64, Float64]:
        """Return the slopes n / (n . t) of the plane with normal n through t, and their
        covariance.
        """
        # with h = n . t: d slopes / d n = I / h - n t' / h^2, d slopes / d t = -n n' / h^2
        by_turn = cv2.Rodrigues(self.parameters[:3])[1]
        normal = self.normal
        shift = self.parameters[3:6]
        # OpenCV has d matrix[i, j] / d turn[k] at [k, 3 i + j]; the normal is column j = 2
        normal_by_turn = by_turn.reshape(3, 3, 3)[:, :, 2].T
        height = float(normal @ shift)
        by_normal = (np.eye(3) - np.outer(normal, shift) / height) / height
        by_pose = np.hstack([by_normal @ normal_by_turn, -np.outer(normal, normal) / height**2])
        return normal / height, by_pose @ self.covariance[:6, :6] @ by_pose.T


def solve_pose(corners: CornerObservations) -> BoardPose:
    """Return the better of the two poses of a distant plane. Raises BoardRefusedError if both fit
    equally well.
    """
    # A homography of weak perspective has two poses, mirror images about the line of sight; IPPE
    # (Collins and Bartoli, 2014) returns both. Each is refined, and the second must be excluded by
    # its residuals.
    _, turns, shifts, _ = cv2.solvePnPGeneric(
        corners.points_m, corners.pixels, corners.camera, None, flags=cv2.SOLVEPNP_IPPE
    )
    starts = [
        np.append(np.concatenate([turn, shift]), np.zeros(3))
        for turn, shift in zip(turns, shifts, strict=True)
    ]
    best, *others = sorted(
        (refine_pose(corners, one.astype(np.float64)) for one in starts), key=lambda pose: pose.chi2
    )
    # chi^2 differs by the square of a number of standard deviations: 25 is five of them.
    for other in others:
        apart_deg = degrees(np.arccos(np.clip(float(best.normal @ other.normal), -1.0, 1.0)))
        if apart_deg > SAME_NORMAL_DEG and other.chi2 - best.chi2 < AMBIGUOUS_CHI2:
            raise BoardRefusedError(
                f"two poses, {apart_deg:.0f} degrees apart, explain the board equally well: bring"
                " it closer, or use a larger one"
            )
    return best


def refine_pose(corners: CornerObservations, parameters: Float64) -> BoardPose:
    """Refine `parameters` (9,) by Gauss-Newton steps, damped where they do not improve
    (Levenberg-Marquardt).
    """
    rows, errors = _linear(corners, parameters)
    damping = 0.0
    for _ in range(MAX_STEPS):
        squares = rows.T @ rows
        step = np.linalg.solve(squares + damping * np.diag(np.diag(squares)), rows.T @ errors)
        new_rows, new_errors = _linear(corners, parameters + step)
        gain = float(errors @ errors - new_errors @ new_errors)
        if gain < 0.0:
            damping = max(10.0 * damping, 1e-3)
            continue
        parameters = parameters + step
        rows = new_rows
        errors = new_errors
        damping = 0.1 * damping
        if gain <= SETTLED * float(errors @ errors):
            break
    errors_px = errors[:-3].reshape(-1, 2) * sqrt(corners.variance_px2)
    # Residuals and priors are in standard deviations, so that (J' J)^-1 is the covariance itself.
    covariance = np.linalg.inv(rows.T @ rows).astype(np.float64)
    return BoardPose(parameters, errors_px, float(errors @ errors), covariance)


def _linear(corners: CornerObservations, parameters: Float64) -> tuple[Float64, Float64]:
    """Return Jacobian (2 n + 3, 9) and residuals (2 n + 3,) at the parameters, in standard
    deviations.
    """
    # The chain rule takes print errors to pixels: a corner moved by dp on the board moves by R dp
    # in the camera, as a translation would, whose pixel derivative OpenCV returns. Three more rows
    # are the priors: stretch and bows are 0 within `print_std`.
    points_m, by_print = _printed(corners, parameters[6:])
    pixels, by_pose = cv2.projectPoints(
        points_m, parameters[:3], parameters[3:6], corners.camera, None
    )[:2]
    moved_m = cv2.Rodrigues(parameters[:3])[0] @ by_print
    by_print_px = (by_pose[:, 3:6].reshape(-1, 2, 3) @ moved_m).reshape(-1, 3)
    sigma_px = sqrt(corners.variance_px2)
    priors = np.hstack([np.zeros((3, 6)), np.diag(1.0 / corners.print_std)])
    rows = np.vstack([np.hstack([by_pose[:, :6], by_print_px]) / sigma_px, priors])
    errors = np.append(
        (corners.pixels - pixels.reshape(-1, 2)).ravel() / sigma_px,
        -parameters[6:] / corners.print_std,
    )
    return rows.astype(np.float64), errors


def _printed(corners: CornerObservations, deformation: Float64) -> tuple[Float64, Float64]:
    """Return corners (n, 3) of a stretched and bowed print, and their derivatives (n, 3, 3) by
    stretch and bows.
    """
    # x grows by exp(s / 2) and y shrinks by it, so that the area, which is the scale, stays; a bow
    # is a parabola that is 0 at the sheet's edges and stands off the wall, against the board's z,
    # by its height in the middle
    across, down = (2.0 * corners.points_m[:, :2] / corners.size_m - 1.0).T
    heights = np.stack([1.0 - across**2, 1.0 - down**2])
    wide = np.exp(0.5 * deformation[0])
    x_m = wide * corners.points_m[:, 0]
    y_m = corners.points_m[:, 1] / wide
    points_m = np.column_stack([x_m, y_m, -deformation[1:] @ heights])
    by_print = np.zeros((len(points_m), 3, 3))
    by_print[:, :2, 0] = points_m[:, :2] * [0.5, -0.5]
    by_print[:, 2, 1:] = -heights.T
    return points_m, by_print


OUTLIER_SIGMAS = 5.0
SIGMA_FLOOR_PX = 0.02
MIN_SQUARES = 0
MAGSAC_PX = 1.0
MIN_GOOD_SHARE = 0.7
"""Inliers as a share of the detected corners; more outliers are no accident."""
MAX_RESIDUAL_PX = 0.6
"""RMS of a coordinate: the corners of one dim frame stay below half of that."""
MISFIT_CHI2 = 25.0
"""Largest advantage of a free homography over the pose, in variances."""
MAX_STRETCH = 0.015
MAX_BOW_M = 0.0015
"""Beyond the errors of a printer and of a sheet that was glued on."""
MAX_ANGLE_STD_DEG = 1.0
"""Exceeded by a board seen edge on, or a few corners close together."""
LINE_MESSAGE = (
    "the board's corners are in a line, as of a board seen edge on, or mirrored: turn the lidar"
    " towards the wall"
)


@dataclass(frozen=True)
class PrintErrors:
    """Standard uncertainties of a print on the wall."""

    scale_std: float = 0.0025
    """Relative: a ruler reads 100 mm to a quarter of a millimetre."""
    stretch_std: float = 0.0035
    """Width over height: two axes that are each that far off."""
    bow_std_m: float = 0.0003
    """Height of the middle of the sheet over the wall, along either axis."""


@dataclass(frozen=True)
class BoardFit:
    """Plane of a board in the lidar frame."""

    slopes: Float64
    """(3,); -normal / distance_m, the normal towards the lidar."""
    covariance: Float64
    """(3, 3) of the slopes."""
    corners: int
    """Number of corners used."""
    residual_px: float
    """RMS of a coordinate's residual."""
    stretch: float
    """Width over height of the print, less 1."""
    bow_m: float
    """Height of the middle of the sheet over the wall."""


def fit_board(
    corners: Corners,
    board: Board,
    intrinsics: Intrinsics,
    printed: PrintErrors | None = None,
) -> BoardFit:
    """Fit the plane of `board` to its corners in the lidar's infrared image.

    Raises BoardRefusedError where the corners are not those of a flat print of the right
    proportions, and where they do not determine the plane.
    """
    printed = printed or PrintErrors()
    # First with the noise that a free homography leaves, which no wrong assumption about print or
    # lens inflates, so that a misfit shows; then with the residuals' own, for the covariance.
    observed = _observations(corners, board, intrinsics, printed)
    pose = solve_pose(observed)
    _check_fit(pose)
    observed = replace(observed, variance_px2=_variance_px2(pose.errors_px, UNKNOWNS))
    pose = refine_pose(observed, pose.parameters)
    _check_print(pose)
    slopes, covariance = pose.slopes()
    _check_certain(slopes, covariance)
    _check_faced(slopes)
    return BoardFit(
        slopes=slopes,
        # A print larger by a share moves the plane away by that share: the slopes change along
        # themselves. No image shows the scale, so its variance is added, not fitted.
        covariance=covariance + printed.scale_std**2 * np.outer(slopes, slopes),
        corners=len(observed.pixels),
        residual_px=float(np.sqrt(np.mean(pose.errors_px**2))),
        stretch=float(np.expm1(pose.parameters[6])),
        bow_m=float(pose.parameters[7:].sum()),
    )


def _observations(
    corners: Corners, board: Board, intrinsics: Intrinsics, printed: PrintErrors
) -> CornerObservations:
    """Return the corners that lie on one plane."""
    points_m = board.corners_m[corners.ids]
    good = _inliers(points_m, corners.pixels)
    points_m = points_m[good]
    pixels = corners.pixels[good]
    return CornerObservations(
        points_m=points_m,
        pixels=pixels,
        camera=intrinsics.matrix,
        size_m=np.array(board.size_mm) * 1e-3,
        print_std=np.array([printed.stretch_std, printed.bow_std_m, printed.bow_std_m]),
        variance_px2=_plane_variance_px2(points_m, pixels),
    )


def _inliers(points_m: Float64, pixels: Float64) -> Mask:
    """Return the corners on one plane with most others: the detector now and then takes an edge for
    a corner.
    """
    # The length of a two-dimensional error has a median of 1.18 sigma (Rayleigh); dividing by
    # sqrt(2) x 0.674 = 0.95 takes it a quarter too large, on the wide side.
    errors_px = np.linalg.norm(_homography_errors_px(points_m, pixels, cv2.USAC_MAGSAC), axis=1)
    sigma_px = max(float(np.median(errors_px)) / sqrt(2.0) / MEDIAN_PER_SIGMA, SIGMA_FLOOR_PX)
    good = errors_px < OUTLIER_SIGMAS * sigma_px
    if good.sum() < max(MIN_CORNERS, MIN_GOOD_SHARE * len(good)):
        raise BoardRefusedError(
            f"only {good.sum()} of {len(good)} corners lie on one plane: make sure that the board"
            " is flat on the wall, and keep the lidar still"
        )
    return good


def _homography_errors_px(points_m: Float64, pixels: Float64, method: int) -> Float64:
    """Return residuals (n, 2) of the best homography: of any plane seen by any pinhole."""
    found: tuple[Any, ...] = cv2.findHomography(points_m[:, :2], pixels, method, MAGSAC_PX)
    if found[0] is None:  # OpenCV's types do not say so
        raise BoardRefusedError(LINE_MESSAGE)
    return pixels - np.asarray(
        cv2.perspectiveTransform(points_m[np.newaxis, :, :2], found[0])[0], np.float64
    )


def _plane_variance_px2(points_m: Float64, pixels: Float64) -> float:
    """Return the variance of the homography's residuals. Raises BoardRefusedError where it exceeds
    noise.
    """
    variance_px2 = _variance_px2(_homography_errors_px(points_m, pixels, MIN_SQUARES), spent=8)
    if variance_px2 > MAX_RESIDUAL_PX**2:
        raise BoardRefusedError(
            f"the board is not flat: its corners are {sqrt(variance_px2):.2f} pixels RMS off a"
            f" plane, {MAX_RESIDUAL_PX:g} allowed; glue it to the wall or to a stiff plate, and"
            " keep lidar and board still"
        )
    return variance_px2


def _variance_px2(errors_px: Float64, spent: int) -> float:
    """Return the variance of a coordinate from the residuals of a model with `spent` parameters."""
    # Student's t with k degrees of freedom has the variance k / (k - 2): dividing the sum of
    # squares by k - 2 instead of k makes normal intervals as wide as they must be where few corners
    # estimate the noise
    return max(float((errors_px**2).sum()) / (errors_px.size - spent - 2), SIGMA_FLOOR_PX**2)


def _check_fit(pose: BoardPose) -> None:
    """Raise BoardRefusedError if a homography explains the corners much better than any pose."""
    # A homography has 8 free parameters, a pose 6 and three that priors hold: what it explains
    # beyond them is intrinsics or squares that are not those assumed.
    free = pose.errors_px.size - 8
    if pose.chi2 > free + MISFIT_CHI2:
        raise BoardRefusedError(
            f"the squares do not fit: the residuals of a pose are {sqrt(pose.chi2 / free):.1f}"
            " times those of a free plane; make sure that the print is neither stretched nor"
            " skewed, and that the intrinsics are this camera's"
        )


def _check_print(pose: BoardPose) -> None:
    """Raise BoardRefusedError for a stretch or bow beyond the errors of a print."""
    stretch = float(pose.parameters[6])
    bows_m = pose.parameters[7:]
    if abs(stretch) > MAX_STRETCH:
        raise BoardRefusedError(
            f"the squares do not fit: they are {100.0 * stretch:+.1f} % wider than high; print"
            " without stretching, and use this camera's intrinsics"
        )
    if float(np.abs(bows_m).max()) > MAX_BOW_M:
        raise BoardRefusedError(
            f"the board is not flat: its middle stands {1e3 * float(bows_m.sum()):+.1f} mm off the"
            " wall; glue it to the wall or to a stiff plate"
        )


def _check_certain(slopes: Float64, covariance: Float64) -> None:
    """Raise BoardRefusedError if the corners leave the normal uncertain."""
    # the normal turns by at most distance x (change of the slopes), in the direction of the largest
    # eigenvalue
    distance_m = 1.0 / float(np.linalg.norm(slopes))
    angle_std_deg = degrees(distance_m * sqrt(float(np.linalg.eigvalsh(covariance)[-1])))
    if angle_std_deg > MAX_ANGLE_STD_DEG:
        raise BoardRefusedError(
            f"the board determines the wall's angle only to {angle_std_deg:.1f} degrees,"
            f" {MAX_ANGLE_STD_DEG:g} needed: it is too far away, edge on, or mostly out of view;"
            " move it to the near side of the view"
        )


def _check_faced(slopes: Float64) -> None:
    """Raise BoardRefusedError for a plane that the optical axis never meets."""
    # along the axis 1 / z = slopes[2]; at the side of the view such a plane is visible all the same
    if slopes[2] <= 0.0:
        raise BoardRefusedError(
            "the optical axis never meets the board's plane: turn the lidar towards the wall"
        )
