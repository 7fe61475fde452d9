"""Checks of a whole rig: difference from another rig, footprint on the wall, lines of sight to the
hidden object.

The lidar must not see the object's box past the occluder, and the lit wall must. Each problem comes
with its remedy.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import atan, degrees

import numpy as np

from nlos_calibration.arrays import Float64, Mask
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.rig import (
    OBJECT_SIDE,
    Extent,
    LidarPose,
    ObjectBox,
    Occluder,
    OccluderRecord,
    Rig,
)
from nlos_calibration.wall import FACING_RANGE_DEG, TOLERANCE_DEG, TOLERANCE_M, Verdict, at_least


def rig_difference(rig: Rig, other: Rig) -> tuple[str, ...]:
    """Return the differences of `rig` from `other` beyond calibration error, each with its
    amount.
    """
    theirs = other.lidar
    lidar = rig.lidar
    lines = [
        _moved(
            "the lidar",
            lidar.distance_m - theirs.distance_m,
            "farther from the wall",
            "closer to the wall",
        ),
        _turned("yaw", lidar.yaw_deg - theirs.yaw_deg),
        _turned("pitch", lidar.pitch_deg - theirs.pitch_deg),
        *_occluder(rig, other),
        _field(rig.pinhole, other.pinhole),
        _wall(rig, other),
        "another object box" if box_difference_m(rig, other) > SAME_BOX_M else "",
        "other device constants" if rig.device != other.device else "",
    ]
    return tuple(line for line in lines if line)


def _moved(part: str, by_m: float, more: str, less: str) -> str:
    if abs(by_m) <= TOLERANCE_M:
        return ""
    return f"{part} {abs(by_m) * 1e3:.0f} mm {more if by_m > 0 else less}"


def _turned(angle: str, by_deg: float) -> str:
    return f"{angle} {by_deg:+.1f} degrees" if abs(by_deg) > TOLERANCE_DEG else ""


def _occluder(rig: Rig, other: Rig) -> tuple[str, ...]:
    here = rig.occluder
    there = other.occluder
    if here is None:
        return () if there is None else ("no occluder",)
    if there is None:
        return ("an occluder",)
    place = _moved(
        "the occluder", here.x_m - there.x_m, "farther along the wall", "nearer along the wall"
    )
    return place, _moved("its gap", here.z_min_m - there.z_min_m, "wider", "narrower")


def _field(here: Intrinsics, there: Intrinsics) -> str:
    if (apart_deg := view_difference_deg(here, there)) <= TOLERANCE_DEG:
        return ""
    across, down = _view_angles_deg(here)
    across_there, down_there = _view_angles_deg(there)
    if max(abs(across - across_there), abs(down - down_there)) <= TOLERANCE_DEG:
        return f"a view whose middle is {apart_deg:.1f} degrees aside"
    return (
        f"a field of view of {across:.1f} x {down:.1f} degrees, not {across_there:.1f} x"
        f" {down_there:.1f}"
    )


def view_difference_deg(here: Intrinsics, there: Intrinsics) -> float:
    """Return the largest angle in degrees between the same edges of two fields of view, or between
    their widths or heights.
    """
    # Angles, not pixels: the same view at another resolution is no difference.
    edges = np.arctan(_view_edges(here)) - np.arctan(_view_edges(there))
    # Two edges that are off by a little each, in opposite directions, are a width that is off more.
    widths = edges[:, 1] - edges[:, 0]
    return float(np.degrees(max(np.abs(edges).max(), np.abs(widths).max())))


def _view_angles_deg(pinhole: Intrinsics) -> tuple[float, float]:
    """Return the width and height of the field of view in degrees."""
    (left, right), (top, bottom) = _view_edges(pinhole)
    return degrees(atan(right) - atan(left)), degrees(atan(bottom) - atan(top))


SAME_BOX_M = 1e-4
"""Difference of two boxes' sides that is none: the frame of a box, the lidar's foot, is measured."""


def box_difference_m(rig: Rig, other: Rig) -> float:
    """Return the largest difference between the sides of two rigs' object boxes; infinite where
    only one has a box.
    """
    if rig.object_box is None or other.object_box is None:
        return 0.0 if rig.object_box == other.object_box else float("inf")
    sides = zip(vars(rig.object_box).values(), vars(other.object_box).values(), strict=True)
    return max(abs(one_m - other_m) for one_m, other_m in sides)


SMALLER_WALL = 0.02
"""Share of the view that a wall may leave out and still be called the same."""


def _wall(rig: Rig, other: Rig) -> str:
    if (missing := missing_wall(rig, other)) <= SMALLER_WALL:
        return ""
    return f"a smaller wall, which {missing:.0%} of the view misses"


def missing_wall(rig: Rig, other: Rig) -> float:
    """Return the share of a rig's view that would meet the other rig's wall, and misses its own."""
    # Both walls from the same place: what the poses differ by is no difference of the walls.
    pose = rig.wall_from_lidar
    own, theirs = (footprint(pose, rig.pinhole, wall) for wall in (rig.wall, other.wall))
    return float((theirs.on_wall & ~own.on_wall).mean())


MAP_SHAPE = 64, 80
"""Rows and columns of a frame's map."""


@dataclass(frozen=True)
class Footprint:
    """The lidar's view on the wall plane, in the wall frame's x and y; NaN where a beam never meets
    it.
    """

    corners_m: Float64
    """(4, 2); of the view: upper left, upper right, lower right, lower left."""
    cells_m: Float64
    """(rows, columns, 2); points where the beams through the cells' centres meet the plane."""
    on_wall: Mask
    """(rows, columns); the cells that meet the plane within the wall's extent."""

    @property
    def share(self) -> float:
        """Cells on the wall as a share of all."""
        return float(self.on_wall.mean())


def footprint(
    wall_from_lidar: Float64,
    intrinsics: Intrinsics,
    wall: Extent,
    shape: tuple[int, int] = MAP_SHAPE,
) -> Footprint:
    """Return the footprint of a map of `shape` cells seen from the pose (4, 4)."""
    cells_m = on_plane(wall_from_lidar, intrinsics.scaled(shape[1], shape[0]).rays())
    return Footprint(
        on_plane(wall_from_lidar, corner_rays(intrinsics)), cells_m, wall.contains(cells_m)
    )


def corner_rays(intrinsics: Intrinsics) -> Float64:
    """Return the rays (4, 3) of unit z through the view's corners: upper left, upper right, lower
    right, lower left.
    """
    (left, right), (top, bottom) = _view_edges(intrinsics)
    return np.array(
        [[left, top, 1.0], [right, top, 1.0], [right, bottom, 1.0], [left, bottom, 1.0]]
    )


def _view_edges(intrinsics: Intrinsics) -> tuple[Float64, Float64]:
    """Return x (left, right) and y (top, bottom) of the view's edges at unit depth."""
    pinhole = intrinsics.scaled(1, 1)  # one pixel, whose edges are at -0.5 and 0.5
    edges = np.array([-0.5, 0.5])
    return (edges - pinhole.ppx) / pinhole.fx, (edges - pinhole.ppy) / pinhole.fy


def on_plane(wall_from_lidar: Float64, rays: Float64) -> Float64:
    """Return wall x and y (..., 2) where rays (..., 3) in the lidar frame meet the wall plane; NaN
    without hit.
    """
    # A ray p = t + s d meets z = 0 at s = t_z / -d_z, and never if d_z >= 0: it leads away.
    directions = rays @ wall_from_lidar[:3, :3].T
    origin = wall_from_lidar[:3, 3]
    towards = np.where(directions[..., 2] < 0.0, -directions[..., 2], np.nan)
    return origin[:2] + directions[..., :2] * (origin[2] / towards)[..., np.newaxis]


SLICES = 24
"""Number of slices of the box along y for the volume that the lidar sees."""


def lidar_visible_share(rig: Rig, box: ObjectBox) -> float:
    """Return the share of the box's volume that is in the lidar's field of view and not behind the
    occluder.
    """
    # A plane through the lidar cuts each slice y = const of the box along a line. The occluder,
    # endless in y, and the four sides of the field of view are such planes: the visible part of a
    # slice is a convex polygon.
    middles = (np.arange(SLICES) + 0.5) / SLICES
    slices_m = box.y_min_m + middles * (box.y_max_m - box.y_min_m)
    past: list[Float64] = []
    occluder = rig.occluder
    # A sheet on the other side of the lidar than the box hides nothing of it.
    if occluder is not None and occluder.x_m * (box.x_min_m + box.x_max_m) > 0.0:
        past = [_past_edge(occluder, (0.0, rig.lidar.distance_m))]
    shares = [_visible_share(box, [*past, *_field_half_planes(rig, y_m)]) for y_m in slices_m]
    return float(np.mean(shares))


def wall_visible_share(rig: Rig, box: ObjectBox, view: Footprint) -> float:
    """Return the share of the box's volume in sight of the lit wall, from the cell that sees most
    of it.
    """
    # from a cell at x before the sheet, the line of sight past the edge rises by gap / (x_m - x):
    # the farthest lit cell sees all that any other does
    x_m = view.cells_m[..., 0][view.on_wall]
    occluder = rig.occluder
    if occluder is not None:
        # a cell at x beyond the sheet is lit if the beam, at z = distance (1 - x_m / x) there,
        # passes below the edge
        distance_m = rig.lidar.distance_m
        x_m = x_m[
            (x_m <= occluder.x_m) | (distance_m * (x_m - occluder.x_m) < occluder.z_min_m * x_m)
        ]
    if len(x_m) == 0:
        return 0.0
    farthest_m = float(x_m.max())
    if occluder is None or farthest_m >= occluder.x_m:
        return 1.0
    return _visible_share(box, [_past_edge(occluder, (farthest_m, 0.0))])


def _past_edge(occluder: Occluder, eye: tuple[float, float]) -> Float64:
    """Return the half plane a x + b z + c >= 0 as (a, b, c), visible below the edge from an eye (x,
    z).
    """
    # The line from the eye to (x, z) meets the sheet at eye_z + (z - eye_z) run / (x - eye_x),
    # visible if that is below the edge: (z - eye_z) run <= rise (x - eye_x), or >= where x - eye_x
    # is negative, as run then is.
    run_m = occluder.x_m - eye[0]
    rise_m = occluder.z_min_m - eye[1]
    return np.copysign(1.0, run_m) * np.array([rise_m, -run_m, run_m * eye[1] - rise_m * eye[0]])


def _field_half_planes(rig: Rig, y_m: float) -> list[Float64]:
    """Return the half planes (a, b, c) in a slice at y that the four sides of the field of view
    leave.
    """
    pose = rig.wall_from_lidar
    (left, right), (top, bottom) = _view_edges(rig.pinhole)
    inward = np.array(
        [[1.0, 0.0, -left], [-1.0, 0.0, right], [0.0, 1.0, -top], [0.0, -1.0, bottom]]
    )
    # a side n . q >= 0 of the lidar frame is (R n) . (p - t) >= 0 in the wall frame, a line in x
    # and z at fixed y
    sides = inward @ pose[:3, :3].T
    half_planes: list[Float64] = []
    for side in sides:
        x, y, z = side
        half_planes.append(np.array([x, z, y * y_m - side @ pose[:3, 3]]))
    return half_planes


def _visible_share(box: ObjectBox, half_planes: list[Float64]) -> float:
    """Return the share of the box's cross-section in x and z that is inside all half planes."""
    x = (box.x_min_m, box.x_max_m)
    z = (box.z_near_m, box.z_far_m)
    # Cutting a convex polygon by a half plane leaves a convex polygon, so the cuts may follow each
    # other in any order.
    corners = np.array([[x[0], z[0]], [x[1], z[0]], [x[1], z[1]], [x[0], z[1]]])
    left = corners
    for half_plane in half_planes:
        left = _cut(left, half_plane)
    return _area(left) / _area(corners)


def _cut(corners: Float64, half_plane: Float64) -> Float64:
    """Cut a convex polygon (n, 2) by a half plane (Sutherland and Hodgman, 1974); (0, 2) where
    nothing is left.
    """
    # Walk around the polygon: keep each corner that is inside, and add the point of each edge that
    # crosses the line, where the linear function `inside` is 0.
    inside = corners @ half_plane[:2] + half_plane[2]
    points: list[Float64] = []
    for here, there, at, to in zip(
        corners, np.roll(corners, -1, 0), inside, np.roll(inside, -1), strict=True
    ):
        if at >= 0.0:
            points.append(here)
        if (at >= 0.0) != (to >= 0.0):
            points.append(here + at / (at - to) * (there - here))
    return np.array(points).reshape(-1, 2)


def _area(corners: Float64) -> float:
    """Return the area of a polygon (n, 2) by the shoelace formula."""
    x, z = corners.T
    return float(abs(x @ np.roll(z, -1) - z @ np.roll(x, -1)) / 2.0)


GAP_RANGE_M = 0.05, 0.20
"""The paper's (SI 1): less lets too little light through, more lets the lidar see the object."""
PAPER_X_M = 0.20
MIN_PLACE_M = 0.05
"""Beginning of an object box that leaves an occluder room before it."""
CLEAR_M = 0.01
"""Distance to the box that the occluder is advised to have at least."""
WARN_TILT_DEG = 2.0
MIN_SHARE = 0.55
"""Share of the map's cells on the wall. The paper's rig has 57 % in its worst pose: 75 degrees,
0.30 m.
"""
MAX_LEAK = 0.001
"""Share of the box in the lidar's sight: less is within the error of a calibrated edge."""
MIN_SEEN = 0.5
"""Share of the box in sight of some part of the lit wall; the paper's rig has all of it, at any
angle.
"""
FARTHEST_CM = 20
FARTHEST_DEG = 90
"""Largest move and turn that is advised."""


def judge_rig(rig: Rig, view: Footprint, occluder: OccluderRecord | None) -> tuple[str, ...]:
    """Return the problems that keep the rig from working like the paper's, each with its remedy.

    `occluder` is the source of the rig's; None where the paper's is assumed. Distance and angle are
    not repeated here: see `out_of_range`.
    """
    name = "the occluder"
    if rig.occluder and not occluder:
        name += " (not measured, the paper's is assumed)"
    if rig.lidar.yaw_deg < 0.0 and not (rig.occluder and rig.occluder.x_m < 0.0):
        # The other problems and their remedies take the lidar to look the right way.
        away = f"the lidar looks away from the object (yaw {rig.lidar.yaw_deg:.0f} degrees)"
        return (f"{away}: turn it to its right, or mirror the bench",)
    problems = _too_little_wall(rig, view)
    if rig.occluder is not None and rig.occluder.x_m < 0.0 > rig.lidar.yaw_deg:
        # The lidar looks that way too: nothing is misplaced, the whole bench is a mirror image.
        place = f"{name} stands at x = {rig.occluder.x_m:.3f} m, where the lidar looks"
        problems.append(f"{place}: {OBJECT_SIDE}")
    elif rig.occluder is not None:
        tilt_deg = occluder.tilt_deg if occluder else None
        problems += _occluder_position(rig.occluder, rig.object_box, tilt_deg or 0.0, name)
    if rig.object_box is not None and _between(rig.occluder, rig.object_box):
        problems += _leak(rig, rig.object_box, name) + _aperture(rig, rig.object_box, view, name)
    return tuple(problems)


def combined(verdict: Verdict, advice: str, problems: tuple[str, ...]) -> tuple[Verdict, str]:
    """Return the wall's verdict and advice with the rig's problems added."""
    if not problems:
        return verdict, advice
    return "out of range" if verdict == "good" else verdict, "; ".join((advice, *problems))


def _too_little_wall(rig: Rig, view: Footprint) -> list[str]:
    """Report a map that is mostly off the wall; beyond the paper's angles `out_of_range` already
    advises to turn.
    """
    if view.share >= MIN_SHARE or rig.facing_deg > FACING_RANGE_DEG[1] + TOLERANCE_DEG:
        return []
    turn = _first(
        FARTHEST_DEG, lambda degrees: _footprint(_turned_to_wall(rig, degrees)).share >= MIN_SHARE
    )
    cure = f"turn the lidar {_degrees(turn)} towards the wall" if turn else "use a larger wall"
    return [f"{view.share:.0%} of the map's cells meet the wall, {MIN_SHARE:.0%} needed: {cure}"]


def _occluder_position(
    occluder: Occluder, box: ObjectBox | None, tilt_deg: float, name: str
) -> list[str]:
    """Compare the occluder's gap, position and tilt with the paper's ranges."""
    problems: list[str] = []
    low_m, high_m = GAP_RANGE_M
    gap_m = occluder.z_min_m
    if not low_m - TOLERANCE_M <= gap_m <= high_m + TOLERANCE_M:
        short = gap_m < low_m
        by_cm = at_least(100.0 * (low_m - gap_m if short else gap_m - high_m))
        way = "away from" if short else "towards"
        needed = f"{low_m:.2f} to {high_m:.2f} needed"
        problems.append(
            f"{name} has a gap of {gap_m:.3f} m, {needed}: move it {by_cm} cm {way} the wall"
        )
    if not _between(occluder, box):
        ends = f"the lidar at 0 and the object{f' from {box.x_min_m:.3f} m on' if box else ''}"
        problems.append(
            f"{name} stands at x = {occluder.x_m:.3f} m, not between {ends}:"
            f" {_move_between(occluder, box)}"
        )
    if abs(tilt_deg) > WARN_TILT_DEG:
        way = "towards the lidar" if tilt_deg > 0.0 else "away from the lidar"
        problems.append(
            f"{name} leans by {tilt_deg:+.1f} degrees, 0 assumed: tilt its upper end back {way}"
        )
    return problems


def _move_between(occluder: Occluder, box: ObjectBox | None) -> str:
    """Return what to move so that the occluder stands between lidar and object."""
    if not box or box.x_min_m >= MIN_PLACE_M:
        return _move_to(occluder, min(PAPER_X_M, box.x_min_m - CLEAR_M) if box else PAPER_X_M)
    by_cm = at_least(100.0 * (PAPER_X_M + CLEAR_M - box.x_min_m))
    moved = f"move the object {by_cm} cm away from the lidar, along the wall"
    if 0.0 < occluder.x_m <= PAPER_X_M:
        return moved
    return f"{moved}, and {_move_to(occluder, PAPER_X_M)}"


def _move_to(occluder: Occluder, place_m: float) -> str:
    """Return by how much to move the occluder to a place along the wall."""
    way = "away from" if occluder.x_m < place_m else "towards"
    by_cm = at_least(100.0 * abs(occluder.x_m - place_m))
    papers = "the paper's " if place_m == PAPER_X_M else ""
    return f"move it {by_cm} cm {way} the lidar, to {papers}{place_m:.2f} m"


def _between(occluder: Occluder | None, box: ObjectBox | None) -> bool:
    """Return True if the sheet, if there is one, stands between lidar and object."""
    return occluder is None or 0.0 < occluder.x_m <= (box.x_min_m if box else float("inf"))


def _leak(rig: Rig, box: ObjectBox, name: str) -> list[str]:
    """Report an object in the lidar's own sight, with the smallest move of the occluder that hides
    it.
    """
    if (share := lidar_visible_share(rig, box)) <= MAX_LEAK:
        return []
    problem = f"the lidar itself sees {share:.1%} of the object's box"
    if rig.occluder is None:
        return [f"{problem}: put an occluder at x = {PAPER_X_M:.2f} m before it"]

    # Lowering the edge is tried first: it keeps the occluder's place between lidar and object.
    def hidden(x_cm: int, z_cm: int) -> bool:
        moved = _with_occluder_moved(rig, x_cm, z_cm)
        return moved is not None and lidar_visible_share(moved, box) <= MAX_LEAK

    if by_cm := _first(FARTHEST_CM, lambda cm: hidden(0, -cm)):
        return [f"{problem}, past {name}: move the occluder {by_cm} cm towards the wall"]
    if by_cm := _first(FARTHEST_CM, lambda cm: hidden(-cm, 0)):
        return [f"{problem}, past {name}: move the occluder {by_cm} cm towards the lidar"]
    return [f"{problem}, past {name}: move the object out of its sight, away from the wall"]


def _aperture(rig: Rig, box: ObjectBox, view: Footprint, name: str) -> list[str]:
    """Report a box out of sight of the lit wall, with the smallest turn or move that opens the
    way.
    """
    if (share := wall_visible_share(rig, box, view)) >= MIN_SEEN:
        return []
    problem = (
        f"the lit wall sees {share:.1%} of the object's box past {name}, {MIN_SEEN:.0%} needed"
    )

    # Turning the lidar lights more of the wall next to the occluder; a wider gap shows more of the
    # box.
    def turned(degrees: int) -> bool:
        if (yaw_deg := rig.lidar.yaw_deg + degrees) > FACING_RANGE_DEG[1]:
            return False
        turned = _posed(rig, yaw_deg, rig.lidar.pitch_deg)
        return wall_visible_share(turned, box, _footprint(turned)) >= MIN_SEEN

    def opened(cm: int) -> bool:
        moved = _with_occluder_moved(rig, 0, cm)
        return moved is not None and wall_visible_share(moved, box, view) >= MIN_SEEN

    if by_deg := _first(FARTHEST_DEG, turned):
        return [f"{problem}: turn the lidar {_degrees(by_deg)} towards the occluder"]
    if by_cm := _first(FARTHEST_CM, opened):
        return [f"{problem}: move the occluder {by_cm} cm away from the wall"]
    return [f"{problem}: use a larger wall"]


def rig_with_occluder(rig: Rig, x_m: float, gap_m: float) -> Rig:
    """Return the rig with its occluder at x_m, gap_m."""
    return rig.model_copy(update={"occluder": Occluder(x_m=x_m, z_min_m=gap_m)})


def _with_occluder_moved(rig: Rig, x_cm: int, z_cm: int) -> Rig | None:
    """Return the rig with its occluder moved; None where that is past the lidar or out of the
    paper's gaps.
    """
    if rig.occluder is None:
        return None
    x_m = rig.occluder.x_m + x_cm / 100.0
    gap_m = rig.occluder.z_min_m + z_cm / 100.0
    if x_m <= 0.0 or not GAP_RANGE_M[0] <= gap_m <= GAP_RANGE_M[1]:
        return None
    return rig_with_occluder(rig, x_m, gap_m)


def _turned_to_wall(rig: Rig, degrees: int) -> Rig:
    """Return the rig with its lidar turned by `degrees` towards the wall's normal, at most onto
    it.
    """
    # Yaw and pitch shrink in proportion, so that the axis keeps its direction while the angle
    # falls.
    left = max(1.0 - degrees / max(rig.facing_deg, 1e-9), 0.0)
    return _posed(rig, left * rig.lidar.yaw_deg, left * rig.lidar.pitch_deg)


def _posed(rig: Rig, yaw_deg: float, pitch_deg: float) -> Rig:
    lidar = LidarPose(distance_m=rig.lidar.distance_m, yaw_deg=yaw_deg, pitch_deg=pitch_deg)
    return rig.model_copy(update={"lidar": lidar})


def _footprint(rig: Rig) -> Footprint:
    return footprint(rig.wall_from_lidar, rig.pinhole, rig.wall)


def _first(limit: int, cures: Callable[[int], bool]) -> int:
    """Return the smallest whole amount that cures; 0 where none up to the limit does."""
    return next((amount for amount in range(1, limit + 1) if cures(amount)), 0)


def _degrees(amount: int) -> str:
    return f"{amount} degree{'s' * (amount != 1)}"
