"""The occluder from a mean depth map of the bench with it in place: where its sheet stands, its gap, or a refusal.

What stands before the wall in a lidar's view, and the plane of it in the wall frame.

The occluder's edge in the view: where, row by row, the sight passes from the wall to the sheet.
"""

from dataclasses import dataclass, field
from math import degrees, hypot, radians, sqrt

import cv2
import numpy as np
from numpy.typing import NDArray

from nlos_calibration.arrays import Float64, Mask
from nlos_calibration.errors import OccluderRefusedError, WallRefusedError
from nlos_calibration.flatness import ripples
from nlos_calibration.geometry import Intrinsics
from nlos_calibration.noise import MeanNoise, depth_noise_m
from nlos_calibration.plane import GATE_SIGMAS, PlaneFit, fit_depth, plane_depth_m
from nlos_calibration.rig import Occluder, Rig

WALL_BAND_M = 0.004
"""What the wall's own pose and the lidar's ripples may put a point of it off the plane, beside noise."""
NEIGHBOURS = 4.5 / 9.0
"""Of a pixel and those around it, more than this share must stand out with it: scattered outliers do not."""


@dataclass(frozen=True)
class Scene:
    """What the lidar saw, by the wall's plane."""

    depth_m: Float64
    """(height, width); NaN is no return."""
    sigma_m: Float64
    """(height, width); the noise of one sample there, since ripples do not fall with the number of samples."""
    rays: Float64
    """(height, width, 3); of unit depth, in the lidar frame."""
    pose: Float64
    """wall_from_lidar (4, 4)."""
    near: Mask
    """Pixels in front of the wall, together with their neighbours."""
    passed: Mask
    """Pixels on the wall, or behind it: nothing before the wall stopped them."""
    behind_share: float
    """Of the depths, those behind the wall."""

    @property
    def direction(self) -> Float64:
        """The rays in the wall frame."""
        return self.rays @ self.pose[:3, :3].T


@dataclass(frozen=True)
class SheetFit:
    """A plane normal . p = 1 + normal . lidar_m in the wall frame, read as x = x_m + lean z + twist y."""

    plane: PlaneFit
    uneven_m: float
    """RMS of the deviation of parts of it from the plane, beyond noise."""
    normal: Float64
    """(3,)."""
    covariance: Float64
    """(3, 3) of `normal`."""
    lidar_m: Float64
    """(3,)."""

    @property
    def lean(self) -> float:
        """Positive where x grows with z."""
        return float(-self.normal[2] / self.normal[0])

    @property
    def lean_std(self) -> float:
        """How surely."""
        return self._std(np.array([-self.lean, 0.0, -1.0]) / self.normal[0])

    @property
    def twist(self) -> float:
        """Positive where x grows with y."""
        return float(-self.normal[1] / self.normal[0])

    @property
    def tilt_deg(self) -> float:
        """Against the plane x = const, whichever way."""
        return degrees(np.arctan2(hypot(self.normal[1], self.normal[2]), abs(self.normal[0])))

    @property
    def tilt_std_deg(self) -> float:
        """How surely, at most."""
        twist_std = self._std(np.array([-self.twist, -1.0, 0.0]) / self.normal[0])
        return degrees(hypot(self.lean_std, twist_std))

    def x_m(self, z_m: float) -> float:
        """Of the plane at a height over the wall and y = 0."""
        return float((1.0 + self.normal @ self.lidar_m - self.normal[2] * z_m) / self.normal[0])

    def x_std_m(self, z_m: float) -> float:
        """How surely."""
        return self._std((self.lidar_m - np.array([self.x_m(z_m), 0.0, z_m])) / self.normal[0])

    def _std(self, gradient: Float64) -> float:
        return float(np.sqrt(max(gradient @ self.covariance @ gradient, 0.0)))

    def met_m(self, scene: Scene) -> Float64:
        """Where each ray meets the plane (height, width, 3), far away where it never does."""
        return scene.pose[:3, 3] + scene.direction * self._depth_m(scene)[..., np.newaxis]

    def met_by(self, scene: Scene) -> Mask:
        """The pixels that may be points of the plane, by their depth (height, width)."""
        return np.abs(scene.depth_m - self._depth_m(scene)) <= GATE_SIGMAS * scene.sigma_m

    def _depth_m(self, scene: Scene) -> Float64:
        return plane_depth_m(scene.rays, self.plane.slopes)


def look(depth_m: Float64, noise: MeanNoise, intrinsics: Intrinsics, pose: Float64) -> Scene:
    """Each pixel before the wall, on it or behind it, by more than noise and the wall's own error explain."""
    depth_m = np.where(np.isfinite(depth_m) & (depth_m > 0.0), depth_m, np.nan)
    rays = intrinsics.rays()
    along = rays @ pose[2, :3]
    sigma_m = max(noise.scale, 1.0) * depth_noise_m(depth_m)
    height_m, band_m = pose[2, 3] + depth_m * along, WALL_BAND_M + GATE_SIGMAS * sigma_m * np.abs(along)
    near = (height_m > band_m).astype(np.float32)
    together = cv2.boxFilter(near, -1, (3, 3), borderType=cv2.BORDER_REPLICATE) > NEIGHBOURS
    behind = float((height_m < -band_m).sum() / max(int(np.isfinite(depth_m).sum()), 1))
    return Scene(depth_m, sigma_m, rays, pose, (near > 0) & together, height_m <= band_m, behind)


def fit_sheet(scene: Scene, noise: MeanNoise, generator: np.random.Generator) -> SheetFit:
    """The plane of most of what stands before the wall. Raises WallRefusedError where there is none."""
    near_m = np.where(scene.near, scene.depth_m, np.nan)
    plane = fit_depth(scene.rays.reshape(-1, 3), near_m.ravel(), generator, noise, min_extent=0.0)
    turn, rippled = scene.pose[:3, :3], ripples(plane, scene.rays)
    covariance = turn @ rippled.covariance @ turn.T
    return SheetFit(plane, rippled.rms_m, turn @ plane.slopes, covariance, scene.pose[:3, 3])


MIN_ROW_PIXELS = 2
"""Of the sheet, in a row: fewer may be strays."""
GATE_SCATTERS, REFITS = 3.0, 8
SCATTER_PER_MEDIAN = 1.4826
"""The standard deviation of a normal distribution over its median of |x|."""


@dataclass(frozen=True)
class Edge:
    """The edge as a line z = gap_m + slope x y on the sheet, in the wall frame."""

    gap_m: float
    gap_std_m: float
    """Of the resolution of the view and of the scatter of the rows; neither falls with the number of rows, which share
    what moves them."""
    slope: float
    rows: int
    """In how many rows of the image it is seen."""


def find_edge(met_m: Float64, sheet: Mask, passed: Mask) -> Edge | None:
    """The edge from where each pixel's ray meets the sheet's plane (height, width, 3); None where it is not seen.

    `sheet` are pixels that return from the sheet, `passed` those whose beams went by it. A pixel that mixes both, reads
    anything or nothing is neither: the edge is somewhere between the last that passed and the first that did not.
    Heights must grow along each row.
    """
    height_m, y_m = met_m[..., 2], met_m[..., 1]
    middle_m = np.median(height_m[sheet])  # what is seen past another edge of the sheet says nothing about this one
    votes = np.where(height_m > middle_m, 0, passed.astype(np.int64) - sheet)
    balance = np.cumsum(votes, axis=1)
    best = balance == balance.max(axis=1, keepdims=True)
    last, first = best.argmax(axis=1), votes.shape[1] - best[:, ::-1].argmax(axis=1)
    seen = (balance.max(axis=1) > 0) & (first < votes.shape[1])
    seen[seen] = _follow(votes[seen] < 0, first[seen]) >= MIN_ROW_PIXELS
    if not seen.any():
        return None
    rows = np.flatnonzero(seen)
    low_m, high_m = height_m[rows, last[rows]], height_m[rows, first[rows]]
    across_m = (y_m[rows, last[rows]] + y_m[rows, first[rows]]) / 2.0
    return _line(across_m, (low_m + high_m) / 2.0, high_m - low_m)


def rows_of(sheet: Mask) -> Mask:
    """(height,); the rows in which the sheet is seen."""
    return sheet.sum(axis=1) >= MIN_ROW_PIXELS


def _follow(marked: Mask, start: NDArray[np.int64]) -> NDArray[np.int64]:
    """How many of each row are marked from its start on."""
    columns = np.arange(marked.shape[1])
    return (marked & (columns >= start[:, np.newaxis])).sum(axis=1)


def _line(y_m: Float64, z_m: Float64, width_m: Float64) -> Edge:
    """A line through the middles of brackets that are `width_m` wide; rows far off it are left out."""
    line, inside = np.array([np.median(z_m), 0.0]), np.ones(len(z_m), np.bool_)
    terms, resolution_m = np.column_stack([np.ones_like(y_m), y_m]), float(np.median(width_m)) / sqrt(12.0)
    for _ in range(REFITS):
        off_m = z_m - terms @ line
        scatter_m = max(SCATTER_PER_MEDIAN * float(np.median(np.abs(off_m))), resolution_m)
        inside = np.abs(off_m) <= GATE_SCATTERS * scatter_m
        line = np.linalg.lstsq(terms[inside] / width_m[inside, None], z_m[inside] / width_m[inside])[0]
    scatter_m = float(np.sqrt(np.mean((z_m - terms @ line)[inside] ** 2)))
    return Edge(float(line[0]), max(resolution_m, scatter_m), float(line[1]), len(z_m))


MIN_SHARE, MIN_PIXELS, MIN_COLUMNS = 0.002, 100, 4
"""Less in front of the wall is no occluder; of fewer columns nobody can tell how it stands."""
MIN_ON_SHEET, WARN_ON_SHEET_SHARE = 0.7, 0.95
"""Of what stands in front of the wall."""
MAX_UNEVEN_M = 0.003
"""RMS off its plane, beyond noise: more than the lidar's ripples."""
MIN_ROWS = 0.6
"""Of the rows in which a sheet without end would be seen."""
MAX_BEHIND, WARN_BEHIND_SHARE = 0.5, 0.02
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
    if seen.behind_share > WARN_BEHIND_SHARE:
        told.append(f"{seen.behind_share:.0%} of the depth is behind the wall: is an object hidden? Take it away")
    if sheet.plane.inlier_fraction < WARN_ON_SHEET_SHARE:
        off = 1.0 - sheet.plane.inlier_fraction
        told.append(f"{off:.0%} of what stands before the wall is not on the occluder: take away what else is there")
    return tuple(told)
