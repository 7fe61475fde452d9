"""How much light goes which way, told from a coarse look: some beams, some relay cells, every patch.

The verdicts on effects need to know what leaving one out would change, for a small part of what rendering costs.
"""

from dataclasses import dataclass

import numba
import numpy as np
from nlos_calibration.arrays import Float64
from numpy.typing import NDArray

from nlos_cam.render.geometry import NO_OCCLUDER, Beams, Relay, softened
from nlos_cam.render.interreflection import AROUND_M
from nlos_cam.render.job import TransportJob
from nlos_cam.render.patches import Patches
from nlos_cam.render.visibility import BIAS_CELLS, HeightField, occluded

SAMPLE_BEAMS, SAMPLE_CELLS = 160, 96
CAUTION = 1.5
"""What is told from a coarse look is taken this much larger before it is called a bound."""


@dataclass(frozen=True)
class EnergySurvey:
    """For each patch (n,): the light that reaches it from the beams, and that which the lidar gets of what it gives."""

    taken: Float64
    given: Float64
    taken_tilt: Float64
    """How much of it changes, beam by beam, where the patch is taken to face the wall squarely."""
    given_tilt: Float64
    taken_cut: Float64
    """How much more it would be without the occluder."""
    given_cut: Float64
    uneven: float
    """How many times as much a BRDF may make one patch give as another."""

    @property
    def energy(self) -> Float64:
        """(n,); of three bounces over each patch."""
        return self.taken * self.given

    def share(self, change: Float64) -> float:
        """A change of each patch's energy (n,) as a bound on the relative change of the whole, 1 being all or more."""
        whole, part = float(self.energy.sum()), CAUTION * self.uneven * float(change.sum())
        return min(part / whole, 1.0) if whole > 0 else float(part > 0)

    @property
    def tilt(self) -> float:
        """What leaving tilt out changes at most."""
        return self.share(self.taken_tilt * (self.given + self.given_tilt) + self.taken * self.given_tilt)

    @property
    def occluder(self) -> float:
        """What leaving the occluder out changes at most."""
        return self.share((self.taken + self.taken_cut) * (self.given + self.given_cut) - self.energy)


def survey(job: TransportJob, uneven: float) -> EnergySurvey:
    """Look at some beams of a job, and some cells of its relay, which is whole: none cut off by the occluder.

    `uneven` is how many times as much a BRDF may make one patch give as another.
    """
    patches, relay = job.patches, job.relay
    lit = slice(None, None, max(len(job.foot_m) // SAMPLE_BEAMS, 1))
    some = slice(None, None, max(len(relay.x_m) // SAMPLE_CELLS, 1))
    shape, start = (patches.point_m, patches.normal, patches.beta), job.beam_weight[lit]
    feet = job.foot_m[lit, 0], job.foot_m[lit, 1], start, np.zeros(len(start), np.bool_)
    hidden = relay.behind(job.edge_m, job.lidar_m)[some]
    cells = relay.x_m[some], relay.y_m[some], job.relay_weight[some], hidden
    soft_wall = np.full_like(patches.beta, job.soft_wall_m2)
    taken = _sums(*shape, *feet, job.soft_patch_m2, job.near_m, *job.edge_m, job.lambertian, False)
    given = _sums(*shape, *cells, soft_wall, job.near_m, *job.edge_m, job.lambertian, True)
    scale = job.strength / len(start)
    return EnergySurvey(taken[0] * scale, given[0], taken[1] * scale, given[1], taken[2] * scale, given[2], uneven)


@numba.njit(cache=True, parallel=True)
def _sums(
    points: Float64,
    normals: Float64,
    beta: Float64,
    x: Float64,
    y: Float64,
    weight: Float64,
    hidden: NDArray[np.bool_],
    soft: Float64,
    near_m: float,
    edge_x: float,
    edge_z: float,
    lambertian: bool,
    outgoing: bool,
) -> Float64:
    """Sums (3, n) over points of the wall: the light, what tilt changes of it, what the occluder cuts off."""
    sums = np.zeros((3, len(points)))
    for s in numba.prange(len(points)):
        point, normal = points[s], normals[s]
        for w in range(len(x)):
            dx, dy, z = x[w] - point[0], y[w] - point[1], point[2]
            squared = dx * dx + dy * dy + z * z
            length = max(np.sqrt(squared), 1e-12)  # where the object touches the wall
            at_wall = z / length
            tilted = max(normal[0] * dx + normal[1] * dy - normal[2] * z, 0.0) / length
            # from the lidar a patch takes by its cosine and area, towards it gives (paper) whatever its cosine
            bent = (tilted if lambertian else (1.0 if tilted > 0 else 0.0)) if outgoing else tilted
            level = (at_wall if lambertian else (1.0 if at_wall > 0 else 0.0)) if outgoing else at_wall / beta[s]
            if outgoing or lambertian:
                bent, level = bent * at_wall, level * at_wall
            light = weight[w] / softened(squared, soft[s], near_m)
            if hidden[w] or occluded(point[0], z, x[w], 0.0, edge_x, edge_z):
                sums[2, s] += light * bent
            else:
                sums[0, s] += light * bent
                sums[1, s] += light * abs(bent - level)
    return sums


def occluder_meets(edge_m: tuple[float, float], patches: Patches, beams: Beams, relay: Relay) -> bool:
    """Whether the occluder may cut any leg between wall and patches or wall and lidar; never wrongly no."""
    if edge_m == NO_OCCLUDER:
        return False
    if relay.behind(edge_m, beams.lidar_m).any():
        return True
    feet = beams.foot_m[beams.on_wall, 0]
    x, z = patches.point_m[:, 0], patches.point_m[:, 2]
    # inter-reflection goes over the wall about the object too
    least = min(relay.x_m.min(), feet.min(initial=np.inf), x.min() - AROUND_M)
    most = max(relay.x_m.max(), feet.max(initial=-np.inf), x.max() + AROUND_M)
    with np.errstate(divide="ignore", invalid="ignore"):
        from_right = (x > edge_m[0]) & (least < edge_m[0]) & (z * (edge_m[0] - least) / (x - least) >= edge_m[1])
        from_left = (x < edge_m[0]) & (most > edge_m[0]) & (z * (most - edge_m[0]) / (most - x) >= edge_m[1])
    return bool((from_right | from_left).any())


def shaded(patches: Patches, field: HeightField) -> NDArray[np.bool_]:
    """Which patches (n,) have another rise above their tangent plane: the rest of the surface is its lower convex hull.

    Only such a patch can be shaded: what stays below the tangent plane cannot cut a leg to the lit side.
    """
    point, slope = patches.point_m.astype(np.float32), patches.slope.astype(np.float32)
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
        lowest = np.float32(1e9)
        for t in range(len(x)):
            height = z[t] - slope_x[s] * x[t] - slope_y[s] * y[t]
            lowest = min(lowest, height)
        result[s] = lowest < z[s] - slope_x[s] * x[s] - slope_y[s] * y[s] - bias
    return result
