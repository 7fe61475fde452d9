"""Visibility on tensors, leg by leg against the walk that defines it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from nlos_calibration.rig import load_rig

from nlos_cam.objects.placement import object_depth
from nlos_cam.render.accuracy import Accuracy
from nlos_cam.render.backend_torch import lay_out, shade
from nlos_cam.render.job import TransportJob
from nlos_cam.render.planning import Prepared
from nlos_cam.render.scene import Scene
from nlos_cam.render.visibility import visible

CPU = torch.device("cpu")
RIG = load_rig("paper-rig")
SMALL = Accuracy("small", relay_columns=12, relay_rows=10)


def _job(depth: np.ndarray) -> TransportJob:
    job = Prepared.of(Scene(RIG, depth), SMALL, {"direct", "three-bounce", "self-occlusion", "tilt"}).job()
    assert job is not None
    return job.some(np.arange(0, len(job.foot_m), 60))


def _holes() -> np.ndarray:
    """Cells here and there at any depth: every step meets background."""
    generator = np.random.default_rng(4)
    depth = generator.uniform(0.13, 0.39, (24, 24)).astype(np.float32)
    depth[generator.random((24, 24)) < 0.7] = np.nan
    return depth


def _ridge() -> np.ndarray:
    depth = np.full((24, 24), 0.35, np.float32)
    depth[:, 15] = 0.15
    return depth


OBJECTS = {
    "ridge": _ridge(),
    "ridge along the rows": _ridge().T.copy(),
    "holes": _holes(),
    "object": object_depth(3, RIG.object_box)[1][::2, ::2].copy(),
}


def _shaded(jobs: list[TransportJob], job: TransportJob, first: int, chunk: int = 1 << 18) -> np.ndarray:
    """V (n, m) of a job's legs to its feet, worked out within a batch."""
    fields, sites = lay_out(jobs, CPU)
    count = len(job.patches.beta)
    weight = torch.ones(count, len(job.foot_m))
    point, foot = torch.as_tensor(job.patches.point_m).float(), torch.as_tensor(job.foot_m).float()
    dx, dy = (foot[:, axis] - point[:, axis, None] for axis in (0, 1))
    shade(weight, dx, dy, sites.part(first, first + count), fields, chunk)
    return weight.numpy() > 0


def _walked(job: TransportJob) -> np.ndarray:
    p, free = job.patches, np.zeros((len(job.patches.beta), len(job.foot_m)), bool)
    for s in range(len(p.beta)):
        for w, (x, y, _) in enumerate(job.foot_m):
            free[s, w] = visible(job.field, p.row[s], p.column[s], p.point_m[s], x, y)
    return free


@pytest.mark.parametrize("name", OBJECTS)
def test_every_leg_is_told_as_the_exact_walk_tells_it(name: str) -> None:
    job = _job(OBJECTS[name])
    exact = _walked(job)
    assert 0.02 < exact.mean() < 0.98
    assert (_shaded([job], job, 0) != exact).mean() < 1e-4  # float32, on the very edge of a shadow


def test_sectors_and_chunks_decide_time_and_not_the_result() -> None:
    job = _job(OBJECTS["holes"])
    coarse = replace(job, accuracy=replace(job.accuracy, sectors=1))
    assert np.array_equal(_shaded([job], job, 0), _shaded([coarse], coarse, 0, 5000))


def test_an_object_of_a_batch_is_shaded_by_itself_alone() -> None:
    jobs = [_job(OBJECTS[name]) for name in ("holes", "ridge")]
    assert np.array_equal(_shaded(jobs, jobs[1], len(jobs[0].patches.beta)), _shaded(jobs[1:], jobs[1], 0))


def test_one_cell_does_not_shade_itself() -> None:
    depth = np.full((8, 8), np.nan, np.float32)
    depth[3, 4] = 0.2
    job = replace(_job(depth), field=_job(depth).field._replace(shades=True))
    assert _shaded([job], job, 0).all()
