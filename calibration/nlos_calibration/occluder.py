"""The occluder from a mean depth map of the bench with it in place: where its sheet stands, its gap, or a refusal."""

from dataclasses import dataclass, field
from math import degrees, hypot, radians

import numpy as np

from nlos_calibration.arrays import Float64, Mask
from nlos_calibration.errors import OccluderRefusedError, WallRefusedError
from nlos_calibration.occluder_edge import Edge, find_edge, rows_of
from nlos_calibration.occluder_sheet import Scene, SheetFit, fit_sheet, look
from nlos_calibration.projection import Intrinsics
from nlos_calibration.range_noise import MeanNoise
from nlos_calibration.rig import Occluder, Rig

MIN_SHARE, MIN_PIXELS, MIN_COLUMNS = 0.002, 100, 4
"""Less in front of the wall is no occluder; of fewer columns nobody can tell how it stands."""
MIN_ON_SHEET, TOLD_ON_SHEET = 0.7, 0.95
"""Of what stands in front of the wall."""
MAX_UNEVEN_M = 0.003
"""RMS off its plane, beyond noise: more than the lidar's ripples."""
MIN_ROWS = 0.6
"""Of the rows in which a sheet without end would be seen."""
MAX_BEHIND, TOLD_BEHIND = 0.5, 0.02
"""Of the depths, those behind the wall: light by way of a hidden object. The sheet is still seen beside a few."""
MAX_TILT_DEG, SURE_SIGMAS = 5.0, 2.0
MIN_GAP_M = 0.005
"""Less is as good as none, beside `WALL_BAND_M`."""
MAX_GAP_STD_M = 0.005
"""A ruler does better."""
REACH_HEIGHT_M = 0.1
"""Above the wall, the paper's gap."""
BY_HAND = "enter its place and gap by hand (--occluder-x-m, --occluder-gap-m)"


@dataclass(frozen=True, eq=False)
class OccluderFit:
    """A sheet x = x_m, z >= gap_m of the wall frame, as it was seen; 1.96 of the *_std hold 95 % or more."""

    x_m: float
    """Of the edge, at y = 0."""
    x_std_m: float
    gap_m: float
    gap_std_m: float
    tilt_deg: float
    """Against the plane x = x_m, about wall y; positive leans away from the lidar's foot."""
    tilt_std_deg: float
    twist_deg: float
    """About wall z; positive where x grows with y."""
    edge_deg: float
    """Of the edge against the wall; positive where the gap grows with y."""
    residual_m: float
    """RMS distance of the sheet's points from its plane."""
    pixels: Mask = field(repr=False)
    """(height, width); those that the sheet's plane rests on."""
    warnings: tuple[str, ...]


def find_occluder(
    depth_m: Float64,
    noise: MeanNoise,
    intrinsics: Intrinsics,
    wall_from_lidar: Float64,
    generator: np.random.Generator,
    *,
    distance_std_m: float = 0.0,
    yaw_std_deg: float = 0.0,
) -> OccluderFit:
    """Find the occluder in a mean depth map (height, width) of the bench with it in place and nothing hidden.

    `noise` is that of the flattened map, the depth is corrected as that which the wall was fitted to, and *_std is how
    surely its pose (4, 4) is known. Raises OccluderRefusedError where there is no sheet whose edge can be trusted.
    """
    seen = look(depth_m, noise, intrinsics, wall_from_lidar)
    _check_in_view(seen)
    sheet = _sheet(seen, noise, generator)
    met_m, pixels = sheet.met_m(seen), sheet.plane.inliers.reshape(depth_m.shape)
    _check_stand(sheet, float(np.median(met_m[pixels][:, 2])))
    # what may be the wall or the sheet, at the foot of the sheet, is neither
    edge = _edge(met_m, pixels, seen.passed & ~sheet.met_by(seen))
    x_m, x_std_m, yaw_std = sheet.x_m(edge.gap_m), sheet.x_std_m(edge.gap_m), radians(yaw_std_deg)
    above_m = wall_from_lidar[2, 3] - edge.gap_m
    # the beam past the edge is known: where it meets the sheet depends on where that stands
    gap_std_m = hypot(edge.gap_std_m, above_m / x_m * x_std_m, distance_std_m, x_m * yaw_std)
    found = OccluderFit(
        x_m=x_m,
        x_std_m=hypot(x_std_m, above_m * yaw_std, sheet.lean * edge.gap_std_m),
        gap_m=edge.gap_m,
        gap_std_m=gap_std_m,
        tilt_deg=degrees(np.arctan(sheet.lean)),
        tilt_std_deg=degrees(sheet.lean_std / (1.0 + sheet.lean**2)),
        twist_deg=degrees(np.arctan(sheet.twist)),
        edge_deg=degrees(np.arctan(edge.slope)),
        residual_m=sheet.plane.residual_m,
        pixels=pixels,
        warnings=_warnings(seen, sheet),
    )
    _check_fit(found)
    return found


def rig_with_occluder(rig: Rig, x_m: float, gap_m: float) -> Rig:
    """The rig with its occluder there, found or entered."""
    return rig.model_copy(update={"occluder": Occluder(x_m=x_m, z_min_m=gap_m)})


def _check_in_view(seen: Scene) -> None:
    """Refuse a view that an object fills, or in which nothing stands before the wall."""
    if seen.behind_share > MAX_BEHIND:
        raise OccluderRefusedError(
            f"{seen.behind_share:.0%} of the depth is behind the wall ({MAX_BEHIND:.0%} allowed), by way of something "
            "hidden: take the hidden object away, leave the occluder, and record again"
        )
    if seen.near.sum() >= max(MIN_SHARE * seen.near.size, MIN_PIXELS):
        columns = np.median(seen.near.sum(axis=1)[seen.near.any(axis=1)])
        if columns >= MIN_COLUMNS:
            return
        raise OccluderRefusedError(
            f"the view holds {columns:.0f} columns of what stands before the wall, {MIN_COLUMNS} needed: turn the "
            f"lidar towards the occluder, or {BY_HAND}"
        )
    reach_m = _reach_m(seen)
    how_far = f"reach to x = {reach_m:.2f} m" if np.isfinite(reach_m) else "reach without end"
    raise OccluderRefusedError(
        f"no occluder is in view: {REACH_HEIGHT_M:.2f} m off the wall the beams of this pose {how_far} and meet "
        f"nothing before the wall: put it in their way, or {BY_HAND}"
    )


def _reach_m(seen: Scene) -> float:
    """How far in x a beam of the middle row gets before it is as near to the wall as an edge might be."""
    x, z = (seen.direction[len(seen.direction) // 2, :, axis] for axis in (0, 2))
    down_m = max(seen.pose[2, 3] - REACH_HEIGHT_M, 0.0)
    return float(np.inf if (z >= 0.0).any() else (x / -z).max() * down_m)


def _sheet(seen: Scene, noise: MeanNoise, generator: np.random.Generator) -> SheetFit:
    """The flat sheet that most of what stands before the wall lies on."""
    try:
        sheet = fit_sheet(seen, noise, generator)
    except WallRefusedError as error:
        raise OccluderRefusedError(_no_sheet("its points lie on no plane")) from error
    if sheet.plane.inlier_fraction < MIN_ON_SHEET:
        raise OccluderRefusedError(_no_sheet(f"{sheet.plane.inlier_fraction:.0%} of it lie on a plane"))
    if sheet.uneven_m > MAX_UNEVEN_M:
        raise OccluderRefusedError(_no_sheet(f"{sheet.uneven_m * 1e3:.1f} mm RMS off a plane"))
    return sheet


def _no_sheet(why: str) -> str:
    return f"what stands before the wall is no sheet ({why}): take away all but the occluder, or {BY_HAND}"


def _check_stand(sheet: SheetFit, middle_m: float) -> None:
    """Refuse a sheet that leans, or stands where no object can hide behind it."""
    if sheet.tilt_deg - SURE_SIGMAS * sheet.tilt_std_deg > MAX_TILT_DEG:
        lean_deg, twist_deg = degrees(np.arctan(sheet.lean)), degrees(np.arctan(sheet.twist))
        raise OccluderRefusedError(
            f"the occluder is {sheet.tilt_deg:.1f} degrees off the plane x = const ({MAX_TILT_DEG:.0f} allowed): it "
            f"leans by {lean_deg:+.1f} and is twisted by {twist_deg:+.1f}; set it upright on the wall and level with it"
        )
    if (x_m := sheet.x_m(middle_m)) <= 0.0:
        raise OccluderRefusedError(
            f"the occluder stands at x = {x_m:.3f} m, on the wrong side of the lidar: the hidden object is looked for "
            "at positive x, to the lidar's right; mirror the bench or turn the lidar upside down"
        )


def _edge(met_m: Float64, pixels: Mask, passed: Mask) -> Edge:
    """The sheet's edge; refuses one that is out of view, touches the wall, or ends in the middle of the view."""
    lowest_m, middle_m = np.percentile(met_m[pixels][:, 2], (5.0, 50.0))
    would = met_m[..., 2].max(axis=1) > middle_m
    rows = rows_of(pixels)
    if (rows & would).sum() < MIN_ROWS * would.sum():
        raise OccluderRefusedError(_no_sheet(f"seen in {(rows & would).sum() / max(would.sum(), 1):.0%} of the rows"))
    edge = find_edge(met_m, pixels, passed)
    if edge is None or edge.rows < MIN_ROWS * rows.sum():
        raise OccluderRefusedError(
            f"the occluder's edge is out of view: it is seen from {lowest_m:.3f} m off the wall on, and no wall before "
            f"it; turn the lidar away from it, or {BY_HAND}"
        )
    return edge


def _check_fit(found: OccluderFit) -> None:
    if found.gap_m < max(MIN_GAP_M, SURE_SIGMAS * found.gap_std_m):
        raise OccluderRefusedError(
            f"the occluder touches the wall (gap {found.gap_m * 1e3:.1f} mm, known to {found.gap_std_m * 1e3:.1f} mm): "
            "leave 0.05 to 0.20 m for the light to pass"
        )
    if found.gap_std_m > MAX_GAP_STD_M:
        raise OccluderRefusedError(
            f"the occluder's edge is seen to {found.gap_std_m * 1e3:.0f} mm only ({MAX_GAP_STD_M * 1e3:.0f} allowed), "
            f"about {found.gap_m:.2f} m off the wall: too few pixels beside it have depth; {BY_HAND}"
        )
    if abs(found.edge_deg) > MAX_TILT_DEG:
        raise OccluderRefusedError(
            f"the occluder's edge is {abs(found.edge_deg):.1f} degrees off the wall ({MAX_TILT_DEG:.0f} allowed): set "
            "it so that the gap is the same from top to bottom"
        )


def _warnings(seen: Scene, sheet: SheetFit) -> tuple[str, ...]:
    """What leaves the occluder found but should be known."""
    told: list[str] = []
    if seen.behind_share > TOLD_BEHIND:
        told.append(f"{seen.behind_share:.0%} of the depth is behind the wall: is an object hidden? Take it away")
    if sheet.plane.inlier_fraction < TOLD_ON_SHEET:
        off = 1.0 - sheet.plane.inlier_fraction
        told.append(f"{off:.0%} of what stands before the wall is not on the occluder: take away what else is there")
    return tuple(told)
