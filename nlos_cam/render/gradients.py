"""Derivatives of the reported intensity and path length with respect to a scene: depth, albedo,
pose of lidar and wall.

The winner of every beam is held: at a tie the reported echo jumps and has no derivative, so leave
out beams whose `margin` is small. Also held are visibility (the light at a moving edge of a shadow
is missing), which neighbors of the depth map are joined, and near-contact areas. The light that
crosses the edges of the winner's bin is included.

The reported path of a three-bounce winner is its bin's center, a step function. Its derivative here
is the light-weighted mean rate of the path lengths in the bin: the mean of the steps as the echo
moves through the bins.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from nlos_calibration import Rig
from nlos_calibration.arrays import Float32, Float64, Mask

from nlos_cam.errors import SceneError
from nlos_cam.frames import SATURATED
from nlos_cam.render import backend_cpu, backend_reference
from nlos_cam.render.accuracy import STOPS, Accuracy, accuracy_named
from nlos_cam.render.backend_numba import NumbaJob
from nlos_cam.render.echoes import MultiBounce, compete, no_echoes, strongest
from nlos_cam.render.effects import Effects
from nlos_cam.render.geometry import cast, softened
from nlos_cam.render.gradient_legs import (
    BeamRates,
    GradientScene,
    PatchChange,
    PointChange,
    Tilts,
    Winners,
    pull,
    push,
    softened_slope,
)
from nlos_cam.render.job import TransportJob
from nlos_cam.render.material import without_lobe
from nlos_cam.render.planning import RenderProblem, prepare
from nlos_cam.render.scene import Scene
from nlos_cam.render.scene_facts import bins_of
from nlos_cam.render.sensor.model import SensorModel

Parameters = Literal["depth", "albedo", "lidar", "wall"]
COVERED = {"direct", "three-bounce", "occluder", "self-occlusion", "tilt", "colour"}
"""Effects whose derivatives are here; the others a plan must leave out."""


@dataclass(frozen=True)
class SceneVector:
    """A number for each parameter of a scene: rates of their change, or derivatives with respect to
    them.
    """

    depth_m: Float64 | None = None
    """(rows, columns); of the depth map, tilts following. 0 for background."""
    albedo: Float64 | None = None
    """(rows, columns)."""
    point_m: Float64 | None = None
    """(n, 3); of the patches' centers in the wall frame, tilts held: along given directions, a
    product with them.
    """
    lidar: Float64 | None = None
    """(6,); shift (m) and turn (rad) of the lidar along and about axes parallel to the wall
    frame's, at the lidar.
    """
    wall: Float64 | None = None
    """(6,); the same of the wall about its frame's origin, while lidar and object stay."""


class MovedRig(Rig):
    """Rig whose lidar has any pose, also one that the wall frame's definition leaves no number
    for.
    """

    pose: tuple[float, ...]
    """Rows of wall_from_lidar (4, 4), flattened."""

    @property
    def wall_from_lidar(self) -> Float64:
        """Pose (4, 4) of the lidar in the wall frame."""
        return np.reshape(self.pose, (4, 4))


def moved(
    problem: RenderProblem, lidar: Float64 | None = None, wall: Float64 | None = None
) -> RenderProblem:
    """Return a render problem after motions (6,), as in SceneVector, of the lidar, then of the
    wall.

    The plan, what the object hides from itself, and the relay cells that the occluder hides stay.
    """
    shift, turn = _motion(lidar)
    back, turned = _motion(wall)
    # The wall's frame moves with the wall, so that a point x of the room has the coordinates
    # turned^T (x - back) afterwards.
    pose = problem.scene.rig.wall_from_lidar.copy()
    pose[:3, :3] = turned.T @ turn @ pose[:3, :3]
    pose[:3, 3] = turned.T @ (pose[:3, 3] + shift - back)
    rig = MovedRig(**problem.scene.rig.model_dump(exclude={"pose"}), pose=tuple(pose.ravel()))
    scene = replace(problem.scene, rig=rig)

    intrinsics = scene.intrinsics(problem.accuracy.beams_per_cell)
    lambertian = scene.radiometry == "lambertian"
    beams = cast(rig, intrinsics, lambertian=lambertian, occluder=problem.includes("occluder"))
    if not problem.includes("direct"):
        beams = beams.without_direct()
    job = problem.job
    if job is None:
        return replace(problem, scene=scene, beams=beams)

    # Rows x^T turned are (turned^T x)^T.
    patches = replace(
        job.patches,
        point_m=(job.patches.point_m - back) @ turned,
        normal=job.patches.normal @ turned,
    )
    x, y, z = pose[:3, 3]
    # d4 of S4 and the cosine at which the relay's light leaves the wall; cells stay on the wall.
    length = np.sqrt((job.relay.x_m - x) ** 2 + (job.relay.y_m - y) ** 2 + z**2)
    relay = replace(job.relay, length_m=length, cos_lidar=z / length)
    lit = beams.on_wall
    spots = beams.laser_spot_m[lit]
    job = replace(
        job,
        patches=patches,
        relay=relay,
        lidar_m=beams.lidar_m,
        laser_spot_m=spots,
        length_m=beams.length_m[lit],
        cos_incidence=beams.cos_incidence[lit],
        bins=bins_of(beams, patches, relay, rig.device),
    )
    return replace(problem, scene=scene, beams=beams, job=job)


def _motion(vector: Float64 | None) -> tuple[Float64, Float64]:
    """Return shift (3,) and rotation (3, 3) of a motion (6,) by Rodrigues' formula."""
    if vector is None:
        return np.zeros(3), np.eye(3)
    turn = vector[3:]
    angle = float(np.linalg.norm(turn))
    cross = np.cross(np.eye(3), turn)  # rows e_i x turn: the matrix of turn x
    # I + sin a / a K + (1 - cos a) / a^2 K^2, with 1 - cos a = 2 sin^2(a / 2). numpy's sinc is
    # sin(pi x) / (pi x), which is 1 at 0: no division by a.
    rotation = (
        np.eye(3)
        + np.sinc(angle / np.pi) * cross
        + 0.5 * np.sinc(angle / 2 / np.pi) ** 2 * cross @ cross
    )
    return vector[:3], rotation


class Gradients:
    """Winners of a scene with their derivatives: J v by `push`, J^T w by `pull`, and J for some
    parameters.

    Maps are (rows, columns) of beams, as `render` has them at `beams_per_cell` 1. Raises SceneError
    for a scene with an effect that is not COVERED, or an accuracy that joins cells (`draft`).
    """

    def __init__(
        self,
        scene: Scene | RenderProblem,
        accuracy: str | Accuracy = "standard",
        effects: Effects = "auto",
    ) -> None:
        if isinstance(scene, RenderProblem):
            problem = scene
        else:
            exact = replace(accuracy_named(accuracy), finest_cells=0)
            problem = prepare(scene, exact, effects, bounded=False)
        self.problem = problem
        beams = problem.beams
        if missing := sorted({effect.name for effect in problem.plan if effect.included} - COVERED):
            raise SceneError(
                f"no gradients of the effect {missing[0]}: leave it out with `effects`"
            )
        job = problem.job
        depth_m = problem.scene.object_depth_m
        # Joined cells have no depth of their own to differentiate by.
        if job is not None and depth_m is not None and len(job.field.depth_m) < len(depth_m):
            raise SceneError(
                f"no gradients at accuracy {problem.accuracy.name!r}, which joins cells: choose"
                " fine"
            )
        if job is None:
            echoes = no_echoes(len(beams.on_wall))
        else:
            echoes = _echoes(job).spread_over(beams.on_wall)
        echoes = echoes.reshape(beams.shape)
        depth, self.intensity, self.margin = compete(beams, echoes)
        self.depth_m: Float32 = depth
        """(rows, columns); as the lidar reports it."""
        self.three_bounce: Mask = beams.on_wall.reshape(beams.shape) & (
            echoes.peak > beams.direct.reshape(beams.shape)
        )
        """(rows, columns); beams that a three-bounce echo wins."""
        returning = beams.on_wall & (beams.direct > 0)
        self.direct: Mask = returning.reshape(beams.shape) & ~self.three_bounce
        """(rows, columns); beams that the wall's direct return wins. The others have no
        derivatives: 0 throughout.
        """
        self._peak = echoes.peak[self.three_bounce]
        self._path = echoes.path_m[self.three_bounce]

    def pull(self, intensity: Float64 | None = None, path_m: Float64 | None = None) -> SceneVector:
        """Return J^T w: the derivative of the sum of both reported maps times weights (rows,
        columns).

        About the cost of two renders, whatever the number of parameters.
        """
        job = self._maybe_job
        shape = self.intensity.shape
        light = np.zeros(shape) if intensity is None else np.asarray(intensity, np.float64)
        path = np.zeros(shape) if path_m is None else np.asarray(path_m, np.float64)

        # A direct winner's path is 2 d1: the way there and back.
        lidar = np.zeros(6)
        if self.direct.any():
            rates = self._lidar_rates
            lidar += (
                rates.direct * light[self.direct]
                + 2 * rates.length[:, self.direct.ravel()] * path[self.direct]
            ).sum(1)
        to_lidar = _wall_as_lidar(self.problem.beams.lidar_m)
        if job is None:
            return SceneVector(
                np.zeros((0, 0)), np.zeros((0, 0)), np.zeros((0, 3)), lidar, to_lidar.T @ lidar
            )

        # The mean path is the light-weighted sum over the bin's light; that light's own change is
        # left out, as the mean rate of the lengths is meant (see the module).
        by_patch, beams, cells = pull(
            *self._scene,
            light[self.three_bounce].astype(np.float32),
            (path[self.three_bounce] / self._peak).astype(np.float32),
        )
        beams = beams.sum(0, np.float64)
        cells = cells.sum(0, np.float64)
        point = by_patch[:, :3]
        normal = by_patch[:, 3:6]
        strength = by_patch[:, 6]

        # Chain rule from the legs' ends (m motions, c quantities, n points) to the lidar, and from
        # patches to the wall: they move against it, a turn by the cross product with their arms.
        spots, relay = self._lidar_points
        lidar += np.einsum("mcn,cn->m", spots, beams) + np.einsum("mcn,cn->m", relay, cells)
        turned = np.cross(job.patches.point_m, point) + np.cross(job.patches.normal, normal)
        wall = to_lidar.T @ lidar - np.concatenate([point.sum(0), turned.sum(0)])

        # A cell's depth moves its own patch along z, and tilts it and its neighbors.
        depth = point[:, 2] + self._tilts.transposed(normal, strength)
        albedo = strength * job.patches.area_m2 * self._of_albedo
        return SceneVector(self.image(depth), self.image(albedo), point, lidar, wall)

    def push(self, change: SceneVector) -> tuple[Float64, Float64]:
        """Return J v: the rates (rows, columns) of reported intensity and path (m) for rates of
        change of a scene.
        """
        job = self._maybe_job
        shape = self.intensity.shape
        light = np.zeros(shape)
        path = np.zeros(shape)
        wall = np.zeros(6) if change.wall is None else np.asarray(change.wall, np.float64)
        lidar = _wall_as_lidar(self.problem.beams.lidar_m) @ wall + (
            0 if change.lidar is None else change.lidar
        )
        if lidar.any():
            rates = self._lidar_rates
            light[self.direct] = lidar @ rates.direct
            path[self.direct] = 2 * lidar @ rates.length[:, self.direct.ravel()]
        if job is not None:
            spots, relay = (
                PointChange(*np.einsum("m,mcn->cn", lidar, rate).astype(np.float32))
                for rate in self._lidar_points
            )
            patches = self._patch_change(change, wall)
            brighter, longer = push(*self._scene, patches, spots, relay, False)
            light[self.three_bounce] = brighter.sum(0, np.float64)
            path[self.three_bounce] = longer.sum(0, np.float64) / self._peak
        return light, path

    def jacobian(self, parameters: Parameters) -> tuple[Float32, Float32]:
        """Return the derivatives of intensity and path (m) as matrices.

        By the pose of "lidar" or "wall" (rows * columns, 6); by "depth" or "albedo" (k, n) for the
        k beams of `three_bounce` and the n cells with a surface, in the order of the image.
        """
        if parameters in {"lidar", "wall"}:
            # Column by column: J e_i for the six unit motions.
            found = [self.push(SceneVector(**{parameters: unit})) for unit in np.eye(6)]
            light, path = (
                np.stack([map_.ravel() for map_ in maps], -1) for maps in zip(*found, strict=True)
            )
            return light.astype(np.float32), path.astype(np.float32)
        if self._maybe_job is None:
            return np.zeros((0, 0), np.float32), np.zeros((0, 0), np.float32)
        if parameters == "albedo":
            nowhere = np.zeros_like(self.echo_job.patches.normal)
            strength = self.echo_job.patches.area_m2 * self._of_albedo
            return self._each(nowhere, nowhere, strength)
        tilts = self._tilts
        still = np.zeros(len(self._tilts.beta))
        up = np.tile([0.0, 0.0, 1.0], (len(still), 1))
        # One pass for the depth alone; one for the slope along each axis by its two neighbors: a
        # patch's slope is linear in the two depths of its pair, one with plus and one with minus.
        light, path = self._each(up, 0 * up, still)
        for axis, (more, less) in enumerate(tilts.pairs):
            steeper = np.zeros((len(still), 2))
            steeper[:, axis] = 1 / tilts.pitch_m[axis]
            by_slope = self._each(0 * up, *tilts.turned(steeper))
            for total, part in zip((light, path), by_slope, strict=True):
                np.add.at(total.T, more, part.T)
                np.subtract.at(total.T, less, part.T)
        return light, path

    def _each(self, point: Float64, normal: Float64, strength: Float64) -> tuple[Float32, Float32]:
        """Return the rates (k, n) of the winners for the change of each patch alone."""
        change = PatchChange(
            *(np.ascontiguousarray(part, np.float32) for part in (point, normal, strength))
        )
        spots, relay = (
            PointChange(*np.zeros(rate.shape[1:], np.float32)) for rate in self._lidar_points
        )
        light, path = push(*self._scene, change, spots, relay, True)
        return light.T, path.T / self._peak[:, None]

    def _patch_change(self, change: SceneVector, wall: Float64) -> PatchChange:
        """Return the rates of the patches; the wall's motion moves them the other way."""
        patches = self.echo_job.patches
        point = -wall[:3] - np.cross(wall[3:], patches.point_m)
        normal = -np.cross(wall[3:], patches.normal)
        strength = np.zeros(len(point))
        where = patches.row, patches.column
        if change.point_m is not None:
            point = point + change.point_m
        if change.depth_m is not None:
            # The tilt's part: depths change slopes, and slopes the normal and the true area (S3).
            rate = np.asarray(change.depth_m, np.float64)[where]
            point[:, 2] += rate
            turned, stronger = self._tilts.turned(self._tilts.slopes(rate))
            normal = normal + turned
            strength = strength + stronger
        if change.albedo is not None:
            rate = np.asarray(change.albedo, np.float64)[where] * self._of_albedo
            strength = strength + rate * patches.area_m2
        return PatchChange(
            *(np.ascontiguousarray(part, np.float32) for part in (point, normal, strength))
        )

    @property
    def _of_albedo(self) -> float:
        """Rate of a patch's own albedo by the scene's: a BRDF that is left out is a factor of
        it.
        """
        brdf = self.problem.scene.surface.brdf
        return 1.0 if brdf is None else without_lobe(brdf)

    def image(self, values: Float64) -> Float64:
        """Return the patches' values as an image of the depth map, 0 for background."""
        image = np.zeros(self.echo_job.field.depth_m.shape)
        image[self.echo_job.patches.row, self.echo_job.patches.column] = values
        return image

    @property
    def echo_job(self) -> TransportJob:
        """Transport of the beams that three bounces win. Raises SceneError if they win none."""
        if (job := self._maybe_job) is None:
            raise SceneError("no gradients of an object: three bounces win no beam")
        return job

    @cached_property
    def _maybe_job(self) -> TransportJob | None:
        """Transport of the beams that three bounces win; None if they win none."""
        if (job := self.problem.job) is None or not self.three_bounce.any():
            return None
        if job.accuracy.sub_bins == 0:  # the reference has no tables: the finest
            job = replace(job, accuracy=replace(job.accuracy, sub_bins=STOPS["fine"].sub_bins))
        return job.select((np.cumsum(self.problem.beams.on_wall) - 1)[self.three_bounce.ravel()])

    @cached_property
    def _scene(self) -> GradientScene:
        """Arguments of the kernels."""
        job = self.echo_job
        single = NumbaJob(job, tiled=False)
        per_bin = job.accuracy.sub_bins
        # The reported path is the center of bin k: (k + 1/2) bin_m.
        edge = (np.round(self._path / job.bin_m - 0.5) * per_bin).astype(np.float32)
        pitch = np.float32(job.relay.diagonal_m / np.sqrt(2))
        lidar_x, lidar_y = job.lidar_m[:2].astype(np.float32)
        winners = Winners(edge, per_bin, lidar_x, lidar_y, pitch)
        feet = single.feet(np.ones(len(self._peak)))
        surface, _, _, optics, field = single.sites
        return GradientScene(feet, surface, single.relay, optics, field, winners)

    @cached_property
    def _tilts(self) -> Tilts:
        return Tilts.of(
            self.echo_job, self.problem.scene.jump_m, tilted=self.problem.includes("tilt")
        )

    @cached_property
    def _lidar_rates(self) -> BeamRates:
        return BeamRates.of(self.problem, self.direct.ravel())

    @cached_property
    def _lidar_points(self) -> tuple[Float64, Float64]:
        """Rates of the winners' spots (6, 4, k) and of the relay's cells (6, 4, m) for unit motions
        of the lidar.
        """
        job = self.echo_job
        wins = self.three_bounce.ravel()
        rates = self._lidar_rates
        # A spot's weight goes with cos t1 in S2. In the rendering equation the laser's whole power
        # lands on the spot at any angle.
        cosine = rates.cosine[:, wins] / job.cos_incidence
        if job.lambertian:
            cosine = 0 * cosine
        x, y = rates.spot[:, wins].transpose(2, 0, 1)
        spots = np.stack([x, y, rates.length[:, wins], cosine], 1)

        # Relay cells stay where they are; the lidar's shift changes d4, its turn nothing. The
        # weight goes with 1 / softened(d4^2), and in the rendering equation with the cosine
        # lidar_z / d4.
        squared = job.relay.length_m**2
        relay = job.relay
        away = job.lidar_m - np.stack([relay.x_m, relay.y_m, 0 * relay.x_m], -1)  # (m, 3)
        length = np.concatenate([away.T / relay.length_m, np.zeros((3, len(squared)))])
        light = -2 * relay.length_m * softened_slope(squared, job.soft_wall_m2, job.near_m) * length
        light /= softened(squared, job.soft_wall_m2, job.near_m)
        if job.lambertian:
            light += (
                np.array([0, 0, 1 / job.lidar_m[2], 0, 0, 0])[:, None] - length / relay.length_m
            )
        return spots, np.stack([0 * length, 0 * length, length, light], 1)


def _echoes(job: TransportJob) -> MultiBounce:
    if job.accuracy.sub_bins == 0:
        return strongest(backend_reference.histograms(job), job.bin_m)
    return backend_cpu.echoes(job)


def _wall_as_lidar(lidar_m: Float64) -> Float64:
    """Return the matrix (6, 6) from a motion of the wall to the lidar's motion in the wall's
    frame.
    """
    # A point x of the room has coordinates x - shift - turn x x after the wall has moved, to first
    # order: the lidar seems to shift by -shift - turn x lidar and to turn by -turn.
    matrix = -np.eye(6)
    matrix[:3, 3:] = np.cross(np.eye(3), lidar_m)
    return matrix


def intensity_noise(gradients: Gradients, model: SensorModel, frames: int = 1) -> Float64:
    """Return the standard deviation (rows, columns) of the intensities, as the mean over pixels and
    frames.

    Shot, read and quantization noise; infinite for saturated beams, which determine nothing, and
    for all beams of a lidar to which nothing of the wall returns.
    """
    scene = gradients.problem.scene
    shape = gradients.intensity.shape
    bare = scene.rig.model_copy(update={"occluder": None})
    brightest = cast(
        bare, scene.intrinsics(), lambertian=scene.radiometry == "lambertian"
    ).direct.max()
    if brightest == 0:
        return np.full(shape, np.inf)
    gain = model.bare_wall_counts / brightest
    # Variances of read noise, of photons (in proportion to the counts), and of rounding to whole
    # counts (1 / 12) add; the mean over a cell's pixels and frames divides them.
    counts = gain * gradients.intensity.astype(np.float64) + model.ambient_counts
    variance = model.read_noise_counts**2 + model.shot_noise**2 * counts + 1 / 12
    pixels = scene.rig.pinhole.width * scene.rig.pinhole.height / np.prod(shape)
    return np.where(counts < SATURATED, np.sqrt(variance / (pixels * frames)) / gain, np.inf)


@dataclass(frozen=True)
class DepthBound:
    """Standard deviations (rows, columns) in meters that no unbiased estimate of depth falls below;
    NaN outside.
    """

    alone_m: Float64
    """Of each cell if all the others are known."""
    bound_m: Float64
    """Of each cell if all are unknown, each with a prior of `prior_m`."""
    modes_m: Float64
    """(n,); of the patterns of depth that the echoes tell apart, the best determined first, without
    the prior.
    """
    determined: float
    """Number of depths that the echoes determine beyond the prior: the trace of bound^-2 times
    information.
    """


def depth_bound(
    gradients: Gradients,
    noise: Float64,
    prior_m: float = 0.05,
    block: int = 1,
    min_margin: float = 0.01,
) -> DepthBound:
    """Return the Cramer-Rao bound of an object's depth from the intensities of its echoes with
    known noise.

    `block` x `block` cells move as one. Beams below `min_margin` are left out: near a tie there is
    no derivative. The reported path is a bin's center and carries no information about less than a
    bin, so it is not used.
    """
    job = gradients.echo_job
    wins = gradients.three_bounce
    rates, _ = gradients.jacobian("depth")
    sure = (gradients.margin[wins] >= min_margin) & np.isfinite(noise[wins])
    # Blocks get numbers without gaps; a depth map has at most 256 columns.
    block_of = job.patches.row // block * 1000 + job.patches.column // block
    group = np.unique(block_of, return_inverse=True)[1]

    # Fisher information of independent normal errors: sum over beams of J^T J / noise^2. The rate
    # of a block is the sum of its cells'.
    scaled = np.zeros((int(sure.sum()), group.max() + 1))
    np.add.at(scaled.T, group, (rates[sure] / noise[wins][sure, None]).T)
    information = scaled.T @ scaled
    values = np.maximum(np.linalg.eigvalsh(information)[::-1], 1e-30)
    # Cramer-Rao: no unbiased estimate has a covariance below the inverse. Others held, it is the
    # inverse of the diagonal; with all unknown, the diagonal of the inverse.
    covariance = np.linalg.inv(information + np.eye(len(information)) / prior_m**2)
    deviations = 1 / np.sqrt(np.maximum(np.diag(information), 1e-30)), np.sqrt(np.diag(covariance))
    maps: list[Float64] = []
    for deviation in deviations:
        image = np.full(job.field.depth_m.shape, np.nan)
        image[job.patches.row, job.patches.column] = deviation[group]
        maps.append(image)
    alone, bound = maps
    determined = float(np.sum(values / (values + prior_m**-2)))
    return DepthBound(alone, bound, 1 / np.sqrt(values), determined)


@dataclass(frozen=True)
class PoseFit:
    """Motion of lidar or wall that fits measured echoes best."""

    motion: Float64
    """(6,); shift (m) and turn (rad), as in SceneVector."""
    deviation: Float64
    """(6,); standard deviations by the Cramer-Rao bound with the prior."""
    cost: tuple[float, float]
    """Mean robust loss (Cauchy's) of the residuals in units of the noise, before and after."""
    iterations: int
    problem: RenderProblem
    """Render problem with the motion applied."""


OUTLIER = 3.0
"""Residual in units of the noise from which on a beam counts less."""
MAX_DAMPINGS = 12
"""Tries of a step, each five times more cautious than the last."""


def fit_pose(
    problem: RenderProblem,
    intensity: Float64,
    noise: Float64,
    body: Literal["lidar", "wall"] = "lidar",
    *,
    prior: tuple[float, float] = (0.02, 0.02),
    min_margin: float = 0.01,
    model_error: float = 0.005,
    steps: int = 30,
) -> PoseFit:
    """Fit the pose of lidar or wall to the measured intensities (rows, columns) of a known object's
    echoes.

    Robust least squares by Levenberg and Marquardt's method; `prior` is the standard deviation of
    shift (m) and turn (rad) from the problem's pose, `model_error` a relative error of the
    renderer. Used are the beams that three bounces win by `min_margin` in the measured pose. The
    wall's motions within its plane change nothing but shadows: the prior alone decides them.
    """
    # The strongest echo is continuous in the pose even where the winner changes, so the residual is
    # too.
    precision = np.repeat(np.array(prior) ** -2.0, 3)
    motion = np.zeros(6)
    damping = 1e-3
    iterations = 0
    now = Gradients(problem)

    def residual(at: Gradients) -> tuple[Float64, Float64, Mask]:
        used = at.three_bounce & (at.margin >= min_margin) & np.isfinite(noise)
        deviation = np.hypot(noise, model_error * at.intensity)[used]
        return (intensity - at.intensity)[used] / deviation, deviation, used

    def loss(at: Gradients, shift: Float64) -> float:
        # Cauchy's: a beam whose strongest echo is the wall's in one pose and the object's in the
        # other counts little.
        rest = residual(at)[0]
        each = OUTLIER**2 * np.log1p((rest / OUTLIER) ** 2)
        return float(each.mean() + precision @ shift**2 / rest.size) if rest.size else np.inf

    first = cost = loss(now, motion)
    normal = np.diag(precision)
    while iterations < steps:
        iterations += 1
        # Gauss and Newton's step with Cauchy's weight for each residual, (J^T W J + P) step =
        # J^T W r - P motion: the prior P pulls back to the first pose.
        rest, deviation, used = residual(now)
        weight = 1 / (1 + (rest / OUTLIER) ** 2)
        rates = now.jacobian(body)[0][used.ravel()].astype(np.float64) / deviation[:, None]
        normal = rates.T @ (weight[:, None] * rates) + np.diag(precision)
        downhill = rates.T @ (weight * rest) - precision * motion
        before = cost
        # Marquardt's damping shortens and turns the step towards the steepest descent, in each
        # parameter's own scale.
        for _ in range(MAX_DAMPINGS):
            damped = normal + damping * np.diag(np.diag(normal))
            step = np.linalg.solve(damped, downhill).astype(np.float64)
            following = Gradients(moved(now.problem, **{body: step}))
            if (found := loss(following, motion + step)) < cost:
                now = following
                motion = motion + step
                cost = found
                damping = damping / 5
                break
            damping *= 5
        if before - cost < 1e-4 * before:
            break
    deviation = np.sqrt(np.diag(np.linalg.inv(normal)))
    return PoseFit(motion, deviation, (first, cost), iterations, now.problem)
