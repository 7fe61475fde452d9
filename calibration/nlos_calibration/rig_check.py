"""How one rig differs from another, in words, where it is by more than a calibration may err.

Where the lidar's view meets the wall: its corners, the cells of the map, and how many of them are on the wall.

Who sees the hidden object's box past the occluder: the lidar, which must not, and the wall, which must.

From a whole rig to its problems: occluder, footprint, and who sees the hidden object; each with what to do.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import atan, degrees

import numpy as np
from numpy.typing import NDArray

from nlos_calibration.arrays import Float64
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.rig import Extent, LidarPose, ObjectBox, Occluder, OccluderRecord, PinholeRecord, Rig
from nlos_calibration.wall import FACING_RANGE_DEG, TOLERANCE_DEG, TOLERANCE_M, Verdict, at_least


def rig_difference(rig: Rig, other: Rig) -> tuple[str, ...]:
    """What `rig` is or has against `other`, each with its amount; empty where a network would not notice."""
    lidar, theirs = rig.lidar, other.lidar
    told = [
        _moved("the lidar", lidar.distance_m - theirs.distance_m, "farther from the wall", "closer to the wall"),
        _turned("yaw", lidar.yaw_deg - theirs.yaw_deg),
        _turned("pitch", lidar.pitch_deg - theirs.pitch_deg),
        *_occluder(rig, other),
        _field(rig.intrinsics, other.intrinsics),
        "another object box" if rig.object_box != other.object_box else "",
        "other device constants" if rig.device != other.device else "",
    ]
    return tuple(difference for difference in told if difference)


def _moved(what: str, by_m: float, more: str, less: str) -> str:
    return f"{what} {abs(by_m) * 1e3:.0f} mm {more if by_m > 0 else less}" if abs(by_m) > TOLERANCE_M else ""


def _turned(angle: str, by_deg: float) -> str:
    return f"{angle} {by_deg:+.1f} degrees" if abs(by_deg) > TOLERANCE_DEG else ""


def _occluder(rig: Rig, other: Rig) -> tuple[str, ...]:
    here, there = rig.occluder, other.occluder
    if here is None or there is None:
        return () if here is there else ("no occluder" if here is None else "an occluder",)
    place = _moved("the occluder", here.x_m - there.x_m, "farther along the wall", "nearer along the wall")
    return place, _moved("its gap", here.z_min_m - there.z_min_m, "wider", "narrower")


def _field(here: PinholeRecord, there: PinholeRecord) -> str:
    (across, down), (across_there, down_there) = (_field_deg(pinhole) for pinhole in (here, there))
    if max(abs(across - across_there), abs(down - down_there)) <= TOLERANCE_DEG:
        return ""
    return f"a field of view of {across:.1f} x {down:.1f} degrees, not {across_there:.1f} x {down_there:.1f}"


def _field_deg(pinhole: PinholeRecord) -> tuple[float, float]:
    """Across and down, from edge to edge."""
    spans = (
        (pinhole.ppx + 0.5, pinhole.width - pinhole.ppx - 0.5, pinhole.fx),
        (pinhole.ppy + 0.5, pinhole.height - pinhole.ppy - 0.5, pinhole.fy),
    )
    across, down = (degrees(atan(before / focal) + atan(after / focal)) for before, after, focal in spans)
    return across, down


MAP_SHAPE = 64, 80
"""Rows and columns of the map that a frame is reduced to."""


@dataclass(frozen=True)
class Footprint:
    """Points of the wall plane in the wall frame's x and y; NaN where a beam never meets it."""

    corners_m: Float64
    """(4, 2); of the view: upper left, upper right, lower right, lower left."""
    cells_m: Float64
    """(rows, columns, 2); where the beam through each cell's centre meets the plane. cells_m[i] is row i's line."""
    on_wall: NDArray[np.bool_]
    """(rows, columns); the cells that meet the plane within the wall's extent."""

    @property
    def share(self) -> float:
        """Of the cells that are on the wall."""
        return float(self.on_wall.mean())


def footprint(
    wall_from_lidar: Float64, intrinsics: Intrinsics, wall: Extent, shape: tuple[int, int] = MAP_SHAPE
) -> Footprint:
    """The footprint of a map of `shape` cells seen from the pose (4, 4)."""
    cells_m = on_plane(wall_from_lidar, intrinsics.scaled(shape[1], shape[0]).rays())
    edges = intrinsics.scaled(1, 1)
    x, y = (np.array([-0.5, 0.5]) - edges.ppx) / edges.fx, (np.array([-0.5, 0.5]) - edges.ppy) / edges.fy
    corners = np.array([[x[0], y[0], 1.0], [x[1], y[0], 1.0], [x[1], y[1], 1.0], [x[0], y[1], 1.0]])
    across, up = cells_m[..., 0], cells_m[..., 1]
    on_wall = (across >= wall.x_min_m) & (across <= wall.x_max_m) & (up >= wall.y_min_m) & (up <= wall.y_max_m)
    return Footprint(on_plane(wall_from_lidar, corners), cells_m, on_wall)


def on_plane(wall_from_lidar: Float64, rays: Float64) -> Float64:
    """Wall x and y (..., 2) of where rays (..., 3) in the lidar frame meet the wall plane; NaN where they never do."""
    directions = rays @ wall_from_lidar[:3, :3].T
    origin = wall_from_lidar[:3, 3]
    towards = np.where(directions[..., 2] < 0.0, -directions[..., 2], np.nan)
    return origin[:2] + directions[..., :2] * (origin[2] / towards)[..., np.newaxis]


SLICES = 24
"""Of the box along y, in which the share of it that the lidar sees is added up."""


def lidar_sees(rig: Rig, box: ObjectBox) -> float:
    """The share of the box's volume inside the lidar's field that the occluder does not hide."""
    edges = (np.arange(SLICES) + 0.5) / SLICES
    across_m = box.y_min_m + edges * (box.y_max_m - box.y_min_m)
    past = [_past_edge(rig.occluder, (0.0, rig.lidar.distance_m))] if rig.occluder else []
    return float(np.mean([_visible_share(box, [*past, *_field_half_planes(rig, y_m)]) for y_m in across_m]))


def wall_sees(rig: Rig, box: ObjectBox, seen: Footprint) -> float:
    """The share of the box's volume that is seen from the lit wall, by the cell that sees most of it.

    That is the farthest from the lidar's foot: no cell before it sees what it does not.
    """
    x_m = seen.cells_m[..., 0][seen.on_wall]
    occluder = rig.occluder
    if occluder is not None:
        # a cell beyond the sheet is lit if the beam passes below the edge: z = distance (1 - x_m / x) there
        distance_m = rig.lidar.distance_m
        x_m = x_m[(x_m <= occluder.x_m) | (distance_m * (x_m - occluder.x_m) < occluder.z_min_m * x_m)]
    if len(x_m) == 0:
        return 0.0
    farthest_m = float(x_m.max())
    if occluder is None or farthest_m >= occluder.x_m:
        return 1.0
    return _visible_share(box, [_past_edge(occluder, (farthest_m, 0.0))])


def _past_edge(occluder: Occluder, eye: tuple[float, float]) -> Float64:
    """Half plane (a, b, c), a x + b z + c >= 0, of what is seen below the edge from an eye (x, z) before the sheet.

    The sight to (x, z) meets the sheet at eye_z + (z - eye_z) (x_m - eye_x) / (x - eye_x), to be below the edge.
    """
    run_m, rise_m = occluder.x_m - eye[0], occluder.z_min_m - eye[1]
    return np.array([rise_m, -run_m, run_m * eye[1] - rise_m * eye[0]])


def _field_half_planes(rig: Rig, y_m: float) -> list[Float64]:
    """The half planes (a, b, c) that the four sides of the lidar's field of view leave of a slice at y."""
    pinhole, pose = rig.pinhole.scaled(1, 1), rig.wall_from_lidar
    left, right = (np.array([-0.5, 0.5]) - pinhole.ppx) / pinhole.fx
    top, bottom = (np.array([-0.5, 0.5]) - pinhole.ppy) / pinhole.fy
    inward = np.array([[1.0, 0.0, -left], [-1.0, 0.0, right], [0.0, 1.0, -top], [0.0, -1.0, bottom]])
    sides = inward @ pose[:3, :3].T
    return [np.array([x, z, y * y_m - side @ pose[:3, 3]]) for side in sides for x, y, z in [side]]


def _visible_share(box: ObjectBox, half_planes: list[Float64]) -> float:
    """Of the box's cross-section in x and z, what all half planes leave."""
    x, z = (box.x_min_m, box.x_max_m), (box.z_near_m, box.z_far_m)
    corners = np.array([[x[0], z[0]], [x[1], z[0]], [x[1], z[1]], [x[0], z[1]]])
    left = corners
    for half_plane in half_planes:
        left = _cut(left, half_plane)
    return _area(left) / _area(corners)


def _cut(corners: Float64, half_plane: Float64) -> Float64:
    """A convex polygon (n, 2) cut by a half plane (Sutherland and Hodgman); (0, 2) where nothing is left."""
    inside = corners @ half_plane[:2] + half_plane[2]
    kept: list[Float64] = []
    for here, there, at, to in zip(corners, np.roll(corners, -1, 0), inside, np.roll(inside, -1), strict=True):
        if at >= 0.0:
            kept.append(here)
        if (at >= 0.0) != (to >= 0.0):
            kept.append(here + at / (at - to) * (there - here))
    return np.array(kept).reshape(-1, 2)


def _area(corners: Float64) -> float:
    """By the shoelace formula."""
    x, z = corners.T
    return float(abs(x @ np.roll(z, -1) - z @ np.roll(x, -1)) / 2.0)


GAP_RANGE_M = 0.05, 0.20
"""The paper's (SI 1): less lets too little light through, more lets the lidar see the object."""
PAPER_X_M = 0.20
WARN_TILT_DEG = 2.0
MIN_SHARE = 0.55
"""Of the map's cells on the wall. The paper's rig keeps 57 % at its worst: 75 degrees, 0.30 m."""
MAX_LEAK = 0.001
"""Of the box, in the lidar's sight: less is within what a calibrated edge may err by."""
MIN_SEEN = 0.5
"""Of the box, to be seen from some part of the wall that the lidar lights; the paper's rig has all, at any angle."""
FARTHEST_CM, FARTHEST_DEG = 20, 90
"""How far advice goes."""


def judge_rig(rig: Rig, seen: Footprint, occluder: OccluderRecord | None) -> tuple[str, ...]:
    """What keeps the rig from working as the paper's does, each with what to do; what `out_of_range` says is not here.

    `occluder` is how that of the rig is known; None where it is the paper's, assumed.
    """
    name = "the occluder" if occluder or not rig.occluder else "the occluder (not measured, the paper's is assumed)"
    problems = _too_little_wall(rig, seen)
    if rig.occluder is not None:
        tilt_deg = occluder.tilt_deg if occluder else None
        problems += _stand(rig.occluder, rig.object_box, tilt_deg or 0.0, name)
    if rig.object_box is not None and _between(rig.occluder, rig.object_box):
        problems += _leak(rig, rig.object_box, name) + _aperture(rig, rig.object_box, seen, name)
    return tuple(problems)


def combined(verdict: Verdict, advice: str, problems: tuple[str, ...]) -> tuple[Verdict, str]:
    """The wall's verdict and advice with the rig's problems in them."""
    if not problems:
        return verdict, advice
    return "out of range" if verdict == "good" else verdict, "; ".join((advice, *problems))


def _too_little_wall(rig: Rig, seen: Footprint) -> list[str]:
    """Too much of the map off the wall; beyond the paper's angles `out_of_range` says to turn."""
    if seen.share >= MIN_SHARE or rig.facing_deg > FACING_RANGE_DEG[1] + TOLERANCE_DEG:
        return []
    turn = _first(FARTHEST_DEG, lambda degrees: _seen(_turned_to_wall(rig, degrees)).share >= MIN_SHARE)
    cure = f"turn the lidar {_degrees(turn)} towards the wall" if turn else "take a larger wall"
    return [f"{seen.share:.0%} of the map's cells meet the wall, {MIN_SHARE:.0%} needed: {cure}"]


def _stand(occluder: Occluder, box: ObjectBox | None, tilt_deg: float, name: str) -> list[str]:
    """The occluder against the paper's ranges."""
    problems: list[str] = []
    (low_m, high_m), gap_m = GAP_RANGE_M, occluder.z_min_m
    if not low_m - TOLERANCE_M <= gap_m <= high_m + TOLERANCE_M:
        short = gap_m < low_m
        by_cm, way = at_least(100.0 * (low_m - gap_m if short else gap_m - high_m)), "away from" if short else "towards"
        needed = f"{low_m:.2f} to {high_m:.2f} needed"
        problems.append(f"{name} has a gap of {gap_m:.3f} m, {needed}: move it {by_cm} cm {way} the wall")
    if not _between(occluder, box):
        by_cm, way = (
            at_least(100.0 * abs(occluder.x_m - PAPER_X_M)),
            "away from" if occluder.x_m < PAPER_X_M else "towards",
        )
        ends = f"the lidar at 0 and the object{f' from {box.x_min_m:.3f} m on' if box else ''}"
        problems.append(
            f"{name} stands at x = {occluder.x_m:.3f} m, not between {ends}: move it {by_cm} cm {way} the lidar, to "
            f"the paper's {PAPER_X_M:.2f} m"
        )
    if abs(tilt_deg) > WARN_TILT_DEG:
        way = "towards the lidar" if tilt_deg > 0.0 else "away from the lidar"
        problems.append(f"{name} leans by {tilt_deg:+.1f} degrees, 0 assumed: tilt its upper end back {way}")
    return problems


def _between(occluder: Occluder | None, box: ObjectBox | None) -> bool:
    """Whether the sheet, if there is one, stands between lidar and object."""
    return occluder is None or 0.0 < occluder.x_m <= (box.x_min_m if box else float("inf"))


def _leak(rig: Rig, box: ObjectBox, name: str) -> list[str]:
    """The object in the lidar's own sight."""
    if (share := lidar_sees(rig, box)) <= MAX_LEAK:
        return []
    what = f"the lidar sees {share:.1%} of the object's box itself"
    if rig.occluder is None:
        return [f"{what}: put an occluder at x = {PAPER_X_M:.2f} m before it"]

    def hidden(x_cm: int, z_cm: int) -> bool:
        moved = _with_occluder_moved(rig, x_cm, z_cm)
        return moved is not None and lidar_sees(moved, box) <= MAX_LEAK

    if by_cm := _first(FARTHEST_CM, lambda cm: hidden(0, -cm)):
        return [f"{what}, past {name}: move the occluder {by_cm} cm towards the wall"]
    if by_cm := _first(FARTHEST_CM, lambda cm: hidden(-cm, 0)):
        return [f"{what}, past {name}: move the occluder {by_cm} cm towards the lidar"]
    return [f"{what}, past {name}: move the object out of its sight, away from the wall"]


def _aperture(rig: Rig, box: ObjectBox, seen: Footprint, name: str) -> list[str]:
    """No light by way of the wall."""
    if (share := wall_sees(rig, box, seen)) >= MIN_SEEN:
        return []
    what = f"the wall that the lidar lights sees {share:.1%} of the object's box past {name}, {MIN_SEEN:.0%} needed"

    def opened(cm: int) -> bool:
        moved = _with_occluder_moved(rig, 0, cm)
        return moved is not None and wall_sees(moved, box, seen) >= MIN_SEEN

    turned = _first(FARTHEST_DEG, lambda degrees: _sees_when_turned(rig, box, degrees))
    if turned:
        return [f"{what}: turn the lidar {_degrees(turned)} towards the occluder"]
    by_cm = _first(FARTHEST_CM, opened)
    return [f"{what}: " + (f"move the occluder {by_cm} cm away from the wall" if by_cm else "take a larger wall")]


def _with_occluder_moved(rig: Rig, x_cm: int, z_cm: int) -> Rig | None:
    """The rig with its occluder moved; None where that is past the lidar or out of the paper's gaps."""
    if rig.occluder is None:
        return None
    x_m, gap_m = rig.occluder.x_m + x_cm / 100.0, rig.occluder.z_min_m + z_cm / 100.0
    if x_m <= 0.0 or not GAP_RANGE_M[0] <= gap_m <= GAP_RANGE_M[1]:
        return None
    return rig.model_copy(update={"occluder": Occluder(x_m=x_m, z_min_m=gap_m)})


def _sees_when_turned(rig: Rig, box: ObjectBox, degrees: int) -> bool:
    yaw_deg = rig.lidar.yaw_deg + degrees
    if yaw_deg > FACING_RANGE_DEG[1]:
        return False
    turned = _posed(rig, yaw_deg, rig.lidar.pitch_deg)
    return wall_sees(turned, box, _seen(turned)) >= MIN_SEEN


def _turned_to_wall(rig: Rig, degrees: int) -> Rig:
    """The rig with its lidar turned towards the wall's normal, as far as that at most."""
    left = max(1.0 - degrees / max(rig.facing_deg, 1e-9), 0.0)
    return _posed(rig, left * rig.lidar.yaw_deg, left * rig.lidar.pitch_deg)


def _posed(rig: Rig, yaw_deg: float, pitch_deg: float) -> Rig:
    lidar = LidarPose(distance_m=rig.lidar.distance_m, yaw_deg=yaw_deg, pitch_deg=pitch_deg)
    return rig.model_copy(update={"lidar": lidar})


def _seen(rig: Rig) -> Footprint:
    return footprint(rig.wall_from_lidar, rig.pinhole, rig.wall)


def _first(most: int, cures: Callable[[int], bool]) -> int:
    """The least whole amount that cures; 0 where none does."""
    return next((amount for amount in range(1, most + 1) if cures(amount)), 0)


def _degrees(amount: int) -> str:
    return f"{amount} degree{'s' * (amount != 1)}"
