"""Wall from depth and a printed board together: one pose, one verdict, and the board's part of the
record.

Infrared shares the lidar's pinhole. Another camera has a distorting lens and a pose of its own: its
plane is fitted in its own frame, and moved to the lidar's together with its covariance.

Depth and board each give slopes = -normal / distance_m (3,) with a covariance. Where they agree,
they are averaged by weight. Where they do not, an average would be neither: one is used, and the
likely causes are listed with amounts.
"""

from dataclasses import dataclass, field, replace
from math import degrees, radians, sqrt
from typing import Annotated, Literal

import cv2
import numpy as np
from pydantic import Field

from nlos_calibration.arrays import Float64
from nlos_calibration.board import Board, Corners, Light, find_corners
from nlos_calibration.board_pose import BoardFit, PrintErrors, fit_board
from nlos_calibration.errors import BoardRefusedError, WallRefusedError
from nlos_calibration.geometry import Intrinsics, plane_from_slopes, wall_from_plane
from nlos_calibration.rig import Finite, NotNegative, Positive, Record
from nlos_calibration.wall import Verdict, WallFit, WallMeasures, measures_of, out_of_range

UNDISTORTED = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9)


@dataclass(frozen=True)
class CameraErrors:
    """Standard uncertainties of a color camera's calibration: assumed, since its maker publishes
    none.

    Owners of the L515 saw color and depth 4 to 5 pixels apart at 4 m, which is a turn of 0.3
    degrees.
    """

    turn_std_deg: float = 0.2
    """Rotation against the lidar about each axis, errors of the principal point included."""
    shift_std_m: float = 0.0005
    """Position along each axis."""
    focal_std: float = 0.001
    """Relative; librealsense itself corrects it for the camera's temperature."""


EXACT = CameraErrors(0.0, 0.0, 0.0)
"""Errors of the lidar's infrared: it shares the pinhole with the depth, so that both have the same
errors.
"""


@dataclass(frozen=True)
class BoardView:
    """Image of a board and the camera that took it, by default the lidar in infrared."""

    image: Float64
    """(height, width), the mean over frames; of any gain."""
    intrinsics: Intrinsics
    distortion: Float64 = field(default_factory=lambda: np.zeros(5))
    """(5,): k1, k2, p1, p2, k3 of Brown and Conrady, in the order of OpenCV and librealsense."""
    lidar_from_camera: Float64 = field(default_factory=lambda: np.eye(4))
    """(4, 4)."""
    light: Light = "infrared"
    errors: CameraErrors = EXACT


def fit_in_lidar(
    corners: Corners, board: Board, view: BoardView, printed: PrintErrors | None = None
) -> BoardFit:
    """Fit the plane of `board` in the lidar frame to corners detected in the image of a view.

    Raises BoardRefusedError as `fit_board` does, and where the lidar would be behind the plane.
    """
    fit = fit_board(
        undistorted(corners, view), board, view.intrinsics, printed, focal_std=view.errors.focal_std
    )
    slopes, covariance = plane_in_lidar(
        fit.slopes, fit.covariance, view.lidar_from_camera, view.errors
    )
    return replace(fit, slopes=slopes, covariance=covariance)


def undistorted(corners: Corners, view: BoardView) -> Corners:
    """Return the corners as a pinhole of the same intrinsics would see them."""
    if not view.distortion.any():
        return corners
    points = corners.pixels.reshape(-1, 1, 2)
    straight = cv2.undistortImagePoints(
        points, view.intrinsics.matrix, view.distortion, None, UNDISTORTED
    )
    return replace(corners, pixels=np.asarray(straight, np.float64).reshape(-1, 2))


def plane_in_lidar(
    slopes: Float64, covariance: Float64, lidar_from_camera: Float64, errors: CameraErrors
) -> tuple[Float64, Float64]:
    """Move a plane slopes . p = 1 from the camera's to the lidar's frame: slopes (3,) and
    covariance (3, 3).

    Raises BoardRefusedError where the plane runs between camera and lidar.
    """
    # With u = R slopes and t the camera's position, p_camera = R' (p - t) gives u . (p - t) = 1, so
    # the lidar's slopes are v = u / h with h = 1 + u . t. Derivatives: dv/du = (I - v t') / h,
    # dv/dt = -u u' / h^2 = -v v', and a small turn w changes u by w x u. Errors of turn and
    # position have equal, independent axes.
    turn = lidar_from_camera[:3, :3]
    place_m = lidar_from_camera[:3, 3]
    turned = turn @ slopes
    height = 1.0 + float(turned @ place_m)
    if height <= 0.0:
        raise BoardRefusedError(
            "the board's wall runs between color camera and lidar: check the pose of one to the"
            " other"
        )
    moved = turned / height
    by_turned = (np.eye(3) - np.outer(moved, place_m)) / height
    x, y, z = turned
    cross = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])  # d (w x u) / d w
    by_slopes = by_turned @ turn
    by_angle = by_turned @ cross
    by_place = -np.outer(moved, moved)
    angle_std = radians(errors.turn_std_deg)
    return moved, (
        by_slopes @ covariance @ by_slopes.T
        + angle_std**2 * by_angle @ by_angle.T
        + errors.shift_std_m**2 * by_place @ by_place.T
    )


Used = Literal["both", "depth", "board"]

AGREE_SIGMAS = 4.0
"""Chance alone puts two planes farther apart once in 900 times (chi-square of three unknowns)."""
MAX_OFFSET_M = 0.03
MAX_SCALE = 0.2
"""Largest plausible range offset of a lidar, and scale error of a printer."""


@dataclass(frozen=True)
class UncertainPlane:
    """A plane in the lidar frame with its uncertainty."""

    slopes: Float64
    """(3,); -normal / distance_m, the normal towards the lidar."""
    covariance: Float64
    """(3, 3) of the slopes."""

    @property
    def distance_m(self) -> float:
        """Distance from the lidar along the normal."""
        return plane_from_slopes(self.slopes)[1]

    @property
    def normal(self) -> Float64:
        """Unit normal (3,), towards the lidar."""
        return plane_from_slopes(self.slopes)[0]


@dataclass(frozen=True)
class Disagreement:
    """Difference of the board's plane from the depth's, with its size in joint standard
    uncertainties.
    """

    distance_m: float
    """The board's less the depth's."""
    angle_deg: float
    """Between the normals."""
    sigmas: float
    """Of distance and angle together."""
    distance_sigmas: float
    angle_sigmas: float


@dataclass(frozen=True)
class Combined:
    """The plane to use, its origin, and the comparison behind it."""

    plane: UncertainPlane
    used: Used
    disagreement: Disagreement
    causes: tuple[str, ...]
    """Likely causes of a disagreement, each with its amount; empty where they agree."""


def combine(depth: UncertainPlane, board: UncertainPlane, *, measured: bool) -> Combined:
    """Average both planes where they agree; else use the board's if its squares were `measured`, or
    the depth's.
    """
    apart = disagreement(depth, board)
    if apart.sigmas <= AGREE_SIGMAS:
        # Weighting by inverse covariances, written in Kalman's form: it needs no inverse of the
        # depth's covariance, which may be zero.
        gain = depth.covariance @ np.linalg.inv(depth.covariance + board.covariance)
        slopes = depth.slopes + gain @ (board.slopes - depth.slopes)
        average = UncertainPlane(slopes, depth.covariance - gain @ depth.covariance)
        return Combined(average, "both", apart, ())
    used: Used = "board" if measured else "depth"
    return Combined(
        board if measured else depth, used, apart, _causes(depth, board, apart, measured=measured)
    )


def disagreement(depth: UncertainPlane, board: UncertainPlane) -> Disagreement:
    """Compare two planes, also in units of their joint uncertainty."""
    # 1 / |slopes| is the distance and their direction the normal, so the part of the difference
    # along the slopes is a change of distance, and the two parts across them are a change of angle.
    # The null space of a row is the last right singular vectors of its decomposition.
    difference = board.slopes - depth.slopes
    covariance = board.covariance + depth.covariance
    along = depth.distance_m * depth.slopes
    across = np.linalg.svd(along[np.newaxis])[2][1:]
    angle_rad = np.arctan2(
        np.linalg.norm(np.cross(depth.normal, board.normal)), depth.normal @ board.normal
    )
    return Disagreement(
        distance_m=board.distance_m - depth.distance_m,
        angle_deg=degrees(angle_rad),
        sigmas=_sigmas(np.eye(3), difference, covariance),
        distance_sigmas=_sigmas(along[np.newaxis], difference, covariance),
        angle_sigmas=_sigmas(across, difference, covariance),
    )


def _sigmas(axes: Float64, difference: Float64, covariance: Float64) -> float:
    """Return the Mahalanobis length sqrt(d' C^-1 d) of the difference along `axes` (k, 3)."""
    off = axes @ difference
    return sqrt(max(float(off @ np.linalg.solve(axes @ covariance @ axes.T, off)), 0.0))


def _causes(
    depth: UncertainPlane, board: UncertainPlane, apart: Disagreement, *, measured: bool
) -> tuple[str, ...]:
    """Return the usual causes of a disagreement that could explain this one, each with its
    amount.
    """
    causes: list[str] = []
    scale = (
        depth.distance_m / board.distance_m
    )  # a board's distance is proportional to the assumed size of its squares
    offset_m = apart.distance_m / max(
        -float(depth.normal[2]), 1e-3
    )  # along the axis, longer than along the normal
    if apart.distance_sigmas > AGREE_SIGMAS:
        if abs(scale - 1.0) <= MAX_SCALE and not measured:
            causes.append(
                f"the print's scale: squares of {100.0 * scale:.1f} % of their size would explain"
                " the distance; measure the printed bar and give --square-mm"
            )
        if abs(offset_m) <= MAX_OFFSET_M:
            causes.append(
                f"the lidar's range offset: {1e3 * offset_m:+.1f} mm along its axis would explain"
                " the distance; measure with a tape and give --tape-m"
            )
    if apart.angle_sigmas > AGREE_SIGMAS:
        causes.append(
            f"the angle: the normals are {apart.angle_deg:.2f} degrees apart; glue the board flat"
            " on the same wall, and let the lidar warm up (ripples turn the depth's plane)"
        )
    return tuple(causes) or (
        "distance and angle together: none of the usual causes fits; measure again",
    )


COLOR_POSE_CAUSE = (
    "the color camera's factory pose against the lidar, which may have shifted: measure in infrared"
    " to compare"
)
"""A further cause of a disagreement, where the board was seen in color."""


@dataclass(frozen=True)
class WallByBoard(WallMeasures):
    """Wall measured by a board alone, since its depth was refused."""

    wall_from_lidar: Float64
    """(4, 4)."""
    verdict: Verdict
    advice: str
    warnings: tuple[str, ...] = ()


class BoardRecord(Record):
    """Measurement of the wall by a board, and its use."""

    printed: Board
    measured: bool
    """True if the squares' size was measured on the print; else it is that of the drawing."""
    seen_in: Light = "infrared"
    corners: Annotated[int, Field(gt=0)]
    residual_px: NotNegative
    stretch: Finite
    """Width over height, less 1."""
    bow_m: Finite
    distance_m: Positive
    distance_std_m: NotNegative
    yaw_deg: Finite
    yaw_std_deg: NotNegative
    pitch_deg: Finite
    pitch_std_deg: NotNegative
    facing_deg: Annotated[float, Field(ge=0, lt=90)]
    facing_std_deg: NotNegative
    used: Used
    """Source of the record's pose."""
    disagreement_m: Finite | None = None
    """The board's distance less the depth's; None, like all of the disagreement, where the depth
    was refused.
    """
    disagreement_deg: NotNegative | None = None
    disagreement_sigmas: NotNegative | None = None
    causes: tuple[str, ...] = ()
    """Likely causes of a disagreement that chance does not explain."""
    depth_refused: str = ""
    """Reason why the depth was refused; empty where it was not."""


def wall_with_board(
    depth: WallFit | WallRefusedError, view: BoardView, board: Board, *, measured: bool
) -> tuple[WallFit | WallByBoard, BoardRecord]:
    """Measure the wall from its depth (or the reason why that was refused) and a view of a board.

    `measured` states that the board's squares were measured by hand. Raises BoardRefusedError for
    an unusable view.
    """
    fit = fit_in_lidar(find_corners(view.image, board, view.light), board, view)
    plane = UncertainPlane(fit.slopes, fit.covariance)
    record = BoardRecord(
        **vars(measures_of(fit.slopes, fit.covariance)),
        **{name: getattr(fit, name) for name in ("corners", "residual_px", "stretch", "bow_m")},
        printed=board,
        measured=measured,
        seen_in=view.light,
        used="board",
    )
    if isinstance(depth, WallRefusedError):
        return _by_board(plane, depth), record.model_copy(update={"depth_refused": str(depth)})
    by_depth = UncertainPlane(-depth.wall_from_lidar[2, :3] / depth.distance_m, depth.covariance)
    both = combine(by_depth, plane, measured=measured)
    if both.causes and view.light == "colour":
        both = replace(both, causes=(*both.causes, COLOR_POSE_CAUSE))
    apart = both.disagreement
    comparison = {
        "used": both.used,
        "disagreement_m": apart.distance_m,
        "disagreement_deg": apart.angle_deg,
        "disagreement_sigmas": apart.sigmas,
        "causes": both.causes,
    }
    return _by_both(depth, both), record.model_copy(update=comparison)


def _by_board(plane: UncertainPlane, refusal: WallRefusedError) -> WallByBoard:
    """Return the board's wall, doubtful for want of a depth to compare it with."""
    measures = measures_of(plane.slopes, plane.covariance)
    doubt = f"the plane is the board's alone, since the depth was refused: {refusal}"
    problems = out_of_range(measures.distance_m, measures.facing_deg)
    pose = wall_from_plane(plane.normal, plane.distance_m)
    return WallByBoard(
        **vars(measures),
        wall_from_lidar=pose,
        verdict="doubtful",
        advice="; ".join([doubt, *problems]),
    )


def _by_both(depth: WallFit, both: Combined) -> WallFit:
    """Return the depth's wall with the combined plane, and the verdict on both."""
    measures = measures_of(both.plane.slopes, both.plane.covariance)
    problems = out_of_range(measures.distance_m, measures.facing_deg)
    verdict = depth.verdict
    advice = depth.advice
    if both.causes:
        apart = both.disagreement
        conflict = (
            f"depth and board disagree by {1e3 * apart.distance_m:+.1f} mm and"
            f" {apart.angle_deg:.2f} degrees ({apart.sigmas:.0f} standard deviations), the"
            f" {both.used}'s plane is used; likely causes: " + " | ".join(both.causes)
        )
        verdict = "doubtful"
        advice = "; ".join([conflict, *problems])
    elif verdict != "doubtful":
        verdict = "out of range" if problems else "good"
        advice = "; ".join(problems) or f"{depth.advice}; depth and board agree"
    pose = wall_from_plane(both.plane.normal, both.plane.distance_m)
    fitted = replace(
        depth, **vars(measures), wall_from_lidar=pose, covariance=both.plane.covariance
    )
    return replace(fitted, verdict=verdict, advice=advice)
