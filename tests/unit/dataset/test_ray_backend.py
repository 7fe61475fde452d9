"""Ray cluster as a farm of workers: each piece once, a bounded number in flight, one clear line for each failure."""

import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_farm import samples_of
from nlos_calibration import load_rig

import nlos_cam
from nlos_cam.dataset import DatasetPlan, ray_backend
from nlos_cam.dataset.ray_backend import PIECES_PER_CPU, RayFarm, make_piece
from nlos_cam.errors import SceneError, WorkersLostError

PLAN = DatasetPlan(load_rig("paper-rig"), 0)
PIECES = [range(k, k + 2) for k in range(0, 40, 2)]
LOCAL = """
import numpy as np
from nlos_calibration import load_rig
from nlos_cam.dataset import DatasetPlan, ray_farm
from nlos_cam.dataset.samples import make_samples
plan = DatasetPlan(load_rig("paper-rig"), 0, accuracy="draft")
made = dict(ray_farm("local")(plan, [range(0, 1), range(1, 3)]))
for piece, samples in made.items():
    for name, values in make_samples(plan, piece).items():
        np.testing.assert_array_equal(samples[name], values)
assert len(made) == 2
"""


class RayError(Exception):
    cause: Exception | None = None


class FakeRay:
    """The part of Ray that the farm uses, in this process; results arrive last first."""

    def __init__(self, fails: RayError | None = None) -> None:
        self.exceptions = SimpleNamespace(RayError=RayError)
        self.fails, self.running, self.most_waiting = fails, False, 0

    def init(self, address: str, **_: object) -> None:
        if address == "nowhere":
            raise ConnectionError("could not\nfind any running Ray instance")
        self.running = True

    def shutdown(self) -> None:
        self.running = False

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 2.0}

    def remote(self, **options: object) -> Callable[..., Any]:
        assert options == {"num_cpus": 1, "max_retries": ray_backend.MAX_RETRIES}
        return lambda work: SimpleNamespace(remote=lambda *arguments: (work, arguments))

    def wait(self, waiting: list[Any], num_returns: int) -> tuple[list[Any], list[Any]]:
        assert num_returns == 1
        self.most_waiting = max(self.most_waiting, len(waiting))
        return waiting[-1:], waiting[:-1]

    def get(self, ready: tuple[Callable[..., Any], tuple[Any, ...]]) -> Any:
        if self.fails:
            raise self.fails
        return ready[0](*ready[1])


@pytest.fixture(autouse=True)
def _nothing_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_backend, "make_samples", lambda _, piece: samples_of(piece))
    monkeypatch.setattr(ray_backend, "use_one_thread", lambda: None)


def test_ray_farm_makes_every_piece_once_and_leaves_cluster() -> None:
    ray = FakeRay()
    made = dict(RayFarm(ray, "auto")(PLAN, PIECES))
    assert sorted(made, key=lambda piece: piece.start) == PIECES
    for piece, samples in made.items():
        np.testing.assert_array_equal(samples["depth_m"], samples_of(piece)["depth_m"])
    assert ray.most_waiting == 2 * PIECES_PER_CPU
    assert not ray.running
    making = RayFarm(ray, "auto")(PLAN, PIECES)
    next(making)
    assert ray.running
    making.close()
    assert not ray.running


def test_ray_farm_refuses_missing_cluster() -> None:
    assert list(RayFarm(FakeRay(), "nowhere")(PLAN, [])) == []  # nothing to make needs no cluster
    with pytest.raises(WorkersLostError, match="nowhere") as caught:
        list(RayFarm(FakeRay(), "nowhere")(PLAN, PIECES))
    assert "\n" not in str(caught.value)


def test_ray_farm_raises_error_of_failed_or_lost_worker() -> None:
    failed = RayError("a long traceback")
    failed.cause = SceneError("cup.stl is empty")
    with pytest.raises(SceneError, match=r"^cup\.stl is empty$"):
        list(RayFarm(FakeRay(failed), "auto")(PLAN, PIECES))
    ray = FakeRay(RayError("the worker\ndied"))
    with pytest.raises(WorkersLostError, match="the worker died"):
        list(RayFarm(ray, "auto")(PLAN, PIECES))
    assert not ray.running


def test_ray_worker_of_another_version_is_refused() -> None:
    assert make_piece(PLAN, range(1), nlos_cam.__version__).keys() == samples_of(range(1)).keys()
    with pytest.raises(SceneError, match=rf"{nlos_cam.__version__}.*9\.9"):
        make_piece(PLAN, range(1), "9.9")


@pytest.mark.slow
@pytest.mark.skipif(find_spec("ray") is None, reason="needs Ray (the extra `many`)")
def test_local_cluster_makes_equal_samples() -> None:
    """Runs in a process of its own, since Ray leaves threads behind."""
    done = subprocess.run([sys.executable, "-c", LOCAL], capture_output=True, text=True, check=False, timeout=280)
    assert done.returncode == 0, done.stdout + done.stderr
