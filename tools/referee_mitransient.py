"""The other side of tools/referee.py: mitransient's Monte-Carlo transients of single beams, in our units.

A pixel of its sensor holds the radiance from a point of the wall, for a laser that puts its power on a square unit
about the beam's foot. The three 1 / pi and the cosines of the two legs to the object are in it. What it lacks of S2 is
the wall cell's area and the receiver's solid angle from there: those are multiplied in, and nothing is fitted.

Lengths go over in millimetres about the middle of the relay wall: a ray starts 9e-5 (1 + largest coordinate) off its
surface, whatever the unit: 0.1 mm in metres, which shows, 0.02 mm so. `filter_bounces` is off by one in 1.3.1;
max_depth 3 leaves but the three-bounce paths, as a flat wall sends nothing to itself.
"""

import os
import time
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from nlos_calibration.arrays import Float64
from numpy.typing import NDArray
from referee_scene import RIG, Face

UNITS_PER_M = 1000.0
CENTRE_M = np.array([(RIG.relay.x_min_m + RIG.relay.x_max_m) / 2, (RIG.relay.y_min_m + RIG.relay.y_max_m) / 2, 0.0])
HALF_M = np.array([RIG.relay.x_max_m - RIG.relay.x_min_m, RIG.relay.y_max_m - RIG.relay.y_min_m]) / 2


@dataclass(frozen=True)
class Job:
    """What to sample."""

    faces: tuple[Face, ...]
    columns: int
    """Points of the wall that the sensor looks at, along x: the middles of our relay cells."""
    rows: int
    bins: int
    samples: int
    """Paths for each point of the wall and run."""

    @property
    def aimed(self) -> bool:
        """Whether the second bounce is sampled on the object alone.

        mitransient does so whatever stands before the point it aims at: an object that shades itself comes out too
        bright. There, the few paths have to do that meet the object when drawn by the cosine.
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
    """Mitsuba with mitransient's plug-ins. Ends the program where they are missing."""
    try:
        import drjit
        import mitsuba

        mitsuba.set_variant("llvm_ad_mono")
        import mitransient  # noqa: F401  (registers its plug-ins)
    except ImportError as error:
        raise SystemExit(f"{error}: the top of tools/referee.py says what to install") from error
    drjit.set_thread_count(os.cpu_count() or 1)
    return mitsuba


def sample(job: Job, feet_m: Float64, seeds: NDArray[np.uint32]) -> Estimate:
    """Histograms of the beams that land on `feet_m` (beams, 3), one run for each of their seeds (beams, runs)."""
    mitsuba = load()
    scene, mean, error, seconds = mitsuba.load_dict(_scene(mitsuba, job)), [], [], []
    for foot_m, own in zip(feet_m, seeds.tolist(), strict=True):
        _point_laser(mitsuba, scene, foot_m)
        _run(scene, job, foot_m, 0)  # compiles
        runs = []
        for seed in own:
            started = time.process_time()
            runs.append(_run(scene, job, foot_m, seed))
            seconds.append(time.process_time() - started)
        mean.append(np.mean(runs, axis=0))
        error.append(np.std(runs, axis=0, ddof=1) / np.sqrt(len(own)))
    return Estimate(np.array(mean), np.array(error), seeds.shape[1], min(seconds))


def _units(point_m: Float64) -> list[float]:
    return ((point_m - CENTRE_M) * UNITS_PER_M).tolist()


def _mesh(mitsuba: ModuleType, quads_m: Float64, albedo: float) -> Any:
    """A mesh of quadrilaterals (n, 4, 3)."""
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


def _point_laser(mitsuba: ModuleType, scene: Any, foot_m: Float64) -> None:
    from mitransient.nlos import focus_emitter_at_relay_wall_3dpoint

    wall = next(shape for shape in scene.shapes() if shape.sensor() is not None)
    focus_emitter_at_relay_wall_3dpoint(mitsuba.Point3f(_units(foot_m)), wall, scene.emitters()[0])


def _run(scene: Any, job: Job, foot_m: Float64, seed: int) -> Float64:
    """One run's histogram (bins,): the pixels' sum, each with its cell's area and the receiver's solid angle."""
    _, transient = scene.integrator().render(scene, scene.sensors()[0], seed=seed, spp=job.samples)
    radiance = np.array(transient, dtype=np.float64)[..., 0]  # (rows, columns, bins)
    lidar = RIG.wall_from_lidar[:3, 3]
    across, up = ((2 * np.arange(n) + 1) / n - 1 for n in (job.columns, job.rows))
    x, y = np.meshgrid(CENTRE_M[0] + HALF_M[0] * across, CENTRE_M[1] + HALF_M[1] * up)
    squared = (x - lidar[0]) ** 2 + (y - lidar[1]) ** 2 + lidar[2] ** 2
    solid_angle = RIG.device.receiver_cell_m2 * lidar[2] / squared**1.5
    cell_units = 4 * HALF_M.prod() / (job.columns * job.rows) * UNITS_PER_M**2
    to_foot = np.linalg.norm(foot_m - lidar)
    power = lidar[2] / to_foot**3 / UNITS_PER_M**2  # on a square unit about the foot, of intensity 1
    return (radiance * solid_angle[..., None]).sum((0, 1)) * cell_units / power
