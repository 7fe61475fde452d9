"""Range offset of the lidar from a distance measured by tape or board, and its effect on the pose.

Sign: true depth = the lidar's depth + offset_m, along the optical axis; the truth counts from the
front glass. The tape goes from the point of the glass on the optical axis to the wall, along the
wall's normal. The data sheet puts 4.5 mm between the glass and the zero of depth, and its readers
disagree about the sign: so it is measured.

Two causes look alike where the wall is faced squarely, and the origin's is taken; on an oblique
wall the flatter one is right:

- origin: the beams meet in the zero of depth, which lies offset_m before the glass. The measured
  wall is flat; the pose's origin moves along the optical axis, and the distance by offset_m x
  cos(facing).
- depth: the beams meet in the glass, and every depth is too short by offset_m. That bends and turns
  an oblique wall (by 0.2 degrees at 45 degrees and 4.5 mm); the corrected depths are fitted again.

A printed board is seen through the lidar's own pinhole, so its distance counts from the point where
the beams meet: it shows an offset of the depth, and none of the origin.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import cos, hypot, radians
from typing import Literal

import numpy as np

from nlos_calibration.errors import CalibrationError, WallRefusedError
from nlos_calibration.flatness import SURE_SIGMAS
from nlos_calibration.geometry import Intrinsics, plane_gradients
from nlos_calibration.noise import depth_noise_m
from nlos_calibration.wall import MEASURE_BY_TAPE, WallFit

# A ruled millimetre is read to half of it.
TAPE_STD_M = 0.0005
"""Standard uncertainty of a tape read by eye."""
MAX_OFFSET_M = 0.03
"""A larger offset is a misreading."""
SEARCHED_M = 0.15
"""Larger offsets are not looked for where the depth as read is no wall."""
SEARCH_STEP_M = 0.01
"""An offset known to this leaves a wall that is not refused."""
FIRST_STEP_M = 0.002
"""Largest first step of the search for the offset of a wall that is not refused."""
AGREED_M = 1e-6
MAX_STEPS = 8

Cause = Literal["origin", "depth"]
FitWith = Callable[[float, float], WallFit]
"""Fit of the wall with (offset_m added to each depth, the pose's origin origin_m behind the zero of
depth).
"""
FitAlongRays = Callable[[float], WallFit]
"""Fit of the wall with this length in m added along each ray."""


@dataclass(frozen=True)
class CorrectedWall:
    """A wall at the distance measured by tape or board, and the lidar's offset that follows from
    it.
    """

    fit: WallFit
    """Wall with that distance and its uncertainty."""
    offset_m: float
    """Length to add to the lidar's depth."""
    offset_std_m: float
    cause: Cause


def distance_per_offset(fit: WallFit, intrinsics: Intrinsics) -> float:
    """Return by how much a wall's fitted distance grows per length added to each of its depths, to
    first order: 1 where it is faced squarely, 0.6 at 75 degrees.
    """
    # The fit follows the depths p_z = 1 / (slopes . r) by the change of slopes whose -p_z^2 r .
    # change comes nearest to 1 in every pixel, weighted by its noise: a slope's share of that
    # length is taken for a turn of the wall.
    normal = fit.wall_from_lidar[2, :3]
    rays = intrinsics.rays()[fit.inliers]
    predicted_m = -fit.distance_m / (rays @ normal)
    weight = 1.0 / depth_noise_m(predicted_m)
    rows = -rays * (predicted_m**2 * weight)[:, np.newaxis]
    change = np.linalg.lstsq(rows.T @ rows, rows.T @ weight)[0]
    return float(plane_gradients(normal, fit.distance_m)[0] @ change)


def fit_with_tape_distance(
    fit_with: FitWith, tape_m: float, fit_along_rays: FitAlongRays | None = None
) -> CorrectedWall:
    """Find the offset that puts the wall at `tape_m`, with the cause that makes the wall flatter:
    the depth where it does so by more than noise, else the origin.

    Raises CalibrationError where tape and lidar cannot both be right, and names the offset where
    the depth is that of a bare wall but for it; WallRefusedError where it is of no bare wall.
    """
    taped = _fit_with_tape_distance(fit_with, tape_m, fit_along_rays)
    fit = taped.fit
    measured = f"the tape's offset is {1e3 * taped.offset_m:+.1f} mm: measure the distance again"
    return replace(taped, fit=replace(fit, advice=fit.advice.replace(MEASURE_BY_TAPE, measured)))


def _fit_with_tape_distance(
    fit_with: FitWith, tape_m: float, fit_along_rays: FitAlongRays | None
) -> CorrectedWall:
    # an origin that moves back along the optical axis moves away from the wall by cos(facing) of
    # that: exact. A depth offset also bends an oblique wall, so its effect on the distance is found
    # numerically.
    try:
        plain = fit_with(0.0, 0.0)
    except WallRefusedError:
        # A large offset bends an oblique wall so far that it looks like clutter.
        found = _searched(lambda offset_m: fit_with(offset_m, 0.0), tape_m, TAPE_STD_M)
        if found and abs(found.offset_m) <= MAX_OFFSET_M:
            return found
        along = None
        if not found and fit_along_rays:
            along = _searched(fit_along_rays, tape_m, TAPE_STD_M)
        if not (found or along):
            raise
        raise _named(found, along, tape_m) from None
    corrected = _corrected(fit_with, plain, tape_m, TAPE_STD_M)
    # Both fits have the same noise, and a wall faced squarely shows no more than that: the halves'
    # bends then differ by chance, and the depth stays as it was read.
    if corrected and abs(corrected.offset_m) <= MAX_OFFSET_M:
        flatter_deg = plain.bend_deg - corrected.fit.bend_deg
        if flatter_deg > SURE_SIGMAS * plain.bend_std_deg:
            return corrected

    axis_share = cos(radians(plain.facing_deg))
    origin_m = (tape_m - plain.distance_m) / axis_share
    if abs(origin_m) > MAX_OFFSET_M:
        raise CalibrationError(
            f"the tape reads {tape_m * 1e3:.1f} mm and the lidar {plain.distance_m * 1e3:.1f} mm,"
            f" an offset of {abs(origin_m) * 1e3:.0f} mm ({MAX_OFFSET_M * 1e3:.0f} mm allowed):"
            " measure from the front glass to the wall, along the wall's normal"
        )
    return _with_offset(fit_with(0.0, origin_m), origin_m, axis_share, TAPE_STD_M, "origin")


def fit_with_board_distance(
    fit_with: FitWith, board_m: float, board_std_m: float
) -> CorrectedWall | None:
    """Find the offset of the depth that puts the wall at a board's distance and makes it flatter.

    None where no offset up to MAX_OFFSET_M does, as for a board of another size than was measured.
    """
    try:
        plain = fit_with(0.0, 0.0)
    except WallRefusedError:
        found = _searched(lambda offset_m: fit_with(offset_m, 0.0), board_m, board_std_m)
    else:
        found = _corrected(fit_with, plain, board_m, board_std_m)
        if found and found.fit.bend_deg >= plain.bend_deg:
            return None
    return found if found and abs(found.offset_m) <= MAX_OFFSET_M else None


def _searched(
    fit_with: Callable[[float], WallFit], distance_m: float, std_m: float
) -> CorrectedWall | None:
    """Return the smallest offset that makes the depth a bare wall at `distance_m`; None without
    any.

    One number has to do both, so clutter or a bent wall does not pass.
    """
    steps = int(SEARCHED_M / SEARCH_STEP_M + 0.5)
    for step in sorted(range(-steps, steps + 1), key=abs):
        offset_m = step * SEARCH_STEP_M
        try:
            start = fit_with(offset_m)
        except WallRefusedError:
            continue
        if abs(distance_m - start.distance_m) > SEARCH_STEP_M:
            continue
        found = _corrected(
            lambda added_m, _origin_m, at_m=offset_m: fit_with(at_m + added_m),
            start,
            distance_m,
            std_m,
        )
        if found:
            return replace(found, offset_m=offset_m + found.offset_m)
    return None


def _named(
    found: CorrectedWall | None, along: CorrectedWall | None, tape_m: float
) -> CalibrationError:
    """Return the error that names an offset too large, or along the rays, to be corrected."""
    offset_m = found.offset_m if found else along.offset_m if along else 0.0
    kind = "depths" if found else "ranges along the rays"
    return CalibrationError(
        f"the lidar's {kind} are {abs(offset_m) * 1e3:.0f} mm too"
        f" {'short' if offset_m > 0 else 'long'}: corrected by that they are a bare wall at the"
        f" tape's {tape_m * 1e3:.0f} mm, and nothing needs to be removed. An offset of depth of up"
        f" to {MAX_OFFSET_M * 1e3:.0f} mm can be corrected: check the tape, let the lidar warm up,"
        " or move it farther from the wall"
    )


def _corrected(
    fit_with: FitWith, plain: WallFit, distance_m: float, std_m: float
) -> CorrectedWall | None:
    """Solve distance(offset) = distance_m by the secant method, from the wall of no offset on; None
    where no correction leaves a wall there.
    """
    # The effect of an offset is known by the first step only: a long one could leave no wall.
    missing_m = distance_m - plain.distance_m
    offset_m = float(np.clip(missing_m, -FIRST_STEP_M, FIRST_STEP_M))
    before = plain
    step_m = offset_m
    for _ in range(MAX_STEPS):
        try:
            fit = fit_with(offset_m, 0.0)
        except WallRefusedError:
            return None
        # The secant's slope: by how much the wall moves per offset, the turn that it causes
        # included. A wall that comes nearer as its depths grow cannot be corrected so.
        effect = (fit.distance_m - before.distance_m) / step_m if step_m else 1.0
        if effect <= 0.0:
            return None
        before = fit
        step_m = (distance_m - fit.distance_m) / effect
        if abs(step_m) < AGREED_M:
            return _with_offset(fit, offset_m, effect, std_m, "depth")
        offset_m += step_m
    return None


def _with_offset(
    fit: WallFit, offset_m: float, effect: float, std_m: float, cause: Cause
) -> CorrectedWall:
    """Return the result; `effect` is the change of distance per change of offset, `std_m` the
    uncertainty of the distance by tape or board.
    """
    # offset = (measured - distance) / effect, so the two independent uncertainties add in squares
    # and divide by the effect
    offset_std_m = hypot(std_m, fit.distance_std_m) / effect
    return CorrectedWall(replace(fit, distance_std_m=std_m), offset_m, offset_std_m, cause)
