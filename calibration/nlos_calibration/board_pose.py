"""The pose of a print by least squares over its corners, together with what the printer and the glue did to it.

A print is not what was drawn: one that is 0.2 % too wide for its height turns the plane by 0.2 degrees, one that stands
off the wall by 0.5 mm in its middle shifts it by 1 mm. So stretch and bows are unknowns too, each held by what is to be
expected of it.

The wall's plane from a board's corners, and how surely; or a refusal that says why.

The plane normal . p + distance_m = 0 is told as slopes = -normal / distance_m, like the depth's. Its covariance is that
of the corners, by their own residuals, through pose, stretch and bows (`board_pose`); and that of the print's scale,
which no image shows.
"""

from dataclasses import dataclass, replace
from math import degrees, sqrt
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nlos_calibration.arrays import Float64
from nlos_calibration.board import MIN_CORNERS, Board, Corners
from nlos_calibration.errors import BoardRefusedError
from nlos_calibration.geometry import Intrinsics

UNKNOWNS = 9
AMBIGUOUS_CHI2 = 25.0
"""A second pose is out only if it is worse by five standard deviations."""
SAME_NORMAL_DEG = 0.5
MAX_STEPS, SETTLED = 50, 1e-10


@dataclass(frozen=True)
class SeenCorners:
    """Corners on the drawing, where they are seen, and how well."""

    points_m: Float64
    """(n, 3)."""
    pixels: Float64
    """(n, 2)."""
    camera: Float64
    """(3, 3)."""
    size_m: Float64
    """(2,); the drawing's width and height."""
    print_std: Float64
    """(3,); what to expect of the print's stretch (width over height) and of its bows along x and y (m)."""
    variance_px2: float
    """Of a coordinate."""


@dataclass(frozen=True)
class BoardPose:
    """lidar_from_board, and what the print is like."""

    parameters: Float64
    """(9,): rotation vector, translation, logarithm of the stretch, bows along x and y."""
    errors_px: Float64
    """(n, 2)."""
    chi2: float
    """Of the corners and of what is expected of the print."""
    covariance: Float64
    """(9, 9)."""

    @property
    def normal(self) -> Float64:
        """(3,), away from the lidar."""
        return cv2.Rodrigues(self.parameters[:3])[0][:, 2].astype(np.float64)

    def slopes(self) -> tuple[Float64, Float64]:
        """The slopes n / (n . t) of the plane with normal n through t, and their covariance."""
        by_turn = cv2.Rodrigues(self.parameters[:3])[1]
        normal, shift = self.normal, self.parameters[3:6]
        normal_by_turn = by_turn.reshape(3, 3, 3)[:, :, 2].T  # OpenCV: d matrix[i, j] / d turn[k] at [k, 3 i + j]
        height = float(normal @ shift)
        by_normal = (np.eye(3) - np.outer(normal, shift) / height) / height
        by_pose = np.hstack([by_normal @ normal_by_turn, -np.outer(normal, normal) / height**2])
        return normal / height, by_pose @ self.covariance[:6, :6] @ by_pose.T


def solve_pose(seen: SeenCorners) -> BoardPose:
    """The better of the two poses that a plane seen from afar allows. Raises BoardRefusedError where neither is."""
    _, turns, shifts, _ = cv2.solvePnPGeneric(seen.points_m, seen.pixels, seen.camera, None, flags=cv2.SOLVEPNP_IPPE)
    starts = [np.append(np.concatenate([turn, shift]), np.zeros(3)) for turn, shift in zip(turns, shifts, strict=True)]
    best, *others = sorted(
        (refine_pose(seen, start.astype(np.float64)) for start in starts), key=lambda pose: pose.chi2
    )
    for other in others:
        apart_deg = degrees(np.arccos(np.clip(float(best.normal @ other.normal), -1.0, 1.0)))
        if apart_deg > SAME_NORMAL_DEG and other.chi2 - best.chi2 < AMBIGUOUS_CHI2:
            raise BoardRefusedError(
                f"two poses, {apart_deg:.0f} degrees apart, explain the board equally well: bring it closer, or take a "
                "larger one",
            )
    return best


def refine_pose(seen: SeenCorners, parameters: Float64) -> BoardPose:
    """Least squares by Gauss and Newton's steps from `parameters` (9,), damped where they would not improve."""
    rows, errors = _linear(seen, parameters)
    damping = 0.0
    for _ in range(MAX_STEPS):
        squares = rows.T @ rows
        step = np.linalg.solve(squares + damping * np.diag(np.diag(squares)), rows.T @ errors)
        new_rows, new_errors = _linear(seen, parameters + step)
        gain = float(errors @ errors - new_errors @ new_errors)
        if gain < 0.0:
            damping = max(10.0 * damping, 1e-3)
            continue
        parameters, rows, errors, damping = parameters + step, new_rows, new_errors, 0.1 * damping
        if gain <= SETTLED * float(errors @ errors):
            break
    errors_px = errors[:-3].reshape(-1, 2) * sqrt(seen.variance_px2)
    return BoardPose(parameters, errors_px, float(errors @ errors), np.linalg.inv(rows.T @ rows).astype(np.float64))


def _linear(seen: SeenCorners, parameters: Float64) -> tuple[Float64, Float64]:
    """What is seen, by the parameters (2 n + 3, 9), and what they leave of it, in standard deviations."""
    points_m, by_print = _printed(seen, parameters[6:])
    pixels, by_pose = cv2.projectPoints(points_m, parameters[:3], parameters[3:6], seen.camera, None)[:2]
    moved_m = cv2.Rodrigues(parameters[:3])[0] @ by_print
    by_print_px = (by_pose[:, 3:6].reshape(-1, 2, 3) @ moved_m).reshape(-1, 3)
    sigma_px = sqrt(seen.variance_px2)
    expected = np.hstack([np.zeros((3, 6)), np.diag(1.0 / seen.print_std)])
    rows = np.vstack([np.hstack([by_pose[:, :6], by_print_px]) / sigma_px, expected])
    errors = np.append((seen.pixels - pixels.reshape(-1, 2)).ravel() / sigma_px, -parameters[6:] / seen.print_std)
    return rows.astype(np.float64), errors


def _printed(seen: SeenCorners, how: Float64) -> tuple[Float64, Float64]:
    """Where the corners (n, 3) of a stretched and bowed print are, and that by stretch and bows (n, 3, 3)."""
    across, down = (2.0 * seen.points_m[:, :2] / seen.size_m - 1.0).T
    heights = np.stack([1.0 - across**2, 1.0 - down**2])
    wide = np.exp(0.5 * how[0])
    points_m = np.column_stack([wide * seen.points_m[:, 0], seen.points_m[:, 1] / wide, -how[1:] @ heights])
    by_print = np.zeros((len(points_m), 3, 3))
    by_print[:, :2, 0] = points_m[:, :2] * [0.5, -0.5]
    by_print[:, 2, 1:] = -heights.T
    return points_m, by_print


OUTLIER_SIGMAS, SIGMA_FLOOR_PX = 5.0, 0.02
MIN_SQUARES, MAGSAC_PX = 0, 1.0
MEDIAN_PER_SIGMA = 0.67449
"""The median of |x| of a normal distribution."""
MIN_GOOD_SHARE = 0.7
"""Of the corners that were found; more strays are no accident."""
MAX_RESIDUAL_PX = 0.6
"""RMS of a coordinate: the corners of one dim frame stay below a half of that."""
MISFIT_CHI2 = 25.0
"""How much better any homography may be than the pose, in variances."""
MAX_STRETCH, MAX_BOW_M = 0.015, 0.0015
"""More is no printer's error, and no sheet that was glued on."""
MAX_ANGLE_STD_DEG = 1.0
"""A board seen edge on, or a few corners close together, say less."""
IN_A_LINE = (
    "the board's corners are seen in a line, as of a board seen edge on, or mirrored: turn the lidar to the wall"
)


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
    """The plane of a board in the frame of what saw it: the lidar's, or a camera's until it is moved there."""

    slopes: Float64
    """(3,); -normal / distance_m, the normal towards it."""
    covariance: Float64
    """(3, 3) of the slopes."""
    corners: int
    """How many the plane rests on."""
    residual_px: float
    """RMS of a coordinate's residual."""
    stretch: float
    """Width over height as seen, less 1."""
    bow_m: float
    """How far the middle of the sheet stands off the wall."""


def fit_board(
    corners: Corners,
    board: Board,
    intrinsics: Intrinsics,
    printed: PrintErrors | None = None,
    focal_std: float = 0.0,
) -> BoardFit:
    """The plane of `board` from its corners in the image of a pinhole, in the frame of that camera.

    `focal_std` is the relative uncertainty of its focal length. Raises BoardRefusedError where the corners do not lie
    as on a flat print of the right proportions, and where they leave the plane open.
    """
    printed = printed or PrintErrors()
    seen = _seen(corners, board, intrinsics, printed)
    pose = solve_pose(seen)
    _check_fit(pose)
    seen = replace(seen, variance_px2=_variance_px2(pose.errors_px, UNKNOWNS))
    pose = refine_pose(seen, pose.parameters)
    _check_print(pose)
    slopes, covariance = pose.slopes()
    by_focal = _by_focal(seen, pose, focal_std)
    _check_certain(slopes, covariance)
    return BoardFit(
        slopes=slopes,
        covariance=covariance + printed.scale_std**2 * np.outer(slopes, slopes) + np.outer(by_focal, by_focal),
        corners=len(seen.pixels),
        residual_px=float(np.sqrt(np.mean(pose.errors_px**2))),
        stretch=float(np.expm1(pose.parameters[6])),
        bow_m=float(pose.parameters[7:].sum()),
    )


def _seen(corners: Corners, board: Board, intrinsics: Intrinsics, printed: PrintErrors) -> SeenCorners:
    """The corners that lie on one plane."""
    points_m = board.corners_m[corners.ids]
    good = _good(points_m, corners.pixels)
    points_m, pixels = points_m[good], corners.pixels[good]
    return SeenCorners(
        points_m=points_m,
        pixels=pixels,
        camera=intrinsics.matrix,
        size_m=np.array(board.size_mm) * 1e-3,
        print_std=np.array([printed.stretch_std, printed.bow_std_m, printed.bow_std_m]),
        variance_px2=_plane_variance_px2(points_m, pixels),
    )


def _good(points_m: Float64, pixels: Float64) -> NDArray[np.bool_]:
    """Which corners lie as on a plane with most others: the detector now and then takes an edge for a corner."""
    errors_px = np.linalg.norm(_off_a_plane_px(points_m, pixels, cv2.USAC_MAGSAC), axis=1)
    sigma_px = max(float(np.median(errors_px)) / sqrt(2.0) / MEDIAN_PER_SIGMA, SIGMA_FLOOR_PX)
    good = errors_px < OUTLIER_SIGMAS * sigma_px
    if good.sum() < max(MIN_CORNERS, MIN_GOOD_SHARE * len(good)):
        raise BoardRefusedError(
            f"only {good.sum()} of {len(good)} corners lie on one plane: is the board flat on the wall, and the lidar "
            "still?",
        )
    return good


def _off_a_plane_px(points_m: Float64, pixels: Float64, method: int) -> Float64:
    """Residuals (n, 2) of any plane seen by any pinhole."""
    found: tuple[Any, ...] = cv2.findHomography(points_m[:, :2], pixels, method, MAGSAC_PX)
    if found[0] is None:  # OpenCV's types do not say so
        raise BoardRefusedError(IN_A_LINE)
    return pixels - np.asarray(cv2.perspectiveTransform(points_m[np.newaxis, :, :2], found[0])[0], np.float64)


def _plane_variance_px2(points_m: Float64, pixels: Float64) -> float:
    """Of the residuals of any plane seen by any pinhole. Raises BoardRefusedError where it is no noise."""
    variance_px2 = _variance_px2(_off_a_plane_px(points_m, pixels, MIN_SQUARES), spent=8)
    if variance_px2 > MAX_RESIDUAL_PX**2:
        raise BoardRefusedError(
            f"the board is not flat: its corners are {sqrt(variance_px2):.2f} pixels RMS off a plane, "
            f"{MAX_RESIDUAL_PX:g} allowed; glue it to the wall or to a stiff plate, and keep lidar and board still",
        )
    return variance_px2


def _variance_px2(errors_px: Float64, spent: int) -> float:
    """Of a coordinate, from what a model with `spent` parameters leaves.

    Divided by two less than that leaves: normal intervals are then as wide as Student's, which they should be where
    noise is estimated from few corners.
    """
    return max(float((errors_px**2).sum()) / (errors_px.size - spent - 2), SIGMA_FLOOR_PX**2)


def _by_focal(seen: SeenCorners, pose: BoardPose, focal_std: float) -> Float64:
    """How the slopes (3,) change where the focal length is longer by its uncertainty."""
    if focal_std == 0.0:
        return np.zeros(3)
    longer = seen.camera + np.diag(np.diag(seen.camera)) * focal_std * np.array([1.0, 1.0, 0.0])
    return refine_pose(replace(seen, camera=longer), pose.parameters).slopes()[0] - pose.slopes()[0]


def _check_fit(pose: BoardPose) -> None:
    free = pose.errors_px.size - 8
    if pose.chi2 > free + MISFIT_CHI2:
        raise BoardRefusedError(
            f"the squares do not fit: {sqrt(pose.chi2 / free):.1f} times as far off any pose as off a plane; is the "
            "print stretched or skewed, or are these another camera's intrinsics?",
        )


def _check_print(pose: BoardPose) -> None:
    stretch, bows_m = float(pose.parameters[6]), pose.parameters[7:]
    if abs(stretch) > MAX_STRETCH:
        raise BoardRefusedError(
            f"the squares do not fit: they are seen {100.0 * stretch:+.1f} % wider than high; print without "
            "stretching, and use the intrinsics of what saw it",
        )
    if float(np.abs(bows_m).max()) > MAX_BOW_M:
        raise BoardRefusedError(
            f"the board is not flat: its middle stands {1e3 * float(bows_m.sum()):+.1f} mm off the wall; glue it to "
            "the wall or to a stiff plate",
        )


def _check_certain(slopes: Float64, covariance: Float64) -> None:
    distance_m = 1.0 / float(np.linalg.norm(slopes))
    angle_std_deg = degrees(distance_m * sqrt(float(np.linalg.eigvalsh(covariance)[-1])))
    if angle_std_deg > MAX_ANGLE_STD_DEG:
        raise BoardRefusedError(
            f"the board fixes the wall's angle to {angle_std_deg:.1f} degrees only, {MAX_ANGLE_STD_DEG:g} needed: it "
            "is seen too far off, edge on, or too little of it; move it to the near side of the view",
        )
