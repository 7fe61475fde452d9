"""The fast renderer: S2 factorised at the object's patches, for the CPU (numba, float32).

weight(p, s, q) = A(p, s) B(s, q) and length = (d1 + d2)(p, s) + (d3 + d4)(s, q). So each patch s gets one table of B
over d3 + d4, counted in sub-bins, and each beam p adds it, shifted by d1 + d2 to the nearest sub-bin. The sums of
sub-bins to bins are made beforehand for each of the shifts within a bin, so that a beam adds one row: one product for a
patch and a bin. Neither rounding leans: a path lies anywhere within its sub-bin, and the nearest shift leaves the bin's
edge in the middle of that.
"""

import numpy as np
from numpy.typing import NDArray

from nlos_cam.frames import Float32
from nlos_cam.render.between import with_inter_reflection
from nlos_cam.render.job import Job
from nlos_cam.render.kernels import LANES, shift_and_add, sub_bins, tables
from nlos_cam.render.legs import Optics, Points32, Surface32
from nlos_cam.render.scatter import nodes, scattering
from nlos_cam.render.visibility import horizon_table

Array = NDArray[np.float64]


def histograms(job: Job) -> Float32:
    """Histograms (n, bins) of I_multi over path length, for the job's beams.

    Does not depend on the number of threads: each histogram is summed by one thread, patches in order.
    """
    stage = _Stage(job)
    if job.brdf is None:
        return stage.histograms(np.empty((0, 0), np.float32), np.ones(len(job.foot_m)))
    total = np.zeros((len(job.foot_m), job.bins), np.float32)
    for foot, share in nodes(job, job.brdf):
        factor = scattering(job.brdf)(foot, job.patches.point_m, job.patches.normal, job.relay.x_m, job.relay.y_m)
        total += stage.histograms(factor.astype(np.float32), share)
    return total


class _Stage:
    """A job in float32, with what does not depend on the BRDF made once."""

    def __init__(self, job: Job) -> None:
        patches, relay = job.patches, job.relay
        self.job, accuracy = job, job.accuracy
        self.surface = Surface32(
            *_columns(patches.point_m),
            *_columns(patches.normal),
            _single(job.soft_patch_m2),
            patches.row,
            patches.column,
        )
        columns = relay.x_m, relay.y_m, relay.length_m, job.relay_weight
        self.relay = _points(columns, job.soft_wall_m2)
        self.low, self.high = horizons(job)
        edge_x, edge_z = job.edge_m
        self.optics = Optics(
            np.float32(edge_x),
            np.float32(edge_z),
            np.float32(job.near_m**2),
            job.lambertian,
            np.float32(accuracy.sub_bins / job.bin_m),
            accuracy.sectors if job.field.shades else 0,
        )
        self.width = table_width(job)

    def histograms(self, factor: Float32, share: Array) -> Float32:
        """Histograms (n, bins) of the beams, each taken to some share (n,)."""
        job, shadow = self.job, (self.optics, self.job.field, self.low, self.high)
        some = np.flatnonzero(share)
        x, y, _ = job.foot_m[some].T
        feet = _points((x, y, job.length_m[some], job.beam_weight[some] * share[some]), 0.0)
        first, fine = sub_bins(self.surface, self.relay, *shadow, factor, job.accuracy.sub_bins, self.width)
        if job.more_bounces:
            fine = with_inter_reflection(job, first, fine)
        table = tables(fine, job.accuracy.sub_bins)
        found = shift_and_add(feet, self.surface, *shadow, _single(job.strength), first, table, job.bins)
        if len(some) == len(share):
            return found[:, : job.bins]
        histogram = np.zeros((len(share), job.bins), np.float32)
        histogram[some] = found[:, : job.bins]
        return histogram


def _single(column: Array) -> Float32:
    return np.ascontiguousarray(column, np.float32)


def _points(columns: tuple[Array, Array, Array, Array], soft_m2: float) -> Points32:
    x, y, length, weight = (_single(column) for column in columns)
    return Points32(x, y, length, weight, np.float32(soft_m2))


def _columns(points: Array) -> tuple[Float32, Float32, Float32]:
    return _single(points[:, 0]), _single(points[:, 1]), _single(points[:, 2])


def horizons(job: Job) -> tuple[Float32, Float32]:
    """The horizon tables (n, directions) that the job's accuracy asks for; empty where nothing shades."""
    patches, field, accuracy = job.patches, job.field, job.accuracy
    if not field.shades:
        return np.empty((0, 0), np.float32), np.empty((0, 0), np.float32)
    x = np.concatenate([job.foot_m[:, 0], job.relay.x_m])
    y = np.concatenate([job.foot_m[:, 1], job.relay.y_m])
    across = np.maximum(x.max() - patches.point_m[:, 0], patches.point_m[:, 0] - x.min()) / field.pitch_x_m
    along = np.maximum(y.max() - patches.point_m[:, 1], patches.point_m[:, 1] - y.min()) / field.pitch_y_m
    where = patches.row, patches.column, patches.point_m[:, 2].copy(), np.maximum(across, along)
    return horizon_table(field, *where, accuracy.sectors)


def table_width(job: Job) -> int:
    """Bins from the shortest to the longest d3 + d4 of any patch, in whole vectors.

    The sum is convex over the wall: longest at a corner of the relay, and never shorter than the straight way to the
    mirrored lidar.
    """
    x, y, z = job.patches.point_m.T
    relay, lidar = job.relay, job.lidar_m
    longest = np.zeros_like(x)
    for corner_x in (relay.x_m.min(), relay.x_m.max()):
        for corner_y in (relay.y_m.min(), relay.y_m.max()):
            d3 = np.sqrt((x - corner_x) ** 2 + (y - corner_y) ** 2 + z**2)
            longest = np.maximum(longest, d3 + np.linalg.norm([corner_x - lidar[0], corner_y - lidar[1], lidar[2]]))
    shortest = np.sqrt((x - lidar[0]) ** 2 + (y - lidar[1]) ** 2 + (z + lidar[2]) ** 2)
    bins = int((longest - shortest).max() / job.bin_m) + 3
    return (bins + LANES - 1) // LANES * LANES
