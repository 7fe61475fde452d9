"""Torch backend on the CPU: batches and sums (laws compare whole renderings with the reference)."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from depth_maps import depth_map
from nlos_calibration.rig import load_rig

from nlos_cam.errors import SceneError
from nlos_cam.objects import object_box, object_depth
from nlos_cam.render import Accuracy, Scene, TransportJob, backend_torch, phong, prepare, render
from nlos_cam.render.backend_torch import lay_out, part, shade
from nlos_cam.render.geometry import NO_OCCLUDER
from nlos_cam.render.visibility import visible

CPU = torch.device("cpu")
RIG = load_rig("paper-rig")
SMALL = Accuracy("small", relay_columns=16, relay_rows=12, sub_bins=4)


def _scene(size: int = 12) -> Scene:
    plane = np.s_[2 : 2 + size, 2 : 2 + size], 0.2 + 0.01 * np.arange(size)
    return Scene(RIG, depth_map(16, np.nan, plane, ((5, 5), 0.15)))


def _job(scene: Scene, beams: int = 30, accuracy: Accuracy = SMALL) -> TransportJob:
    job = prepare(scene, accuracy, "auto").job
    return job.select(np.arange(0, len(job.laser_spot_m), len(job.laser_spot_m) // beams))


def test_counted_is_exact_in_any_order() -> None:
    generator = torch.Generator().manual_seed(0)
    at = torch.randint(0, 7, (5, 900), generator=generator)
    weight = 10 ** torch.empty(5, 900).uniform_(-9, 3, generator=generator)
    exact = torch.zeros(5, 7, dtype=torch.float64).scatter_add_(1, at, weight.double())
    found = backend_torch.counted(at, weight, 7)
    turned = torch.randperm(900, generator=generator)

    torch.testing.assert_close(found, exact.float(), rtol=1e-6, atol=0)
    assert torch.equal(backend_torch.counted(at[:, turned], weight[:, turned], 7), found)
    assert not backend_torch.counted(
        torch.zeros(2, 3, dtype=torch.int64), torch.zeros(2, 3), 4
    ).any()


def test_histograms_do_not_depend_on_the_chunk_size(monkeypatch: pytest.MonkeyPatch) -> None:
    job = _job(_scene())
    whole = backend_torch.histograms(job, CPU)
    monkeypatch.setattr(backend_torch, "CPU_CHUNK", 500)

    np.testing.assert_allclose(
        backend_torch.histograms(job, CPU), whole, rtol=1e-5, atol=1e-6 * whole.max()
    )


def _assert_as_alone(jobs: list[TransportJob]) -> None:
    for job, found in zip(jobs, backend_torch.histograms_of_all(jobs, CPU), strict=True):
        alone = backend_torch.histograms(job, CPU)
        assert found.shape == alone.shape == (len(job.laser_spot_m), job.bins)
        np.testing.assert_allclose(found, alone, rtol=1e-5, atol=1e-6 * alone.max())


def test_histograms_of_all_keep_the_order_of_jobs() -> None:
    """Two rigs in turn make a batch each; objects that shade and that do not share one."""
    bare = RIG.model_copy(update={"occluder": None})
    level = 0 * _scene().object_depth_m + np.float32(0.2)
    scenes = [
        _scene(),
        Scene(bare, level),
        Scene(RIG, level),
        Scene(bare, _scene(6).object_depth_m),
    ]
    jobs = [_job(scene) for scene in scenes]

    assert [job.field.shades for job in jobs] == [True, False, False, True]
    _assert_as_alone(jobs)
    assert backend_torch.histograms_of_all([], CPU) == []


CHANGES = {"edge_m": NO_OCCLUDER, "lambertian": True, "bin_m": 0.02, "receiver_cell_m2": 1.0}


@pytest.mark.parametrize(
    ("field", "value"), [*CHANGES.items(), ("accuracy", replace(SMALL, sub_bins=2))]
)
def test_jobs_that_differ_in_more_than_the_object_stay_apart(field: str, value: Any) -> None:
    job = _job(_scene(8))
    _assert_as_alone([job, replace(job, **{field: value})])


@pytest.mark.slow
@pytest.mark.parametrize("change", [{"brdf": phong(0.5, 0.5, 3.0)}, {"more_bounces": True}])
def test_jobs_with_brdf_or_interreflection_stay_apart(change: dict[str, Any]) -> None:
    jobs = [replace(_job(_scene(size), 10), **change) for size in (4, 3)]

    _assert_as_alone(jobs)

    for job in jobs:
        plain = backend_torch.histograms(replace(job, brdf=None, more_bounces=False), CPU)
        assert not np.allclose(backend_torch.histograms(job, CPU), plain, rtol=1e-3)


@pytest.mark.parametrize(
    ("memory", "least", "most"), [(4 << 30, 1 << 23, 1 << 24), (1 << 40, 1 << 27, 1 << 27)]
)
def test_chunk_fits_in_half_the_gpu_memory(
    monkeypatch: pytest.MonkeyPatch, memory: int, least: int, most: int
) -> None:
    monkeypatch.setattr(
        torch.cuda, "get_device_properties", lambda _: SimpleNamespace(total_memory=memory)
    )
    assert least <= backend_torch.chunk_for(torch.device("cuda")) <= most


def test_render_refuses_cuda_without_a_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SceneError, match="CUDA") as raised:
        render(_scene(), SMALL, backend="cuda")

    assert "\n" not in str(raised.value)


def _shading_job(depth: np.ndarray) -> TransportJob:
    accuracy = Accuracy("coarse", relay_columns=12, relay_rows=10)
    job = prepare(
        Scene(RIG, depth), accuracy, {"direct", "three-bounce", "self-occlusion", "tilt"}
    ).job
    return job.select(np.arange(0, len(job.laser_spot_m), 60))


def _shaded(
    jobs: list[TransportJob], job: TransportJob, first: int, chunk: int = 1 << 18
) -> np.ndarray:
    """Visibility (n, m) of the legs of a job, computed within a batch."""
    fields, sites = lay_out(jobs, CPU)
    count = len(job.patches.beta)
    weight = torch.ones(count, len(job.laser_spot_m))
    point = torch.as_tensor(job.patches.point_m).float()
    foot = torch.as_tensor(job.laser_spot_m).float()
    dx, dy = (foot[:, axis] - point[:, axis, None] for axis in (0, 1))
    shade(weight, dx, dy, part(sites, first, first + count), fields, chunk)
    return weight.numpy() > 0


@pytest.mark.slow
def test_shade_agrees_with_the_exact_walk_for_every_leg() -> None:
    """A ridge along either axis, scattered cells at any depth, and a generated object; alone and in
    a batch.
    """
    generator = np.random.default_rng(4)
    ridge = depth_map(32, 0.35, (np.s_[:, 15], 0.15))
    holes = generator.uniform(0.13, 0.39, (32, 32)).astype(np.float32)
    holes[generator.random((32, 32)) < 0.7] = np.nan
    thing = object_depth(3, object_box(RIG))[1][::2, ::2].copy()
    jobs = [_shading_job(depth) for depth in (ridge, ridge.T.copy(), holes, thing)]
    first = 0
    for job in jobs:
        p = job.patches
        found = _shaded([job], job, 0)
        sites = zip(p.row, p.column, p.point_m, strict=True)
        exact = np.array(
            [[visible(job.field, *site, x, y) for x, y, _ in job.laser_spot_m] for site in sites]
        )
        assert 0.02 < exact.mean() < 0.98
        assert (found != exact).mean() < 1e-4  # float32 at the edge of a shadow
        coarse = replace(job, accuracy=replace(job.accuracy, sectors=1))
        np.testing.assert_array_equal(_shaded([coarse], coarse, 0, 5000), found)
        np.testing.assert_array_equal(_shaded(jobs, job, first), found)
        first += len(p.beta)
