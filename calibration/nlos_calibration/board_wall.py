"""Wall from depth and a printed board together: one pose, one verdict, and the board's part of the
record.

The board is seen in infrared, through the lidar's own pinhole. Depth and board each give slopes =
-normal / distance_m (3,) with a covariance. Where they agree, they are averaged by weight. Where
they do not, an average would be neither: one is used, and the likely causes are listed with
amounts. A measured board also gives the depth's range offset, where that explains the difference.
"""

from dataclasses import dataclass, field, fields, replace
from math import degrees, hypot, sqrt
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from nlos_calibration.arrays import Float64, UInt8
from nlos_calibration.board import Board, find_corners
from nlos_calibration.board_pose import fit_board
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.geometry import Intrinsics, plane_from_slopes, wall_from_plane
from nlos_calibration.range_offset import MAX_OFFSET_M, CorrectedWall, distance_per_offset
from nlos_calibration.rig import Finite, NotNegative, Positive, Record
from nlos_calibration.wall import (
    Verdict,
    WallFit,
    WallMeasures,
    measures_of,
    out_of_range,
    range_verdict,
)

Used = Literal["both", "depth", "board"]

AGREE_SIGMAS = 4.0
"""Chance alone puts two planes farther apart once in 900 times (chi-square of three unknowns)."""
MAX_SCALE = 0.2
"""Largest plausible scale error of a printer."""


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


def combine(
    depth: UncertainPlane, board: UncertainPlane, *, measured: bool, per_offset: float = 1.0
) -> Combined:
    """Average both planes where they agree; else use the board's if its squares were `measured`, or
    the depth's.

    `per_offset` is the growth of the depth's distance per length added to each depth
    (`distance_per_offset`).
    """
    apart = disagreement(depth, board)
    if apart.sigmas <= AGREE_SIGMAS:
        # Weighting by inverse covariances, written in Kalman's form: it needs no inverse of the
        # depth's covariance, which may be zero.
        gain = depth.covariance @ np.linalg.inv(depth.covariance + board.covariance)
        slopes = depth.slopes + gain @ (board.slopes - depth.slopes)
        average = UncertainPlane(slopes, depth.covariance - gain @ depth.covariance)
        return Combined(average, "both", apart, ())
    # Which of two is wrong only a ruler tells: a measured print is trusted, a drawing is not.
    used: Used = "board" if measured else "depth"
    causes = _causes(depth, board, apart, measured=measured, per_offset=per_offset)
    return Combined(board if measured else depth, used, apart, causes)


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
    depth: UncertainPlane,
    board: UncertainPlane,
    apart: Disagreement,
    *,
    measured: bool,
    per_offset: float,
) -> tuple[str, ...]:
    """Return the usual causes of a disagreement that could explain this one, each with its
    amount.
    """
    causes: list[str] = []
    # A board's distance is proportional to the assumed size of its squares. The offset that it
    # shows is one of the depth (`range_offset`).
    scale = depth.distance_m / board.distance_m
    offset_m = apart.distance_m / max(per_offset, 1e-3)
    if apart.distance_sigmas > AGREE_SIGMAS:
        if abs(scale - 1.0) <= MAX_SCALE and not measured:
            causes.append(
                f"the print's scale: squares of {100.0 * scale:.1f} % of their size would explain"
                " the distance; measure the printed bar and give --square-mm"
            )
        if abs(offset_m) <= MAX_OFFSET_M:
            causes.append(
                f"the lidar's range offset: {1e3 * offset_m:+.1f} mm added to each depth would"
                " explain the distance; measure with a tape and give --tape-m"
            )
    if apart.angle_sigmas > AGREE_SIGMAS:
        causes.append(
            f"the angle: the normals are {apart.angle_deg:.2f} degrees apart; glue the board flat"
            " on the same wall, and let the lidar warm up (ripples turn the depth's plane)"
        )
    return tuple(causes) or (
        "distance and angle together: none of the usual causes fits; measure again",
    )


@dataclass(frozen=True)
class WallByBoard(WallMeasures):
    """Wall measured by a board alone, since its depth was refused."""

    wall_from_lidar: Float64
    """(4, 4)."""
    covariance: Float64 = field(repr=False)
    """(3, 3) of -normal / distance."""
    verdict: Verdict
    advice: str
    warnings: tuple[str, ...] = ()


class BoardRecord(Record):
    """Measurement of the wall by a board, and its use."""

    printed: Board
    measured: bool
    """True if the squares' size was measured on the print; else it is that of the drawing."""
    seen_in: Literal["infrared"] = "infrared"
    """Light of the image; stated in the file, where other lights may follow."""
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
    depth: WallFit | WallRefusedError,
    image: NDArray[np.floating] | UInt8,
    intrinsics: Intrinsics,
    board: Board,
    *,
    measured: bool,
) -> tuple[WallFit | WallByBoard, BoardRecord]:
    """Measure the wall from its depth (or the reason why that was refused) and a board.

    `image` (height, width) is the mean infrared; `measured` states that the board's squares were
    measured by hand. Raises BoardRefusedError for an unusable image.
    """
    fit = fit_board(find_corners(image, board), board, intrinsics)
    plane = UncertainPlane(fit.slopes, fit.covariance)
    record = BoardRecord(
        **vars(measures_of(fit.slopes, fit.covariance)),
        **{name: getattr(fit, name) for name in ("corners", "residual_px", "stretch", "bow_m")},
        printed=board,
        measured=measured,
        used="board",
    )
    if isinstance(depth, WallRefusedError):
        return _by_board(plane, depth), record.model_copy(update={"depth_refused": str(depth)})
    # In slopes both are linear, and their covariances add; distance and angles would not be.
    by_depth = UncertainPlane(-depth.wall_from_lidar[2, :3] / depth.distance_m, depth.covariance)
    per_offset = distance_per_offset(depth, intrinsics)
    both = combine(by_depth, plane, measured=measured, per_offset=per_offset)
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
    # No board shows whether the rest of the wall is bare and flat.
    measures = measures_of(plane.slopes, plane.covariance)
    reason = f"the plane is the board's alone, since the depth was refused: {refusal}"
    problems = out_of_range(measures.distance_m, measures.facing_deg)
    pose = wall_from_plane(plane.normal, plane.distance_m)
    return WallByBoard(
        **vars(measures),
        wall_from_lidar=pose,
        covariance=plane.covariance,
        verdict="doubtful",
        advice="; ".join([reason, *problems]),
    )


def _by_both(depth: WallFit, both: Combined) -> WallFit:
    """Return the depth's wall with the combined plane, and the verdict on both."""
    measures = measures_of(both.plane.slopes, both.plane.covariance)
    verdict = depth.verdict
    advice = depth.advice
    if both.causes:
        problems = out_of_range(measures.distance_m, measures.facing_deg)
        apart = both.disagreement
        conflict = (
            f"depth and board disagree by {1e3 * apart.distance_m:+.1f} mm and"
            f" {apart.angle_deg:.2f} degrees ({apart.sigmas:.0f} standard deviations), the"
            f" {both.used}'s plane is used; likely causes: " + " | ".join(both.causes)
        )
        verdict = "doubtful"
        advice = "; ".join([conflict, *problems])
    elif verdict != "doubtful":
        verdict, advice = range_verdict(measures.distance_m, measures.facing_deg)
        if verdict == "good":
            advice = f"{advice}; depth and board agree"
    pose = wall_from_plane(both.plane.normal, both.plane.distance_m)
    fitted = replace(
        depth, **vars(measures), wall_from_lidar=pose, covariance=both.plane.covariance
    )
    return replace(fitted, verdict=verdict, advice=advice)


def with_range_offset(
    by_board: WallFit | WallByBoard, depth: WallFit | WallRefusedError, corrected: CorrectedWall
) -> WallFit | None:
    """Return a measured board's wall with the depth as its range offset corrects it; None where the
    two are still turned against each other.

    It stays doubtful, unless the bend of the uncorrected `depth` shows the offset by itself.
    """
    # The offset was chosen for the distance, so that only the angles can contradict it.
    fit = corrected.fit
    for angle in ("yaw", "pitch"):
        apart_deg = getattr(fit, f"{angle}_deg") - getattr(by_board, f"{angle}_deg")
        std_deg = hypot(getattr(fit, f"{angle}_std_deg"), getattr(by_board, f"{angle}_std_deg"))
        if abs(apart_deg) > AGREE_SIGMAS * std_deg:
            return None

    amount = f"a range offset of {1e3 * corrected.offset_m:+.1f} mm"
    verdict: Verdict = "doubtful"
    advice = f"{by_board.advice}; {amount} is added to the depth, which then agrees"
    was_bent = isinstance(depth, WallRefusedError) or depth.verdict == "doubtful"
    if was_bent and fit.verdict != "doubtful":
        verdict, advice = range_verdict(by_board.distance_m, by_board.facing_deg)
        advice = f"{advice}; depth and board agree with {amount}"
    return replace(
        fit,
        **{one.name: getattr(by_board, one.name) for one in fields(WallMeasures)},
        wall_from_lidar=by_board.wall_from_lidar,
        covariance=by_board.covariance,
        verdict=verdict,
        advice=advice,
    )
