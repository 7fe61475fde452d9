"""The pose of a print by least squares over its corners, together with what the printer and the glue did to it.

A print is not what was drawn: one that is 0.2 % too wide for its height turns the plane by 0.2 degrees, one that stands
off the wall by 0.5 mm in its middle shifts it by 1 mm. So stretch and bows are unknowns too, each held by what is to be
expected of it.
"""

from dataclasses import dataclass
from math import degrees, sqrt

import cv2
import numpy as np

from nlos_calibration.arrays import Float64
from nlos_calibration.errors import BoardRefusedError

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
