"""The wall from depth and board together: one pose, one verdict, and what the record keeps of the board."""

from dataclasses import dataclass, replace
from typing import Annotated

from pydantic import Field

from nlos_calibration.arrays import Float64
from nlos_calibration.board import Board
from nlos_calibration.board_corners import Light
from nlos_calibration.board_plane import BoardFit
from nlos_calibration.board_view import BoardView, find_in_view
from nlos_calibration.combine import Combined, Plane, Used, combine
from nlos_calibration.errors import WallRefusedError
from nlos_calibration.geometry import wall_from_plane
from nlos_calibration.rig import Finite, NotNegative, Positive, Record
from nlos_calibration.uncertainty import WallMeasures, measures_of
from nlos_calibration.verdict import Verdict, out_of_range
from nlos_calibration.wall import WallFit

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
