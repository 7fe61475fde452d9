"""What every implementation of the renderer is given: a scene as its plan wants it, in float64, radiometry resolved."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from nlos_calibration.arrays import Float64
from numpy.typing import NDArray

from nlos_cam.render.accuracy import Accuracy
from nlos_cam.render.geometry import NEAR_DIAGONALS, Relay, contact_m2, softened, solid_angle
from nlos_cam.render.material import Brdf
from nlos_cam.render.patches import Patches
from nlos_cam.render.visibility import HeightField


@dataclass(frozen=True)
class TransportJob:
    """Some beams, the patches, the relay wall and all that decides their three-bounce histograms."""

    foot_m: Float64
    """(n, 3); where the beams land on the wall."""
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
    map_foot_m: Float64
    """(k, 3); of every beam of the map: a BRDF is tabulated among these, whichever of them are rendered."""
    wall_m: tuple[float, float, float, float]
    """(x_min, x_max, y_min, y_max) of the physical wall, which inter-reflection goes over."""
    brdf: Brdf | None = None
    """None is Lambertian."""
    more_bounces: bool = False
    """Whether inter-reflection is wanted."""

    def some(self, which: NDArray[np.int64]) -> "TransportJob":
        """The same for some of the beams."""
        beams = {name: getattr(self, name)[which] for name in ("foot_m", "length_m", "cos_incidence")}
        return replace(self, **beams)

    @property
    def solid_angle(self) -> float:
        """What each bounce spreads its light over."""
        return solid_angle(lambertian=self.lambertian)

    @cached_property
    def near_m(self) -> float:
        """The distance at which near contact begins."""
        return NEAR_DIAGONALS * max(self.patches.diagonal_m, self.relay.diagonal_m)

    @cached_property
    def soft_patch_m2(self) -> Float64:
        """(n,); what near contact adds to d2^2 at a patch."""
        return contact_m2(self.patches.area_m2, self.solid_angle)

    @property
    def soft_wall_m2(self) -> float:
        """The same for d3^2 at a cell of the relay wall."""
        return contact_m2(self.relay.cell_m2, self.solid_angle)

    @cached_property
    def beam_weight(self) -> Float64:
        """(n,); what of S2 depends on the beam alone."""
        return (np.ones_like(self.cos_incidence) if self.lambertian else self.cos_incidence) / self.solid_angle

    @cached_property
    def relay_weight(self) -> Float64:
        """(m,); what of S2 depends on the relay cell alone: its area, and the way from it to the lidar."""
        relay = self.relay
        squared = softened(relay.length_m**2, self.soft_wall_m2, self.near_m)
        weight = relay.cell_m2 / (self.solid_angle**2 * squared)
        return weight * self.receiver_cell_m2 * relay.cos_lidar if self.lambertian else weight

    @cached_property
    def strength(self) -> Float64:
        """(n,); what of S2 depends on the patch alone: albedo times true area."""
        return self.patches.albedo * self.patches.area_m2


def near_legs(job: TransportJob) -> int:
    """How many legs between patches and wall are shorter than near contact."""
    reach, count = job.near_m**2, 0
    for point in job.patches.point_m[job.patches.point_m[:, 2] < job.near_m]:
        for x, y in ((job.foot_m[:, 0], job.foot_m[:, 1]), (job.relay.x_m, job.relay.y_m)):
            count += int((((x - point[0]) ** 2 + (y - point[1]) ** 2 + point[2] ** 2) < reach).sum())
    return count
