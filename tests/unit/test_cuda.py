import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from nlos_calibration.rig import load_rig
from torch.nn.functional import embedding_bag

from nlos_cam.errors import SceneError
from nlos_cam.render import backend_numba, backend_torch
from nlos_cam.render.accuracy import Accuracy
from nlos_cam.render.geometry import NO_OCCLUDER
from nlos_cam.render.job import TransportJob
from nlos_cam.render.material import phong
from nlos_cam.render.planning import Prepared
from nlos_cam.render.renderer import render
from nlos_cam.render.scene import Scene

CPU = torch.device("cpu")
RIG = load_rig("paper-rig")
SMALL = Accuracy("small", relay_columns=16, relay_rows=12, sub_bins=4)


def _scene(size: int = 12, step_m: float = 0.01) -> Scene:
    depth = np.full((16, 16), np.nan, np.float32)
    depth[2 : 2 + size, 2 : 2 + size] = 0.2 + step_m * np.arange(size)
    depth[5, 5] = 0.15
    return Scene(RIG, depth)


def _job(scene: Scene, beams: int = 30, accuracy: Accuracy = SMALL) -> TransportJob:
    job = Prepared.of(scene, accuracy, "auto").job()
    assert job is not None
    return job.some(np.arange(0, len(job.foot_m), len(job.foot_m) // beams))


def test_counting_adds_up_every_weight() -> None:
    generator = torch.Generator().manual_seed(0)
    at = torch.randint(0, 7, (5, 900), generator=generator)
    weight = 10 ** torch.empty(5, 900).uniform_(-9, 3, generator=generator)
    exact = torch.zeros(5, 7, dtype=torch.float64).scatter_add_(1, at, weight.double())
    torch.testing.assert_close(backend_torch.counted(at, weight, 7), exact.float(), rtol=1e-6, atol=0)


def test_counting_does_not_depend_on_the_order() -> None:
    generator = torch.Generator().manual_seed(1)
    at, weight = torch.randint(0, 3, (2, 4000), generator=generator), torch.rand(2, 4000, generator=generator)
    turned = torch.randperm(4000, generator=generator)
    assert torch.equal(backend_torch.counted(at, weight, 3), backend_torch.counted(at[:, turned], weight[:, turned], 3))


def test_counting_nothing_gives_nothing() -> None:
    assert not backend_torch.counted(torch.zeros(2, 3, dtype=torch.int64), torch.zeros(2, 3), 4).any()


@pytest.mark.parametrize("per_bin", [1, 4])
def test_tables_are_those_of_the_numba_renderer(per_bin: int) -> None:
    fine = np.random.default_rng(0).random((6, 5 * per_bin)).astype(np.float32)
    np.testing.assert_allclose(
        backend_torch.tables(torch.as_tensor(fine), per_bin).numpy(), backend_numba.tables(fine, per_bin), rtol=1e-5
    )


def test_a_shifted_sum_is_what_a_loop_says() -> None:
    generator = torch.Generator().manual_seed(2)
    table, weight = torch.rand(4, 2, 3, generator=generator), torch.rand(4, 5, generator=generator)
    shift, at = torch.randint(0, 2, (4, 5), generator=generator), torch.randint(0, 14, (4, 5), generator=generator)
    at[:, 4] = 13  # beyond the gate
    expected = torch.zeros(5, 12 + 3 + 2)
    for s in range(4):
        for p in range(5):
            expected[p, at[s, p] : at[s, p] + 3] += weight[s, p] * table[s, shift[s, p]]
    found = backend_torch.shifted_sum(table, shift.int(), at.int(), weight, 12)
    torch.testing.assert_close(found, expected[:, :12])  # what would come after the gate is cut


def test_the_gpus_kernel_sums_the_same_windows() -> None:
    generator = torch.Generator().manual_seed(3)
    windows = torch.rand(50, generator=generator).unfold(0, 8, 1)
    start, weight = torch.randint(0, 43, (6, 9), generator=generator), torch.rand(6, 9, generator=generator)
    bags = embedding_bag(start, windows, per_sample_weights=weight, mode="sum")
    torch.testing.assert_close(backend_torch.window_sums(windows, start, weight), bags)


def test_chunks_do_not_change_the_histograms(monkeypatch: pytest.MonkeyPatch) -> None:
    job = _job(_scene())
    whole = backend_torch.histograms(job, CPU)
    monkeypatch.setattr(backend_torch, "CPU_CHUNK", 500)
    np.testing.assert_allclose(backend_torch.histograms(job, CPU), whole, rtol=1e-5, atol=1e-6 * whole.max())


def test_jobs_come_back_in_their_order() -> None:
    """Two rigs in turn: each makes a batch of its own."""
    bare = RIG.model_copy(update={"occluder": None})
    scenes = [_scene(), Scene(bare, _scene().object_depth_m), _scene(4), Scene(bare, _scene(6).object_depth_m)]
    jobs = [_job(scene) for scene in scenes]
    for job, found in zip(jobs, backend_torch.histograms_of_all(jobs, CPU), strict=True):
        alone = backend_torch.histograms(job, CPU)
        assert found.shape == alone.shape == (len(job.foot_m), job.bins)
        np.testing.assert_allclose(found, alone, rtol=1e-5, atol=1e-6 * alone.max())


@pytest.mark.parametrize(
    "change",
    [
        {"edge_m": NO_OCCLUDER},
        {"lambertian": True},
        {"bin_m": 0.02},
        {"receiver_cell_m2": 1.0},
        {"accuracy": replace(SMALL, sub_bins=2)},
    ],
)
def test_jobs_that_differ_in_more_than_the_object_do_not_share_a_batch(change: dict[str, Any]) -> None:
    job = _job(_scene(8))
    other = replace(job, **change)
    found = backend_torch.histograms_of_all([job, other], CPU)
    np.testing.assert_allclose(found[1], backend_torch.histograms(other, CPU), rtol=1e-5, atol=1e-6 * found[1].max())


@pytest.mark.parametrize("change", [{"brdf": phong(0.5, 0.5, 3.0)}, {"more_bounces": True}])
def test_jobs_whose_tables_need_more_than_the_wall_stay_apart(change: dict[str, Any]) -> None:
    jobs = [replace(_job(_scene(size), 10), **change) for size in (4, 3)]
    for job, found in zip(jobs, backend_torch.histograms_of_all(jobs, CPU), strict=True):
        np.testing.assert_allclose(found, backend_torch.histograms(job, CPU), rtol=1e-5, atol=1e-6 * found.max())
        assert not np.allclose(
            found, backend_torch.histograms(replace(job, brdf=None, more_bounces=False), CPU), rtol=1e-3
        )


def test_objects_that_shade_and_that_do_not_share_a_batch() -> None:
    level = np.where(np.isnan(_scene().object_depth_m), np.nan, 0.2).astype(np.float32)
    jobs = [_job(Scene(RIG, level)), _job(_scene())]
    assert [job.field.shades for job in jobs] == [False, True]
    for job, found in zip(jobs, backend_torch.histograms_of_all(jobs, CPU), strict=True):
        np.testing.assert_allclose(found, backend_torch.histograms(job, CPU), rtol=1e-5, atol=1e-6 * found.max())


@pytest.mark.parametrize(("memory", "least", "most"), [(4 << 30, 1 << 23, 1 << 24), (1 << 40, 1 << 27, 1 << 27)])
def test_a_gpu_takes_what_fits_in_half_of_it(
    monkeypatch: pytest.MonkeyPatch, memory: int, least: int, most: int
) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _: SimpleNamespace(total_memory=memory))
    assert least <= backend_torch.chunk_for(torch.device("cuda")) <= most


def test_no_jobs_give_no_histograms() -> None:
    assert backend_torch.histograms_of_all([], CPU) == []


def test_without_a_gpu_cuda_is_refused_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SceneError, match="no CUDA device is here: choose cpu, or torch") as raised:
        render(_scene(), SMALL, backend="cuda")
    assert "\n" not in str(raised.value)


def test_torch_is_not_imported_before_it_is_asked_for() -> None:
    late = "import sys, nlos_cam.render.renderer; print('torch' in sys.modules)"
    ended = subprocess.run([sys.executable, "-c", late], capture_output=True, text=True, check=True, timeout=120)
    assert ended.stdout.strip() == "False"
