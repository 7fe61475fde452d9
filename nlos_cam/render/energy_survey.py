"""Coarse survey of the light over each patch, from some beams and some relay cells.

The plan's verdicts need the change that leaving an effect out would make, for a small part of the
cost of rendering. S2 factorizes at the patch: the energy over patch s is (sum over beams of A) x
(sum over relay cells of B). So both sums, with and without an effect, bound the change of the
whole.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from nlos_calibration.arrays import Float64
from numpy.typing import NDArray

from nlos_cam.render.geometry import NO_OCCLUDER, Beams, Relay, softened_leg, spread
from nlos_cam.render.interreflection import AROUND_M
from nlos_cam.render.job import TransportJob
from nlos_cam.render.patches import Patches
from nlos_cam.render.visibility import BIAS_CELLS, HeightField

SAMPLE_BEAMS = 160
SAMPLE_CELLS = 96
CAUTION = 1.5
"""Factor on every surveyed change before it is used as a bound."""


class SurveyPatches(NamedTuple):
    """Patches (n) as the compiled sum takes them."""

    point_m: Float64
    """(n, 3)."""
    normal: Float64
    """(n, 3)."""
    beta: Float64
    soft_m2: Float64
    """Near-contact term of the leg's receiver."""


class SurveyPoints(NamedTuple):
    """Points (m) of the wall: laser spots or relay cells."""

    x_m: Float64
    y_m: Float64
    weight: Float64
    hidden: NDArray[np.bool_]
    """True where the occluder cuts the leg to the lidar."""


@dataclass(frozen=True)
class EnergySurvey:
    """Light per patch (n,): incident from the beams, and the share of it returned to the lidar over
    the relay wall.
    """

    incident: Float64
    returned: Float64
    incident_tilt: Float64
    """Change of incident light, summed beam by beam, if the patch faces the wall squarely."""
    returned_tilt: Float64
    incident_cut: Float64
    """Light that the occluder keeps from the patch."""
    returned_cut: Float64
    uneven: float
    """Largest ratio of light between two patches that a BRDF may cause."""

    @property
    def energy(self) -> Float64:
        """(n,); energy of three bounces over each patch."""
        return self.incident * self.returned

    def share(self, change: Float64) -> float:
        """Return a bound on the relative change of the whole, at most 1, for a change of each
        patch's energy (n,).
        """
        # A BRDF may give the changed patches up to `uneven` times the others' light.
        whole = float(self.energy.sum())
        part = CAUTION * self.uneven * float(change.sum())
        # Where the sample finds no light at all, nothing is known of what an effect changes.
        return min(part / whole, 1.0) if whole > 0 else float(change.size > 0)

    @property
    def tilt(self) -> float:
        """Bound on the change if tilt is left out."""
        return self.share(
            # (A + a)(B + b) - A B = a (B + b) + A b, with |a| and |b| the sums of changes leg by
            # leg.
            self.incident_tilt * (self.returned + self.returned_tilt)
            + self.incident * self.returned_tilt
        )

    @property
    def occluder(self) -> float:
        """Bound on the change if the occluder is left out."""
        return self.share(
            (self.incident + self.incident_cut) * (self.returned + self.returned_cut) - self.energy
        )


def survey(job: TransportJob, uneven: float) -> EnergySurvey:
    """Return the survey of a job whose relay is whole: no cells removed behind the occluder.

    `uneven` is the largest ratio of light between two patches that a BRDF may cause.
    """
    relay = job.relay
    lit = spread(len(job.laser_spot_m), SAMPLE_BEAMS)
    some = spread(len(relay.x_m), SAMPLE_CELLS)
    weight = job.beam_weight[lit]
    # Every leg from a spot's beam to the lidar is free: the beam would not light the wall else.
    feet = _contiguous(
        job.laser_spot_m[lit, 0], job.laser_spot_m[lit, 1], weight, np.zeros(len(weight), np.bool_)
    )
    cells = _contiguous(
        relay.x_m[some],
        relay.y_m[some],
        job.relay_weight[some],
        relay.behind(job.edge_m, job.lidar_m)[some],
    )

    # The near-contact term belongs to the leg's receiver: the patch, then the relay cell.
    patches = job.patches
    lit_patches = SurveyPatches(patches.point_m, patches.normal, patches.beta, job.soft_patch_m2)
    soft_wall = np.full_like(patches.beta, job.soft_wall_m2)
    edge = job.near_m, *job.edge_m, job.lambertian
    incident = _sums(lit_patches, feet, *edge, False)
    returned = _sums(lit_patches._replace(soft_m2=soft_wall), cells, *edge, True)
    # Sums over samples: their scale cancels in every share.
    scale = job.strength / len(weight)
    return EnergySurvey(
        incident[0] * scale,
        returned[0],
        incident[1] * scale,
        returned[1],
        incident[2] * scale,
        returned[2],
        uneven,
    )


def _contiguous(x: Float64, y: Float64, weight: Float64, hidden: NDArray[np.bool_]) -> SurveyPoints:
    """Return points of the wall in one layout, so that `_sums` is compiled once."""
    return SurveyPoints(
        np.ascontiguousarray(x),
        np.ascontiguousarray(y),
        np.ascontiguousarray(weight),
        np.ascontiguousarray(hidden),
    )


@numba.njit(cache=True, parallel=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _sums(
    patches: SurveyPatches,
    wall: SurveyPoints,
    near_m: float,
    edge_x: float,
    edge_z: float,
    lambertian: bool,
    outgoing: bool,
) -> Float64:
    """Return sums (3, n) over points of the wall: light, its change by tilt, and light that the
    occluder cuts off.
    """
    points = patches.point_m
    normals = patches.normal
    x = wall.x_m
    y = wall.y_m
    sums = np.zeros((3, len(points)))
    for s in numba.prange(len(points)):
        point_x = points[s, 0]
        point_y = points[s, 1]
        z = points[s, 2]
        area = patches.beta[s]
        normal_x = normals[s, 0]
        normal_y = normals[s, 1]
        behind = normals[s, 2] * z
        soft = patches.soft_m2[s]
        seen = 0.0
        changed = 0.0
        cut = 0.0
        to_edge = edge_x - point_x
        for w in range(len(x)):
            dx = x[w] - point_x
            dy = y[w] - point_y
            squared = dx * dx + dy * dy + z * z
            length = max(np.sqrt(squared), 1e-12)  # where the object touches the wall
            at_wall = z / length
            tilted = max(normal_x * dx + normal_y * dy - behind, 0.0) / length
            # Incident light goes with the patch's cosine and area; returned light goes with it in
            # Lambertian radiometry, and in the paper's only with the side that is lit. A level
            # patch has cos = z / d and area / beta.
            bent = tilted
            level = at_wall
            if not outgoing:
                level = at_wall / area
            elif not lambertian:
                bent = 1.0 if tilted > 0 else 0.0
                level = 1.0 if at_wall > 0 else 0.0
            # The wall's own cosine: of received light always, of emitted light in Lambertian
            # radiometry.
            slant = at_wall if outgoing or lambertian else 1.0
            light = wall.weight[w] * slant / softened_leg(squared, soft, near_m)
            # As in `visibility.occluded`, without its branch: the loop is made of vectors.
            crosses = (to_edge * (edge_x - x[w]) < 0) & (
                z - to_edge / (dx if dx != 0 else 1.0) * z >= edge_z
            )
            open_share = 0.0 if wall.hidden[w] | crosses else 1.0
            seen += open_share * light * bent
            changed += open_share * light * abs(bent - level)
            cut += (1.0 - open_share) * light * bent
        sums[0, s] = seen
        sums[1, s] = changed
        sums[2, s] = cut
    return sums


def occluder_meets(
    edge_m: tuple[float, float], patches: Patches, beams: Beams, relay: Relay
) -> bool:
    """Return whether the occluder may cut any leg between wall and patches or wall and lidar; never
    wrongly False.
    """
    if edge_m == NO_OCCLUDER:
        return False
    if relay.behind(edge_m, beams.lidar_m).any():
        return True

    feet = beams.laser_spot_m[beams.on_wall, 0]
    x = patches.point_m[:, 0]
    z = patches.point_m[:, 2]
    # The occluder is the half plane x = edge_x, z >= edge_z, parallel to y: heights alone decide.
    # Wall points range from `least` to `most`, interreflection around the object included. The leg
    # to the farthest of them is the highest where it crosses the edge: z (edge - end) / (x - end)
    # by similar triangles.
    least = min(relay.x_m.min(), feet.min(initial=np.inf), x.min() - AROUND_M)
    most = max(relay.x_m.max(), feet.max(initial=-np.inf), x.max() + AROUND_M)
    with np.errstate(divide="ignore", invalid="ignore"):
        from_right = (
            (x > edge_m[0])
            & (least < edge_m[0])
            & (z * (edge_m[0] - least) / (x - least) >= edge_m[1])
        )
        from_left = (
            (x < edge_m[0])
            & (most > edge_m[0])
            & (z * (most - edge_m[0]) / (most - x) >= edge_m[1])
        )
    return bool((from_right | from_left).any())


def shaded(patches: Patches, field: HeightField) -> NDArray[np.bool_]:
    """Return a mask (n,) of the patches with another above their tangent plane: those off the lower
    convex hull.

    Only such a patch can be shaded: a surface below the tangent plane cannot cut a leg to the lit
    side.
    """
    point = patches.point_m.astype(np.float32)
    slope = patches.slope.astype(np.float32)
    bias = np.float32(BIAS_CELLS * max(field.pitch_x_m, field.pitch_y_m))
    x, y, z = (np.ascontiguousarray(point[:, axis]) for axis in range(3))
    return _rises_above(x, y, z, slope[:, 0].copy(), slope[:, 1].copy(), bias)


@numba.njit(cache=True, parallel=True, fastmath={"contract", "reassoc", "nsz"})
def _rises_above(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    z: NDArray[np.float32],
    slope_x: NDArray[np.float32],
    slope_y: NDArray[np.float32],
    bias: np.float32,
) -> NDArray[np.bool_]:
    result = np.zeros(len(x), np.bool_)
    for s in numba.prange(len(x)):
        # Patch t is above the tangent plane of s if z_t - g . (x_t - x_s) < z_s - bias, as smaller
        # z is nearer to the wall.
        lowest = np.float32(1e9)
        for t in range(len(x)):
            height = z[t] - slope_x[s] * x[t] - slope_y[s] * y[t]
            lowest = min(lowest, height)
        result[s] = lowest < z[s] - slope_x[s] * x[s] - slope_y[s] * y[s] - bias
    return result
