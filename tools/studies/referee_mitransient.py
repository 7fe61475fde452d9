"""mitransient's side of the referee: its scenes, and Monte-Carlo transients of single beams in our units.

A pixel of its sensor holds the radiance from a point of the wall, for a laser that puts its power on a square unit
about the beam's foot. The three 1 / pi and the cosines of the two legs to the object are included; the wall cell's area
and the receiver's solid angle from there are multiplied in. Nothing is fitted.

Lengths are passed in millimetres about the middle of the relay wall: a ray starts 9e-5 (1 + largest coordinate) off its
surface, which is a visible 0.1 mm in metres, and 0.02 mm so. `filter_bounces` is off by one in 1.3.1; max_depth 3
leaves only the three-bounce paths, because a flat wall sends nothing to itself.
"""

import os
import time
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from nlos_calibration import Extent, LidarPose, ObjectBox, Rig
from nlos_calibration.arrays import Float64
from numpy.typing import NDArray

from nlos_cam.objects import cell_centers_m
from nlos_cam.render import Radiometry, Scene

SLOPE_X, SLOPE_Y = 0.3, 0.2
"""dz/dx and dz/dy of every face."""
WALL = Extent(x_min_m=0.05, x_max_m=0.45, y_min_m=-0.2, y_max_m=0.2)
BOX = ObjectBox(x_min_m=0.25, x_max_m=0.45, y_min_m=-0.1, y_max_m=0.1, z_near_m=0.12, z_far_m=0.4)
RIG = Rig(name="referee", lidar=LidarPose(distance_m=0.2, yaw_deg=45.0), wall=WALL, relay=WALL, object_box=BOX)
"""The paper's lidar without its occluder, in front of a wall that ends where the relay wall does."""


@dataclass(frozen=True)
class Face:
    """A rectangle of the object box, seen along z, on a slanted plane."""

    x_min_m: float
    x_max_m: float
    y_min_m: float
    y_max_m: float
    z_m: float
    """Of the plane, at the middle of the object box."""

    def depth_m(self, x_m: Float64, y_m: Float64) -> Float64:
        """Return the plane's depth at points of the wall."""
        middle = (BOX.x_min_m + BOX.x_max_m) / 2, (BOX.y_min_m + BOX.y_max_m) / 2
        return self.z_m + SLOPE_X * (x_m - middle[0]) + SLOPE_Y * (y_m - middle[1])

    def covers(self, x_m: Float64, y_m: Float64) -> NDArray[np.bool_]:
        """Mask the points of the wall in front of the face."""
        return (x_m > self.x_min_m) & (x_m < self.x_max_m) & (y_m > self.y_min_m) & (y_m < self.y_max_m)

    @property
    def corners_m(self) -> Float64:
        """(4, 3); in the order that makes the face look at the wall."""
        x = np.array([self.x_min_m, self.x_min_m, self.x_max_m, self.x_max_m])
        y = np.array([self.y_min_m, self.y_max_m, self.y_max_m, self.y_min_m])
        return np.stack([x, y, self.depth_m(x, y)], axis=-1)

    @property
    def sides_m(self) -> Float64:
        """(4, 4, 3); the walls of the column that a depth map makes of the face, down to the box's far end."""
        rim = self.corners_m
        foot = np.concatenate([rim[:, :2], np.full((4, 1), BOX.z_far_m)], axis=1)
        return np.stack([rim, np.roll(rim, -1, 0), np.roll(foot, -1, 0), foot], axis=1)


PLATE = (Face(0.25, 0.45, -0.1, 0.1, 0.22),)
"""No part of it shades another."""
STEP = (*PLATE, Face(0.3, 0.35, -0.05, 0.05, 0.18))
"""The plate with a block on it, whose shadow falls on the plate."""


def depth_map(faces: tuple[Face, ...], cells: int) -> NDArray[np.float32]:
    """Return the depth (cells, cells) of the face nearest to the wall; NaN for none."""
    x, y = np.meshgrid(*cell_centers_m(BOX, cells))
    depths = [np.where(face.covers(x, y), face.depth_m(x, y), np.nan) for face in faces]
    return np.fmin.reduce(depths).astype(np.float32)


def hidden(
    faces: tuple[Face, ...], cells: int, *, nearer_m: float = 0.0, radiometry: Radiometry = "lambertian"
) -> Scene:
    """Return the scene for our side; the changes test the referee's sensitivity."""
    return Scene(RIG, depth_map(faces, cells) - np.float32(nearer_m), radiometry=radiometry)


UNITS_PER_M = 1000.0
CENTRE_M = np.array([(RIG.relay.x_min_m + RIG.relay.x_max_m) / 2, (RIG.relay.y_min_m + RIG.relay.y_max_m) / 2, 0.0])
HALF_M = np.array([RIG.relay.x_max_m - RIG.relay.x_min_m, RIG.relay.y_max_m - RIG.relay.y_min_m]) / 2


@dataclass(frozen=True)
class Job:
    """Scene, wall grid and number of paths of a run."""

    faces: tuple[Face, ...]
    columns: int
    """Points of the wall that the sensor looks at, along x: the middles of our relay cells."""
    rows: int
    bins: int
    samples: int
    """Paths for each point of the wall and run."""

    @property
    def aimed(self) -> bool:
        """True where the second bounce is sampled on the object alone.

        mitransient ignores occluders of the point it aims at, so that a self-occluding object comes out too bright.
        There the second bounce is drawn by the cosine, and few paths meet the object.
        """
        return len(self.faces) == 1


@dataclass(frozen=True)
class Estimate:
    """Monte-Carlo histograms of some beams, from independent runs."""

    mean: Float64
    """(beams, bins)."""
    error: Float64
    """(beams, bins); standard error of the mean, from the scatter of the runs."""
    runs: int
    core_seconds: float
    """Of the quickest run of one beam."""

    @property
    def noise(self) -> Float64:
        """(beams, bins); standard deviation of one run."""
        return self.error * np.sqrt(self.runs)


def load() -> ModuleType:
    """Return Mitsuba with mitransient's plug-ins. Ends the program where they are missing."""
    try:
        import drjit
        import mitsuba

        mitsuba.set_variant("llvm_ad_mono")
        import mitransient  # noqa: F401  (registers its plug-ins)
    except ImportError as error:
        raise SystemExit(f"{error}: tools/studies/referee.py lists the packages to install") from error
    drjit.set_thread_count(os.cpu_count() or 1)
    return mitsuba


def sample(job: Job, feet_m: Float64, seeds: NDArray[np.uint32]) -> Estimate:
    """Sample the histograms of the beams with spots at `feet_m` (beams, 3), one run for each seed (beams, runs)."""
    mitsuba = load()
    scene, mean, error, seconds = mitsuba.load_dict(_scene(mitsuba, job)), [], [], []
    for laser_spot_m, own in zip(feet_m, seeds.tolist(), strict=True):
        _point_laser(mitsuba, scene, laser_spot_m)
        _run(scene, job, laser_spot_m, 0)  # compiles
        runs = []
        for seed in own:
            started = time.process_time()
            runs.append(_run(scene, job, laser_spot_m, seed))
            seconds.append(time.process_time() - started)
        mean.append(np.mean(runs, axis=0))
        error.append(np.std(runs, axis=0, ddof=1) / np.sqrt(len(own)))
    return Estimate(np.array(mean), np.array(error), seeds.shape[1], min(seconds))


def _units(point_m: Float64) -> list[float]:
    return ((point_m - CENTRE_M) * UNITS_PER_M).tolist()


def _mesh(mitsuba: ModuleType, quads_m: Float64, albedo: float) -> Any:
    """Return a mesh of quadrilaterals (n, 4, 3)."""
    first = 4 * np.arange(len(quads_m))[:, None, None]
    triangles = first + np.array([[0, 1, 2], [0, 2, 3]])
    properties = mitsuba.Properties()
    properties["material"] = mitsuba.load_dict({"type": "diffuse", "reflectance": albedo})
    mesh = mitsuba.Mesh("quads", 4 * len(quads_m), 2 * len(quads_m), props=properties)
    parameters = mitsuba.traverse(mesh)
    parameters["vertex_positions"] = ((quads_m - CENTRE_M) * UNITS_PER_M).astype(np.float32).ravel()
    parameters["faces"] = triangles.astype(np.uint32).ravel()
    parameters.update()
    return mesh


def _scene(mitsuba: ModuleType, job: Job) -> dict[str, Any]:
    lidar = _units(RIG.wall_from_lidar[:3, 3])
    film = {"type": "transient_hdr_film", "width": job.columns, "height": job.rows, "temporal_bins": job.bins}
    film |= {"bin_width_opl": RIG.device.bin_m * UNITS_PER_M, "start_opl": 0.0, "rfilter": {"type": "box"}}
    sensor = {"type": "nlos_capture_meter", "sensor_origin": lidar, "film": film, "sampler": {"type": "independent"}}
    integrator = {"type": "transient_nlos_path", "max_depth": 3, "account_first_and_last_bounces": True}
    integrator |= {"nlos_laser_sampling": True, "nlos_hidden_geometry_sampling": job.aimed, "temporal_filter": "box"}
    at = mitsuba.ScalarTransform4f()
    wall = {"type": "rectangle", "to_world": at.scale([*(HALF_M * UNITS_PER_M), 1.0]), "sensor": sensor}
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": integrator,
        "wall": wall | {"bsdf": {"type": "diffuse", "reflectance": 1.0}},
        "laser": {"type": "spot", "intensity": 1.0, "to_world": at.look_at(lidar, [0, 0, 0], [0, 1, 0])},
        "faces": _mesh(mitsuba, np.array([face.corners_m for face in job.faces]), 1.0),
    }
    if not job.aimed:
        scene["sides"] = _mesh(mitsuba, np.concatenate([face.sides_m for face in job.faces[1:]]), 0.0)
    return scene


def _point_laser(mitsuba: ModuleType, scene: Any, laser_spot_m: Float64) -> None:
    from mitransient.nlos import focus_emitter_at_relay_wall_3dpoint

    wall = next(shape for shape in scene.shapes() if shape.sensor() is not None)
    focus_emitter_at_relay_wall_3dpoint(mitsuba.Point3f(_units(laser_spot_m)), wall, scene.emitters()[0])


def _run(scene: Any, job: Job, laser_spot_m: Float64, seed: int) -> Float64:
    """Return one run's histogram (bins,): pixels summed with their cell's area and the receiver's solid angle."""
    _, transient = scene.integrator().render(scene, scene.sensors()[0], seed=seed, spp=job.samples)
    radiance = np.array(transient, dtype=np.float64)[..., 0]  # (rows, columns, bins)
    lidar = RIG.wall_from_lidar[:3, 3]
    across, up = ((2 * np.arange(n) + 1) / n - 1 for n in (job.columns, job.rows))
    x, y = np.meshgrid(CENTRE_M[0] + HALF_M[0] * across, CENTRE_M[1] + HALF_M[1] * up)
    squared = (x - lidar[0]) ** 2 + (y - lidar[1]) ** 2 + lidar[2] ** 2
    solid_angle = RIG.device.receiver_cell_m2 * lidar[2] / squared**1.5
    cell_units = 4 * HALF_M.prod() / (job.columns * job.rows) * UNITS_PER_M**2
    to_foot = np.linalg.norm(laser_spot_m - lidar)
    power = lidar[2] / to_foot**3 / UNITS_PER_M**2  # on a square unit about the foot, of intensity 1
    return (radiance * solid_angle[..., None]).sum((0, 1)) * cell_units / power
