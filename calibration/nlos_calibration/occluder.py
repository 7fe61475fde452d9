"""Occluder from a mean depth map of the bench with it in place: its sheet, its edge and gap, or a
refusal.

Three steps: the pixels in front of the wall; the plane of their sheet in the wall frame; and its
edge, where row by row the line of sight passes from the wall to the sheet.
"""

from dataclasses import dataclass, field
from math import degrees, hypot, radians, sqrt

import cv2
import numpy as np

from nlos_calibration.arrays import Float64, Mask
from nlos_calibration.errors import OccluderRefusedError, WallRefusedError
from nlos_calibration.flatness import ripples
from nlos_calibration.geometry import Intrinsics, propagated_std
from nlos_calibration.noise import SCATTER_PER_MEDIAN, MeanNoise, depth_noise_m, with_mm
from nlos_calibration.plane import GATE_SIGMAS, PlaneFit, fit_depth, plane_depth_m
from nlos_calibration.rig import OBJECT_SIDE

WALL_BAND_M = 0.004
"""Distance of a wall point from the plane by errors of the wall's pose and the lidar's ripples,
beside noise.
"""
NEIGHBOURS = 4.5 / 9.0
"""A pixel counts as in front of the wall if more than this share of its 3 x 3 block is: scattered
outliers are not.
"""


@dataclass(frozen=True)
class ClassifiedView:
    """Depth map with its pixels classified by the wall's plane."""

    depth_m: Float64
    """(height, width); NaN is no return."""
    sigma_m: Float64
    """(height, width); noise of one sample, since ripples do not fall with the number of
    samples.
    """
    rays: Float64
    """(height, width, 3); of unit depth, in the lidar frame."""
    pose: Float64
    """wall_from_lidar (4, 4)."""
    near: Mask
    """Pixels in front of the wall, together with their neighbours."""
    passed: Mask
    """Pixels on the wall or behind it: nothing in front of the wall stopped their beams."""
    behind_share: float
    """Depths behind the wall as a share of all."""

    @property
    def direction(self) -> Float64:
        """Rays in the wall frame."""
        return self.rays @ self.pose[:3, :3].T


@dataclass(frozen=True)
class SheetFit:
    """Plane of a sheet in the wall frame, read as x = x_m + lean z + twist y."""

    # The lidar's plane is slopes . q = 1. With q = R' (p - t) it is n . p = 1 + n . t in the wall
    # frame, where n = R slopes and t = `lidar_m`. Solved for x: (1 + n . t - n_y y - n_z z) / n_x,
    # so lean = -n_z / n_x and twist = -n_y / n_x. The gradients below are the derivatives of these
    # by n.

    plane: PlaneFit
    normal: Float64
    """(3,), n; not a unit vector."""
    covariance: Float64
    """(3, 3) of `normal`."""
    lidar_m: Float64
    """(3,)."""

    @property
    def lean(self) -> float:
        """Dx / dz."""
        return float(-self.normal[2] / self.normal[0])

    @property
    def lean_std(self) -> float:
        """Standard uncertainty of `lean`."""
        return propagated_std(np.array([-self.lean, 0.0, -1.0]) / self.normal[0], self.covariance)

    @property
    def twist(self) -> float:
        """Dx / dy."""
        return float(-self.normal[1] / self.normal[0])

    @property
    def tilt_deg(self) -> float:
        """Angle against the plane x = const, in any direction."""
        return degrees(np.arctan2(hypot(self.normal[1], self.normal[2]), abs(self.normal[0])))

    @property
    def tilt_std_deg(self) -> float:
        """Upper limit of the standard uncertainty of `tilt_deg`."""
        # tilt = atan(h) with h^2 = lean^2 + twist^2, so that dh is at most the hypotenuse of both
        # uncertainties, and d tilt = dh / (1 + h^2): a sheet that faces the lidar is as surely
        # tilted as an upright one is not
        twist_std = propagated_std(
            np.array([-self.twist, -1.0, 0.0]) / self.normal[0], self.covariance
        )
        per_tangent = 1.0 / (1.0 + self.lean**2 + self.twist**2)
        return degrees(hypot(self.lean_std, twist_std) * per_tangent)

    def x_m(self, z_m: float) -> float:
        """Return x of the plane at a height over the wall and y = 0."""
        return float((1.0 + self.normal @ self.lidar_m - self.normal[2] * z_m) / self.normal[0])

    def x_std_m(self, z_m: float) -> float:
        """Return the standard uncertainty of `x_m`."""
        gradient = (self.lidar_m - np.array([self.x_m(z_m), 0.0, z_m])) / self.normal[0]
        return propagated_std(gradient, self.covariance)

    def hit_points_m(self, view: ClassifiedView) -> Float64:
        """Return each ray's intersection with the plane (height, width, 3), far away where there is
        none.
        """
        return (
            view.pose[:3, 3]
            + view.direction * plane_depth_m(view.rays, self.plane.slopes)[..., np.newaxis]
        )

    def matching_pixels(self, view: ClassifiedView) -> Mask:
        """Return the pixels (height, width) with a depth that fits the plane."""
        return (
            np.abs(view.depth_m - plane_depth_m(view.rays, self.plane.slopes))
            <= GATE_SIGMAS * view.sigma_m
        )


def classify(
    depth_m: Float64, noise: MeanNoise, intrinsics: Intrinsics, pose: Float64
) -> ClassifiedView:
    """Classify pixels as before, on or behind the wall, by more than noise and the wall's own
    error.
    """
    # the height over the wall is z of the point depth x ray in the wall frame; its noise is that of
    # the depth times the ray's component along the normal
    depth_m = np.where(np.isfinite(depth_m) & (depth_m > 0.0), depth_m, np.nan)
    rays = intrinsics.rays()
    along = rays @ pose[2, :3]
    sigma_m = max(noise.scale, 1.0) * depth_noise_m(depth_m)
    height_m = pose[2, 3] + depth_m * along
    band_m = WALL_BAND_M + GATE_SIGMAS * sigma_m * np.abs(along)
    near = (height_m > band_m).astype(np.float32)
    together = cv2.boxFilter(near, -1, (3, 3), borderType=cv2.BORDER_REPLICATE) > NEIGHBOURS
    behind = float((height_m < -band_m).sum() / max(int(np.isfinite(depth_m).sum()), 1))
    return ClassifiedView(
        depth_m, sigma_m, rays, pose, (near > 0) & together, height_m <= band_m, behind
    )


MIN_ROW_PIXELS = 2
"""Sheet pixels in a row of the image that shows the sheet: fewer may be strays."""
GATE_SCATTERS = 3.0
REFITS = 8


@dataclass(frozen=True)
class Edge:
    """Edge as a line z = gap_m + slope x y on the sheet, in the wall frame."""

    gap_m: float
    gap_std_m: float
    """Resolution of the view or scatter of the rows; neither falls with the number of rows, whose
    errors are shared.
    """
    slope: float
    rows: int
    """Number of image rows that show the edge."""


def find_edge(hits_m: Float64, sheet: Mask, passed: Mask) -> Edge | None:
    """Find the edge, from each ray's intersection with the sheet's plane (height, width, 3); None
    if it is not visible.

    `sheet` are pixels that return from the sheet, `passed` those whose beams went by it. A pixel
    that mixes both, reads anything or nothing is neither: the edge lies between the last that
    passed and the first that did not. Heights must grow along each row.
    """
    # Each row votes +1 for a pixel that passed and -1 for the sheet. The running sum of votes at a
    # column is, up to a constant, the number of pixels that an edge there would classify correctly;
    # its maximum is the best edge, also among strays. The plateau of the maximum is the bracket of
    # undecided pixels around the edge.
    height_m = hits_m[..., 2]
    y_m = hits_m[..., 1]
    middle_m = np.median(height_m[sheet])  # beams above it passed another edge of the sheet
    votes = np.where(height_m > middle_m, 0, passed.astype(np.int64) - sheet)
    balance = np.cumsum(votes, axis=1)
    best = balance == balance.max(axis=1, keepdims=True)
    last = best.argmax(axis=1)
    first = votes.shape[1] - best[:, ::-1].argmax(axis=1)
    visible = (balance.max(axis=1) > 0) & (first < votes.shape[1])
    beyond = np.arange(votes.shape[1]) >= first[:, np.newaxis]
    visible &= ((votes < 0) & beyond).sum(axis=1) >= MIN_ROW_PIXELS
    if not visible.any():
        return None
    rows = np.flatnonzero(visible)
    low_m = height_m[rows, last[rows]]
    high_m = height_m[rows, first[rows]]
    across_m = (y_m[rows, last[rows]] + y_m[rows, first[rows]]) / 2.0
    return _line(across_m, (low_m + high_m) / 2.0, high_m - low_m)


def _line(y_m: Float64, z_m: Float64, width_m: Float64) -> Edge:
    """Fit a line through the middles of brackets that are `width_m` wide, without rows far off
    it.
    """
    # the edge is uniform in its bracket, with the standard deviation width / sqrt(12); rows weigh
    # by 1 / width
    line = np.array([np.median(z_m), 0.0])
    inside = np.ones(len(z_m), np.bool_)
    terms = np.column_stack([np.ones_like(y_m), y_m])
    resolution_m = float(np.median(width_m)) / sqrt(12.0)
    for _ in range(REFITS):
        off_m = z_m - terms @ line
        scatter_m = max(SCATTER_PER_MEDIAN * float(np.median(np.abs(off_m))), resolution_m)
        inside = np.abs(off_m) <= GATE_SCATTERS * scatter_m
        line = np.linalg.lstsq(
            terms[inside] / width_m[inside, None], z_m[inside] / width_m[inside]
        )[0]
    scatter_m = float(np.sqrt(np.mean((z_m - terms @ line)[inside] ** 2)))
    return Edge(float(line[0]), max(resolution_m, scatter_m), float(line[1]), len(z_m))


MIN_SHARE = 0.002
MIN_PIXELS = 100
MIN_COLUMNS = 4
"""Smallest share of the view, number of pixels and columns of an occluder; fewer columns leave its
tilt open.
"""
MIN_ON_SHEET = 0.7
WARN_ON_SHEET_SHARE = 0.95
"""Sheet pixels as a share of those in front of the wall."""
MAX_UNEVEN_M = 0.003
"""RMS off its plane, beyond noise: more than the lidar's ripples."""
MIN_ROWS = 0.6
"""Share of the rows in which an endless sheet would be visible."""
MAX_BEHIND = 0.5
WARN_BEHIND_SHARE = 0.02
"""Depths behind the wall as a share of all: light by way of a hidden object. A few leave the sheet
visible.
"""
MAX_TILT_DEG = 5.0
SURE_SIGMAS = 2.0
MIN_GAP_M = 0.005
"""Beside `WALL_BAND_M`, a smaller gap cannot be told from none."""
MAX_GAP_STD_M = 0.005
"""A ruler does better."""
REACH_HEIGHT_M = 0.1
"""Height above the wall, the paper's gap."""
BY_HAND = (
    "measure the wall again with its position and gap by hand (--wall --occluder-x-m X"
    " --occluder-gap-m G)"
)


@dataclass(frozen=True, eq=False)
class OccluderFit:
    """A detected sheet x = x_m, z >= gap_m of the wall frame; 1.96 of the *_std hold 95 % or
    more.
    """

    x_m: float
    """Position of the edge, at y = 0."""
    x_std_m: float
    gap_m: float
    gap_std_m: float
    tilt_deg: float
    """Angle against the plane x = x_m, about wall y; positive leans away from the lidar."""
    tilt_std_deg: float
    twist_deg: float
    """Angle about wall z; positive where x grows with y."""
    edge_deg: float
    """Angle of the edge against the wall; positive where the gap grows with y."""
    residual_m: float
    """RMS distance of the sheet's points from its plane."""
    pixels: Mask = field(repr=False)
    """(height, width); inliers of the sheet's plane."""
    warnings: tuple[str, ...]
    why_unusable: str = ""
    """Reason not to use the reference that was taken along: an object seems to be hidden."""


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
    """Find the occluder in a mean depth map (height, width) of the bench with it in place and
    nothing hidden.

    `noise` is that of the flattened map; the depth has the corrections of the one that the wall was
    fitted to, and *_std are the uncertainties of the wall's pose (4, 4). Raises
    OccluderRefusedError without a sheet whose edge can be trusted.
    """
    view = classify(depth_m, noise, intrinsics, wall_from_lidar)
    _check_in_view(view)
    sheet = _sheet(view, noise, generator)
    hits_m = sheet.hit_points_m(view)
    pixels = sheet.plane.inliers.reshape(depth_m.shape)
    _check_upright(sheet, float(np.median(hits_m[pixels][:, 2])))
    # pixels that fit both, where the sheet comes near the wall, are neither
    edge = _edge(hits_m, pixels, view.passed & ~sheet.matching_pixels(view))
    x_m = sheet.x_m(edge.gap_m)
    x_std_m = sheet.x_std_m(edge.gap_m)
    yaw_std = radians(yaw_std_deg)
    above_m = wall_from_lidar[2, 3] - edge.gap_m
    # The beam that grazes the edge is known; it falls by above / x, so that a sheet farther by dx
    # has its edge lower by dx above / x. An error of the wall's yaw turns the edge about the lidar,
    # by x dyaw in z and above dyaw in x. The contributions are independent and add in squares.
    gap_std_m = hypot(edge.gap_std_m, above_m / x_m * x_std_m, distance_std_m, x_m * yaw_std)
    fit = OccluderFit(
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
        warnings=_warnings(sheet),
        why_unusable=_sign_of_object(view),
    )
    _check_edge(fit)
    return fit


def _check_in_view(view: ClassifiedView) -> None:
    """Refuse a view that an object fills, or with nothing in front of the wall."""
    if view.behind_share > MAX_BEHIND:
        raise OccluderRefusedError(
            f"{view.behind_share:.0%} of the depth is behind the wall ({MAX_BEHIND:.0%} allowed),"
            " by way of a hidden object: remove the object, leave the occluder, and record again"
        )
    if view.near.sum() >= max(MIN_SHARE * view.near.size, MIN_PIXELS):
        columns = np.median(view.near.sum(axis=1)[view.near.any(axis=1)])
        if columns >= MIN_COLUMNS:
            return
        raise OccluderRefusedError(
            f"the occluder fills {columns:.0f} columns of the view, {MIN_COLUMNS} needed: turn the"
            f" lidar towards the occluder, or {BY_HAND}"
        )
    # x at which the farthest beam of the middle row is as near to the wall as an edge might be
    x, _, z = view.direction[len(view.direction) // 2].T
    reach = "reach without end"
    if (z < 0.0).all():
        reach_m = (x / -z).max() * max(view.pose[2, 3] - REACH_HEIGHT_M, 0.0)
        reach = f"reach to x = {reach_m:.2f} m"
    raise OccluderRefusedError(
        f"no occluder is in view: {REACH_HEIGHT_M:.2f} m off the wall the beams of this pose"
        f" {reach} and meet nothing in front of the wall: move it into their way, or {BY_HAND}"
    )


def _sheet(view: ClassifiedView, noise: MeanNoise, generator: np.random.Generator) -> SheetFit:
    """Fit the plane of most pixels in front of the wall, and refuse anything that is not flat."""
    # No least width is asked of its inliers (min_extent 0): a sheet may show as a narrow strip,
    # whose tilt is then uncertain and says so in the covariance.
    near_m = np.where(view.near, view.depth_m, np.nan)
    try:
        plane = fit_depth(
            view.rays.reshape(-1, 3), near_m.ravel(), generator, noise, min_extent=0.0
        )
    except WallRefusedError as error:
        raise OccluderRefusedError(_no_sheet("its points lie on no plane")) from error
    if plane.inlier_fraction < MIN_ON_SHEET:
        raise OccluderRefusedError(_no_sheet(f"{plane.inlier_fraction:.0%} of it lie on a plane"))
    turn = view.pose[:3, :3]
    rippled = ripples(plane, view.rays)
    if rippled.rms_m > MAX_UNEVEN_M:
        raise OccluderRefusedError(_no_sheet(f"{rippled.rms_m * 1e3:.1f} mm RMS off a plane"))
    return SheetFit(
        plane, turn @ plane.slopes, turn @ rippled.covariance @ turn.T, view.pose[:3, 3]
    )


def _no_sheet(why: str) -> str:
    return (
        f"the object in front of the wall is not a flat sheet ({why}): remove all but the occluder,"
        f" or {BY_HAND}"
    )


def _check_upright(sheet: SheetFit, middle_m: float) -> None:
    """Refuse a sheet that leans, or stands where no object can be hidden behind it."""
    if sheet.tilt_deg - SURE_SIGMAS * sheet.tilt_std_deg > MAX_TILT_DEG:
        lean_deg = degrees(np.arctan(sheet.lean))
        twist_deg = degrees(np.arctan(sheet.twist))
        raise OccluderRefusedError(
            f"the occluder is {sheet.tilt_deg:.1f} degrees off the plane x = const"
            f" ({MAX_TILT_DEG:.0f} allowed): it leans by {lean_deg:+.1f} and is twisted by"
            f" {twist_deg:+.1f}; set it upright on the wall and level with it"
        )
    if (x_m := sheet.x_m(middle_m)) <= 0.0:
        raise OccluderRefusedError(
            f"the occluder stands at x = {x_m:.3f} m, on the wrong side of the lidar: {OBJECT_SIDE}"
        )


def _edge(hits_m: Float64, pixels: Mask, passed: Mask) -> Edge:
    """Find the sheet's edge; refuse one that is out of view, touches the wall, or ends in the
    middle of the view.
    """
    # Rows whose beams rise to the sheet's middle must show it: a real sheet has no end in y.
    lowest_m, middle_m = np.percentile(hits_m[pixels][:, 2], (5.0, 50.0))
    expected = hits_m[..., 2].max(axis=1) > middle_m
    rows = pixels.sum(axis=1) >= MIN_ROW_PIXELS
    if (rows & expected).sum() < MIN_ROWS * expected.sum():
        share = (rows & expected).sum() / max(expected.sum(), 1)
        raise OccluderRefusedError(_no_sheet(f"visible in {share:.0%} of the rows"))
    edge = find_edge(hits_m, pixels, passed)
    if edge is None or edge.rows < MIN_ROWS * rows.sum():
        raise OccluderRefusedError(
            f"the occluder's edge is out of view: the sheet is visible from {lowest_m:.3f} m off"
            f" the wall on, without wall beside it; turn the lidar away from it, or {BY_HAND}"
        )
    return edge


def _check_edge(fit: OccluderFit) -> None:
    """Refuse a gap that is too small or too uncertain, and a tilted edge."""
    # A gap is one only if it exceeds its own uncertainty and what the wall's error can feign.
    if fit.gap_m < max(MIN_GAP_M, SURE_SIGMAS * fit.gap_std_m):
        gap = with_mm(fit.gap_m, fit.gap_std_m)
        raise OccluderRefusedError(
            f"the occluder touches the wall (gap {gap}): leave 0.05 to 0.20 m for the light"
        )
    if fit.gap_std_m > MAX_GAP_STD_M:
        raise OccluderRefusedError(
            f"the occluder's edge, {fit.gap_m:.2f} m off the wall, is uncertain by"
            f" {fit.gap_std_m * 1e3:.0f} mm ({MAX_GAP_STD_M * 1e3:.0f} mm allowed): too few pixels"
            f" beside it have depth; {BY_HAND}"
        )
    if abs(fit.edge_deg) > MAX_TILT_DEG:
        raise OccluderRefusedError(
            f"the occluder's edge is {abs(fit.edge_deg):.1f} degrees off the wall"
            f" ({MAX_TILT_DEG:.0f} allowed): make the gap the same from top to bottom"
        )


def _sign_of_object(view: ClassifiedView) -> str:
    """Return the sign of a hidden object in the view, whose echoes the reference then holds too;
    else empty.
    """
    if view.behind_share <= WARN_BEHIND_SHARE:
        return ""
    return f"an object seems to be hidden ({view.behind_share:.0%} of the depth is behind the wall)"


def _warnings(sheet: SheetFit) -> tuple[str, ...]:
    """Return remarks on an occluder that was found nevertheless."""
    if sheet.plane.inlier_fraction >= WARN_ON_SHEET_SHARE:
        return ()
    off = 1.0 - sheet.plane.inlier_fraction
    remark = f"{off:.0%} of the pixels in front of the wall are not on the occluder"
    return (f"{remark}: remove everything else",)
