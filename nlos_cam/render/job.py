"""Input of every backend: the transport of one render problem in float64, with the radiometry
resolved to factors.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from nlos_calibration.arrays import Float64, Int64
from numpy.typing import NDArray

from nlos_cam.render.accuracy import Accuracy
from nlos_cam.render.geometry import NEAR_DIAGONALS, Relay, contact_m2, softened, solid_angle
from nlos_cam.render.material import Brdf
from nlos_cam.render.patches import Patches
from nlos_cam.render.visibility import HeightField


class PatchArrays(NamedTuple):
    """Patches (n) as columns for compiled loops."""

    point_m: Float64
    normal: Float64
    strength: Float64
    """Albedo times true area."""
    soft_m2: Float64
    """Near-contact term."""
    row: Int64
    column: Int64


@dataclass(frozen=True)
class TransportJob:
    """Three-bounce transport of some beams: beams, patches, relay wall and all else that decides
    their histograms.
    """

    laser_spot_m: Float64
    """(n, 3); points where the beams land on the wall."""
    length_m: Float64
    """(n,); d1."""
    cos_incidence: Float64
    """(n,); cos t1."""
    patches: Patches
    relay: Relay
    lidar_m: Float64
    """(3,)."""
    edge_m: tuple[float, float]
    """(x, z) of the occluder's edge."""
    field: HeightField
    lambertian: bool
    receiver_cell_m2: float
    bin_m: float
    bins: int
    accuracy: Accuracy
    wall_m: tuple[float, float, float, float]
    """(x_min, x_max, y_min, y_max) of the physical wall, for interreflection."""
    brdf: Brdf | None = None
    """None is Lambertian."""
    more_bounces: bool = False
    """True to include interreflection."""

    def select(self, which: NDArray[np.int64]) -> "TransportJob":
        """Return the job for some of its beams (indices)."""
        beams = {
            name: getattr(self, name)[which]
            for name in ("laser_spot_m", "length_m", "cos_incidence")
        }
        return replace(self, **beams)

    @property
    def solid_angle(self) -> float:
        """Solid angle over which each bounce spreads its light."""
        return solid_angle(lambertian=self.lambertian)

    @cached_property
    def near_m(self) -> float:
        """Distance in meters at which near contact begins."""
        return NEAR_DIAGONALS * max(self.patches.diagonal_m, self.relay.diagonal_m)

    @cached_property
    def soft_patch_m2(self) -> Float64:
        """(n,); near-contact term added to d2^2 at a patch."""
        return contact_m2(self.patches.area_m2, self.solid_angle)

    @property
    def soft_wall_m2(self) -> float:
        """Near-contact term added to d3^2 at a cell of the relay wall."""
        return contact_m2(self.relay.cell_m2, self.solid_angle)

    @cached_property
    def beam_weight(self) -> Float64:
        """(n,); factors of S2 that depend on the beam alone."""
        # A beam's power lands on its spot whatever the angle: the cosine t1 is a factor of S2
        # alone.
        return (
            np.ones_like(self.cos_incidence) if self.lambertian else self.cos_incidence
        ) / self.solid_angle

    @cached_property
    def relay_weight(self) -> Float64:
        """(m,); factors of S2 that depend on the relay cell alone: its area, and the leg from it to
        the lidar.
        """
        # S2 falls with 1 / d^2 on each leg; from the wall back to the lidar that leg is fixed for a
        # cell. Near contact the area of the cell bounds it (see `softened`), or a cell below the
        # lidar would send back more than it got.
        relay = self.relay
        squared = softened(relay.length_m**2, self.soft_wall_m2, self.near_m)
        weight = relay.cell_m2 / (self.solid_angle**2 * squared)
        return weight * self.receiver_cell_m2 * relay.cos_lidar if self.lambertian else weight

    @cached_property
    def strength(self) -> Float64:
        """(n,); factors of S2 that depend on the patch alone: albedo times true area."""
        return self.patches.albedo * self.patches.area_m2

    @property
    def patch_arrays(self) -> PatchArrays:
        """Patches as columns for compiled loops."""
        # Flat columns: numba indexes them without an object in between.
        p = self.patches
        return PatchArrays(p.point_m, p.normal, self.strength, self.soft_patch_m2, p.row, p.column)


def count_near_legs(job: TransportJob) -> int:
    """Return the number of legs between patches and wall that are shorter than near contact."""
    # A patch deeper than near contact has no such leg, so only the others are searched.
    reach = job.near_m**2
    count = 0
    for point in job.patches.point_m[job.patches.point_m[:, 2] < job.near_m]:
        for x, y in (
            (job.laser_spot_m[:, 0], job.laser_spot_m[:, 1]),
            (job.relay.x_m, job.relay.y_m),
        ):
            count += int(
                (((x - point[0]) ** 2 + (y - point[1]) ** 2 + point[2] ** 2) < reach).sum()
            )
    return count
