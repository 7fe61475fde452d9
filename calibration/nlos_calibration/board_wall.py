"""The wall from depth and board together: one pose, one verdict, and what the record keeps of the board.

A camera's view of a board, and the wall's plane in the lidar frame from it, whichever camera that is.

Infrared is seen by the lidar itself. Another camera has a lens that distorts and a place of its own: its plane is
fitted in its own frame, and moved to the lidar's together with its covariance.

Two measurements of one plane, by the lidar's depth and by a board: how far apart they are, and what to make of both.

Both are slopes = -normal / distance_m (3,) with a covariance. Where they agree, each counts by its weight. Where they
do not, an average of the two would be neither: one is taken, and the likely causes are told with their amounts.
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
from nlos_calibration.geometry import Intrinsics, wall_from_plane
from nlos_calibration.rig import Finite, NotNegative, Positive, Record
from nlos_calibration.wall import Verdict, WallFit, WallMeasures, measures_of, out_of_range

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


Used = Literal["both", "depth", "board"]

AGREE_SIGMAS = 4.0
"""Chance alone puts two planes farther apart once in 900 times (chi-square of three unknowns)."""
MAX_OFFSET_M, MAX_SCALE = 0.03, 0.2
"""No lidar is farther off, and no printer."""


@dataclass(frozen=True)
class Plane:
    """A plane in the lidar frame with its uncertainty."""

    slopes: Float64
    """(3,); -normal / distance_m, the normal towards the lidar."""
    covariance: Float64
    """(3, 3) of the slopes."""

    @property
    def distance_m(self) -> float:
        """From the lidar along the normal."""
        return 1.0 / float(np.linalg.norm(self.slopes))

    @property
    def normal(self) -> Float64:
        """(3,), unit, towards the lidar."""
        return -self.slopes * self.distance_m


@dataclass(frozen=True)
class Disagreement:
    """How far the board's plane is from the depth's."""

    distance_m: float
    """The board's less the depth's."""
    angle_deg: float
    """Between the normals."""
    sigmas: float
    """Of both together, by the uncertainties of both."""
    distance_sigmas: float
    angle_sigmas: float


@dataclass(frozen=True)
class Combined:
    """The plane to use, and why."""

    plane: Plane
    used: Used
    disagreement: Disagreement
    causes: tuple[str, ...]
    """What may lie behind a disagreement, each with its amount; empty where they agree."""


def combine(depth: Plane, board: Plane, *, measured: bool) -> Combined:
    """Both planes as one where they agree; else the board's if its squares were `measured` by hand, or the depth's."""
    apart = disagreement(depth, board)
    if apart.sigmas <= AGREE_SIGMAS:
        return Combined(_weighted(depth, board), "both", apart, ())
    used: Used = "board" if measured else "depth"
    return Combined(board if measured else depth, used, apart, _causes(depth, board, apart, measured=measured))


def disagreement(depth: Plane, board: Plane) -> Disagreement:
    """How far apart two planes are, and how far that is by their uncertainties."""
    difference, covariance = board.slopes - depth.slopes, board.covariance + depth.covariance
    along = depth.distance_m * depth.slopes  # a change of the slopes along them is one of the distance
    across = np.linalg.svd(along[np.newaxis])[2][1:]  # and across them one of the angle
    angle_rad = np.arctan2(np.linalg.norm(np.cross(depth.normal, board.normal)), depth.normal @ board.normal)
    return Disagreement(
        distance_m=board.distance_m - depth.distance_m,
        angle_deg=degrees(angle_rad),
        sigmas=_sigmas(np.eye(3), difference, covariance),
        distance_sigmas=_sigmas(along[np.newaxis], difference, covariance),
        angle_sigmas=_sigmas(across, difference, covariance),
    )


def _sigmas(axes: Float64, difference: Float64, covariance: Float64) -> float:
    """The length of the difference along `axes` (k, 3), in standard deviations."""
    off = axes @ difference
    return sqrt(max(float(off @ np.linalg.solve(axes @ covariance @ axes.T, off)), 0.0))


def _weighted(depth: Plane, board: Plane) -> Plane:
    """By the inverse of the covariances, written so that a plane known exactly does no harm."""
    gain = depth.covariance @ np.linalg.inv(depth.covariance + board.covariance)
    slopes = depth.slopes + gain @ (board.slopes - depth.slopes)
    return Plane(slopes, depth.covariance - gain @ depth.covariance)


def _causes(depth: Plane, board: Plane, apart: Disagreement, *, measured: bool) -> tuple[str, ...]:
    causes: list[str] = []
    scale = depth.distance_m / board.distance_m
    offset_m = apart.distance_m / max(-float(depth.normal[2]), 1e-3)
    if apart.distance_sigmas > AGREE_SIGMAS:
        if abs(scale - 1.0) <= MAX_SCALE and not measured:
            causes.append(
                f"the print's scale: squares of {100.0 * scale:.1f} % of their size would explain the distance; "
                "measure the printed bar and give --square-mm",
            )
        if abs(offset_m) <= MAX_OFFSET_M:
            causes.append(
                f"the lidar's range offset: {1e3 * offset_m:+.1f} mm along its axis would explain the distance; "
                "measure with a tape and give --tape-m",
            )
    if apart.angle_sigmas > AGREE_SIGMAS:
        causes.append(
            f"the angle: the normals are {apart.angle_deg:.2f} degrees apart; glue the board flat on the same wall, "
            "and let the lidar warm up (ripples turn the depth's plane)",
        )
    return tuple(causes) or ("distance and angle together: none of the usual causes stands out; measure again",)


COLOUR_IS_OFF = (
    "the colour camera's pose against the lidar, which is the factory's and may have moved: look in infrared to see"
)
"""A further cause of a disagreement, where the board was seen in colour."""


@dataclass(frozen=True)
class WallByBoard(WallMeasures):
    """Where the wall is by a board alone, since its depth was refused."""

    wall_from_lidar: Float64
    """(4, 4)."""
    verdict: Verdict
    advice: str
    warnings: tuple[str, ...] = ()


class BoardRecord(Record):
    """What a board said of the wall, and what was made of it."""

    printed: Board
    measured: bool
    """Whether the squares' size was measured on the print, or is that of the drawing."""
    seen_in: Light = "infrared"
    corners: Annotated[int, Field(gt=0)]
    residual_px: NotNegative
    stretch: Finite
    """Of width over height, less 1."""
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
    """Whose plane the pose of the record is."""
    disagreement_m: Finite | None = None
    """The board's distance less the depth's; None, as all of the disagreement, where the depth was refused."""
    disagreement_deg: NotNegative | None = None
    disagreement_sigmas: NotNegative | None = None
    causes: tuple[str, ...] = ()
    """What may lie behind a disagreement that chance does not explain."""
    depth_refused: str = ""
    """Why; empty where it was not."""


def wall_with_board(
    depth: WallFit | WallRefusedError, view: BoardView, board: Board, *, measured: bool
) -> tuple[WallFit | WallByBoard, BoardRecord]:
    """The wall from its depth, or the reason why that was refused, and from a view of a board.

    `measured` says that the board's squares were. Raises BoardRefusedError where the board says nothing.
    """
    fit = find_in_view(view, board)
    plane = Plane(fit.slopes, fit.covariance)
    record = _record(fit, board, view.light, measured=measured)
    if isinstance(depth, WallRefusedError):
        return _by_board(plane, depth), record.model_copy(update={"depth_refused": str(depth)})
    both = combine(Plane(-depth.wall_from_lidar[2, :3] / depth.distance_m, depth.covariance), plane, measured=measured)
    if both.causes and view.light == "colour":
        both = replace(both, causes=(*both.causes, COLOUR_IS_OFF))
    return _by_both(depth, both), record.model_copy(update=_compared(both))


def _by_board(plane: Plane, refusal: WallRefusedError) -> WallByBoard:
    measures = measures_of(plane.slopes, plane.covariance)
    doubt = f"the plane is the board's alone, since the depth was refused: {refusal}"
    problems = out_of_range(measures.distance_m, measures.facing_deg)
    pose = wall_from_plane(plane.normal, plane.distance_m)
    return WallByBoard(**vars(measures), wall_from_lidar=pose, verdict="doubtful", advice="; ".join([doubt, *problems]))


def _by_both(depth: WallFit, both: Combined) -> WallFit:
    measures = measures_of(both.plane.slopes, both.plane.covariance)
    problems = out_of_range(measures.distance_m, measures.facing_deg)
    verdict, advice = depth.verdict, depth.advice
    if both.causes:
        verdict, advice = "doubtful", "; ".join([_conflict(both), *problems])
    elif verdict != "doubtful":
        verdict = "out of range" if problems else "good"
        advice = "; ".join(problems) or f"{depth.advice}; depth and board agree"
    pose = wall_from_plane(both.plane.normal, both.plane.distance_m)
    fitted = replace(depth, **vars(measures), wall_from_lidar=pose, covariance=both.plane.covariance)
    return replace(fitted, verdict=verdict, advice=advice)


def _conflict(both: Combined) -> str:
    apart = both.disagreement
    return (
        f"depth and board disagree by {1e3 * apart.distance_m:+.1f} mm and {apart.angle_deg:.2f} degrees "
        f"({apart.sigmas:.0f} standard deviations), the {both.used}'s plane is used; likely causes: "
        + " | ".join(both.causes)
    )


def _record(fit: BoardFit, board: Board, light: Light, *, measured: bool) -> BoardRecord:
    """What the board said, where there is no depth to compare it with."""
    return BoardRecord(
        **vars(measures_of(fit.slopes, fit.covariance)),
        printed=board,
        measured=measured,
        seen_in=light,
        corners=fit.corners,
        residual_px=fit.residual_px,
        stretch=fit.stretch,
        bow_m=fit.bow_m,
        used="board",
    )


def _compared(both: Combined) -> dict[str, object]:
    """What the record says of the comparison with the depth."""
    apart = both.disagreement
    return {
        "used": both.used,
        "disagreement_m": apart.distance_m,
        "disagreement_deg": apart.angle_deg,
        "disagreement_sigmas": apart.sigmas,
        "causes": both.causes,
    }
